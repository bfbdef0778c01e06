import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.mechanics import Impact, Polygon, Sliding, Striker, Tap
from tapping_cell.planning import (
    CameraNoise,
    CircleArea,
    FreeSpace,
    PlannerSettings,
    PlanningError,
    PositioningSession,
    Refusal,
    RefusalReason,
    Strike,
    StrikeSettings,
    StrikeSpace,
    Workspace,
    make_planner,
)
from tapping_cell.se2 import Pose

angles = st.floats(-math.pi, math.pi)


def outline_gap(space, pose, tip):
    """Return the smallest distance between the tool (sampled by discs) and the disk's edge,
    independently of the code under test."""
    s = space.settings
    gaps = [math.hypot(tip.x - pose.x, tip.y - pose.y) - space.tip_radius]
    for back in np.linspace(s.tool_start, s.tool_length, 400):
        x, y = tip.x - back * math.cos(tip.theta), tip.y - back * math.sin(tip.theta)
        gaps.append(math.hypot(x - pose.x, y - pose.y) - s.tool_radius)
    return min(gaps) - space.object_radius


@given(angles, angles, st.floats(0.002, 0.1), st.floats(-0.99, 0.99))
def test_a_strike_from_its_standoff_gives_the_displacement(space, tap, turn, heading, size, share):
    pose = Pose(0.02, -0.03, turn)
    wanted = np.array(
        [size * math.cos(heading), size * math.sin(heading), share * tap.cone_slope * size]
    )
    found = space.first_strike(pose, wanted[None, :])
    if found is None:  # this must be because the tool would touch the object
        plan = tap.plan(wanted, pose)
        assert outline_gap(space, pose, Pose(*space.rest_pose(plan.strike_pose))) < 0.0015
        return
    _, plan = found
    assert np.allclose(tap.outcome(pose, plan.strike_pose, plan.striker_speed), wanted, atol=1e-9)
    back = plan.contact_pose.distance_to(plan.strike_pose)
    assert back == pytest.approx(space.settings.standoff)
    assert plan.contact_pose.distance_to(pose) == pytest.approx(0.048 + 0.0054)
    assert outline_gap(space, pose, plan.strike_pose) >= space.settings.clearance - 1e-4


def test_taps_beside_a_keep_out_come_from_free_space(tap):
    table = Workspace(keep_outs=(CircleArea(-0.13, 0.0, 0.03),))
    space = StrikeSpace(tap, table)
    planner = make_planner("exact", PlannerSettings.for_tap(tap, CameraNoise()))
    session = PositioningSession((0.03, 0.0, 0.0), planner, space)
    strike = session.decide((-0.02, 0.0, 0.0))
    assert isinstance(strike, Strike) and strike.detour
    for back in np.linspace(0.0, space.settings.tool_length, 50):
        tip = strike.plan.strike_pose
        place = [tip.x - back * math.cos(tip.theta), tip.y - back * math.sin(tip.theta)]
        assert float(table.keep_out_distance(place)) >= space.settings.tool_radius


@pytest.fixture(scope="module")
def one_sided(tap):
    """An arm that reaches x < 0.1 with the elbow to the left, and x > -0.1 with the elbow to the
    right."""

    def reach(poses):
        return np.stack([poses[..., 0] < 0.1, poses[..., 0] > -0.1], axis=-1)

    return StrikeSpace(tap, Workspace(), reach)


def test_one_reachable_elbow_side_is_sufficient(one_sided):
    for x, side in ((-0.2, 0), (0.2, 1)):
        found = one_sided.first_strike(Pose(x, 0.0, 0.0), np.array([[0.0, 0.01, 0.0]]))
        assert found is not None
        reached = one_sided.elbows(found[1].strike_pose)
        assert reached[side] and not reached[1 - side]


def test_unachievable_striker_speeds_are_not_used(tap):
    slow = StrikeSpace(tap, Workspace(), settings=StrikeSettings(fastest=0.3))
    assert slow.first_strike(Pose(0, 0, 0), np.array([[0.1, 0, 0]])) is None
    index, _ = slow.first_strike(Pose(0, 0, 0), np.array([[0.1, 0, 0], [0.005, 0, 0]]))
    assert index == 1


def test_the_slide_with_three_deviations_stays_on_the_table(space):
    edge = space.workspace.length / 2 - space.workspace.edge_margin - space.object_radius
    start = (edge - 0.05, 0.0, 0.0)
    fits = 0.05 / (1 + 3 * space.scatter.distance)
    assert bool(space.slide_is_safe(start, [fits * 0.999, 0, 0]))
    assert not bool(space.slide_is_safe(start, [fits * 1.01, 0, 0]))
    too_near = (edge + 0.003, 0.0, 0.0)
    assert bool(space.slide_is_safe(too_near, [-0.02, 0, 0]))
    assert not bool(space.slide_is_safe(too_near, [0.002, 0, 0]))


