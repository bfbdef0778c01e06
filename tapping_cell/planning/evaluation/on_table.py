"""Trials on a table with edges, keep-outs and an arm. Each trial is a complete session, and the
trials run one after another."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.evaluation.task import (
    Evaluation,
    Results,
    TapClock,
    TrialResult,
    draw_gains,
    draw_tasks,
    trial_result,
)
from tapping_cell.planning.evaluation.tracks import INSTANT
from tapping_cell.planning.evaluation.worlds import TrackedWorld
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.interface import Array, Planner
from tapping_cell.planning.session import PositioningSession, Strike
from tapping_cell.planning.strike import StrikeSpace
from tapping_cell.planning.track import Track
from tapping_cell.se2 import Pose, displaced

MAX_DRAWS = 1000


def run_table_trials(
    evaluation: Evaluation, planner: Planner, count: int, rng: np.random.Generator
) -> Results:
    """Run ``count`` sessions with random tappable starts, and with goals relative to these starts.

    Unreachable goals are not filtered out; the session must refuse them before the first tap.
    """
    if evaluation.space is None:
        raise PlanningError("trials on a table need a function that creates its StrikeSpace")
    space = evaluation.space()
    clock = None if evaluation.clock is None else evaluation.clock()
    free = FreeSpace(space)
    tasks = draw_tasks(evaluation, count, rng)
    true_gains = draw_gains(evaluation, count, rng)
    rows = []
    # Each trial has its own random stream, so that all methods get the same starts: the number of
    # values drawn in a trial depends on the method.
    for index, own in enumerate(rng.spawn(count)):
        start = _draw_start(space, free, own)
        goal = displaced(start, tasks[index])
        gain = true_gains[index : index + 1]
        rows.append(_run_one(evaluation, planner, space, free, clock, start, goal, gain, own))
    return Results.of_trials(rows)


def _draw_start(space: StrikeSpace, free: FreeSpace, rng: np.random.Generator) -> Array:
    half = np.array([space.workspace.length, space.workspace.width]) / 2
    for _ in range(MAX_DRAWS):
        place = rng.uniform(-half, half)
        if bool(free.contains(place)):
            return np.append(place, rng.uniform(-math.pi, math.pi))
    raise PlanningError(
        "nowhere on the table can the object be tapped from enough sides; check the arm's "
        "base and limits and the table's size in the cell file"
    )


def _run_one(
    evaluation: Evaluation,
    planner: Planner,
    space: StrikeSpace,
    free: FreeSpace,
    clock: TapClock | None,
    start: Array,
    goal: Array,
    gain: Array,
    rng: np.random.Generator,
) -> TrialResult:
    session = PositioningSession(
        goal,
        planner,
        space,
        free,
        times=clock,
        objective=evaluation.objective,
        adapt=evaluation.adapt,
        probe=evaluation.probe,
        most_taps=evaluation.most_taps,
    )
    camera = evaluation.settings.camera
    pose, over, seconds = start.copy(), False, math.nan
    if clock is not None:
        tip, seconds = clock.parked, 0.0
        session.arm = tip

    def observe() -> tuple[Array, Array]:
        return pose + camera.deviations * rng.standard_normal(3), camera.covariance

    for decision in session.decisions(observe):
        if not isinstance(decision, Strike):
            continue
        seen = displaced(session.goal, -np.array(decision.residual))
        moved = evaluation.simulation.answer(
            pose[None, :], seen[None, :], np.array([decision.commanded]), gain, rng
        )[0]
        if evaluation.track and isinstance(evaluation.simulation, TrackedWorld):
            session.track = seen_track(*evaluation.simulation.path(), evaluation, rng)
        pose = displaced(pose, moved)
        over = over or float(space.workspace.edge_distance(pose[:2])) < space.object_radius
        if clock is not None:
            spent, tip = clock.tap(tip, Pose(*seen.tolist()), decision)
            session.arm = tip
            seconds += spent
    return trial_result(session, decision, pose, evaluation.most_taps, over, seconds)


def seen_track(
    time: Array, poses: Array, evaluation: Evaluation, rng: np.random.Generator
) -> Track:
    """Return the images of a true path, poses (n, 3) at equal steps of time, that a camera with the
    rate of the evaluation takes from a random time on. One image has the noise of an observation,
    and an error of its time."""
    step = max(1, round(1.0 / (evaluation.track * (time[1] - time[0]))))
    taken = slice(int(rng.integers(step)), None, step)
    camera = evaluation.settings.camera
    speed = np.gradient(poses, time, axis=0)[taken]
    deviations = np.stack(
        [
            np.hypot(camera.position, INSTANT * np.hypot(speed[:, 0], speed[:, 1])),
            np.hypot(camera.angle, INSTANT * speed[:, 2]),
        ],
        axis=-1,
    )
    noise = deviations[:, [0, 0, 1]] * rng.standard_normal(speed.shape)
    return Track(time[taken], poses[taken] + noise, np.maximum(deviations, 1e-7))
