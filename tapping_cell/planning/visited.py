"""Memory of the poses from which the object was tapped, so that the object does not move in
circles.

The ranking of alternative taps looks only one tap ahead. If the path assumed by this ranking is not
possible, for example because a polygon cannot be struck in its direction, the best tap may lead to
a pose whose best tap leads back. Learning real-time A* (Korf, Artificial Intelligence 42, 1990)
avoids this: for each visited pose, the estimated cost of its best tap is stored, and every tap that
would end near the pose is assigned at least this cost. Every further visit raises this cost, until
another tap is cheaper.
"""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.planning.interface import Array
from tapping_cell.se2 import wrap_angle

RADIUS = 0.008
"""Distance from a visited pose, m, within which its cost applies. For comparison, the end of an
80 mm slide has a standard deviation of 4 mm with the default scatter."""

SHARE = 0.5
"""Largest radius around a visited pose, as a share of its distance from the goal. Taps close to the
goal stay possible."""

ANGLE = math.radians(15.0)
"""Rotation relative to a visited pose, rad, within which its cost applies."""


class VisitedPoses:
    """Poses from which the object was tapped, each with its estimated number of further taps."""

    def __init__(self, goal: Array) -> None:
        self._goal = goal
        self._poses: Array = np.zeros((0, 3))
        self._costs: Array = np.zeros(0)

    def add(self, pose: Array, cost: float) -> None:
        """Store that the goal is estimated to take ``cost`` taps from ``pose`` on."""
        self._poses = np.vstack([self._poses, pose])
        self._costs = np.append(self._costs, cost)

    def extra(self, poses: Array, cost: Array) -> Array:
        """Return, for poses (n, 3), the number of taps, (n,), by which the costs stored for visited
        poses nearby exceed the estimated costs ``cost`` (n,)."""
        if not self._costs.size:
            return np.zeros(cost.shape)
        apart = poses[:, None, :] - self._poses
        left = self._goal[:2] - self._poses[:, :2]
        near = np.minimum(RADIUS, SHARE * np.hypot(left[:, 0], left[:, 1]))
        close = np.hypot(apart[..., 0], apart[..., 1]) <= near
        close &= np.abs(wrap_angle(apart[..., 2])) <= ANGLE
        known = np.max(np.where(close, self._costs, 0.0), axis=-1)
        return np.asarray(np.maximum(known - cost, 0.0))
