"""Round bars in ``table`` that represent the arm, and what they hide from the camera."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.arm_shape import Bars, arm_bars
from tapping_cell.hardware.scara import Branch, ScaraGeometry
from tapping_cell.se2 import Array, Pose
from tapping_cell.vision.free_view import view_clearance

VIEW_MARGIN_M = 0.008
"""Margin around the object and the markers, for errors of arm, camera and shapes."""


def bars_in_table(cell: Cell, geometry: ScaraGeometry, joints: ArrayLike) -> Bars:
    """Return the bars of a cell's arm in ``table`` for joints (N, 4)."""
    bars = arm_bars(geometry, cell.arm.shape(cell.file.tapper), joints)
    start, end = (_in_table(cell.arm_base, places) for places in (bars.start, bars.end))
    return Bars(start, end, bars.radius)


def may_hide(
    cell: Cell,
    lens: tuple[float, float, float],
    tip: tuple[float, float, float, float],
    place: tuple[float, float, float],
    radius: float,
) -> bool:
    """Return whether the arm may hide a part of an object from the camera.

    ``lens``: position of the camera's lens; ``tip``: x, y, height and yaw of the arm's tip;
    ``place``: x, y and height of the object, whose parts are within ``radius`` of it; m and rad in
    ``table``. The elbow may be on either side. False if the arm is not a SCARA, because the cell
    file does not describe the links of other arms.
    """
    if cell.arm.chain() is not None:
        return False
    geometry = cell.arm.geometry()
    planar = cell.arm_base.inverse() @ Pose(tip[0], tip[1], tip[3])
    wanted = [[planar.x, planar.y, tip[2], planar.theta]]
    joints = np.concatenate([geometry.inverse_many(wanted, side).joints for side in Branch])
    joints = joints[np.all(np.isfinite(joints), axis=1)]
    if not len(joints):
        return False
    bars = bars_in_table(cell, geometry, joints)
    clearance = view_clearance(lens, bars.start, bars.end, bars.radius + VIEW_MARGIN_M, [place])
    return bool(np.any(clearance <= radius))


def _in_table(base: Pose, places: Array) -> Array:
    """Transform points (..., 3) from ``arm_base`` to ``table``."""
    cos, sin = math.cos(base.theta), math.sin(base.theta)
    turned = np.empty_like(places)
    turned[..., 0] = base.x + cos * places[..., 0] - sin * places[..., 1]
    turned[..., 1] = base.y + sin * places[..., 0] + cos * places[..., 1]
    turned[..., 2] = places[..., 2]
    return turned
