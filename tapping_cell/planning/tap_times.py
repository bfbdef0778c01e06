"""Interface through which a cell with an arm provides the durations of taps to the planner."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array

OBJECTIVES = ("taps", "time")
"""Quantities that planning can minimise: the number of taps, or the time of taps and arm
motions."""


class TapTimes(Protocol):
    """Durations of the arm's motions, s; poses in ``table``, m and rad."""

    @property
    def mean_way(self) -> float:
        """Mean time of the arm's motion to a strike, s."""
        ...

    @property
    def mean_tap(self) -> float:
        """Mean time from the command of a tap to the command of the next tap, s."""
        ...

    def to_strikes(self, tip: ArrayLike, strikes: ArrayLike) -> Array:
        """Return the time (n,), s, of the arm's motion from the tip pose (x, y, height, yaw) to
        strike poses (n, 3); infinite for unreachable poses."""
        ...

    def between(self, strikes: ArrayLike, following: ArrayLike) -> Array:
        """Return the time (n,), s, of the arm's motion from the retreat poses after ``strikes`` (n,
        3) to the strikes ``following`` (n, 3). For unreachable poses, this is the mean time."""
        ...
