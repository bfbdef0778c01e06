"""Minimal example of a planning method in a separate package."""

import numpy as np

from tapping_cell.planning import Taps


class PatientPlanner:
    """If one tap cannot rotate the object enough, first tap it away from the goal while rotating
    it, then tap it to the goal."""

    name = "patient"

    def __init__(self, settings):
        """Store the ``PlannerSettings``: cone, smallest tap, scatter, tolerance."""
        self.settings = settings

    def choose(self, distance, rotation):
        """Return the tap: distance along the line to the goal (m; negative: away), rotation (rad).

        ``distance`` (...) in m and ``rotation`` (...) in rad are the remaining errors.
        """
        slope, least = 0.7 * self.settings.cone_slope, self.settings.smallest_distance
        back = np.maximum((np.abs(rotation) / slope - distance) / 2, least)
        turn = np.copysign(np.minimum(slope * back, np.abs(rotation)), rotation)
        direct = self.taps_to_go(distance, rotation) == 1.0
        return Taps(np.where(direct, distance, -back), np.where(direct, rotation, turn))

    def taps_to_go(self, distance, rotation):
        """Return the expected number of remaining taps: 1 if a single tap suffices, else 2."""
        reach = self.settings.cone_slope * np.asarray(distance)
        one = (np.abs(rotation) <= reach) & (
            np.asarray(distance) >= self.settings.smallest_distance
        )
        return np.where(one, 1.0, 2.0)
