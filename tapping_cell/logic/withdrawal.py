"""Poses of the arm from which the camera sees the object.

Seen from the camera's lens, the arm and its tool hide parts of the table. After a tap, the arm
withdraws only until the camera sees enough reference markers and every place that the object may
have reached. Among the poses at travel height with such a free view, the arm moves to the pose that
minimises the time of the withdrawal plus the time of the move to the next tap. If the object is not
seen at all, it may lie under the arm. The arm then moves to a pose from which the camera sees as
much as possible of the area that the arm hid before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.arm_shape import Bars
from tapping_cell.hardware.motion import (
    MotionSettings,
    Waypoint,
    clear_view_path,
    move_durations,
    raise_step,
    withdraw_path,
)
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.logic.arm_in_view import VIEW_MARGIN_M, bars_in_table
from tapping_cell.se2 import Array, Pose
from tapping_cell.vision.free_view import view_clearance

OVERSHOOT = 1.3
"""Assumed maximum displacement of the object, as a multiple of the predicted displacement."""
PLACES = 6
"""Number of places along the object's path that must be visible."""
MARKERS_HIDDEN = 3
"""Maximum number of reference markers that the arm may hide. If there are few markers, the arm may
hide at most half of them."""
STEPS = np.linspace(-1.0, 1.0, 13)
"""Candidate changes of the shoulder and elbow joints, rad."""
TURNS = (-1.2, 0.0, 1.2)
"""Candidate changes of the tool joint, rad."""
GRID_M = 0.02
"""Grid spacing of the possible places of an unseen object."""
HEADINGS = np.arange(8) * (2.0 * math.pi / 8)
"""Possible headings of the next tap, rad."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Scene that the camera must observe after a tap. ``camera``: lens position in ``table``, m.

    ``before`` and ``predicted``: poses of the object before and after the tap. ``strike``: pose of
    the tip.
    """

    camera: tuple[float, float, float]
    before: Pose
    predicted: Pose
    strike: Pose


def withdrawal(
    cell: Cell, scene: Scene | None, current: Joints, motion: MotionSettings
) -> tuple[Waypoint, ...]:
    """Return waypoints from the joints ``current`` to a pose with a free view or to the park pose.

    The park pose is used if the scene is not known or if no pose at travel height has a free view.
    It is also used if the arm is not a SCARA, because the cell file does not describe the links of
    other arms.
    """

    def choose(geometry: ScaraGeometry, raised: Joints) -> Array | None:
        if scene is None:
            return None
        tried = _candidates(geometry, raised)
        free = tried[_is_free(cell, geometry, scene, tried)]
        if not len(free):
            return None
        way = move_durations(geometry, raised, free, motion.travel_speed)
        onwards = _to_next(cell, geometry, scene, free, motion)
        return np.asarray(free[int(np.argmin(way + onwards))])

    return _path_to_chosen(cell, current, motion, choose)


def hides_object(cell: Cell, scene: Scene | None, joints: Joints) -> bool:
    """Return whether the arm at its joints hides a part of the object before the tap. False if the
    scene is not known or the arm is not a SCARA."""
    if scene is None or cell.arm.chain() is not None:
        return False
    place = np.array([[scene.before.x, scene.before.y, cell.object.height]])
    bars = bars_in_table(cell, cell.arm.geometry(), np.array([joints]))
    return not _sees(cell, scene.camera, bars, place)[0, 0]


def uncovering(
    cell: Cell,
    camera: tuple[float, float, float] | None,
    current: Joints,
    motion: MotionSettings,
) -> tuple[Waypoint, ...]:
    """Return waypoints to the pose that hides the least of the area that the arm hides now.

    If several poses hide equally much, the pose that the arm reaches first is used. The park pose
    is used if no other pose hides less than the park pose, if the lens position ``camera`` in
    ``table`` is not known, or if the arm is not a SCARA.
    """

    def choose(geometry: ScaraGeometry, raised: Joints) -> Array | None:
        if camera is None:
            return None
        tried = np.concatenate([[motion.park], _candidates(geometry, raised)])
        places = _hidden_places(cell, geometry, camera, current)
        bars = _bars(cell, geometry, tried)
        hidden = len(places) - np.sum(_sees(cell, camera, bars, places), axis=1)
        # A pose from which the camera lacks reference markers is the last choice.
        hidden = hidden + np.where(_sees_markers(cell, camera, bars), 0, len(places) + 1)
        least = hidden == hidden.min()
        if least[0]:
            return None
        times = move_durations(geometry, raised, tried[least], motion.travel_speed)
        return np.asarray(tried[least][int(np.argmin(times))])

    return _path_to_chosen(cell, current, motion, choose)


def _path_to_chosen(
    cell: Cell,
    current: Joints,
    motion: MotionSettings,
    choose: Callable[[ScaraGeometry, Joints], Array | None],
) -> tuple[Waypoint, ...]:
    """Return waypoints to the joints (4,) that ``choose`` returns for the raised arm. The park pose
    is used if ``choose`` returns None or if the arm is not a SCARA."""
    geometry = cell.arm.geometry()
    parked = withdraw_path(geometry, current, motion)
    own = cell.arm.ros2_control
    if own is not None and own.chain is not None:
        return parked
    chosen = choose(geometry, raise_step(geometry, current, motion).joints)
    if chosen is None:
        return parked
    return clear_view_path(geometry, current, Joints(*chosen.tolist()), motion)


