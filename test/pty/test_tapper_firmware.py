"""The tapper's real firmware: its logic on the host, its AVR binary in simavr with the driver."""

from __future__ import annotations

import binascii
import ctypes
import queue
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import FireOutcome, TapperDriver
from tapping_cell.hardware.tapper_protocol import State
from tapping_cell.simulation.tapper_emulator import TapperEmulator, TapperMachine

SOURCE = Path(__file__).resolve().parents[2] / "firmware" / "tapper"


def make(folder: Path, *targets: str) -> None:
    built = subprocess.run(
        ["make", "-s", "-C", str(SOURCE), f"BUILD={folder}", *targets],
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stdout + built.stderr


needs_compiler = pytest.mark.skipif(
    not (shutil.which("make") and shutil.which("cc")), reason="no make or no C compiler here"
)
needs_simavr = pytest.mark.skipif(
    not (
        shutil.which("avr-gcc")
        and shutil.which("cc")
        and Path("/usr/include/simavr/sim_avr.h").exists()
    ),
    reason="gcc-avr, avr-libc and libsimavr-dev are not all installed here",
)


@needs_compiler
def test_the_logic_on_the_host(tmp_path: Path) -> None:
    make(tmp_path, "test")


@pytest.mark.skipif(not shutil.which("avr-gcc"), reason="avr-gcc is not installed here")
@pytest.mark.parametrize("drive", ["SPRING", "SOLENOID"])
def test_it_builds_for_the_board(tmp_path: Path, drive: str) -> None:
    make(tmp_path, "all", f"DRIVE={drive}")
    assert (tmp_path / "tapper.hex").stat().st_size > 0


# The firmware and the emulated tapper, written apart, must answer alike.


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    folder = tmp_path_factory.mktemp("firmware")
    make(folder, "host-library")
    loaded = ctypes.CDLL(str(folder / "libtapper_host.so"))
    loaded.host_start.argtypes = [ctypes.c_uint32, ctypes.c_uint64, ctypes.c_uint32]
    loaded.host_output.restype = ctypes.c_char_p
    return loaded


def framed(body: str) -> bytes:
    data = body.encode()
    return b"@%s*%04X\n" % (data, binascii.crc_hqx(data, 0xFFFF))


sessions = st.sampled_from([7, 8])
shots = st.integers(0, 5)
bodies = st.one_of(
    st.just("HELLO"),
    st.just("STATUS"),
    st.just("DISARM"),
    st.just("CLEAR"),
    shots.map(lambda shot: f"FIRE,{shot}"),
    shots.map(lambda shot: f"ARM,{shot},{1000 * (shot % 3)},3000"),
    st.sampled_from(["ARM,1", "FIRE", "FIRE,x", "JUMP", "STATUS,1", "ARM,1,2000000,3000"]),
)
events = st.one_of(
    st.tuples(st.just("frame"), sessions, st.integers(0, 12), bodies),
    st.tuples(st.just("wait"), st.sampled_from([10, 90, 250, 600])),
    st.tuples(st.sampled_from(["!", "press", "open", "close"])),
)


@needs_compiler
@settings(max_examples=400, deadline=None)
@given(st.lists(events, max_size=40))
def test_firmware_and_emulator_answer_alike(
    library: ctypes.CDLL, script: list[tuple[object, ...]]
) -> None:
    draw_ms = 100
    emulator = TapperEmulator(
        TapperMachine(
            draw_time=draw_ms / 1e3,
            draw_time_per_root_joule=0.0,
            release_time=0.0,
            reply_latency=0.0,
            baud=10**9,
        ),
        boot=3,
    )
    library.host_start(3, 0, 0)
    now, drawn_at = 0, None
    for event in script:
        if event[0] == "wait":
            assert isinstance(event[1], int)
            target = now + event[1]
        else:
            target = now + 1
        while now < target:
            now += 1
            if drawn_at == now:
                library.host_set_drawn(now)
            library.host_poll(now)
        emulator.advance(now / 1e3)
        library.host_forget_output()
        draws = library.host_draws()
        if event[0] == "frame":
            line = framed(f"{event[1]},{event[2]},{event[3]}")
            emulator.receive(line, now / 1e3)
            library.host_receive(line, len(line), now)
        elif event[0] == "!":
            emulator.receive(b"!", now / 1e3)
            library.host_receive(b"!", 1, now)
        elif event[0] == "press":
            emulator.press_clear_button(now / 1e3)
            library.host_press_clear(now)
        elif event[0] in ("open", "close"):
            emulator.set_interlock(event[0] == "close", now / 1e3)
            library.host_set_interlock(event[0] == "close", now)
        if library.host_draws() != draws:
            drawn_at = now + draw_ms
        said = emulator.take_output(now / 1e3 + 1e-6).decode()
        told = library.host_output().decode()
        assert strip_version(told) == strip_version(said), (event, now)
        library.host_end_release(now)
        emulator.advance(now / 1e3 + 1e-6)


def strip_version(text: str) -> list[str]:
    """Replies without checksum, and without the version of a WELCOME."""
    bodies = [line.split("*")[0] for line in text.splitlines()]
    return [body.rsplit(",", 1)[0] if "WELCOME" in body else body for body in bodies]


# The AVR binary.


class Board:
    """The firmware in simavr, with handles on its inputs and an eye on its release output."""

    def __init__(self, folder: Path) -> None:
        self.process = subprocess.Popen(
            [str(folder / "simavr_board"), str(folder / "tapper.elf")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self.process.stdout is not None
        lines = iter(self.process.stdout.readline, "")
        self.port = next(line.split()[1] for line in lines if line.startswith("PORT"))
        self.edges: list[tuple[int, int]] = []
        self.times: queue.Queue[int] = queue.Queue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith("RELEASE"):
                _, level, at = line.split()
                self.edges.append((int(level), int(at)))
            elif line.startswith("TIME"):
                self.times.put(int(line.split()[1]))

    def tell(self, order: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(order + "\n")
        time.sleep(0.1)

    def clock(self) -> float:
        """The board's own time, s: behind the wall's where the machine is busy."""
        self.tell("time")
        return self.times.get(timeout=10.0) * 1e-6

    def rest(self, duration: float) -> None:
        """Wait until so much of the board's own time has passed, s."""
        end = self.clock() + duration
        while self.clock() < end:
            pass

    def pulses(self) -> list[int]:
        """Lengths of the release pulses, us."""
        ups = [at for level, at in self.edges if level]
        downs = [at for level, at in self.edges if not level and ups and at > ups[0]]
        return [down - up for up, down in zip(ups, downs, strict=False)]

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._reader.join()
        for stream in (self.process.stdin, self.process.stdout):
            assert stream is not None
            stream.close()


@pytest.fixture(scope="module")
def binaries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("avr")
    make(folder, "simavr")
    return folder


@pytest.fixture
def board(binaries: Path) -> Iterator[Board]:
    running = Board(binaries)
    yield running
    running.close()


@needs_simavr
def test_the_driver_fires_the_real_firmware_once(board: Board) -> None:
    driver = TapperDriver(SerialTransport(board.port))
    driver.connect()
    assert driver.version == "1.0.0"
    assert driver.arm(5, 0.002).state is State.DRAWN
    assert driver.fire(5).outcome is FireOutcome.FIRED
    board.rest(0.2)
    (pulse,) = board.pulses()
    assert pulse == pytest.approx(20_000, abs=100)
    with pytest.raises(HardwareFault) as caught:
        driver.fire(5)
    assert caught.value.reason is FaultReason.SHOT_SPENT
    board.rest(1.0)
    driver.arm(6, 0.002)
    assert driver.fire(6).outcome is FireOutcome.FIRED
    board.rest(0.2)
    assert len(board.pulses()) == 2


@needs_simavr
def test_the_real_firmware_disarms_stops_and_remembers(board: Board) -> None:
    transport = SerialTransport(board.port)
    driver = TapperDriver(transport)
    first = driver.connect().boot
    driver.arm(5, 0.002)
    board.rest(0.8)
    assert driver.fire(5).outcome is FireOutcome.NOT_FIRED
    driver.arm(6, 0.002)
    board.tell("interlock 0")
    assert driver.fire(6).outcome is FireOutcome.NOT_FIRED
    board.tell("interlock 1")
    board.rest(0.8)
    driver.arm(7, 0.002)
    assert driver.stop()
    with pytest.raises(HardwareFault) as caught:
        driver.clear()
    assert caught.value.reason is FaultReason.NEEDS_PERSON
    board.tell("clear 1")
    board.tell("clear 0")
    driver.clear()
    board.rest(0.8)
    driver.arm(8, 0.002)
    board.tell("reset")
    assert driver.fire(8).outcome is FireOutcome.UNKNOWN
    assert driver.connect().boot == first + 1
    second = TapperDriver(transport)
    second.connect()
    with pytest.raises(HardwareFault) as caught:
        second.arm(8, 0.002)
    assert caught.value.reason is FaultReason.SHOT_SPENT
    assert board.pulses() == []
