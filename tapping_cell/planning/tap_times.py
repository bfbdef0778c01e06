"""What taps cost in seconds, as a cell tells it to planning."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array

OBJECTIVES = ("taps", "time")
"""What a goal is reached with the fewest of: taps, or seconds of the taps and the arm's way."""


class TapTimes(Protocol):
    """Seconds of the arm's moves; poses in ``table``, m and rad."""

    @property
    def mean_way(self) -> float:
        """Mean time in s of the arm's way to a strike."""
        ...

    @property
    def mean_tap(self) -> float:
        """Mean time in s from the command of a tap to that of the next."""
        ...

    def to_strikes(self, tip: ArrayLike, strikes: ArrayLike) -> Array:
        """Time (n,) in s of the arm's way from where its tip stands, (4,) as x, y, height and yaw,
        to strike poses (n, 3); infinite where the arm cannot reach one."""
        ...

    def between(self, strikes: ArrayLike, following: ArrayLike) -> Array:
        """Time (n,) in s of the arm's way to strikes (n, 3) that follow others (n, 3), from where
        it withdraws to after those; the mean where the arm cannot reach one."""
        ...
