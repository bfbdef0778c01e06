"""How long the arm stands still for a shot: what docs/safety.md adds up, as numbers. Times in s."""

from __future__ import annotations

from tapping_cell.configuration.cell import Cell

BEFORE_FLIGHT_S = 0.17
"""Of the arm's promise, what is left to ask the arm and the board, for the window and the pulse."""
RELEASE_S = 0.1
"""Of that, what must be left when the answer is heard: a question to the board, window, pulse."""
RELEASED_S = 0.035
"""From the report of a release on, the pulse is over by then at the latest."""
SLOWNESS = 1.1
"""A striker may be slower than its curve says by so much: friction and the curve's error."""


def flight(stroke: float, speed: float) -> float:
    """How long a striker of this speed (m/s) is on its way at most: through its stroke (m)."""
    return SLOWNESS * stroke / speed


def hold(time_of_flight: float) -> float:
    """For how long the arm is asked to stand still for a shot."""
    return BEFORE_FLIGHT_S + time_of_flight


def longest_hold(cell: Cell) -> float:
    """The longest promise that a tapper of the cell asks for: for its slowest strike."""
    return max(
        hold(flight(tapper.stroke, tapper.curve().slowest))
        for tapper in cell.tapper_sections.values()
    )
