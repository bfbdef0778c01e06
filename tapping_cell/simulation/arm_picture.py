"""Silhouettes of the arm in the overhead camera's view: links, quill, tool and striker."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.configuration.cell import ArmSection, TapperSection
from tapping_cell.se2 import Pose, transform_points, unit_vectors
from tapping_cell.simulation.rendered_camera import Occluder

Array = NDArray[np.float64]

QUILL_RADIUS = 0.010
_LINK_LEVEL, _TOOL_LEVEL, _STRIKER_LEVEL = 70.0, 55.0, 120.0
_ROUND = np.linspace(0.0, 2 * math.pi, 12, endpoint=False)
_UNIT_CIRCLE = unit_vectors(_ROUND)


def arm_solids(
    arm: ArmSection, tapper: TapperSection, base: Pose, joints: ArrayLike
) -> tuple[Occluder, ...]:
    """Return the silhouettes of the arm's parts, lowest first, at true joint values (rad, rad, m,
    rad).

    ``base``: true pose of ``arm_base`` in ``table``.
    """
    geometry = arm.geometry()
    q = np.asarray(joints, dtype=float)
    tip = geometry.forward(q)
    striker = base @ Pose(tip.x, tip.y, tip.yaw)
    elbow_angle = q[0] + q[1]
    elbow = geometry.upper_arm * unit_vectors(q[0])
    wrist = elbow + geometry.forearm * unit_vectors(elbow_angle)
    low = arm.tip_height + arm.link_clearance
    shoulder, elbow, wrist = transform_points(base, np.array([[0.0, 0.0], elbow, wrist]))
    return (
        *_tool(tapper, np.array(striker), tip.z),
        _solid(_circle(wrist, QUILL_RADIUS), max(tip.z, 0.0), low, _TOOL_LEVEL),
        _link(elbow, wrist, low, arm),
        _link(shoulder, elbow, low, arm),
    )


def _tool(tapper: TapperSection, tip: Array, height: float) -> tuple[Occluder, ...]:
    """Return the silhouettes of striker and housing; the centre of the striker's ball is at
    ``tip``."""
    striker = (-tapper.tool_start, tapper.tip_radius)
    housing = (-tapper.tool_length, -tapper.tool_start)
    return (
        _box(tip, striker, tapper.tip_radius, height, _STRIKER_LEVEL),
        _box(tip, housing, tapper.tool_radius, height, _TOOL_LEVEL),
    )


def _box(
    pose: Array, along: tuple[float, float], half: float, height: float, level: float
) -> Occluder:
    """Return the silhouette of a bar with a square section along the line of travel, centred
    ``height`` m above the table."""
    (start, end), low = along, max(height - half, 0.0)
    corners = np.array([[start, -half], [end, -half], [end, half], [start, half]])
    return _solid(transform_points(pose, corners), low, height + half, level)


def _link(start: Array, end: Array, low: float, arm: ArmSection) -> Occluder:
    half = arm.link_half_width
    ends = np.concatenate([_circle(start, half), _circle(end, half)])
    return _solid(ends, low, low + arm.link_thickness, _LINK_LEVEL)


def _circle(middle: Array, radius: float) -> Array:
    return np.asarray(middle + radius * _UNIT_CIRCLE)


def _solid(outline: Array, low: float, high: float, level: float) -> Occluder:
    count = len(outline)
    points = np.empty((2 * count, 3))
    points[:count, :2] = points[count:, :2] = outline
    points[:count, 2], points[count:, 2] = low, high
    return Occluder(points, level, convex=True)
