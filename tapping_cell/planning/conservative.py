"""Conservative two-tap plans: subgoals that allow for errors of the first tap (section 4.2 of the
paper)."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array, Taps
from tapping_cell.planning.nominal import nominal_taps
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.two_tap import two_tap_choice

ERROR_LINE = 0.3
"""Relative error of the rotation that plans allow for: twice the standard deviation, which is 15 %
(section 3.1.1 of the paper)."""


@dataclass(frozen=True, slots=True)
class ConservativePlanner:
    """Makes a larger first tap than an exact plan, to a subgoal further inside the region from
    which one tap reaches the goal. The second tap then reaches the goal despite the error of the
    first tap's rotation (the error line)."""

    settings: PlannerSettings
    name: str = "conservative"

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose the direct tap or the first tap of a conservative two-tap plan."""
        line = ERROR_LINE if self.settings.error_line is None else self.settings.error_line
        return two_tap_choice(distance, rotation, self.settings, line)

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the number of taps that would be needed if taps had no errors."""
        return nominal_taps(distance, rotation, self.settings)
