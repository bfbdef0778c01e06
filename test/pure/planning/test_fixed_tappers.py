"""Fixed tappers: the choice of taps, learning of the lines, coverage, refusals."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.configuration.assembly import make_fixed_space, make_planner_settings
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.planning import CircleArea, Refusal, RefusalReason, Strike
from tapping_cell.planning.coverage import coverage
from tapping_cell.planning.evaluation.fixed_cell import FixedEvaluation, evaluate_fixed
from tapping_cell.planning.evaluation.task import End
from tapping_cell.planning.fixed_policy import Grading, scatter_points, states_after
from tapping_cell.planning.fixed_session import FixedTapperSession
from tapping_cell.planning.fixed_solver import GoalSolver
from tapping_cell.planning.fixed_tappers import BESIDES_FLIGHT_S, MEAN_TAP_S, FixedStrikeSpace
from tapping_cell.planning.mounts import MountBelief
from tapping_cell.planning.settings import CameraNoise, Scatter
from tapping_cell.se2 import Pose

CELL = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")
SPACE = make_fixed_space(CELL)
PLAN = replace(
    make_planner_settings(CELL, CELL.tolerance), camera=CameraNoise(5e-5, math.radians(0.05))
)
TIP = CELL.file.tapper.tip_radius


@cache
def solver() -> GoalSolver:
    """Return a solver with two coarse grids, which takes half a second per goal. Its solutions need
    0.2 taps more than those of the normal grids."""
    return GoalSolver(finer=(0.5,))


def session(goal=(0.0, 0.0, 0.0), space: FixedStrikeSpace = SPACE) -> FixedTapperSession:
    return FixedTapperSession(goal, PLAN, space, solver())


@given(x=st.floats(-0.05, 0.05), y=st.floats(-0.05, 0.05), theta=st.floats(-3.0, 3.0))
def test_a_disk_is_hit_where_its_line_passes(x: float, y: float, theta: float) -> None:
    """The lever arm of a line about the centre of a disk determines the contact and the direction
    of rotation."""
    lines = SPACE.lines(np.array([x, y, theta]))
    reach = SPACE.object_radius + TIP
    for index, tapper in enumerate(SPACE.tappers):
        mount = tapper.mount
        along = np.array([math.cos(mount.theta), math.sin(mount.theta)])
        to = np.array([x - mount.x, y - mount.y])
        # lever arm of the disk's centre, positive to the left of the line
        lever = along[0] * to[1] - along[1] * to[0]
        if abs(lever) < reach * math.sin(math.radians(59.0)):
            assert lines.usable[index]
            travel = to @ along - math.sqrt(reach**2 - lever**2)
            assert lines.travel[index] == pytest.approx(travel, abs=1e-9)
        elif abs(lever) > reach * math.sin(math.radians(61.0)):
            assert not lines.usable[index]
        if lines.usable[index] and abs(lever) > 1e-6:
            # An impact to the right of the object's centre turns the object counter-clockwise.
            assert np.sign(lines.slope[index]) == np.sign(lever)


@given(distance=st.floats(0.002, 0.08), index=st.integers(0, 7))
def test_the_planned_speed_gives_the_planned_distance(distance: float, index: int) -> None:
    pose = np.array([0.005, -0.003, 0.4])
    plan = SPACE.plan(index, pose, distance)
    mount = SPACE.tappers[index].mount
    moved = SPACE.tappers[index].tap.outcome(
        pose, [mount.x, mount.y, mount.theta], plan.striker_speed
    )
    assert math.hypot(moved[0], moved[1]) == pytest.approx(distance, rel=1e-6)
    assert plan.tapper == SPACE.tappers[index].name


def test_the_shipped_cell_covers_its_area_and_an_incomplete_one_does_not() -> None:
    assert not np.any(coverage(SPACE).dead)
    half = make_fixed_space(
        replace(
            CELL,
            file=replace(
                CELL.file,
                fixed_tappers=replace(CELL.fixed_tappers, tappers=CELL.fixed_tappers.tappers[:4]),
            ),
        )
    )
    assert np.mean(coverage(half).dead) > 0.2


def test_trials_end_at_the_goal() -> None:
    results = evaluate_fixed_coarse(FixedEvaluation(SPACE, PLAN, trials=6, seed=1))
    assert np.all(results.end == End.DONE)
    assert np.all(results.inside)
    assert np.mean(results.taps) < 7.0


def test_the_coarse_solution_also_turns_an_object_half_around() -> None:
    """The first taps are chosen from the coarse solution. In an earlier version, whose grid steps
    were proportional to the rotation, the interpolated values near half a turn were three times too
    high. The chosen taps were then too short, and a goal took 20 taps."""
    half_around = FixedEvaluation(
        SPACE, PLAN, trials=6, seed=1, start_angle=math.pi, goal=(-0.05, 0.02, -1.57)
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "tapping_cell.planning.evaluation.fixed_cell.GoalSolver", lambda: GoalSolver(finer=())
        )
        results = evaluate_fixed(half_around)
    assert np.all(results.end == End.DONE)
    assert np.mean(results.taps) < 13.0


@given(
    step=st.floats(0.05, 1.0),
    fine=st.floats(1e-4, 0.1),
    ratio=st.floats(0.1, 1e3),
    numbers=st.lists(st.floats(-40.0, 40.0), min_size=1, max_size=20),
)
def test_the_grading_is_monotone_and_its_steps_are_limited(step, fine, ratio, numbers):
    grading = Grading(step, fine, ratio * step * fine)
    steps = np.sort(np.array(numbers))
    assert grading.steps(grading.value(steps)) == pytest.approx(steps, rel=1e-6, abs=1e-6)
    whole = grading.value(np.arange(-30, 31))
    assert np.all(np.diff(whole) > 0.0)
    assert np.all(np.diff(whole) <= grading.widest * (1.0 + 1e-9))


def test_trials_take_about_the_minimum_expected_time() -> None:
    """If nothing needs to be learnt, goals take the predicted time, or a little less because
    interpolation on the coarse grid overestimates it."""
    space = make_fixed_space(CELL, objective="time")
    assert space.key() != SPACE.key()
    trials, turned = 16, math.radians(10.0)
    results = evaluate_fixed_coarse(
        FixedEvaluation(space, PLAN, trials=trials, start_angle=turned, adapt=False, seed=3)
    )
    assert np.all(results.end == End.DONE)
    assert np.all(results.seconds >= BESIDES_FLIGHT_S * results.taps)
    solution = solver().goal(space, PLAN, np.zeros(3)).solution
    assert solution is not None
    rng = np.random.default_rng(4)
    radius = space.area.radius * np.sqrt(rng.random(400))
    bearing, theta = rng.uniform(-math.pi, math.pi, 400), rng.uniform(-turned, turned, 400)
    starts = np.stack([radius * np.cos(bearing), radius * np.sin(bearing), theta], axis=-1)
    expected = MEAN_TAP_S * float(np.mean(solution.taps_to_go(starts)))
    error = np.std(results.seconds) / math.sqrt(trials)
    assert 0.6 * expected < np.mean(results.seconds) < expected + 2.0 * error


@pytest.mark.parametrize("objective", ["taps", "time"])
def test_a_tap_has_the_expected_taps_and_seconds_of_the_solution(objective: str) -> None:
    space = make_fixed_space(CELL, objective=objective)
    solved = solver()
    solution = solved.goal(space, PLAN, np.zeros(3)).solution
    assert solution is not None
    unit = MEAN_TAP_S if objective == "time" else 1.0
    ratios = []
    for pose in ([0.03, 0.02, 0.2], [-0.04, 0.01, -0.1], [0.0, -0.05, 0.5], [0.02, 0.0, 1.0]):
        strike = FixedTapperSession((0.0, 0.0, 0.0), PLAN, space, solved).decide(pose)
        assert isinstance(strike, Strike)
        taps, seconds = strike.expected
        ratios.append((seconds if objective == "time" else taps) / unit)
        ratios[-1] /= solution.taps_to_go([pose]).item()
        assert taps >= 1.0 and seconds > BESIDES_FLIGHT_S * taps
    assert 0.8 < np.mean(ratios) < 1.2


def test_displaced_lines_are_learnt_while_tapping() -> None:
    evaluation = FixedEvaluation(
        SPACE, PLAN, trials=6, seed=2, mount_error=(5e-4, math.radians(0.5))
    )
    results = evaluate_fixed_coarse(evaluation)
    assert np.all(results.end == End.DONE)
    assert np.all(results.inside)


def evaluate_fixed_coarse(evaluation: FixedEvaluation):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tapping_cell.planning.evaluation.fixed_cell.GoalSolver", solver)
        return evaluate_fixed(evaluation)


def test_impossible_goals_are_refused() -> None:
    outside = session(goal=(0.0, 0.075, 0.0)).decide([0.0, 0.0, 0.0])
    assert isinstance(outside, Refusal)
    assert outside.reason is RefusalReason.GOAL_OUTSIDE_WORKING_AREA
    assert "5.0 mm outside" in outside.sentence
    among = SPACE.among([CircleArea(0.05, 0.0, 0.01, "a clamp")])
    kept = session(goal=(0.02, 0.0, 0.0), space=among).decide([0.0, 0.0, 0.0])
    assert isinstance(kept, Refusal)
    assert kept.reason is RefusalReason.GOAL_IN_KEEP_OUT
    far = session().decide([0.12, 0.0, 0.0])
    assert isinstance(far, Refusal)
    assert far.reason is RefusalReason.OBJECT_OFF_TABLE
    lost = session().decide([math.nan, 0.0, 0.0])
    assert isinstance(lost, Refusal)


def test_a_stroke_that_would_touch_a_keep_out_is_not_used() -> None:
    tapper = SPACE.tappers[0]
    way = 0.9 * tapper.stroke
    foot = CircleArea(
        tapper.mount.x + way * math.cos(tapper.mount.theta),
        tapper.mount.y + way * math.sin(tapper.mount.theta),
        0.004,
    )
    usable = SPACE.among([foot]).lines(np.zeros(3)).usable
    assert not usable[0]
    assert SPACE.lines(np.zeros(3)).usable[0]


def test_a_tapper_that_missed_is_not_used_again_at_once() -> None:
    run = session()
    pose = np.array([0.03, 0.01, 0.2])
    first = run.decide(pose)
    assert isinstance(first, Strike)
    run.observe(first, pose, pose)
    second = run.decide(pose)
    assert isinstance(second, Strike)
    assert second.plan.tapper != first.plan.tapper


def test_the_scatter_points_have_unit_deviation() -> None:
    points = scatter_points(24)
    assert np.allclose(points.mean(axis=0), 0.0, atol=1e-12)
    assert points.std(axis=0) == pytest.approx([1.0, 1.0, 1.0])


def test_states_after_a_tap_have_the_scatter_with_its_floor() -> None:
    scatter = Scatter(0.05, 0.15, 0.02, 3e-4, 0.01)
    length, slope = np.array([0.002, 0.02]), np.array([2.0])
    after = states_after(np.zeros((2, 3)), np.zeros(2), slope, length, scatter, scatter_points(400))
    assert after.std(axis=1) == pytest.approx(
        np.stack(
            [scatter.along(length), scatter.across(length), scatter.turning(2.0 * length)], axis=-1
        ),
        rel=0.05,
    )


@pytest.mark.parametrize(("offset", "angle"), [(0.0006, 0.0), (0.0, 0.008), (-0.0005, 0.005)])
def test_a_line_is_estimated_from_single_taps(offset: float, angle: float) -> None:
    """The object is placed by hand at a dozen poses. The line is found to 0.3 mm at the object."""
    rng = np.random.default_rng(3)
    nominal = SPACE.tappers[0].mount
    true = Pose(
        nominal.x - offset * math.sin(nominal.theta),
        nominal.y + offset * math.cos(nominal.theta),
        nominal.theta + angle,
    )
    truth = SPACE.with_mounts([true, *(tapper.mount for tapper in SPACE.tappers[1:])])
    belief = MountBelief.start(8, 0.001, math.radians(1.0))
    for _ in range(24):
        pose = np.array([rng.uniform(-0.05, 0.05), rng.uniform(-0.02, 0.03), 0.0])
        lines = truth.lines(pose)
        if not lines.usable[0]:
            continue
        heading = lines.heading[0] + PLAN.scatter.direction * rng.standard_normal()
        moved = 0.03 * np.array([math.cos(heading), math.sin(heading), 0.0])
        moved[2] = 0.03 * lines.slope[0] * (1.0 + PLAN.scatter.rotation * rng.standard_normal())
        belief = belief.observe(0, SPACE.tappers[0], pose, moved, 1.0, PLAN.scatter, PLAN.camera)
    found = belief.mount(0, nominal)
    at_contact = 0.11
    gap = (offset + angle * at_contact) - (belief.mean[0, 0] + belief.mean[0, 1] * at_contact)
    assert abs(gap) < 0.0004
    assert found.theta == pytest.approx(true.theta, abs=0.012)
