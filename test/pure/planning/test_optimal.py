import math
import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tapping_cell.planning import CameraNoise, PlannerSettings, Scatter, make_planner
from tapping_cell.planning import optimal as optimal_module
from tapping_cell.planning import value_iteration as solver
from tapping_cell.planning.evaluation import Evaluation, evaluate, summarise
from tapping_cell.planning.optimal import OptimalPlanner
from tapping_cell.planning.policy_cache import load_policy, policy_file

TASKS = [(0.010, 10.0), (0.002, 8.0), (0.300, 180.0)]


@pytest.fixture(scope="module")
def planner():
    return make_planner("optimal", PlannerSettings())


@cache
def simulate(planner, distance, degrees, count=10_000):
    evaluation = Evaluation(
        "optimal",
        planner.settings,
        trials=count,
        goal=(distance, 0.0, math.radians(degrees)),
        seed=7,
    )
    return summarise(evaluate(evaluation, processes=1))["taps"]


@pytest.mark.parametrize(("distance", "degrees"), TASKS)
def test_the_value_is_the_mean_number_of_taps_of_simulated_runs(planner, distance, degrees):
    value = float(planner.taps_to_go(distance, math.radians(degrees)))
    assert simulate(planner, distance, degrees)["mean"] == pytest.approx(value, rel=0.015)


@pytest.mark.parametrize(("distance", "degrees"), TASKS)
def test_no_other_method_needs_fewer_taps(planner, distance, degrees):
    goal = (distance, 0.0, math.radians(degrees))
    best = simulate(planner, distance, degrees)
    for name in ("exact", "conservative", "multi"):
        taps = summarise(
            evaluate(Evaluation(name, planner.settings, trials=2000, goal=goal), processes=1)
        )["taps"]
        assert best["mean_interval"][0] <= taps["mean_interval"][1], name


def test_the_first_tap_of_the_papers_task(planner):
    tap = planner.choose(0.010, math.radians(10.0))
    assert 1e3 * float(tap.distance) == pytest.approx(22.7, abs=1.0)
    assert math.degrees(float(tap.rotation)) == pytest.approx(7.6, abs=0.4)


def test_taps_stay_in_the_cone(planner):
    rng = np.random.default_rng(0)
    tap = planner.choose(rng.uniform(0, 0.5, 5000), rng.uniform(-math.pi, math.pi, 5000))
    assert np.all(
        np.abs(tap.rotation) <= planner.settings.cone_slope * np.abs(tap.distance) * (1 + 1e-9)
    )
    assert np.all(np.abs(tap.distance) >= planner.settings.smallest_distance * (1 - 1e-9))


def test_expected_weights_match_sampling():
    grid, _ = solver.state_grid(0.001, 0.0017, 0.35)
    rng = np.random.default_rng(1)
    cases = [(0.0, 0.0004, 0.0002), (0.0011, 0.0002, 0.0004), (-0.02, 0.001, 0.0005)]
    mean, along, aside = (np.array(column) for column in zip(*cases, strict=True))
    whole, inside = solver._radial_weights(grid, mean, along, aside)
    value = np.sqrt(grid)  # an arbitrary nonlinear function
    assert np.allclose(whole.sum(axis=-1), 1.0, atol=1e-5)
    for row, (m, a, s) in enumerate(cases):
        drawn = np.hypot(m + a * rng.standard_normal(400_000), s * rng.standard_normal(400_000))
        sampled = np.interp(drawn, grid, value)
        assert float(whole[row] @ value) == pytest.approx(sampled.mean(), rel=0.01)
        within = np.where(drawn <= grid[solver.FINE_STEPS], sampled, 0.0).mean()
        got = float(inside[row] @ value[: solver.FINE_STEPS + 1])
        assert got == pytest.approx(within, rel=0.03, abs=2e-4)


