"""Interface through which a cell provides the durations of taps to planning."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array

OBJECTIVES = ("taps", "time")
"""Quantity that planning minimises: the number of taps, or the time of taps and arm motions."""


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
        """Time (n,) of the arm's motion from tip pose (4,), as x, y, height and yaw, to strike
        poses (n, 3), s; infinite for unreachable poses."""
        ...

    def between(self, strikes: ArrayLike, following: ArrayLike) -> Array:
        """Time (n,) of the arm's motion to the ``following`` strikes (n, 3), s, from the retreat
        poses after ``strikes`` (n, 3); the mean time for unreachable poses."""
        ...
