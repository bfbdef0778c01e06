"""Joint values of the arm and the controller's units: rad and m here, degrees and mm there."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.hardware.dialect import AxisValues
from tapping_cell.hardware.scara import Joints

TO_UNITS = (180 / math.pi, 180 / math.pi, 1e3, 180 / math.pi)
"""Joint values (rad, rad, m, rad) to the controller's units (deg, deg, mm, deg)."""


def to_axes(axis_sign: Sequence[int], joints: Joints) -> AxisValues:
    """Axis values of joints; ``axis_sign``: 1 or -1 for each axis."""
    scales = zip(axis_sign, TO_UNITS, joints, strict=True)
    return AxisValues(*(sign * unit * value for sign, unit, value in scales))


def to_joints(axis_sign: Sequence[int], axes: AxisValues) -> Joints:
    """Joints of axis values; ``axis_sign``: 1 or -1 for each axis."""
    scales = zip(axis_sign, TO_UNITS, axes, strict=True)
    return Joints(*(sign * value / unit for sign, unit, value in scales))


def in_words(joints: Joints) -> str:
    """Joints for people."""
    return (
        f"({math.degrees(joints.shoulder):.3f} deg, {math.degrees(joints.elbow):.3f} deg,"
        f" {joints.quill * 1e3:.3f} mm, {math.degrees(joints.tool):.3f} deg)"
    )
