"""Several tappers on one board: firmware and emulator give the same answers, and the driver works
over a line."""

from __future__ import annotations

import binascii
import ctypes
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import FireOutcome, TapperDriver
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import OLD_VERSION, TapperEmulator, TapperMachine

SOURCE = Path(__file__).resolve().parents[2] / "firmware" / "tapper"
needs_compiler = pytest.mark.skipif(
    not (shutil.which("make") and shutil.which("cc")), reason="no make or no C compiler here"
)
COILS = 4
FLIGHT_MS = 300
START_MS = 5000
EDGE_MS = 12
"""Replies are not compared this close to a change of state, because both boards update once per
millisecond."""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("firmware")
    built = subprocess.run(
        ["make", "-s", "-C", str(SOURCE), f"BUILD={folder}", "host-library"],
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    loaded = ctypes.CDLL(str(folder / "libtapper_host.so"))
    loaded.host_start.argtypes = [
        ctypes.c_uint32,
        ctypes.c_uint64,
        ctypes.c_uint32,
        ctypes.c_double,
        ctypes.c_uint32,
    ]
    loaded.host_output.restype = ctypes.c_char_p
    return loaded


class BoardPair:
    """The firmware's logic and the emulated board, both with coils, which receive the same
    inputs."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self.library = library
        self.emulator = TapperEmulator(
            TapperMachine(coils=COILS, first_time_ms=START_MS, reply_latency=0.0, baud=10**9),
            boot=3,
        )
        self.emulator.coils.flight = FLIGHT_MS / 1e3
        library.host_coils(COILS)
        library.host_start(3, 0, START_MS, 0.0, 1)
        library.host_strikers(FLIGHT_MS, 0, 0, 0)
        self.faults = {"blocked": 0, "pulled": 0, "stuck": 0}
        self.now = 0
        self.sequence = 10

    def run(self, duration: int) -> None:
        """Let time pass, and continue until neither board is about to change its state."""
        end = self.now + duration
        while self.now < end:
            before = self.emulator.state
            due = self.emulator.next_event()
            self.now += 1
            self.emulator.advance(self.now / 1e3)
            if self.emulator.state != before:
                end = max(end, self.now + EDGE_MS)
            elif self.now >= end and due is not None and due * 1e3 < self.now + EDGE_MS:
                end += 1
        self.library.host_run(START_MS + self.now)

    def ask(self, words: str) -> tuple[list[str], list[str]]:
        """Return both answers without checksum and version."""
        self.library.host_forget_output()
        self.emulator.take_output(self.now / 1e3 + 1e-6)
        self.sequence += 1
        body = f"7,{self.sequence},{words}".encode()
        data = b"@%s*%04X\n" % (body, binascii.crc_hqx(body, 0xFFFF))
        self.library.host_receive(data, len(data), START_MS + self.now)
        self.emulator.receive(data, self.now / 1e3)
        emulated = self.emulator.take_output(self.now / 1e3 + 1e-6).decode()
        firmware = self.library.host_output().decode()
        return bodies(firmware), bodies(emulated)

    def fail(self, kind: str, channel: int, on: bool) -> None:
        bit = 1 << channel
        self.faults[kind] = self.faults[kind] | bit if on else self.faults[kind] & ~bit
        self.library.host_strikers(
            FLIGHT_MS, self.faults["blocked"], self.faults["pulled"], self.faults["stuck"]
        )
        coils = self.emulator.coils
        act = {"blocked": coils.block, "pulled": coils.keep_out, "stuck": coils.stick}[kind]
        act(channel, on)


def bodies(text: str) -> list[str]:
    frames = [line.split("*")[0] for line in text.splitlines()]
    return [frame.rsplit(",", 1)[0] if "WELCOME" in frame else frame for frame in frames]


channels = st.integers(0, COILS)
events = st.one_of(
    st.tuples(st.just("charge"), channels),
    st.tuples(st.just("fire"), channels),
    st.tuples(st.just("wait"), st.sampled_from([20, 150, 450])),
    st.tuples(st.just("say"), st.sampled_from(["HOME", "STATUS", "DISCHARGE", "HELLO", "CLEAR"])),
    st.tuples(
        st.just("fail"),
        st.sampled_from(["blocked", "pulled", "stuck"]),
        st.integers(0, COILS - 1),
        st.booleans(),
    ),
)


@needs_compiler
@settings(max_examples=150, deadline=None)
@given(st.lists(events, max_size=20))
def test_firmware_and_emulator_answer_alike_with_channels(
    library: ctypes.CDLL, script: list[tuple[object, ...]]
) -> None:
    boards = BoardPair(library)
    boards.run(EDGE_MS)
    for words in ("HELLO", "MODE,RUN", "HOME"):
        firmware, emulated = boards.ask(words)
        assert firmware == emulated
        boards.run(1)
    shot = 0
    for event in script:
        boards.run(int(str(event[1])) if event[0] == "wait" else EDGE_MS)
        match event:
            case ("charge", channel):
                shot += 1
                firmware, emulated = boards.ask(f"CHARGE,{shot},5000,3000,{channel}")
            case ("fire", channel):
                firmware, emulated = boards.ask(
                    f"FIRE,{shot},{START_MS + boards.now + 40},{channel}"
                )
            case ("say", words):
                firmware, emulated = boards.ask(str(words))
            case ("fail", kind, channel, on):
                if boards.emulator.coils.next_event() is None:  # no striker is moving
                    boards.fail(str(kind), int(str(channel)), bool(on))
                continue
            case _:
                firmware, emulated = boards.ask("STATUS")
        assert firmware == emulated, event


class Line:
    """A board on a pseudo-terminal with its driver."""

    def __init__(self, plug: Callable[..., PseudoTerminal], machine: TapperMachine) -> None:
        self.emulator = TapperEmulator(
            machine, on_fire=lambda shot, energy, at: 0.5, boot=4, now=time.monotonic()
        )
        self.port = plug(self.emulator)
        self.driver = TapperDriver(SerialTransport(str(self.port.path)))
        self.driver.connect()

    def fire(self, shot: int, channel: int) -> FireOutcome:
        self.driver.charge(shot, 0.01, channel=channel)
        return self.driver.fire(shot, 0.1, lambda release_by: True).outcome


def test_every_channel_fires_its_own_striker(plug: Callable[..., PseudoTerminal]) -> None:
    line = Line(plug, TapperMachine(coils=8))
    line.emulator.coils.flight = 0.1
    assert line.driver.channels == 8
    for channel in (3, 0, 7):
        assert line.fire(channel + 10 * len(line.emulator.fires) + 1, channel) is FireOutcome.FIRED
        assert line.emulator.channel == channel
        reply = line.driver.status()
        assert reply.channel == channel
        assert line.driver.wait_for_return().state is State.SAFE
        assert line.driver.status().at_mounts == 255
    assert len(line.emulator.fires) == 3


def test_a_striker_that_stays_extended_is_named(plug: Callable[..., PseudoTerminal]) -> None:
    line = Line(plug, TapperMachine(coils=8))
    line.driver.home()
    line.emulator.coils.keep_out(5, True)
    with pytest.raises(HardwareFault, match="channel 5") as caught:
        line.driver.charge(1, 0.01, channel=2)
    assert caught.value.reason is FaultReason.STRIKER_AWAY
    line.emulator.coils.keep_out(5, False)
    assert line.fire(2, 2) is FireOutcome.FIRED


@pytest.mark.parametrize("machine", [TapperMachine(), TapperMachine(version=OLD_VERSION)])
def test_a_board_with_one_channel_keeps_working(
    plug: Callable[..., PseudoTerminal], machine: TapperMachine
) -> None:
    line = Line(plug, machine)
    assert line.driver.channels == 1
    assert line.fire(1, 0) is FireOutcome.FIRED
    with pytest.raises(HardwareFault, match="channel 2") as caught:
        line.driver.charge(2, 0.01, channel=2)
    assert caught.value.reason is FaultReason.SETTINGS_MISMATCH
    assert len(line.emulator.fires) == 1
