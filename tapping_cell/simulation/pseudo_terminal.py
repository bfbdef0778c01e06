"""Emulated device on a real pseudo-terminal that drivers open by a path."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

from tapping_cell.simulation.device_emulator import DeviceEmulator

LONGEST_SLEEP = 0.05
"""Longest real time between updates of an idle emulator, s."""
UNREAD_LIMIT = 65536
"""Maximum number of bytes kept for a driver that does not read; further bytes are lost, as on a
real line."""


class PortTakenError(RuntimeError):
    """The path belongs to a running process or is not a link to a pseudo-terminal."""


class PseudoTerminal:
    """Runs one emulator in a thread on a pseudo-terminal; ``path`` is a link to the terminal.

    The driver may close and open the path repeatedly. A lock file beside the path shows whether the
    process that owns the path is still running. A link left by a crashed process is replaced; the
    link of a running process is never replaced. The link points to a file descriptor of this
    process in ``/proc``, so it is dangling after a crash. A link to the path of the terminal would
    instead lead to another terminal as soon as the system reuses the terminal's number. Use this
    class as a context manager, or call ``open`` and ``close``.

    ``clock`` returns the emulator's time in s and runs ``time_scale`` times as fast as real time.
    ``reset_on_open``: opening the port restarts the board, as the DTR line does on many boards.
    """

    def __init__(
        self,
        emulator: DeviceEmulator,
        path: str | Path,
        clock: Callable[[], float] = time.monotonic,
        time_scale: float = 1.0,
        reset_on_open: bool = False,
    ) -> None:
        self.emulator = emulator
        self.path = Path(path)
        self.lock = threading.RLock()
        """Held while the emulator works; hold it to access the emulator from another thread."""
        self._clock = clock
        self._time_scale = time_scale
        self._reset_on_open = reset_on_open
        self._guard: int | None = None
        self._master: int | None = None
        self._slave: int | None = None
        self._linked: int | None = None
        self._opened = False
        self._unsent = bytearray()
        self._wake_read, self._wake_write = -1, -1
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> PseudoTerminal:
        self.open()
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def open(self) -> None:
        """Claim the path, create the terminal and start the thread; raises PortTakenError."""
        self._guard = self._take_path()
        self._wake_read, self._wake_write = os.pipe()
        self._stop.clear()
        self.plug_in()
        self._thread = threading.Thread(target=self._run, name=f"pty {self.path}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop, close the terminal and remove the link; may be called twice."""
        if self._guard is None:
            return
        self._stop.set()
        self._wake()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.hang_up()
        os.close(self._wake_read)
        os.close(self._wake_write)
        with contextlib.suppress(FileNotFoundError):
            self._guard_path.unlink()
        os.close(self._guard)
        self._guard = None

    def hang_up(self) -> None:
        """Simulate unplugging: the device and the link disappear."""
        with self.lock:
            if self._master is None:
                return
            for descriptor in (self._master, self._slave, self._linked):
                if descriptor is not None:
                    os.close(descriptor)
            self._master = self._slave = self._linked = None
            self._unsent.clear()
            with contextlib.suppress(FileNotFoundError):
                self.path.unlink()
        self._wake()

    def plug_in(self) -> None:
        """Simulate plugging in again, usually under another device number."""
        with self.lock:
            if self._master is not None:
                return
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            # With O_PATH, the descriptor refers to the file but does not keep the terminal open.
            self._linked = os.open(os.ttyname(slave), os.O_PATH | os.O_CLOEXEC)
            if self._reset_on_open:
                # This process keeps no other descriptor of the driver's end, so that it can detect
                # when a driver opens the terminal.
                os.close(slave)
            else:
                self._slave = slave
            self._master = master
            self._opened = False
            fresh = self.path.with_name(self.path.name + ".new")
            with contextlib.suppress(FileNotFoundError):
                fresh.unlink()
            fresh.symlink_to(f"/proc/{os.getpid()}/fd/{self._linked}")
            os.replace(fresh, self.path)
        self._wake()

    @property
    def _guard_path(self) -> Path:
        return self.path.with_name(self.path.name + ".lock")

    def _take_path(self) -> int:
        """Claim the path by locking its lock file; return the descriptor of the lock file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        while True:
            guard = os.open(self._guard_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                fcntl.flock(guard, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(guard)
                raise PortTakenError(
                    f"{self.path} belongs to a running process: end it or choose another path"
                ) from error
            try:
                # The previous owner may have removed the lock file after it was opened and before
                # it was locked here. The lock is then useless, so try again.
                current = os.stat(self._guard_path).st_ino == os.fstat(guard).st_ino
            except FileNotFoundError:
                current = False
            if current:
                break
            os.close(guard)
        if os.path.lexists(self.path) and not self.path.is_symlink():
            self._guard_path.unlink()
            os.close(guard)
            raise PortTakenError(
                f"{self.path} exists and is not a link to a terminal: choose another path"
            )
        return guard

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"w")

    def _run(self) -> None:
        while not self._stop.is_set():
            with self.lock:
                wait = self._serve()
                master = self._master
            poller = select.poll()
            poller.register(self._wake_read, select.POLLIN)
            if master is not None and (self._opened or not self._reset_on_open):
                poller.register(master, select.POLLIN | (select.POLLOUT if self._unsent else 0))
            for descriptor, _ in poller.poll(max(wait, 0.0) * 1e3):
                if descriptor == self._wake_read:
                    os.read(self._wake_read, 4096)

    def _serve(self) -> float:
        """Transfer bytes and advance the emulator; return the time until the next event, s."""
        now = self._clock()
        wait = LONGEST_SLEEP
        if self._master is not None:
            if self._reset_on_open:
                wait = min(wait, self._watch_open(self._master, now))
            with contextlib.suppress(BlockingIOError, OSError):
                # An OSError means that the driver has closed its end, so there is nothing to read.
                data = os.read(self._master, 4096)
                self.emulator.receive(data, now)
        self.emulator.advance(now)
        self._unsent += self.emulator.take_output(now)
        if self._master is not None and self._unsent:
            with contextlib.suppress(BlockingIOError, OSError):
                del self._unsent[: os.write(self._master, self._unsent)]
        if len(self._unsent) > UNREAD_LIMIT or self._master is None:
            self._unsent.clear()
        following = self.emulator.next_event()
        if following is not None:
            wait = min(wait, (following - self._clock()) / self._time_scale)
        return wait

    def _watch_open(self, master: int, now: float) -> float:
        """Restart the board if a driver has opened the port; return the time until the next check,
        s."""
        poller = select.poll()
        poller.register(master, select.POLLIN)
        hung = any(event & select.POLLHUP for _, event in poller.poll(0))
        if hung:
            self._opened = False
            return 0.01
        if not self._opened:
            self._opened = True
            tty.setraw(master)
            self._unsent.clear()
            self.emulator.power_cycle(now)
        return LONGEST_SLEEP
