"""Choice of arm poses for a calibration, spread over the table and over the joint ranges."""

from __future__ import annotations

import math

import numpy as np
from scipy.stats.qmc import Halton

from tapping_cell.hardware.scara import REVOLUTE, Branch, Joints, ScaraGeometry
from tapping_cell.se2 import Pose

TURN = math.radians(120.0)
"""Maximum angle, to either side, between the tool and the line from the shoulder to the tip."""
_INSIDE = 0.01
"""Distance to keep from the joint limits, in rad, so that a wrong zero position of a joint cannot
make a move stop at a limit."""
_TRIED = 50
"""Maximum number of candidate positions per requested pose. Usually far fewer are needed, because
an arm reaches most of its table."""


def arm_places(
    geometry: ScaraGeometry,
    base: Pose,
    half: tuple[float, float],
    height: float,
    count: int,
) -> list[Joints]:
    """Return at most ``count`` joint positions with the tip at ``height`` m above the table.

    Tip positions are evenly distributed over a rectangle about the table's origin with half lengths
    ``half`` (x, y in m); tool angles and elbow sides vary evenly too. ``base`` is the arm's base
    pose in ``table``. The result is deterministic.
    """
    into_base = base.inverse()
    found: list[Joints] = []
    sequence = Halton(3, scramble=False).random(_TRIED * count)
    for number, (x, y, turn) in enumerate((2.0 * sequence - 1.0).tolist()[1:], start=1):
        if len(found) == count:
            break
        tip = into_base @ Pose(half[0] * x, half[1] * y, 0.0)
        yaw = math.atan2(tip.y, tip.x) + TURN * turn
        side = tuple(Branch)[number % 2]
        solution = geometry.inverse((tip.x, tip.y, height, yaw), side)
        if solution.joints is not None and _has_clearance(geometry, solution.joints):
            found.append(solution.joints)
    return found


def _has_clearance(geometry: ScaraGeometry, joints: Joints) -> bool:
    angles, low, high = np.array([joints, geometry.lower, geometry.upper])[:, REVOLUTE]
    return bool(np.all(angles > low + _INSIDE) and np.all(angles < high - _INSIDE))
