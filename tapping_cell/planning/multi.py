"""Multi-tap plans: cones chained backwards from the stopping box (Huang and Mason, section 4.3).

Cone 0 is the box. A state belongs to cone i if there is a tap that moves it into a cone with a
lower number, whatever the error of the tap's rotation. The possible rotations of a tap form its
error line: from (1 - ``error_line``) to (1 + ``error_line``) times the commanded rotation. At each
distance r, the states of cone i form an interval |theta| <= h_i(r); it has no gaps, because
commanded rotations can have any value from 0 to the largest. With s = ``error_line`` and the slope
k of the cone of a tap,

    h_i(r) = largest over taps d of  H + (1 - s) min(k |d|, H / s),   H = h_(i-1)(|r - d|)

so that the rotation that remains after the tap is between -H and H at both ends of the error line.
The paper's task takes five taps with error lines of 60 %, and two taps with 30 %. These numbers of
taps are guaranteed as long as the errors stay within the error lines.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.interface import Array, Taps
from tapping_cell.planning.lookup import bracket
from tapping_cell.planning.settings import PlannerSettings

ERROR_LINE = 0.6
"""Four times the standard deviation of the rotation's scatter (15 %). With this value, the paper's
task takes five taps."""

AIM = 0.3
"""The last tap must aim at a place whose distance from the goal is at most this share of the box's
half width."""

FARTHEST = 1.0
"""Distance in m up to which cones are chained."""

MAX_CONES = 200
TAP_RATIO = 1.05
ROWS = 2048
"""Number of states per batch, which bounds the memory."""


class MultiPlanner:
    """Planner whose taps lead to a cone with a lower number, and thus with fewer remaining taps,
    for all errors on the error line.

    Among these taps it chooses the tap that is expected to reach the cone with the lowest number.
    If there are several such taps, it chooses the shortest.
    """

    name = "multi"

    def __init__(self, settings: PlannerSettings) -> None:
        self.settings = settings
        self.error_line = ERROR_LINE if settings.error_line is None else settings.error_line
        if self.error_line <= 0.0:
            raise PlanningError("the method multi needs an error_line above 0, such as 0.6")
        least, most = settings.smallest_distance, settings.largest_distance
        steps = math.floor(math.log(most / least) / math.log(TAP_RATIO))
        sizes = np.append(least * TAP_RATIO ** np.arange(steps + 1), most)
        self._taps = np.concatenate([sizes, -sizes])
        near = np.arange(0.0, 4.0 * least, least / 20.0)
        far = np.geomspace(4.0 * least, max(FARTHEST, 4.0 * most), 220)
        self.distances: Array = np.concatenate([near, far])
        self.cones: Array = self._chain()
        """Half widths h_i (rad) of the rotation intervals -h_i to h_i of the cones: one row per
        cone, starting with cone 1, and one column per entry of ``distances``; -1 where the cone
        contains no state."""

    def planned_taps(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the number of the state's cone, which is the number of planned taps; 0 inside the
        box."""
        r, theta = np.broadcast_arrays(
            np.asarray(distance, dtype=float), np.abs(np.asarray(rotation, dtype=float))
        )
        box = self.settings.stopping
        level = np.ones(r.shape, dtype=int)
        index, share = bracket(self.distances, r)
        for opening in self.cones[:-1]:
            low = opening[index]
            outside = low + share * (opening[index + 1] - low) < theta
            if not np.any(outside):
                break
            level += outside
        return np.where((r <= box.distance) & (theta <= box.rotation), 0, level)

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the number of planned taps plus a term that grows with the path length and ranks
        the states within a cone."""
        settings = self.settings
        r = np.asarray(distance, dtype=float)
        path = np.maximum(r, np.abs(rotation) / settings.cone_slope)
        # The weight 0.2 is small, so that the number of taps decides between states of a similar
        # distance. Beyond the largest tabulated distance, each largest tap counts as one tap.
        beyond = np.maximum(r - self.distances[-1], 0.0)
        return np.asarray(
            self.planned_taps(distance, rotation)
            + (0.2 * path + beyond) / settings.largest_distance
        )

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose a tap that leads into a lower cone or, if there is none, the tap that ends nearest
        to the goal."""
        r, signed = np.broadcast_arrays(
            np.asarray(distance, dtype=float), np.asarray(rotation, dtype=float)
        )
        flat_r, flat_theta = r.ravel(), np.abs(signed).ravel()
        tap, turn = np.empty(flat_r.size), np.empty(flat_r.size)
        for start in range(0, flat_r.size, ROWS):
            rows = slice(start, start + ROWS)
            tap[rows], turn[rows] = self._choose_rows(flat_r[rows], flat_theta[rows])
        sense = np.where(signed < 0.0, -1.0, 1.0)
        return Taps(tap.reshape(r.shape), sense * turn.reshape(r.shape))

    def _choose_rows(self, r: Array, theta: Array) -> tuple[Array, Array]:
        settings, line = self.settings, self.error_line
        taps = self._taps_at(r)
        level = np.maximum(self.planned_taps(r, theta), 1)
        end = np.abs(r[:, None] - taps)
        below = np.empty_like(taps)
        for cone in np.unique(level):
            rows = level == cone
            below[rows] = self._opening(int(cone) - 1, end[rows])
        angle = theta[:, None]
        least = np.maximum((angle - below) / (1.0 - line), 0.0)
        most = np.minimum(settings.cone_slope * np.abs(taps), (angle + below) / (1.0 + line))
        to_lower_cone = (below > 0.0) & (least <= most * (1.0 + 1e-9))
        turn = np.minimum(np.clip(angle, least, np.maximum(least, most)), np.maximum(most, 0.0))
        left = np.abs(angle - turn)
        cost = self.planned_taps(end, left) + np.abs(taps) / settings.largest_distance
        cost[:, 0] -= np.where(level == 1, 10.0, 0.0)  # the last tap aims at the goal itself
        otherwise = 1e6 + np.maximum(end, left / settings.cone_slope)
        best = np.argmin(np.where(to_lower_cone, cost, otherwise), axis=1)
        index = np.arange(r.size)
        return taps[index, best], turn[index, best]

    def _taps_at(self, r: Array) -> Array:
        """Return the taps that are compared at distances r (n,), (n, taps): the tap to the goal,
        and taps of a geometric progression of sizes."""
        own = np.clip(r, self.settings.smallest_distance, self.settings.largest_distance)
        return np.column_stack([own, np.broadcast_to(self._taps, (r.size, self._taps.size))])

    def _chain(self) -> Array:
        """Compute the half widths h_i of the cones, one cone after the other, until the outermost
        cone contains every state or a cone is no larger than the one before."""
        settings, line = self.settings, self.error_line
        taps = self._taps_at(self.distances)
        end = np.abs(self.distances[:, None] - taps)
        cones: list[Array] = []
        before = np.full(self.distances.size, -1.0)
        while len(cones) < MAX_CONES:
            below = self._box_opening(end) if not cones else np.interp(end, self.distances, before)
            widest = np.minimum(settings.cone_slope * np.abs(taps), below / line)
            opening = np.where(below > 0.0, below + (1.0 - line) * widest, -1.0)
            grown = np.maximum(before, opening.max(axis=1))
            cones.append(grown)
            if float(grown.min()) >= math.pi or np.array_equal(grown, before):
                break
            before = grown
        return np.array(cones)

    def _opening(self, cone: int, distance: Array) -> Array:
        if cone == 0:
            return self._box_opening(distance)
        return np.asarray(np.interp(distance, self.distances, self.cones[cone - 1]))

    def _box_opening(self, distance: Array) -> Array:
        box = self.settings.stopping
        return np.where(distance <= AIM * box.distance, box.rotation, -1.0)


@functools.lru_cache(maxsize=8)
def multi_planner(settings: PlannerSettings) -> MultiPlanner:
    """Return the method for these settings, cached with its cones."""
    return MultiPlanner(settings)
