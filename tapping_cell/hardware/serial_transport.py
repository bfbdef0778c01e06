"""A :class:`~tapping_cell.hardware.transport.Transport` over a serial port with pyserial."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import termios
import threading
import time
from pathlib import Path

import serial
from serial.tools.list_ports import comports

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.port_names import port_problem

POLL_SLICE = 0.02
"""Longest wait between checks of the stop latch, s."""
REOPEN_PERIOD = 0.05
"""Time between attempts to open a missing or busy port, s."""


def known_ports() -> list[str]:
    """Return the serial ports of this computer, each with the system's description."""
    return [f"{port.device} ({port.description})" for port in comports()]


class SerialTransport:
    """One serial port, opened exclusively by its path or a symlink (``/dev/serial/by-id/...``).

    A symlink is resolved each time the port is opened, so a device is found again if it returns
    under another number. Deadlines are times of the steady clock.
    """

    def __init__(self, path: str, baud: int = 115200) -> None:
        self._path = path
        self._baud = baud
        self._port: serial.Serial | None = None
        # Held while a chunk is written. A stop is therefore sent between two chunks of a message,
        # and nothing is sent after it.
        self._lock = threading.Lock()
        self._stopped = False

    @property
    def name(self) -> str:
        """The path as given."""
        return self._path

    @property
    def is_open(self) -> bool:
        """True if the port is open, as far as is known."""
        return self._port is not None

    def now(self) -> float:
        """Return the time of the steady clock, s."""
        return time.monotonic()

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s, even during a stop."""
        time.sleep(duration)

    def open(self, timeout: float) -> None:
        """Open the port exclusively in raw mode, waiting up to ``timeout`` s for it.

        Old input is discarded. Raises HardwareFault: PORT_MISSING, PORT_BUSY, STOPPED.
        """
        self.close()
        deadline = self.now() + timeout
        while True:
            try:
                port = serial.Serial(
                    self._path, self._baud, timeout=0, write_timeout=0, exclusive=True
                )
            except (OSError, ValueError, termios.error) as error:
                # If a port is unplugged between opening and configuration, pyserial may raise other
                # exceptions than its SerialException, which is an OSError.
                if self.now() + REOPEN_PERIOD > deadline:
                    raise self._open_fault(error) from error
                time.sleep(REOPEN_PERIOD)
                continue
            with self._lock:
                self._port = port
            return

    def close(self) -> None:
        """Close the port; never raises."""
        with self._lock:
            port, self._port = self._port, None
        if port is not None:
            # Closing a port whose device was unplugged may fail.
            with contextlib.suppress(OSError):
                port.close()

    def read(self, timeout: float) -> bytes:
        """Return the available bytes, waiting up to ``timeout`` s for the first; may be empty."""
        deadline = self.now() + timeout
        while True:
            if self._stopped:
                raise _stopped_fault(self._path)
            port = self._require_port()
            wait = min(max(deadline - self.now(), 0.0), POLL_SLICE)
            try:
                readable, _, _ = select.select([port], [], [], wait)
                if readable:
                    # If the device was unplugged, `in_waiting` raises a plain OSError and `read` a
                    # SerialException. At end of file, the port is readable although `in_waiting` is
                    # 0, so at least one byte is requested.
                    return bytes(port.read(max(port.in_waiting, 1)))
            except (OSError, ValueError, TypeError) as error:
                raise self._close_after(error) from error
            if self.now() >= deadline:
                return b""

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        """Write all of ``data`` in as many chunks as the port accepts.

        Raises HardwareFault: TIMEOUT if nothing could be written for ``timeout`` s, DISCONNECTED,
        STOPPED.
        """
        rest = memoryview(data)
        deadline = self.now() + timeout
        while rest:
            with self._lock:
                if self._stopped:
                    raise _stopped_fault(self._path)
                port = self._require_port()
                count = self._write_some(port, rest)
            if count:
                rest = rest[count:]
                deadline = self.now() + timeout
            elif self.now() > deadline:
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"{self._path} accepted no data for {timeout:g} s while {len(rest)} bytes were "
                    "still to be sent: check the cable and the flow control, then clear the fault",
                )
            else:
                self._wait_writable(port)

    def stop(self, data: bytes) -> bool:
        """Latch the stop and write ``data`` ahead of everything else. May be called from any
        thread."""
        with self._lock:
            self._stopped = True
            port = self._port
            if port is None:
                return False
            try:
                return self._write_some(port, memoryview(data)) == len(data)
            except HardwareFault:
                return False

    def release(self) -> None:
        """Release the latch of ``stop``."""
        with self._lock:
            self._stopped = False

    def _require_port(self) -> serial.Serial:
        port = self._port
        if port is None:
            raise HardwareFault(
                FaultReason.DISCONNECTED, f"{self._path} is not open: connect first"
            )
        return port

    def _write_some(self, port: serial.Serial, data: memoryview) -> int:
        """Write without blocking; return the number of bytes written, 0 if the port is full."""
        try:
            # pyserial's `write` busy-waits while the output buffer is full, so it is called only if
            # the port is writable.
            _, writable, _ = select.select([], [port], [], 0)
            return int(port.write(data) or 0) if writable else 0
        except (OSError, ValueError, TypeError) as error:
            raise self._close_after(error) from error

    def _wait_writable(self, port: serial.Serial) -> None:
        try:
            select.select([], [port], [], POLL_SLICE)
        except (OSError, ValueError, TypeError) as error:
            raise self._close_after(error) from error

    def _close_after(self, error: Exception) -> HardwareFault:
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError):
                port.close()
        return HardwareFault(
            FaultReason.DISCONNECTED,
            f"{self._path} disappeared ({error}): check the cable and power; the driver opens "
            "it again when it returns",
        )

    def _open_fault(self, error: Exception) -> HardwareFault:
        code = getattr(error, "errno", None)
        if code in (errno.EAGAIN, errno.EBUSY):
            return HardwareFault(
                FaultReason.PORT_BUSY,
                f"{self._path} is in use by another program{_holder(self._path)}: end that "
                "program, then connect again",
            )
        if code == errno.EACCES:
            return HardwareFault(
                FaultReason.PORT_MISSING,
                f"{self._path} may not be opened by this user: add the user to the group that owns"
                " it (often dialout) and log in again",
            )
        if problem := port_problem(self._path):
            return HardwareFault(
                FaultReason.PORT_MISSING, f"{self._path} cannot be opened: it {problem}"
            )
        return HardwareFault(
            FaultReason.PORT_MISSING,
            f"{self._path} cannot be opened ({error}): check the cable, power and the path in the"
            " configuration",
        )


def _holder(path: str) -> str:
    """Return the process that has locked the port, in brackets; empty if it is not known."""
    try:
        port = os.stat(path)
        place = f"{os.major(port.st_dev):02x}:{os.minor(port.st_dev):02x}:{port.st_ino}"
        for line in Path("/proc/locks").read_text().splitlines():
            words = line.split()
            if "FLOCK" in words and place in words and "->" not in words:
                number = words[words.index(place) - 1]
                command = Path(f"/proc/{number}/cmdline").read_bytes().replace(b"\0", b" ")
                return f" (process {number}: {command.decode(errors='replace').strip()[:80]})"
    except OSError:
        return ""
    return ""


def _stopped_fault(path: str) -> HardwareFault:
    return HardwareFault(
        FaultReason.STOPPED, f"{path}: a stop is latched: make the cell safe, then clear the fault"
    )
