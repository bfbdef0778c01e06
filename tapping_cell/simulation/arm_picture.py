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
    held = np.array(striker)
    return (
        *_tool(tapper, held, held, tip.z),
        _solid(_circle(wrist, QUILL_RADIUS), max(tip.z, 0.0), low, _TOOL_LEVEL),
        _link(elbow, wrist, low, arm),
        _link(shoulder, elbow, low, arm),
    )


def striker_solids(
    tapper: TapperSection, mount: Pose, height: float, out: float
) -> tuple[Occluder, ...]:
    """Return the silhouettes of a tapper at a fixed mount. Its tip is ``height`` m above the table
    and extended by ``out`` m."""
    rest = np.array(mount)
    ahead = rest + out * np.array([math.cos(mount.theta), math.sin(mount.theta), 0.0])
    return _tool(tapper, rest, ahead, height)


def _tool(tapper: TapperSection, rest: Array, tip: Array, height: float) -> tuple[Occluder, ...]:
    """Return the silhouettes of striker and housing. The housing is at ``rest``; the striker
    extends from it to ``tip``."""
    out = math.hypot(tip[0] - rest[0], tip[1] - rest[1])
    along = (-tapper.tool_start - out, 0.0)
    housing = (-tapper.tool_length, -tapper.tool_start)
    return (
        _box(tip, along, tapper.tip_radius, height, _STRIKER_LEVEL),
        _box(rest, housing, tapper.tool_radius, height, _TOOL_LEVEL),
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
