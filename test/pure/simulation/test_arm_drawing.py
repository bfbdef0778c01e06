"""The drawn arm: it hides no more than its silhouettes, and does not disturb measurements."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.arm_in_view import bars_in_table
from tapping_cell.logic.withdrawal import Scene, withdrawal
from tapping_cell.se2 import Pose
from tapping_cell.simulation.arm_drawing import ArmDrawing, StrikerDrawing
from tapping_cell.simulation.arm_picture import arm_solids
from tapping_cell.simulation.rendered_camera import Drawing
from tapping_cell.simulation.scene import make_renderer
from tapping_cell.simulation.truth import CameraTruth
from tapping_cell.vision import ArmBars, PoseTracker, UnknownObjects

CELL = load_cell()
ARM, TAPPER, TABLE = CELL.file.arm, CELL.file.tapper, CELL.file.table
DRAWN = ArmDrawing(ARM, TAPPER, CELL.arm_base)
OUTLINE = CELL.object.body().boundary(np.linspace(-math.pi, math.pi, 96, endpoint=False))
LENS = CameraTruth().position
CLEAN = make_renderer(CELL, CameraTruth(noise=0.0), OUTLINE, 1)
NOISY = make_renderer(CELL, CameraTruth(), OUTLINE, 1)
AWAY = (5.0, 5.0, 0.0)
REACH = 0.07
strikes = st.tuples(st.floats(-0.18, 0.18), st.floats(-0.12, 0.12), st.floats(-3.1, 3.1))


def joints_at(strike: Pose, height: float = ARM.strike_height) -> tuple[float, ...] | None:
    """Return joints with the tip at a pose in ``table``; None if the arm does not reach it."""
    tip = CELL.arm_base.inverse() @ strike
    solution = ARM.geometry().inverse((tip.x, tip.y, height, tip.theta), near=ARM.park)
    return solution.joints


@given(strikes, st.floats(0.006, 0.1))
@settings(max_examples=settings.default.max_examples // 5)
def test_every_part_lies_within_the_silhouettes_that_hide_the_object(strike, height) -> None:
    joints = joints_at(Pose(*strike), height)
    assume(joints is not None)
    drawn = DRAWN.at(joints)
    unshaded = Drawing(drawn.points, tuple(replace(part, shade=0.0) for part in drawn.parts))
    solids = arm_solids(ARM, TAPPER, CELL.arm_base, joints)
    empty = CLEAN.render(AWAY)
    empty = CLEAN.render(AWAY)
    silhouettes = CLEAN.render(AWAY, occluders=solids) != empty
    outside = (CLEAN.render(AWAY, drawings=(unshaded,)) != empty) & ~silhouettes
    # The silhouettes have twelve corners instead of round ends.
    assert outside.sum() <= 0.02 * silhouettes.sum()


@given(strikes, st.floats(0.002, 0.06))
@settings(max_examples=settings.default.max_examples // 5, deadline=None)
def test_the_pose_beside_a_withdrawn_arm_is_as_accurate_as_stated(place, slide) -> None:
    """The arm's shadow may fall on the object and on the reference markers, but the arm is not an
    unknown object."""
    pose, way = Pose(*place), np.array([math.cos(place[2]), math.sin(place[2])])
    joints = joints_at(pose @ Pose(-REACH, 0.0, 0.0))
    assume(joints is not None)
    after = Pose(pose.x + slide * way[0], pose.y + slide * way[1], 0.4)
    scene = Scene(LENS, pose, after, pose @ Pose(-REACH, 0.0, 0.0))
    path = withdrawal(CELL, scene, joints, ARM.motion())
    resting = path[-1].joints
    shown = (DRAWN.at(resting),)
    tracker = PoseTracker(CELL.camera, CELL.references, CELL.object.seen())
    camera = make_renderer(CELL, CameraTruth(), OUTLINE, 1)
    seen = None
    for k in range(12):
        seen = tracker.update(camera.render(after, drawings=shown), k / 30.0)
    assert seen is not None and seen.visible, seen
    error = np.array(seen.pose)[:2] - np.array(after)[:2]
    assert error @ np.linalg.solve(seen.covariance[:2, :2], error) < 4.0**2
    assert np.linalg.norm(error) < 1e-4
    bars = bars_in_table(CELL, ARM.geometry(), [resting])
    finder = UnknownObjects(TABLE.length, TABLE.width, CELL.references)
    image = NOISY.render(AWAY, drawings=shown)
    finder.search(image, NOISY.view, [], ArmBars(bars.start[0], bars.end[0], bars.radius))
    assert finder.outlines == []


def test_the_stroke_of_the_striker_is_visible() -> None:
    """The ball moves ahead by the stroke, and the housing stays."""
    drawing, rest = StrikerDrawing(TAPPER), Pose(-0.1, 0.05, 0.3)
    for out in (0.0, TAPPER.stroke):
        bright = CLEAN.render(AWAY, drawings=(drawing.at(rest, 0.006, out),)) > 250
        rows, columns = np.nonzero(bright)
        tip = rest @ Pose(out, 0.0, 0.0)
        expected = CLEAN.view.project(np.array([[tip.x, tip.y]]), 0.006)[0]
        assert math.dist((columns.mean(), rows.mean()), expected) < 4.0


def test_an_unchanged_drawing_gives_the_same_picture_and_a_moved_object_is_drawn_below_it() -> None:
    arm = (DRAWN.at(ARM.park),)
    first = CLEAN.render((0.0, 0.0, 0.0), drawings=arm)
    assert np.array_equal(first, CLEAN.render((0.0, 0.0, 0.0), drawings=arm))
    moved = CLEAN.render((0.1, 0.0, 0.0), drawings=arm)
    assert np.array_equal(moved, CLEAN.render((0.1, 0.0, 0.0), drawings=(DRAWN.at(ARM.park),)))
    assert np.array_equal(CLEAN.render((0.1, 0.0, 0.0)), CLEAN.render((0.1, 0.0, 0.0), drawings=()))
