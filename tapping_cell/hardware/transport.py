"""Interface of the connection to a device. The connection is also the drivers' only clock."""

from __future__ import annotations

from typing import Protocol


class Connection(Protocol):
    """Connection to one device that can be opened, closed and stopped.

    All calls except ``stop`` must come from one thread. Every call that waits for the device or
    sends to it raises HardwareFault: DISCONNECTED if the connection is lost, STOPPED while a stop
    is latched.
    """

    @property
    def name(self) -> str:
        """Path of the port or name of the controller, for messages."""

    @property
    def is_open(self) -> bool:
        """True if the connection is open, as far as is known."""

    def now(self) -> float:
        """Return the time of the steady clock, s."""

    def open(self, timeout: float) -> None:
        """Reopen the connection, waiting up to ``timeout`` s for the port or the controller.

        Raises HardwareFault: PORT_MISSING, PORT_BUSY.
        """

    def close(self) -> None:
        """Close; never raises."""

    def stop(self, data: bytes) -> bool:
        """Latch the stop and send ``data`` ahead of any waiting data. May be called from any
        thread.

        Returns whether the stop was sent. Until ``release``, every call that waits or sends raises
        STOPPED.
        """

    def release(self) -> None:
        """Release the latch of ``stop``."""


class Transport(Connection, Protocol):
    """A byte line to one device."""

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s, even during a stop."""

    def read(self, timeout: float) -> bytes:
        """Return the available bytes, waiting up to ``timeout`` s for the first; may be empty."""

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        """Write all of ``data``; raises HardwareFault TIMEOUT if the port accepts nothing for
        ``timeout`` s."""
