"""The two-tap methods: the nearest subgoal and the tap that leads to it.

The state is the residual to the goal, a distance r >= 0 (m) and a rotation theta (rad). A tap moves
the object along the line to the goal by d (of either sign) and rotates it by at most k |d| (in
either sense). From a subgoal with distance r' and rotation theta', one more tap can reach the goal
if r' is at least the smallest tap and |theta'| <= k r'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array, Taps
from tapping_cell.planning.nominal import nominal_taps
from tapping_cell.planning.settings import PlannerSettings

SECOND_TAP_MARGIN = 1.4
"""Minimum ratio of the second tap to the smallest tap. If the subgoal were exactly one smallest tap
from the goal, half of the runs would fail because of the first tap's scatter."""

ROUNDING = 1e-6
"""Relative tolerance at the edge of the cone, because exact plans end exactly on the edge."""

ERROR_LINE = 0.3
"""Relative error of the rotation that conservative plans allow for: twice the standard deviation of
15 % that the supplied objects have."""


@dataclass(frozen=True, slots=True)
class ExactPlanner:
    """Aims at the edge of the region from which one tap reaches the goal (section 4.1 of the
    paper); plans again if a tap falls short."""

    settings: PlannerSettings
    name: str = "exact"

    @property
    def error_line(self) -> float:
        """Relative error of the first tap's rotation that plans allow for."""
        return 0.0

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose the direct tap or the first tap of a two-tap plan."""
        return two_tap_choice(distance, rotation, self.settings, self.error_line)

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the number of taps that would be needed if taps had no errors."""
        return nominal_taps(distance, rotation, self.settings)


@dataclass(frozen=True, slots=True)
class ConservativePlanner(ExactPlanner):
    """Makes the first tap larger than the exact planner does. Its subgoal lies further inside the
    region from which a second tap reaches the goal (section 4.2 of the paper). The second tap then
    reaches the goal despite the error of the first tap's rotation (the error line)."""

    name: str = "conservative"

    @property
    def error_line(self) -> float:
        """Relative error of the first tap's rotation that plans allow for."""
        return ERROR_LINE if self.settings.error_line is None else self.settings.error_line


def two_tap_choice(
    distance: ArrayLike, rotation: ArrayLike, settings: PlannerSettings, error_line: float
) -> Taps:
    """Choose the tap to the goal if one tap suffices, else the first tap of a two-tap plan.

    The error line of a subgoal contains the possible rotations of the first tap: the commanded
    rotation times 1 +- ``error_line``. The subgoal is the nearest one for which a second tap, in
    the opposite direction, reaches the goal from every point of the error line. Below, s is
    ``error_line``; s = 0 gives the exact two-tap plan (Huang and Mason, sections 4.1 and 4.2). The
    variant "retreat" first taps away from the goal by a, so that the distance r + a remains. The
    variant "overshoot" first taps past the goal by b, so that the distance b remains:

        retreat:    theta - k a (1 - s) = k (r + a)  ->  a = (theta - k r) / (k (2 - s))
        overshoot:  theta - k (r + b)(1 - s) = k b   ->  b = (theta - k r (1 - s)) / (k (2 - s))

    In both variants, both taps use the full slope k of the cone. After an overshoot, the second tap
    can correct the whole error line only if b >= s theta / k; after a retreat it always can. The
    second tap is at least ``SECOND_TAP_MARGIN`` times the smallest tap. Taps are limited to the
    largest tap; the next plan corrects the rest.
    """
    r, signed = np.broadcast_arrays(
        np.asarray(distance, dtype=float), np.asarray(rotation, dtype=float)
    )
    k, least, most = settings.cone_slope, settings.smallest_distance, settings.largest_distance
    least_second = SECOND_TAP_MARGIN * least
    theta = np.abs(signed)
    sense = np.where(signed < 0.0, -1.0, 1.0)
    direct = (r >= least * (1.0 - ROUNDING)) & (theta <= k * r * (1.0 + ROUNDING))

    shortfall = 1.0 - error_line
    if settings.variant == "retreat":
        subgoal = np.maximum((theta - k * r) / (k * (1.0 + shortfall)), least_second)
        first = -subgoal
        second = r + subgoal
    else:
        nearest = (theta - k * r * shortfall) / (k * (1.0 + shortfall))
        subgoal = np.maximum(nearest, np.maximum(theta * error_line / k, least_second))
        first = r + subgoal
        second = subgoal
    turn = _first_rotation(theta, k * np.abs(first), k * second, error_line)

    # If the plan needs a tap above the limit, make the largest tap in the direction of the goal,
    # with as much of the rotation as it can cause.
    too_large = ~direct & (np.maximum(np.abs(first), second) > most)
    tap = np.where(direct, np.clip(r, least, most), np.where(too_large, most, first))
    turn = np.where(direct, np.minimum(theta, k * r) * most / np.maximum(r, most), turn)
    turn = np.where(too_large, np.minimum(k * most, theta), turn)
    return Taps(tap, sense * turn)


def _first_rotation(theta: Array, most: Array, reach: Array, error_line: float) -> Array:
    """Compute the rotation of the first tap: half of theta, limited so that for every error on the
    error line the rotation that remains is at most ``reach``, the largest rotation that the second
    tap can correct."""
    least = np.clip((theta - reach) / (1.0 - error_line), 0.0, most)
    largest = np.clip((theta + reach) / (1.0 + error_line), 0.0, most)
    return np.asarray(np.maximum(least, np.minimum(theta * 0.5, largest)))