def _hidden_places(
    cell: Cell, geometry: ScaraGeometry, camera: tuple[float, float, float], joints: Joints
) -> Array:
    """Return the places (N, 3) on the table at which the arm hides the object or a part of it."""
    half = 0.5 * np.array([cell.file.table.length, cell.file.table.width])
    x, y = (np.arange(-side, side + 0.5 * GRID_M, GRID_M) for side in half)
    grid = np.stack(np.meshgrid(x, y, [cell.object.height], indexing="ij"), axis=-1).reshape(-1, 3)
    seen = _sees(cell, camera, _bars(cell, geometry, np.array([joints])), grid)[0]
    return np.asarray(grid[np.logical_not(seen)])


def _candidates(geometry: ScaraGeometry, raised: Joints) -> Array:
    """Return joints (N, 4) around the raised pose, within their limits and with the elbow on the
    same side. The raised pose itself is the first row."""
    shoulder, elbow, tool = np.meshgrid(STEPS, STEPS, TURNS, indexing="ij")
    change = np.stack([shoulder, elbow, np.zeros_like(shoulder), tool], axis=-1).reshape(-1, 4)
    all_of = np.concatenate([np.zeros((1, 4)), change]) + np.array(raised)
    within = np.all((all_of >= geometry.lower) & (all_of <= geometry.upper), axis=1)
    true_elbow = all_of[:, 1] + geometry.joint_offset[1]
    side = geometry.branch_of(raised).value
    within &= true_elbow * side >= geometry.singularity_margin
    within[0] = True
    return np.asarray(all_of[within])


def _is_free(cell: Cell, geometry: ScaraGeometry, scene: Scene, joints: Array) -> Array:
    """Return a mask (N,) of the joints (N, 4) at which the camera sees the object and enough
    markers."""
    along = np.linspace(0.0, OVERSHOOT, PLACES)
    before = np.array([scene.before.x, scene.before.y])
    way = np.array([scene.predicted.x, scene.predicted.y]) - before
    places = np.column_stack([before + along[:, None] * way, np.full(PLACES, cell.object.height)])
    bars = _bars(cell, geometry, joints)
    free = np.all(_sees(cell, scene.camera, bars, places), axis=1)
    of_free = Bars(bars.start[free], bars.end[free], bars.radius)
    free[free] = _sees_markers(cell, scene.camera, of_free)
    return np.asarray(free)


def _sees(cell: Cell, camera: tuple[float, float, float], bars: Bars, places: Array) -> Array:
    """Return a mask (N, M): True if the bars of an arm pose hide no part of the object at a place
    (M, 3)."""
    clearance = view_clearance(camera, bars.start, bars.end, bars.radius, places)
    return np.asarray(clearance > cell.object.body().bounding_radius)


def _sees_markers(cell: Cell, camera: tuple[float, float, float], bars: Bars) -> Array:
    """Return a mask (N,): True if the bars of an arm pose leave enough reference markers
    visible."""
    markers = cell.references.markers
    of_markers = np.array([[marker.x, marker.y, 0.0] for marker in markers])
    half_diagonals = np.array([marker.size / math.sqrt(2.0) for marker in markers])
    clearance = view_clearance(camera, bars.start, bars.end, bars.radius, of_markers)
    hidden = np.sum(clearance <= half_diagonals, axis=1)
    return np.asarray(hidden <= min(MARKERS_HIDDEN, len(markers) // 2))


def _bars(cell: Cell, geometry: ScaraGeometry, joints: Array) -> Bars:
    """Return the arm's bars with margin in ``table`` for joints (N, 4)."""
    bars = bars_in_table(cell, geometry, joints)
    return replace(bars, radius=bars.radius + VIEW_MARGIN_M)


def _to_next(
    cell: Cell, geometry: ScaraGeometry, scene: Scene, joints: Array, motion: MotionSettings
) -> Array:
    """Return the mean time (N,) in s from joints (N, 4) to the next tap, averaged over
    ``HEADINGS``."""
    reach = math.hypot(scene.strike.x - scene.before.x, scene.strike.y - scene.before.y)
    yaw = HEADINGS - cell.arm_base.theta
    middle = cell.arm_base.inverse() @ scene.predicted
    tips = np.column_stack(
        [
            middle.x - reach * np.cos(yaw),
            middle.y - reach * np.sin(yaw),
            np.full(len(yaw), motion.travel_height),
            yaw,
        ]
    )
    places = geometry.inverse_many(tips, geometry.branch_of(joints[0]), joints[0]).joints
    places = places[np.all(np.isfinite(places), axis=1)]
    if not len(places):
        return np.zeros(len(joints))
    times = move_durations(geometry, joints[:, None], places[None], motion.travel_speed)
    return np.asarray(times.mean(axis=1))
