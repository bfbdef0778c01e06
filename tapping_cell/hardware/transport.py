"""What a driver needs of the line to its device; the drivers know time only through it."""

from __future__ import annotations

from typing import Protocol


class Connection(Protocol):
    """A way to one device that can be opened, closed and stopped.

    All calls but ``stop`` belong to one thread. Every call that waits for the device or sends
    something to it raises HardwareFault: DISCONNECTED when the device is gone, STOPPED while a stop
    is latched.
    """

    @property
    def name(self) -> str:
        """The port's path or the controller's name, for messages."""

    @property
    def is_open(self) -> bool:
        """Whether it is open as far as known."""

    def now(self) -> float:
        """The steady clock, s."""

    def open(self, timeout: float) -> None:
        """Open anew (closing first), waiting up to ``timeout`` s for the port or the controller.

        Raises HardwareFault: PORT_MISSING, PORT_BUSY.
        """

    def close(self) -> None:
        """Close; never raises."""

    def stop(self, data: bytes) -> bool:
        """From any thread: latch the stop and send ``data`` at once, before anything else waiting.

        Returns whether the stop went out. Until ``release`` every call that waits or sends raises
        STOPPED.
        """

    def release(self) -> None:
        """End the latch of ``stop``."""


class Transport(Connection, Protocol):
    """A byte line to one device."""

    def sleep(self, duration: float) -> None:
        """Let ``duration`` s pass, stop or not."""

    def read(self, timeout: float) -> bytes:
        """The bytes at hand, waiting up to ``timeout`` s for the first; empty when none came."""

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        """Write all of ``data``; raises HardwareFault TIMEOUT if the port takes no more for that
        long."""
