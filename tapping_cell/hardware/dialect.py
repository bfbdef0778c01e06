"""Interface between the arm driver and a controller's command language."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.line_quality import ReceivedBytes

AXIS_COUNT = 4


Axes = tuple[float, ...]
"""Axis values in the controller's units (``ArmDialect.units``), in joint order."""


class StraightMove(NamedTuple):
    """A straight absolute move."""

    target: Axes
    feed: float
    """Speed along the line, units/min."""


@dataclass(frozen=True, slots=True)
class Firmware:
    """Identity of the controller's firmware."""

    name: str
    version: str
    continued: bool
    """True if the controller proved that it was not reset since this driver last set it up."""
    remarks: tuple[str, ...] = ()
    """Remarks about this firmware build for the user."""


@dataclass(frozen=True, slots=True)
class AxisReading:
    """Axis positions and state as reported by the controller."""

    axes: Axes
    moving: bool
    alarm: str
    """Reason why the controller refuses to move; empty if it accepts moves."""
    measured: bool
    """False if the controller can only report the commanded position (Marlin's ``M114``)."""
    asked: float
    """Time of the transport's clock just before the request was sent, s."""
    powerless: bool = False
    """True if the motors are or may have been without power, so the position is unknown."""


@dataclass(slots=True)
class LineCounters:
    """Communication counters since the driver was created."""

    retries: int = 0
    resends: int = 0
    timeouts: int = 0
    lines: int = 0
    """Number of lines received."""
    bad_lines: int = 0
    """Number of received lines that were unreadable."""
    received: ReceivedBytes = field(default_factory=ReceivedBytes)


class ArmDialect(Protocol):
    """A controller's command language over one transport. Deadlines are times on the transport's
    clock.

    Every call raises HardwareFault: TIMEOUT, DISCONNECTED, STOPPED, ALARM, BOARD_RESET, REJECTED.
    """

    counters: LineCounters

    @property
    def units(self) -> Sequence[float]:
        """Controller units per rad or m of each joint."""

    @property
    def stop_bytes(self) -> bytes:
        """Bytes that stop the motion immediately, sent outside the queue."""

    @property
    def opening_stop_bytes(self) -> bytes:
        """Bytes that stop the motion of a controller that is not identified yet. A controller at
        rest must remain usable."""

    def connect(self, deadline: float) -> Firmware:
        """Identify and set up the controller on a newly opened line.

        Also raises UNKNOWN_FIRMWARE and SETTINGS_MISMATCH.
        """

    def inspect(self, deadline: float) -> tuple[Firmware, list[Finding]]:
        """Identify the firmware and compare its settings with the required ones; nothing moves."""

    def store(self, finding: Finding, deadline: float) -> None:
        """Send the command of ``finding`` to correct a setting; raises ValueError if only a person
        may change this setting."""

    def read(self, deadline: float) -> AxisReading:
        """Read the positions and state of the axes."""

    def start_moves(self, moves: Sequence[StraightMove], deadline: float) -> None:
        """Send consecutive moves; return when the controller has accepted them."""

    def finish_move(
        self, expected_end: float, deadline: float, within: Callable[[Axes], bool]
    ) -> AxisReading:
        """Wait until all motion has ended, with few queries before ``expected_end``.

        The returned reading is a single report, which may be garbled. A caller that finds a
        difference from the target must read again before it reports a fault. ``within``: whether a
        position is within the joint limits. If moves have no checksum, so that a garbled one may
        lead beyond a limit, two consecutive reports beyond a limit end the wait: the axes of the
        returned reading still move.
        """

    def idle(self, duration: float) -> None:
        """Process incoming data for up to ``duration`` s without sending a query."""

    def home(self, axes: Axes | None, deadline: float) -> None:
        """Run the firmware's homing cycle, verify that it ran, and declare its end position.

        ``axes``: end position; None keeps the firmware's own values. Raises HOMING_FAILED.
        """

    def set_position(self, axes: Axes, deadline: float) -> None:
        """Make the controller take ``axes`` as its current position, without a move.

        Raises HOMING_FAILED if the dialect does not support this.
        """

    def clear(self, deadline: float) -> None:
        """After a stop or an alarm, return the controller to a state that accepts moves."""
