"""Time for which the arm stands still for a shot; docs/safety.md derives it. Times in s."""

from __future__ import annotations

from tapping_cell.configuration.cell import LONGEST_FLIGHT_S, Cell

BEFORE_FLIGHT_S = 0.17
"""The arm stands still for this time plus the striker's time of flight. This constant covers the
requests to arm and board, the firing window and the firing pulse."""
RELEASE_S = 0.1
"""Minimum part of ``BEFORE_FLIGHT_S`` that must remain when the arm's answer arrives. It covers the
request to the board, the firing window and the firing pulse."""
SLOWNESS = 1.1
"""Maximum ratio of actual to predicted time of flight. The ratio is above 1, because friction and
errors of the energy curve can make the striker slower than predicted."""
LONGEST_HOLD_S = BEFORE_FLIGHT_S + SLOWNESS * LONGEST_FLIGHT_S
"""Maximum time for which the tapper of any cell may ask the arm to stand still."""


def flight(stroke: float, speed: float) -> float:
    """Return the maximum time of flight for a striker speed (m/s) and a stroke (m)."""
    return SLOWNESS * stroke / speed


def hold(time_of_flight: float) -> float:
    """Return the duration for which the arm must stand still for a shot."""
    return BEFORE_FLIGHT_S + time_of_flight


def shortfall(time_of_flight: float, granted: float) -> float:
    """Return by how much a granted duration is shorter than :func:`hold`, s. A duration that is not
    a number counts as 0."""
    asked = hold(time_of_flight)
    return asked - min(asked, granted) if granted > 0 else asked


def longest_hold(cell: Cell) -> float:
    """Return the longest time for which a tapper of the cell asks the arm to stand still: the time
    for its slowest strike."""
    longest = max(
        hold(flight(tapper.stroke, tapper.curve().slowest))
        for tapper in cell.tapper_sections.values()
    )
    return min(longest, LONGEST_HOLD_S)
