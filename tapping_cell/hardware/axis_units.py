"""Conversion between joint values (rad, m) and controller axis values (degrees, mm)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.hardware.dialect import AXIS_COUNT, Axes
from tapping_cell.hardware.scara import Joints

LETTERS = "XYZABCUVWE"
"""Axis letters that controllers accept; E exists only in Marlin."""
TO_UNITS = (180 / math.pi, 180 / math.pi, 1e3, 180 / math.pi)
"""Factors from joint values (rad, rad, m, rad) to controller units (deg, deg, mm, deg)."""


def check_letters(letters: str) -> None:
    """Raise ValueError unless ``letters`` are four valid axis letters (shoulder to tool)."""
    if len(letters) != AXIS_COUNT or len(set(letters)) != AXIS_COUNT:
        raise ValueError(f"axis letters {letters!r}: four different letters are needed")
    if not set(letters) <= set(LETTERS):
        raise ValueError(f"axis letters {letters!r}: each must be one of {LETTERS}")


def to_axes(axis_sign: Sequence[int], units: Sequence[float], joints: Sequence[float]) -> Axes:
    """Convert joint values to axis values; ``axis_sign``: 1 or -1 for each axis."""
    scales = zip(axis_sign, units, joints, strict=True)
    return tuple(sign * unit * value for sign, unit, value in scales)


def to_joints(axis_sign: Sequence[int], units: Sequence[float], axes: Axes) -> Axes:
    """Convert axis values to joint values; ``axis_sign``: 1 or -1 for each axis."""
    scales = zip(axis_sign, units, axes, strict=True)
    return tuple(sign * value / unit for sign, unit, value in scales)


def joints_text(joints: Joints) -> str:
    """Format joint values for messages."""
    return (
        f"({math.degrees(joints.shoulder):.3f} deg, {math.degrees(joints.elbow):.3f} deg,"
        f" {joints.quill * 1e3:.3f} mm, {math.degrees(joints.tool):.3f} deg)"
    )
