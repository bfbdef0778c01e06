"""Common interface of the tapper drivers, independent of the firing mechanism."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from tapping_cell.hardware.tapper import FireResult, TapperCounters
from tapping_cell.hardware.tapper_protocol import Reply


class TapperDevice(Protocol):
    """One tapper; :class:`~tapping_cell.hardware.tapper.TapperDriver` documents the behaviour and
    the faults of each call."""

    @property
    def counters(self) -> TapperCounters:
        """Counters for diagnostics."""

    @property
    def last_reply(self) -> Reply | None:
        """Last reply of the tapper."""

    @property
    def version(self) -> str:
        """Firmware version, or a description for a device without firmware."""

    def connect(self, timeout: float = 5.0) -> Reply:
        """Connect to the tapper; this discharges the tapper."""

    def close(self) -> None:
        """Disconnect from the tapper; this discharges the tapper."""

    def status(self) -> Reply:
        """Query the state."""

    def charge(
        self,
        shot: int,
        energy: float,
        go_on: Callable[[], bool] = lambda: True,
        timeout: float = 5.0,
        channel: int = 0,
    ) -> Reply:
        """Prepare a shot with an energy in J on a channel."""

    def fire(self, shot: int, window: float, still_allowed: Callable[[float], bool]) -> FireResult:
        """Fire the shot once, or not at all."""

    def discharge(self) -> Reply:
        """Discharge without a release."""

    def stop(self) -> bool:
        """Stop immediately; from any thread."""

    def clear(self, timeout: float = 5.0) -> Reply:
        """Clear a stop."""


class MountedTappers(TapperDevice, Protocol):
    """Tappers at fixed mounts, whose boards detect the strikers at their mounts."""

    def home(self, go_on: Callable[[], bool] = lambda: True) -> Reply:
        """Verify the strikers' positions."""

    def wait_for_return(self, go_on: Callable[[], bool] = lambda: True) -> Reply:
        """Wait until a released striker is back."""
