"""After a tap the arm moves out of the camera's view of the object. The test checks the free view
with the silhouettes that the simulation draws."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.motion import path_duration, strike_path, withdraw_path
from tapping_cell.hardware.scara import Branch, Joints, TipPose
from tapping_cell.logic.arm_in_view import may_hide
from tapping_cell.logic.withdrawal import MARKERS_HIDDEN, Scene, hides_object, withdrawal
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_picture import arm_solids

CELL = load_cell()
ARM = CELL.file.arm
GEOMETRY = ARM.geometry()
MOTION = ARM.motion()
LENS = (0.02, -0.015, 0.7)
REACH = 0.015 + CELL.object.body().bounding_radius


def struck(x: float, y: float, heading: float, slide: float) -> tuple[Scene, Joints] | None:
    """Return the scene of a tap of the object at this place, and the arm's joints at the strike
    pose."""
    before = Pose(x, y, 0.3)
    way = np.array([math.cos(heading), math.sin(heading)])
    strike = Pose(x - REACH * way[0], y - REACH * way[1], heading)
    after = Pose(x + slide * way[0], y + slide * way[1], 0.4)
    tip = CELL.arm_base.inverse() @ strike
    solution = GEOMETRY.inverse((tip.x, tip.y, ARM.strike_height, tip.theta), near=ARM.park)
    if solution.joints is None:
        return None
    return Scene(LENS, before, after, strike), solution.joints


def hidden(joints: Joints, points: np.ndarray, room: float) -> np.ndarray:
    """Return for each disc whether the arm's silhouette covers any part of it in the image, (M,).
    The discs have the centres ``points`` (M, 3) and the radius ``room``."""
    lens = np.array(LENS)
    found = np.zeros(len(points), dtype=bool)
    for solid in arm_solids(ARM, CELL.file.tapper, CELL.arm_base, joints):
        for number, point in enumerate(points):
            scale = (lens[2] - point[2]) / (lens[2] - solid.points[:, 2])
            shadow = lens[:2] + (solid.points[:, :2] - lens[:2]) * scale[:, None]
            hull = cv2.convexHull(shadow.astype(np.float32))
            distance = cv2.pointPolygonTest(hull, tuple(map(float, point[:2])), True)
            found[number] |= distance > -room
    return found


strikes = st.tuples(
    st.floats(-0.2, 0.2), st.floats(-0.12, 0.12), st.floats(-3.14, 3.14), st.floats(0.0003, 0.08)
)


@given(strikes)
def test_object_and_markers_are_unobstructed_after_every_withdrawal(tap):
    made = struck(*tap)
    assume(made is not None)
    scene, joints = made
    path = withdrawal(CELL, scene, joints, MOTION)
    assume(path[-1].phase != "park")
    end = path[-1].joints
    tops = np.array(
        [[pose.x, pose.y, CELL.object.height] for pose in (scene.before, scene.predicted)]
    )
    assert not hidden(end, tops, CELL.object.body().bounding_radius).any()
    markers = np.array([[marker.x, marker.y, 0.0] for marker in CELL.references.markers])
    assert hidden(end, markers, 0.02).sum() <= MARKERS_HIDDEN
    assert GEOMETRY.forward(end).z > MOTION.travel_height - 1e-6


@given(
    st.tuples(*(st.floats(low, high) for low, high in zip(ARM.lower, ARM.upper, strict=True))),
    st.floats(-0.2, 0.2),
    st.floats(-0.12, 0.12),
)
def test_every_object_that_the_arm_hides_is_known_to_be_possibly_hidden(joints, x, y):
    tip, place = GEOMETRY.forward(joints), (x, y, CELL.object.height)
    room = CELL.object.body().bounding_radius
    assume(GEOMETRY.inverse((tip.x, tip.y, tip.z, tip.yaw)).success)
    planar = CELL.arm_base @ Pose(tip.x, tip.y, tip.yaw)
    seen = may_hide(CELL, LENS, (planar.x, planar.y, tip.z, planar.theta), place, room)
    assert seen or not hidden(Joints(*joints), np.array([place]), room).any()


def test_an_arm_far_from_an_object_does_not_hide_it() -> None:
    park = GEOMETRY.forward(ARM.park)
    planar = CELL.arm_base @ Pose(park.x, park.y, park.yaw)
    tip = planar.x, planar.y, park.z, planar.theta
    room = CELL.object.body().bounding_radius
    assert not may_hide(CELL, LENS, tip, (0.0, 0.0, CELL.object.height), room)


def test_withdrawals_are_short() -> None:
    """On average, a withdrawal takes less than half the time of parking. After at most one of the
    random taps, the arm has to be parked so that the camera sees the object."""
    rng = np.random.default_rng(3)
    early, parked, parks = 0.0, 0.0, 0
    for _ in range(60):
        made = struck(
            rng.uniform(-0.1, 0.1), rng.uniform(-0.06, 0.06), rng.uniform(-3.1, 3.1), 0.01
        )
        if made is None:
            continue
        scene, joints = made
        path = withdrawal(CELL, scene, joints, MOTION)
        early += path_duration(GEOMETRY, joints, path)
        parked += path_duration(GEOMETRY, joints, withdraw_path(GEOMETRY, joints, MOTION))
        parks += path[-1].phase == "park"
    assert early < 0.5 * parked
    assert parks <= 1


def test_without_a_camera_or_a_free_view_the_arm_parks() -> None:
    made = struck(0.0, 0.0, 0.5, 0.01)
    assert made is not None
    scene, joints = made
    park = withdraw_path(GEOMETRY, joints, MOTION)
    assert withdrawal(CELL, None, joints, MOTION) == park
    under_the_arm = replace(scene, predicted=Pose(0.0, 0.46, 0.0))
    assert withdrawal(CELL, under_the_arm, joints, MOTION) == park


@given(strikes)
def test_the_arm_strikes_with_the_elbow_on_the_side_that_leaves_the_object_visible(tap):
    made = struck(*tap)
    assume(made is not None)
    scene, _ = made
    hides = partial(hides_object, CELL, scene)
    tip = CELL.arm_base.inverse() @ scene.strike
    target = TipPose(tip.x, tip.y, ARM.strike_height, tip.theta)
    sides = [GEOMETRY.inverse(target, side).joints for side in Branch]
    reached = strike_path(GEOMETRY, ARM.park, target, MOTION, hides)[-1].joints
    own = GEOMETRY.inverse(target, near=ARM.park).branch
    possible = [not hides(joints) for joints in sides if joints is not None]
    assert hides(reached) is not any(possible)
    if not hides(GEOMETRY.inverse(target, own, near=ARM.park).joints):
        assert GEOMETRY.branch_of(reached) is own
