"""Exact two-tap plans: the nearest subgoal from which one more tap reaches the goal."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array, Taps
from tapping_cell.planning.nominal import nominal_taps
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.two_tap import two_tap_choice


@dataclass(frozen=True, slots=True)
class ExactPlanner:
    """Aims at the edge of the region from which one tap reaches the goal (section 4.1 of the
    paper); plans again if a tap falls short."""

    settings: PlannerSettings
    name: str = "exact"

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose the direct tap or the first tap of an exact two-tap plan."""
        return two_tap_choice(distance, rotation, self.settings, error_line=0.0)

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the number of taps that would be needed if taps had no errors."""
        return nominal_taps(distance, rotation, self.settings)
