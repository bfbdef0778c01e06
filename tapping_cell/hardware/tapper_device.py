"""What every driver of a tapper can do, whatever fires the striker."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tapping_cell.hardware.tapper import FireResult, TapperCounters
from tapping_cell.hardware.tapper_protocol import Reply


class TapperDevice(Protocol):
    """One tapper; see :class:`~tapping_cell.hardware.tapper.TapperDriver` for what each call does
    and raises."""

    counters: TapperCounters
    last_reply: Reply | None

    @property
    def version(self) -> str:
        """The firmware's version, or what stands in its place."""

    def connect(self, timeout: float = 5.0) -> Reply:
        """Open the way to it, which discharges it."""

    def close(self) -> None:
        """Use it no more; it is discharged."""

    def status(self) -> Reply:
        """Ask for its state."""

    def charge(
        self,
        shot: int,
        energy: float,
        go_on: Callable[[], bool] = lambda: True,
        timeout: float = 5.0,
        channel: int = 0,
    ) -> Reply:
        """Get ready for a shot with an energy in J, on a channel."""

    def fire(self, shot: int, window: float, still_allowed: Callable[[float], bool]) -> FireResult:
        """Fire the shot once, or not at all."""

    def discharge(self) -> Reply:
        """End the readiness without a release."""

    def stop(self) -> bool:
        """From any thread: stop at once."""

    def clear(self, timeout: float = 5.0) -> Reply:
        """End a stop."""
