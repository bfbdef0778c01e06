"""Geometry shared by the two-tap methods: which subgoal is nearest, and which tap leads to it.

State: what remains to the goal, a distance r >= 0 (m) and a rotation theta (rad). A tap moves
along the line to the goal by d (either sign) and rotates by at most k |d| (either sense). From a
subgoal with distance r' and rotation theta' one more tap can reach the goal when r' is at least the
smallest tap and |theta'| <= k r'.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array, Taps
from tapping_cell.planning.settings import PlannerSettings

SECOND_TAP_MARGIN = 1.4
"""Least second tap over the smallest tap. A subgoal exactly one smallest tap away would be lost in
half of the runs to the scatter of the first tap; measured in docs/planning.md."""

ROUNDING = 1e-6
"""What the edge of the cone forgives: an exact plan without errors ends right on it."""


def two_tap_choice(
    distance: ArrayLike, rotation: ArrayLike, settings: PlannerSettings, error_line: float
) -> Taps:
    """The tap to the goal where one suffices, else the first tap of a two-tap plan.

    The subgoal is the nearest one whose error line, the rotation of the first tap times
    1 +- ``error_line``, lies wholly where a second, opposite tap reaches the goal; ``error_line`` 0
    is the exact two-tap plan (Huang and Mason, sections 4.1 and 4.2). Retreat taps away from the
    goal by a, so that r + a remains; overshoot taps past it by b, so that b remains:

        retreat:    theta - k a (1 - s) = k (r + a)  ->  a = (theta - k r) / (k (2 - s))
        overshoot:  theta - k (r + b)(1 - s) = k b   ->  b = (theta - k r (1 - s)) / (k (2 - s))

    Both at the full slope k of the cone. The whole error line fits into what the second tap can
    undo, theta (1 +- s) into k b, only from b = s theta / k on; a retreat is always that far. The
    second is at least ``SECOND_TAP_MARGIN`` smallest taps. A tap cannot be larger than the largest:
    what is left is for the next plan.
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

    # A plan that needs larger taps than there are: turn as much as a tap can, stay near the goal.
    too_large = ~direct & (np.maximum(np.abs(first), second) > most)
    tap = np.where(direct, np.clip(r, least, most), np.where(too_large, most, first))
    turn = np.where(direct, np.minimum(theta, k * r) * most / np.maximum(r, most), turn)
    turn = np.where(too_large, np.minimum(k * most, theta), turn)
    return Taps(tap, sense * turn)


def _first_rotation(theta: Array, most: Array, reach: Array, error_line: float) -> Array:
    """The first tap's rotation: the middle of what leaves the whole error line within ``reach``."""
    least = np.clip((theta - reach) / (1.0 - error_line), 0.0, most)
    largest = np.clip((theta + reach) / (1.0 + error_line), 0.0, most)
    return np.asarray(np.maximum(least, np.minimum(theta * 0.5, largest)))
