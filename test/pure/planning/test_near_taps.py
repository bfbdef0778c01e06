"""With the objective `time`, a tap with a shorter arm motion is chosen if the motion saves more
time than the additional expected taps take."""

import math

import numpy as np
import pytest

from tapping_cell.configuration.assembly import make_planner_settings, make_strike_space
from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.arm_times import ArmTimes
from tapping_cell.planning import (
    CameraNoise,
    FreeSpace,
    PlannerSettings,
    PlanningError,
    PositioningSession,
    make_planner,
)
from tapping_cell.planning.evaluation import Evaluation
from tapping_cell.planning.near_taps import best_first, near_taps
from tapping_cell.planning.policy_cache import load_policy

CAMERA = CameraNoise(5e-5, math.radians(0.05))


@pytest.fixture(scope="module")
def method():
    return make_planner("optimal", PlannerSettings(camera=CAMERA))


def test_the_planned_taps_have_the_value_of_the_plan(method):
    plan = load_policy(method.settings)
    rng = np.random.default_rng(1)
    found, tabulated = [], []
    for _ in range(60):
        i, j = (int(rng.integers(0, axis.size - 5)) for axis in (plan.distances, plan.rotations))
        tap, turn = plan.tap[i, j], plan.turn[i, j]
        aside = np.array([0.0 if tap > 0 else math.pi])
        after = method.taps_after(
            plan.distances[i], plan.rotations[j], aside, np.abs([tap]), np.array([turn])
        )
        found.append(1.0 + after.item())
        tabulated.append(plan.value[i, j])
    assert found == pytest.approx(tabulated, rel=0.01, abs=0.02)


@pytest.mark.parametrize("aside", [0.0, 0.4, 1.5, 3.0])
def test_the_value_after_an_off_line_tap_matches_sampling(method, aside):
    rng = np.random.default_rng(3)
    distance, rotation, size, turn, count = 0.020, 0.25, 0.012, 0.06, 200_000
    scatter = method.settings.scatter
    far = size * (1.0 + scatter.distance * rng.standard_normal(count))
    heading = aside + scatter.direction * rng.standard_normal(count)
    measurement = 2**0.5 * CAMERA.position * rng.standard_normal((2, count))
    left = np.hypot(
        distance - far * np.cos(heading) + measurement[0], far * np.sin(heading) + measurement[1]
    )
    turned = rotation - turn * (1.0 + scatter.rotation * rng.standard_normal(count))
    turned += 2**0.5 * CAMERA.angle * rng.standard_normal(count)
    found = method.taps_after(
        distance, rotation, np.array([aside]), np.array([size]), np.array([turn])
    )
    assert found.item() == pytest.approx(method.taps_to_go(left, turned).mean(), abs=0.02)


def test_taps_outside_the_cone_do_not_count(method):
    steep = 2.0 * method.settings.cone_slope * 0.01
    after = method.taps_after(0.01, 0.1, np.zeros(1), np.array([0.01]), np.array([0.01, steep]))
    assert np.isfinite(after[0, 0, 0]) and np.isinf(after[0, 0, 1])


@pytest.fixture(scope="module")
def cell():
    made = load_cell()
    space = make_strike_space(made)
    planner = make_planner("optimal", make_planner_settings(made, (0.001, math.radians(1.0))))
    return made, space, FreeSpace(space), planner, ArmTimes(made)


def test_the_fastest_tap_accounts_for_the_path_of_the_arm(cell):
    _, space, free, planner, times = cell
    pose, goal = np.zeros(3), np.array([0.01, 0.0, 0.3])
    chosen = []
    for yaw in (0.0, 2.0, -2.0):
        session = PositioningSession(goal, planner, space, free, times=times, objective="time")
        session.arm = (-0.05 * math.cos(yaw), -0.05 * math.sin(yaw), 0.06, yaw)
        strike = session.decide(pose)
        plain = PositioningSession(goal, planner, space, free).decide(pose)
        ways = times.to_strikes(session.arm, [strike.plan.strike_pose, plain.plan.strike_pose])
        assert ways[0] <= ways[1] + 1e-9
        chosen.append(math.atan2(strike.commanded.y, strike.commanded.x))
    assert np.ptp(chosen) > 1.0, "the same tap wherever the arm stands"


def test_the_quickest_tap_comes_first(cell):
    _, space, _, planner, times = cell
    session = PositioningSession((0.0, 0.0, 0.0), planner, space, times=times)
    pose, left = np.zeros(3), np.array([0.02, 0.01, 0.3])
    own = planner.choose(math.hypot(0.02, 0.01), 0.3)
    taps = near_taps(pose, left, own, session.gains, planner, planner.settings)
    best = 1.0 + taps.follow.min()
    assert best == pytest.approx(float(planner.taps_to_go(math.hypot(0.02, 0.01), 0.3)), abs=0.02)
    quick = best_first(pose, left, taps, session.gains, space, times, times.parked)
    _, strikes = space.strike_poses(pose, quick[:1])
    row = np.argmin(np.linalg.norm(taps.commanded - quick[0], axis=1))
    ways = np.array([times.to_strikes(times.parked, strikes)[0], times.mean_way])
    # The quickest tap may need more further taps than the best one. These additional taps take at
    # most the time of the arm's motions to the quickest tap and to the next one.
    assert (taps.follow[row] - taps.follow.min()) * times.mean_tap <= ways.sum()


def test_without_values_or_an_arm_position_taps_are_counted(cell):
    _, space, free, planner, times = cell
    goal, pose = (0.05, 0.02, 0.3), (0.0, 0.0, 0.0)
    plain = PositioningSession(goal, planner, space, free).decide(pose)
    session = PositioningSession(goal, planner, space, free, times=times, objective="time")
    assert session.decide(pose).commanded == plain.commanded
    exact = make_planner("exact", planner.settings)
    session = PositioningSession(goal, exact, space, free, times=times, objective="time")
    session.arm = times.parked
    assert session.decide(pose) == PositioningSession(goal, exact, space, free).decide(pose)


@pytest.mark.parametrize("goal", [(0.05, 0.02, 0.3), (0.01, 0.0, 0.17), (-0.1, 0.06, -2.0)])
def test_a_strike_has_the_expected_taps_and_seconds_of_the_policy(cell, goal):
    _, space, free, planner, times = cell
    session = PositioningSession(goal, planner, space, free, times=times)
    session.arm = times.parked
    strike = session.decide(np.zeros(3))
    taps = float(planner.taps_to_go(math.hypot(*goal[:2]), goal[2]))
    if strike.detour:  # an alternative to the tap that the policy prefers
        assert strike.expected.taps > taps - 0.03
    else:
        assert strike.expected.taps == pytest.approx(taps, abs=0.03)
    way = times.to_strikes(times.parked, [strike.plan.strike_pose]).item()
    after = (strike.expected.taps - 1.0) * times.mean_tap
    assert strike.expected.seconds - after - way == pytest.approx(times.mean_tap - times.mean_way)


def test_a_method_without_such_a_value_returns_none(cell):
    _, space, free, planner, times = cell
    exact = make_planner("exact", planner.settings)
    strike = PositioningSession((0.05, 0.02, 0.3), exact, space, free, times=times).decide(
        np.zeros(3)
    )
    assert math.isnan(strike.expected.taps) and math.isnan(strike.expected.seconds)


def test_time_without_an_arm_is_refused():
    with pytest.raises(PlanningError, match="--table"):
        Evaluation("exact", PlannerSettings(), objective="time")
    with pytest.raises(PlanningError, match="taps, time"):
        Evaluation("exact", PlannerSettings(), objective="speed")
