"""What the arm's driver needs of a controller's language."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from tapping_cell.hardware.finding import Finding

AXIS_COUNT = 4


Axes = tuple[float, ...]
"""Axis values in the controller's units (``ArmDialect.units``), in the order of the joints."""


class StraightMove(NamedTuple):
    """A straight absolute move."""

    target: Axes
    feed: float
    """Speed along the line, units/min."""


@dataclass(frozen=True, slots=True)
class Firmware:
    """Who answered on connect."""

    name: str
    version: str
    continued: bool
    """True when the controller proved that it was not reset since this driver last set it up."""
    remarks: tuple[str, ...] = ()
    """What a person should know of this firmware's build, in sentences."""


@dataclass(frozen=True, slots=True)
class AxisReading:
    """One reading of the controller."""

    axes: Axes
    moving: bool
    alarm: str
    """Empty, or why the controller refuses to move."""
    measured: bool
    """False where the controller can only say what it was commanded (Marlin's ``M114``)."""
    asked: float
    """Time of the transport's clock just before the question was sent, s."""
    powerless: bool = False
    """The motors may be, or have been, without power: the position is not known."""


@dataclass(slots=True)
class LineCounters:
    """What happened on the line since the driver was made."""

    retries: int = 0
    resends: int = 0
    timeouts: int = 0
    bad_lines: int = 0


class ArmDialect(Protocol):
    """A controller's language over one transport. Deadlines are times of the transport's clock.

    Every call raises HardwareFault: TIMEOUT, DISCONNECTED, STOPPED, ALARM, BOARD_RESET, REJECTED.
    """

    counters: LineCounters

    @property
    def units(self) -> Sequence[float]:
        """Units of each axis to one rad or m of its joint."""

    @property
    def stop_bytes(self) -> bytes:
        """What stops the motion at once, sent outside the queue."""

    def connect(self, deadline: float) -> Firmware:
        """Talk to the controller on a line just opened.

        Raises UNKNOWN_FIRMWARE and SETTINGS_MISMATCH as well.
        """

    def inspect(self, deadline: float) -> tuple[Firmware, list[Finding]]:
        """Who is on the line and how its settings compare with what is needed; nothing moves."""

    def store(self, finding: Finding, deadline: float) -> None:
        """Send the command of a finding; ValueError for one that only a person may mend."""

    def read(self, deadline: float) -> AxisReading:
        """Ask where the axes are."""

    def start_moves(self, moves: Sequence[StraightMove], deadline: float) -> None:
        """Send moves that follow each other; returns once they are taken."""

    def finish_move(self, expected_end: float, deadline: float) -> AxisReading:
        """Wait until nothing moves any more; asks little before ``expected_end``.

        The reading is one report: what differs from the target must be read again to be believed.
        """

    def idle(self, duration: float) -> None:
        """Listen for up to ``duration`` s without asking anything."""

    def home(self, axes: Axes | None, deadline: float) -> None:
        """Run the firmware's own homing cycle, prove that it ran, declare its end to be ``axes``.

        ``axes`` None keeps the firmware's own values. Raises HOMING_FAILED.
        """

    def set_position(self, axes: Axes, deadline: float) -> None:
        """Declare where the axes stand."""

    def clear(self, deadline: float) -> None:
        """After a stop or an alarm: bring the controller back to where it takes moves."""
