"""A planning method of one's own, as small as they come."""

import numpy as np

from tapping_cell.planning import Taps


class PatientPlanner:
    """Where one tap cannot turn enough: back off, turning, until the next one can with room."""

    name = "patient"

    def __init__(self, settings):
        """Keep the settings: cone, smallest tap, scatter, tolerance."""
        self.settings = settings

    def choose(self, distance, rotation):
        """The tap along the line to the goal, m (negative: away), and its rotation, rad."""
        slope, least = 0.7 * self.settings.cone_slope, self.settings.smallest_distance
        back = np.maximum((np.abs(rotation) / slope - distance) / 2, least)
        turn = np.copysign(np.minimum(slope * back, np.abs(rotation)), rotation)
        direct = self.taps_to_go(distance, rotation) == 1.0
        return Taps(np.where(direct, distance, -back), np.where(direct, rotation, turn))

    def taps_to_go(self, distance, rotation):
        """One where a single tap can do it, else two."""
        reach = self.settings.cone_slope * np.asarray(distance)
        one = (np.abs(rotation) <= reach) & (
            np.asarray(distance) >= self.settings.smallest_distance
        )
        return np.where(one, 1.0, 2.0)
