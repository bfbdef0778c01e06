"""Where an arm is to hold its marker for a calibration: all over the table, in many postures."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.hardware.scara import Branch, Joints, ScaraGeometry
from tapping_cell.se2 import Pose

TURN = math.radians(120.0)
"""The tool is turned by up to this to either side of the line from the shoulder."""
_INSIDE = 0.01
"""Room to the joints' limits, in rad: an uncalibrated zero must not end a move."""
_TRIED = 50
"""Places tried for each that is wanted; a cell's arm reaches most of its table."""


def arm_places(
    geometry: ScaraGeometry,
    base: Pose,
    half: tuple[float, float],
    height: float,
    count: int,
) -> list[Joints]:
    """At most ``count`` postures with the tip at ``height`` m over a rectangle of ``half`` lengths
    (x, y in m) about the table's origin: places, tool's turns and elbow's sides spread evenly.

    ``base`` of the arm in ``table``. The postures are the same for the same arguments.
    """
    into_base = base.inverse()
    found: list[Joints] = []
    for number in range(1, _TRIED * count):
        if len(found) == count:
            break
        x, y = ((2.0 * _spread(number, prime) - 1.0) for prime in (2, 3))
        tip = into_base @ Pose(half[0] * x, half[1] * y, 0.0)
        yaw = math.atan2(tip.y, tip.x) + TURN * (2.0 * _spread(number, 5) - 1.0)
        side = tuple(Branch)[number % 2]
        solution = geometry.inverse((tip.x, tip.y, height, yaw), side)
        if solution.joints is not None and _has_room(geometry, solution.joints):
            found.append(solution.joints)
    return found


def _spread(number: int, prime: int) -> float:
    """The number's place in Van der Corput's sequence of a base: evenly over 0 to 1."""
    place, share = 0.0, 1.0
    while number:
        share /= prime
        number, digit = divmod(number, prime)
        place += digit * share
    return place


def _has_room(geometry: ScaraGeometry, joints: Joints) -> bool:
    turns = np.array(joints)[[0, 1, 3]]
    low, high = np.array(geometry.lower)[[0, 1, 3]], np.array(geometry.upper)[[0, 1, 3]]
    return bool(np.all(turns > low + _INSIDE) and np.all(turns < high - _INSIDE))
