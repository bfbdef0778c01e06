"""Round bars in ``table`` that represent the arm, to compute what the arm hides from the camera."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.arm_shape import Bars, arm_bars
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.se2 import Array, Pose


def bars_in_table(cell: Cell, geometry: ScaraGeometry, joints: ArrayLike) -> Bars:
    """Return the bars of a cell's arm in ``table`` for joints (N, 4)."""
    bars = arm_bars(geometry, cell.arm.shape(cell.file.tapper), joints)
    start, end = (_in_table(cell.arm_base, places) for places in (bars.start, bars.end))
    return Bars(start, end, bars.radius)


def _in_table(base: Pose, places: Array) -> Array:
    """Transform points (..., 3) from ``arm_base`` to ``table``."""
    cos, sin = math.cos(base.theta), math.sin(base.theta)
    turned = np.empty_like(places)
    turned[..., 0] = base.x + cos * places[..., 0] - sin * places[..., 1]
    turned[..., 1] = base.y + sin * places[..., 0] + cos * places[..., 1]
    turned[..., 2] = places[..., 2]
    return turned