def test_a_solved_plan_is_loaded_from_disk_and_a_damaged_one_is_solved_again(
    planner, caplog, monkeypatch
):
    settings = planner.settings
    kept = load_policy(settings)
    assert kept is not None
    solved = []
    monkeypatch.setattr(
        optimal_module, "solutions", lambda given: iter([solved.append(given) or kept])
    )
    assert load_policy(replace(settings, tolerance_position=0.0011)) is None
    path = policy_file(settings)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert load_policy(settings) is None
    assert "solving it again" in caplog.text
    again = make_planner("optimal", settings)
    assert solved == [settings]
    assert path.read_bytes() == whole or load_policy(settings) is not None
    assert float(again.choose(0.01, 0.1).distance) == float(planner.choose(0.01, 0.1).distance)


def test_another_method_is_used_while_a_plan_is_solved(planner, monkeypatch):
    gate, solved = threading.Event(), load_policy(planner.settings)
    coarse, asked = threading.Event(), threading.Event()

    def slow(settings):
        gate.wait(30.0)
        yield solved._replace(tap=np.full_like(solved.tap, 0.03))
        asked.set()
        coarse.wait(30.0)
        yield solved

    monkeypatch.setattr(optimal_module, "solutions", slow)
    settings = PlannerSettings(tolerance_position=0.0013)
    planner = make_planner("optimal", settings, background=True)
    assert not planner.ready and planner.name.startswith("exact")
    exact = make_planner("exact", settings).choose(0.01, 0.2)
    assert float(planner.choose(0.01, 0.2).distance) == float(exact.distance)
    gate.set()
    assert asked.wait(30.0)
    assert not planner.ready and planner.name.startswith("optimal on a coarse grid")
    assert float(planner.choose(0.01, 0.2).distance) == pytest.approx(0.03)
    coarse.set()
    assert planner.wait(60.0) and planner.name == "optimal"


def test_a_failure_in_the_background_is_stored_and_the_fallback_continues(monkeypatch):
    def broken(settings):
        raise MemoryError("no room")

    monkeypatch.setattr(optimal_module, "solutions", broken)
    planner = OptimalPlanner(PlannerSettings(tolerance_position=0.0014), background=True)
    assert not planner.wait(10.0)
    assert isinstance(planner.failure, MemoryError)
    assert float(planner.choose(0.01, 0.0).distance) == pytest.approx(0.01)


@pytest.mark.parametrize(
    "settings",
    [
        PlannerSettings(scatter=Scatter(0.0, 0.0, 0.0)),
        PlannerSettings(tolerance_position=0.01, tolerance_angle=0.2),
        PlannerSettings(cone_slope=31.0, camera=CameraNoise(2e-4, 3e-3)),
    ],
)
def test_other_cells_have_plans_too(settings):
    planner = make_planner("optimal", settings)
    taps = simulate(planner, 0.02, 20.0, 3000)
    value = float(planner.taps_to_go(0.02, math.radians(20.0)))
    assert taps["mean"] == pytest.approx(value, rel=0.06)


def test_a_rotation_beyond_half_a_turn_in_the_cones_units_still_costs_taps(settings):
    """Beyond the grid, the expected number of further taps grows linearly with the remaining
    rotation."""
    policy = make_planner("optimal", settings)
    far = policy.taps_to_go(np.full(4, 0.09), np.array([3.0, 4.0, 5.0, 6.0]))
    largest = settings.cone_slope * settings.largest_distance
    assert np.all(np.diff(far)[1:] == pytest.approx(1.0 / largest, rel=1e-6))


def test_the_coarse_plan_comes_first_and_is_nearly_as_good(planner):
    first, last = solver.solutions(planner.settings)
    assert first.value.size < last.value.size / 3
    rough = optimal_module.OptimalPolicy(planner.settings, first)
    for distance, degrees in TASKS:
        taps = float(rough.taps_to_go(distance, math.radians(degrees)))
        best = float(planner.taps_to_go(distance, math.radians(degrees)))
        assert taps == pytest.approx(best, rel=0.15)
