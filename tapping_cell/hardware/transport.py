"""What a driver needs of the line to its device; the drivers know time only through it."""

from __future__ import annotations

from typing import Protocol


class Transport(Protocol):
    """A byte line to one device.

    All calls but ``stop`` belong to one thread. Every call but ``now``, ``sleep``, ``close`` and
    ``stop`` raises HardwareFault: DISCONNECTED when the line is gone, STOPPED while a stop is
    latched.
    """

    @property
    def name(self) -> str:
        """The port's path, for messages."""

    @property
    def is_open(self) -> bool:
        """Whether the line is open as far as known."""

    def now(self) -> float:
        """The steady clock, s."""

    def sleep(self, duration: float) -> None:
        """Let ``duration`` s pass, stop or not."""

    def open(self, timeout: float) -> None:
        """Open the line anew (closing it first), waiting up to ``timeout`` s for the port.

        Raises HardwareFault: PORT_MISSING, PORT_BUSY.
        """

    def close(self) -> None:
        """Close the line; never raises."""

    def read(self, timeout: float) -> bytes:
        """The bytes at hand, waiting up to ``timeout`` s for the first; empty when none came."""

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        """Write all of ``data``; raises HardwareFault TIMEOUT if the port takes no more for that
        long."""

    def stop(self, data: bytes) -> bool:
        """From any thread: latch the stop and write ``data`` at once, before anything else waiting.

        Returns whether the bytes went out. Until ``release`` every read and write raises STOPPED.
        """

    def release(self) -> None:
        """End the latch of ``stop``."""
