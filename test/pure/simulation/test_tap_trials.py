"""The interface through which evaluation uses the simulated world."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.configuration.assembly import make_tap
from tapping_cell.configuration.cell import load_cell
from tapping_cell.planning import CameraNoise, PlannerSettings, make_planner
from tapping_cell.planning.evaluation import Evaluation, PhysicsWorld, run_open_trials
from tapping_cell.planning.evaluation.task import End
from tapping_cell.planning.settings import Scatter
from tapping_cell.simulation.tap_trials import SimulatedTaps
from tapping_cell.simulation.truth import ScatterTruth, SupportTruth, TruthFile

CELL = load_cell()
TAP = make_tap(CELL)
PLAIN = TruthFile((0.0, 0.0, 0.0))


def commanded(count: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    poses = np.column_stack([random.uniform(-0.1, 0.1, (count, 2)), random.uniform(-3, 3, count)])
    distance, heading = random.uniform(0.005, 0.05, count), random.uniform(-3, 3, count)
    turn = random.uniform(-0.9, 0.9, count) * TAP.cone_slope * distance
    return poses, np.column_stack([distance * np.cos(heading), distance * np.sin(heading), turn])


def test_without_errors_it_agrees_with_the_closed_forms() -> None:
    poses, wanted = commanded(12)
    random = np.random.default_rng(1)
    gains = np.tile([1.0, 1.0, 0.0, 0.0], (12, 1))
    moved = SimulatedTaps(TAP, CELL.object, PLAIN).answer(poses, poses, wanted, gains, random)
    still = Scatter(0.0, 0.0, 0.0)
    closed = PhysicsWorld(model=TAP, truth=TAP, scatter=still).answer(
        poses, poses, wanted, gains, random
    )
    distance = np.hypot(wanted[:, 0], wanted[:, 1])
    assert np.max(np.hypot(*(moved - closed)[:, :2].T) / distance) < 0.01
    assert np.max(np.abs(moved[:, 2] - closed[:, 2]) * 0.048 / distance) < 0.01


def test_results_depend_on_simulation_parameters_gains_and_random_generator() -> None:
    poses, wanted = commanded(4)
    truth = replace(
        PLAIN, support=SupportTruth(friction_factor=2.0), scatter=ScatterTruth(0.02, 0.1, 0.01)
    )
    world = SimulatedTaps(TAP, CELL.object, truth)
    gains = np.full((4, 2), 1.5)
    first, again = (
        world.answer(poses, poses, wanted, gains, np.random.default_rng(7)) for _ in range(2)
    )
    assert np.array_equal(first, again)
    # Twice the friction halves the distance, which is then multiplied by the gain.
    ratio = np.hypot(*first[:, :2].T) / np.hypot(*wanted[:, :2].T)
    assert ratio == pytest.approx(0.75, rel=0.15)
    assert not math.isclose(ratio[0], ratio[1])


def test_goals_are_reached_in_a_world_that_the_files_do_not_describe() -> None:
    truth = replace(
        PLAIN,
        support=SupportTruth(friction_factor=0.6, torque_factor_ratio=0.6, pressure="rim"),
        scatter=ScatterTruth(0.02, 0.1, 0.01),
    )
    settings = PlannerSettings.for_tap(TAP, CameraNoise())
    evaluation = Evaluation(
        planner="exact",
        settings=settings,
        trials=8,
        world=SimulatedTaps(replace(TAP, smallest_distance=0.0), CELL.object, truth),
        adapt=True,
    )
    planner = make_planner("exact", settings)
    results = run_open_trials(evaluation, planner, 8, np.random.default_rng(2))
    assert np.all(results.end == End.DONE) and np.all(results.inside)
    assert results.taps.mean() < 8
