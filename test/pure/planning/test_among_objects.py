"""Other objects on the table are keep-out areas: neither the object nor the striker comes into
contact with them."""

import math

import numpy as np
import pytest

from tapping_cell.planning import (
    CircleArea,
    FreeSpace,
    PolygonArea,
    PositioningSession,
    PrescribedSession,
    Prescription,
    Refusal,
    RefusalReason,
    Strike,
    cautious,
    make_planner,
)
from tapping_cell.planning.gains import Gains

SQUARE = PolygonArea(((0.02, -0.09), (0.08, -0.09), (0.08, -0.03), (0.02, -0.03)), "square")
DISK = CircleArea(-0.08, 0.08, 0.04, "small disk")


@pytest.fixture(scope="module")
def among(space):
    return space.among((SQUARE, DISK))


@pytest.fixture(scope="module")
def free_space(among):
    return FreeSpace(among)


def rim(area):
    """Return points on the other object's edge, computed independently."""
    if isinstance(area, CircleArea):
        angle = np.linspace(0.0, 2.0 * math.pi, 360)
        circle = np.stack([np.cos(angle), np.sin(angle)], -1)
        return area.radius * circle + [area.x, area.y]
    corners = np.array(area.vertices)
    share = np.linspace(0.0, 1.0, 60)[:, None]
    sides = zip(corners, np.roll(corners, -1, axis=0), strict=True)
    return np.concatenate([a + share * (b - a) for a, b in sides])


def test_no_slide_and_no_striker_touches_another_object(tap, settings, among, free_space):
    planner = make_planner("exact", settings)
    rims = np.concatenate([rim(SQUARE), rim(DISK)])
    rng = np.random.default_rng(5)
    strikes = 0
    for _ in range(60):
        start, goal = (rng.uniform((-0.2, -0.14, -3), (0.2, 0.14, 3)) for _ in range(2))
        if not (free_space.contains(start[:2]) and free_space.contains(goal[:2])):
            continue
        decision = PositioningSession(goal, planner, among, free_space).decide(start)
        if not isinstance(decision, Strike):
            continue
        strikes += 1
        step = np.array([decision.wanted.x, decision.wanted.y])
        way = start[:2] + np.linspace(0.0, 1.0, 50)[:, None] * step
        gaps = np.hypot(*(way[:, None] - rims).transpose(2, 0, 1)) - tap.body.bounding_radius
        assert gaps.min() > 0.0
        pose = decision.plan.strike_pose
        back = np.linspace(0.0, among.settings.tool_length, 50)[:, None]
        bar = np.array([pose.x, pose.y]) - back * [math.cos(pose.theta), math.sin(pose.theta)]
        clear = np.hypot(*(bar[:, None] - rims).transpose(2, 0, 1)).min()
        assert clear > among.settings.tool_radius
    assert strikes > 8


def test_an_object_that_appears_and_disappears_changes_the_result_and_is_named(
    settings, space, free, known
):
    planner = make_planner("exact", settings)
    session = PositioningSession((0.15, 0.0, 0.0), planner, space, free, known())
    pose = (-0.1, 0.0, 0.0)
    first = session.decide(pose)
    assert isinstance(first, Strike) and not first.detour
    full = space.among((CircleArea(0.15, 0.05, 0.03, "cup"),))
    session.use_free_space(full, FreeSpace(full))
    refusal = session.decide(pose)
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.GOAL_IN_KEEP_OUT
    assert "'cup'" in refusal.sentence and "20.0 mm" in refusal.sentence
    wall = PolygonArea(((0.02, -0.22), (0.04, -0.22), (0.04, 0.22), (0.02, 0.22)), "ruler")
    shut = space.among((wall,))
    session.use_free_space(shut, FreeSpace(shut))
    refusal = session.decide(pose)
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.NO_PATH_TO_GOAL
    assert "'ruler'" in refusal.sentence
    session.use_free_space(space, free)
    assert session.decide(pose) == first
    assert space.workspace.keep_outs == ()


def test_a_single_tap_towards_another_object_is_refused_and_the_object_named(space):
    careful = space.among((CircleArea(0.12, 0.0, 0.03, "cup"),))
    careful.scatter = cautious(careful)
    tap = Prescription(0.6, 0.0, direction=0.0, slack=math.radians(3.0))
    session = PrescribedSession(tap, careful, FreeSpace(careful), Gains.start())
    refusal = session.decide((0.0, 0.0, 0.0))
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.TAP_LEAVES_TABLE
    assert "'cup'" in refusal.sentence