def test_a_keep_out_beside_the_path_stops_a_long_tap_only(tap):
    space = StrikeSpace(tap, Workspace(keep_outs=(CircleArea(0.1, 0.055, 0.01),)))
    assert not bool(space.slide_is_safe((0, 0, 0), [0.15, 0, 0]))
    assert bool(space.slide_is_safe((0, 0, 0), [0.04, 0, 0]))


def test_positions_without_a_return_tap_are_not_tappable(tap):
    """An arm that can only strike towards +x can never move an object back."""

    def reach(poses):
        return np.cos(poses[..., 2]) > 0.2

    space = StrikeSpace(tap, Workspace(), reach)
    free = FreeSpace(space)
    assert not free.tappable.any()
    planner = make_planner("exact", PlannerSettings.for_tap(tap, CameraNoise()))
    refusal = PositioningSession((0.0, 0.0, 0.0), planner, space, free).decide((-0.1, 0, 0))
    assert isinstance(refusal, Refusal) and refusal.reason is RefusalReason.GOAL_OUT_OF_REACH


def test_paths_lead_around_a_wall(tap):
    wall = tuple(CircleArea(0.0, y, 0.02) for y in np.arange(-0.22, 0.06, 0.03))
    free = FreeSpace(StrikeSpace(tap, Workspace(keep_outs=wall)))
    paths = free.to_goal(np.array([0.2, -0.1]))
    straight = math.hypot(0.4, 0.0)
    assert float(paths.length([-0.2, -0.1])) > 1.2 * straight
    assert float(paths.length([0.15, -0.1])) == pytest.approx(0.05)
    shut = tuple(CircleArea(0.0, y, 0.02) for y in np.arange(-0.22, 0.23, 0.03))
    free = FreeSpace(StrikeSpace(tap, Workspace(keep_outs=shut)))
    assert not free.to_goal(np.array([0.2, -0.1])).reachable([-0.2, -0.1])


def test_the_outline_of_the_tappable_region_separates_it_from_the_rest(tap):
    free = FreeSpace(StrikeSpace(tap, Workspace(keep_outs=(CircleArea(0.05, 0.02, 0.03),))))
    edges = free.outline()
    cells = {tuple(cell) for cell in np.round(free.centres[free.tappable], 6)}
    middle = edges.mean(axis=1)
    half = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1, keepdims=True) / 2
    across = np.flip(edges[:, 1] - edges[:, 0], axis=-1) / 2
    assert np.allclose(np.linalg.norm(across, axis=-1, keepdims=True), half)
    for one, other in zip(np.round(middle + across, 6), np.round(middle - across, 6), strict=True):
        assert (tuple(one) in cells) != (tuple(other) in cells)
    # The outline is closed: each corner belongs to an even number of edges.
    _, counts = np.unique(np.round(edges.reshape(-1, 2), 6), axis=0, return_counts=True)
    assert np.all(counts % 2 == 0)


def test_a_polygon_is_struck_on_its_real_edges():
    square = Polygon(
        ((-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04)), mass=0.2, height=0.012
    )
    tap = Tap(
        sliding=Sliding(square, friction=0.17, torque_factor=2.17, gravity=9.81),
        impact=Impact(square, Striker(0.1, 0.0054), restitution=0.86, friction=0.2),
    )
    space = StrikeSpace(tap, Workspace())
    planner = make_planner("exact", PlannerSettings.for_tap(tap, CameraNoise()))
    session = PositioningSession((0.05, 0.03, 0.4), planner, space)
    pose = np.array([-0.05, -0.02, 0.1])
    for _ in range(15):
        strike = session.decide(pose)
        if not isinstance(strike, Strike):
            break
        tip, box = strike.plan.contact_pose, 0.04
        local = [
            math.cos(-pose[2]) * (tip.x - pose[0]) - math.sin(-pose[2]) * (tip.y - pose[1]),
            math.sin(-pose[2]) * (tip.x - pose[0]) + math.cos(-pose[2]) * (tip.y - pose[1]),
        ]
        beyond = np.maximum(np.abs(local) - box, 0.0)
        assert math.hypot(*beyond) == pytest.approx(0.0054, abs=1e-6)
        after = pose + tap.outcome(pose, strike.plan.strike_pose, strike.plan.striker_speed)
        session.observe(strike, pose, after)
        pose = after
    assert type(strike).__name__ == "Done"


@pytest.mark.parametrize(
    "change",
    [{"standoff": 0.0}, {"fastest": -1.0}, {"tool_length": 0.001}, {"footprint": math.nan}],
)
def test_impossible_strikers_are_refused(change):
    with pytest.raises(PlanningError):
        StrikeSettings(**change)
