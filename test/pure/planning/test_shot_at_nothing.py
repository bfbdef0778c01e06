"""A shot at nothing: the striker's whole stroke keeps its margin from everything."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_prescribed import DISK, SQUARE, make_tap

from tapping_cell.planning import Done, FreeSpace, Gains, Refusal, Strike, StrikeSpace, Workspace
from tapping_cell.planning.shot_at_nothing import MARGIN_M, ShotAtNothing
from tapping_cell.planning.workspace import CircleArea
from tapping_cell.se2 import transform_points, unit_vectors

STROKE, OTHER = 0.025, CircleArea(0.1, 0.05, 0.03)


@pytest.fixture(scope="module", params=[DISK, SQUARE], ids=["disk", "square"])
def space(request):
    return StrikeSpace(make_tap(request.param), Workspace(keep_outs=(OTHER,)))


def session(space):
    return ShotAtNothing(0.3, STROKE, space, FreeSpace(space), Gains.start())


@settings(max_examples=settings.default.max_examples // 5)
@given(st.floats(-0.25, 0.25), st.floats(-0.15, 0.15), st.floats(-math.pi, math.pi))
def test_the_stroke_keeps_its_margin_from_everything(space, x, y, theta):
    shot = session(space).decide((x, y, theta))
    assert isinstance(shot, Strike)
    tip, radius = shot.plan.strike_pose, space.tip_radius
    along = np.linspace(0.0, STROKE, 50)[:, None]
    path = np.array([tip.x, tip.y]) + along * unit_vectors(tip.theta)
    outline = transform_points((x, y, theta), space.outline)
    gaps = np.linalg.norm(path[:, None] - outline, axis=-1)
    assert gaps.min() >= MARGIN_M + radius - 1e-9
    assert np.linalg.norm(path - [OTHER.x, OTHER.y], axis=-1).min() >= OTHER.radius + MARGIN_M
    assert space.tool_is_clear(tip) and space.tool_clears_object((x, y, theta), tip)
    assert shot.predicted == pytest.approx((x, y, theta)) and shot.plan.striker_speed == 0.3


def test_the_session_ends_after_one_shot_and_learns_nothing(space):
    made = session(space)
    shot, before = made.decide((0.0, 0.0, 0.0)), made.gains
    made.observe(shot, (0.0, 0.0, 0.0), (0.001, 0.0, 0.0))
    assert isinstance(made.decide((0.001, 0.0, 0.0)), Done)
    assert made.gains == before and not made.predicted_covariance(shot, shot.predicted).any()


def test_an_arm_that_reaches_nothing_is_refused(space):
    narrow = StrikeSpace(space.tap, space.workspace, lambda poses: np.zeros(poses.shape[:-1], bool))
    shot = session(narrow).decide((0.0, 0.0, 0.0))
    assert isinstance(shot, Refusal) and "move the object" in shot.sentence
