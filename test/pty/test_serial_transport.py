"""The serial port: exclusive access, disconnection in several ways, reconnection by path, and an
immediate stop."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.hardware.tapper import TapperDriver
from tapping_cell.simulation.pseudo_terminal import PortTakenError, PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator


class RawTerminal:
    """A plain pseudo-terminal whose other end the test holds."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.plug()

    def plug(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.link.symlink_to(os.ttyname(self.slave))

    def unplug(self) -> None:
        os.close(self.master)
        os.close(self.slave)
        self.link.unlink()


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[RawTerminal]:
    port = RawTerminal(tmp_path / "by-id")
    yield port
    if port.link.is_symlink():
        port.unplug()


def test_bytes_are_transferred_in_both_directions(terminal: RawTerminal) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    transport.write(b"hello\x00\xff\n")
    assert os.read(terminal.master, 100) == b"hello\x00\xff\n"
    os.write(terminal.master, b"\r\nback\x11\x13")
    assert transport.read(1) == b"\r\nback\x11\x13"
    before = time.monotonic()
    assert transport.read(0.1) == b""
    assert time.monotonic() - before > 0.09


def test_a_second_program_is_refused(terminal: RawTerminal) -> None:
    first, second = (SerialTransport(str(terminal.link)) for _ in range(2))
    first.open(1)
    with pytest.raises(HardwareFault, match="in use by another program") as caught:
        second.open(0)
    assert caught.value.reason is FaultReason.PORT_BUSY
    assert f"process {os.getpid()}: " in str(caught.value)
    first.close()
    second.open(1)


def test_a_missing_port_is_named(tmp_path: Path) -> None:
    transport = SerialTransport(str(tmp_path / "nothing"))
    with pytest.raises(HardwareFault, match="nothing cannot be opened") as caught:
        transport.open(0.1)
    assert caught.value.reason is FaultReason.PORT_MISSING
    with pytest.raises(HardwareFault, match="connect first"):
        transport.read(0)


@pytest.mark.parametrize("call", ["read", "write"])
def test_an_unplugged_port_is_detected_and_found_again(terminal: RawTerminal, call: str) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    terminal.unplug()
    with pytest.raises(HardwareFault) as caught:
        for _ in range(3):
            transport.read(0.1) if call == "read" else transport.write(b"x")
    assert caught.value.reason is FaultReason.DISCONNECTED
    assert not transport.is_open
    back = threading.Timer(0.3, terminal.plug)
    back.start()
    transport.open(20)
    os.write(terminal.master, b"again")
    assert transport.read(1) == b"again"
    back.join()


def test_unplugged_while_waiting(terminal: RawTerminal) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    timer = threading.Timer(0.2, terminal.unplug)
    timer.start()
    with pytest.raises(HardwareFault) as caught:
        transport.read(5)
    assert caught.value.reason is FaultReason.DISCONNECTED
    timer.join()


def test_a_full_line_is_written_in_pieces(terminal: RawTerminal) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    data = bytes(range(256)) * 400  # 100 kB, which is far more than a terminal buffers
    received = bytearray()

    def drain() -> None:
        while len(received) < len(data):
            received.extend(os.read(terminal.master, 999))

    reader = threading.Thread(target=drain)
    reader.start()
    transport.write(data, timeout=20)
    reader.join()
    assert bytes(received) == data


def test_a_blocked_write_ends_at_its_deadline(terminal: RawTerminal) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    before = time.monotonic()
    with pytest.raises(HardwareFault, match="accepted no data for 0.2 s") as caught:
        transport.write(bytes(1_000_000), timeout=0.2)
    assert caught.value.reason is FaultReason.TIMEOUT
    assert time.monotonic() - before > 0.19


def test_stop_is_sent_at_once_and_nothing_after_it(terminal: RawTerminal) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    failures: list[HardwareFault] = []

    def wait() -> None:
        try:
            transport.read(10)
        except HardwareFault as fault:
            failures.append(fault)

    worker = threading.Thread(target=wait)
    worker.start()
    time.sleep(0.05)
    # The other thread waits for 10 s, and the stop must not wait for it.
    assert transport.stop(b"!\x18")
    assert os.read(terminal.master, 10) == b"!\x18"
    assert not failures or failures[0].reason is FaultReason.STOPPED
    worker.join(60)
    assert [fault.reason for fault in failures] == [FaultReason.STOPPED]
    for call in (lambda: transport.write(b"G1"), lambda: transport.read(0)):
        with pytest.raises(HardwareFault) as caught:
            call()
        assert caught.value.reason is FaultReason.STOPPED
    transport.release()
    transport.write(b"next")
    assert os.read(terminal.master, 10) == b"next"


def test_stop_between_the_pieces_of_a_long_write(terminal: RawTerminal) -> None:
    transport = SerialTransport(str(terminal.link))
    transport.open(1)
    failures: list[FaultReason] = []

    def write() -> None:
        try:
            transport.write(b"a" * 1_000_000, timeout=20)
        except HardwareFault as fault:
            failures.append(fault.reason)

    worker = threading.Thread(target=write)
    worker.start()
    received = bytearray()
    while len(received) < 10_000:
        received.extend(os.read(terminal.master, 4096))
    stopped = threading.Thread(target=transport.stop, args=(b"!",))
    stopped.start()
    os.set_blocking(terminal.master, False)
    end = time.monotonic() + 60
    while time.monotonic() < end and (stopped.is_alive() or worker.is_alive()):
        try:
            received.extend(os.read(terminal.master, 4096))
        except BlockingIOError:
            time.sleep(0.001)
    worker.join(60)
    stopped.join(60)
    assert failures == [FaultReason.STOPPED]


def test_a_port_that_vanishes_while_it_is_set_up_is_missing(
    terminal: RawTerminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    def vanished(*_: object, **__: object) -> None:
        raise termios.error(errno.EIO, "Input/output error")

    monkeypatch.setattr(serial, "Serial", vanished)
    with pytest.raises(HardwareFault, match="cannot be opened") as caught:
        SerialTransport(str(terminal.link)).open(0)
    assert caught.value.reason is FaultReason.PORT_MISSING


def test_a_failed_connection_leaves_nothing_open_or_locked(tmp_path: Path) -> None:
    """Disconnect the cable at random times during forty attempts to connect, some of them to boards
    that do not answer."""
    draw = random.Random(5)
    path = tmp_path / "device"
    board = TapperEmulator(now=time.monotonic())
    mute = Silent()
    with PseudoTerminal(board, path) as port:
        driver = TapperDriver(SerialTransport(str(path)))
        driver.connect()
        driver.close()
        opened = len(os.listdir("/proc/self/fd"))
        for _ in range(40):
            with port.lock:
                port.emulator = mute if draw.random() < 0.3 else board
            pull = threading.Timer(draw.uniform(0.0, 0.02), port.hang_up)
            pull.start()
            with contextlib.suppress(HardwareFault):
                driver.connect(0.01)
                driver.status()
            pull.join()
            if driver.connected:
                with pytest.raises(HardwareFault):
                    driver.status()
            port.plug_in()
            # Another program can open the port.
            other = SerialTransport(str(path))
            other.open(0)
            other.close()
        with port.lock:
            port.emulator = board
        driver.close()
        assert len(os.listdir("/proc/self/fd")) == opened
        driver.connect()
        assert driver.status().state.value == "UNHOMED"
        driver.close()


OWNER = """
import sys, time
sys.path.insert(0, {root!r})
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator
with PseudoTerminal(TapperEmulator(now=time.monotonic()), {path!r}):
    print("there", flush=True)
    sys.stdin.read()
"""


def test_the_link_of_a_killed_owner_is_dangling(tmp_path: Path) -> None:
    """The terminal's number may soon be reused by another program, which a driver must not
    disturb."""
    path = tmp_path / "device"
    root = str(Path(__file__).resolve().parents[2])
    script = OWNER.format(root=root, path=str(path))
    owner = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert owner.stdout is not None and owner.stdout.readline() == b"there\n"
        driver = TapperDriver(SerialTransport(str(path)))
        driver.connect()
        driver.close()
    finally:
        owner.kill()
        owner.communicate()
    assert path.is_symlink() and not path.exists()
    terminals = [os.openpty() for _ in range(8)]
    with pytest.raises(HardwareFault) as caught:
        SerialTransport(str(path)).open(0)
    assert caught.value.reason is FaultReason.PORT_MISSING
    for pair in terminals:
        for descriptor in pair:
            os.close(descriptor)


class Silent:
    """An emulator that sends nothing."""

    def receive(self, data: bytes, now: float) -> None: ...

    def advance(self, now: float) -> None: ...

    def take_output(self, now: float) -> bytes:
        return b""

    def next_event(self) -> float | None:
        return None

    def power_cycle(self, now: float) -> None: ...


def test_a_path_in_use_or_foreign_is_refused_and_a_dangling_link_replaced(tmp_path: Path) -> None:
    path = tmp_path / "arm"
    path.symlink_to("/dev/pts/9999")
    with PseudoTerminal(Silent(), path):
        assert os.path.exists(path)
        with pytest.raises(PortTakenError, match="belongs to a running process"):
            PseudoTerminal(Silent(), path).open()
    assert list(tmp_path.iterdir()) == []
    path.write_text("a file of somebody's")
    with pytest.raises(PortTakenError, match="not a link to a terminal"):
        PseudoTerminal(Silent(), path).open()
    assert path.read_text() == "a file of somebody's"
