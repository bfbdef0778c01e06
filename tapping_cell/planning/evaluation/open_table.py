"""Vectorised trials on a table without edges and obstacles: each step is computed for all trials at
once."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tapping_cell.planning.evaluation.polygon_taps import contact_taps
from tapping_cell.planning.evaluation.task import (
    TRUTH,
    End,
    Evaluation,
    Results,
    draw_gains,
    draw_tasks,
)
from tapping_cell.planning.evaluation.worlds import draw_starts
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.interface import Array, Planner
from tapping_cell.planning.session import MISSED
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.stopping import LONG_OBSERVATION
from tapping_cell.se2 import difference

ASIDE = math.radians(30.0)
"""Largest random change of direction after a miss. The same tap would miss again."""


def run_open_trials(
    evaluation: Evaluation, planner: Planner, count: int, rng: np.random.Generator
) -> Results:
    """Run ``count`` trials with one random stream."""
    camera = evaluation.settings.camera
    pose = draw_starts(count, rng)
    goal = pose + draw_tasks(evaluation, count, rng)
    true_gains = draw_gains(evaluation, count, rng)
    gains = Gains.start((count,))
    camera_noise = camera.deviations
    seen = pose + camera_noise * rng.standard_normal((count, 3))
    taps = np.zeros(count, dtype=np.int64)
    end = np.full(count, End.ENDLESS, dtype=np.int64)
    aside = np.zeros(count)
    running: NDArray[np.intp] = np.arange(count, dtype=np.intp)
    model = evaluation.world.model if evaluation.world is not None else None
    for _ in range(evaluation.most_taps + 1):
        inside = observe_longer(seen, pose, goal, running, evaluation.settings, rng)
        left = difference(seen[running], goal[running])
        end[running[inside]] = End.DONE
        running, left = running[~inside], left[~inside]
        if running.size == 0:
            break
        still = taps[running] < evaluation.most_taps
        running, left = running[still], left[still]
        known = gains.of(running)
        box = evaluation.settings.stopping.rotation
        distance, turn, heading = known.to_plan(left, box)
        tap = planner.choose(distance, turn)
        orientation = seen[running, 2]
        commanded = known.command(
            tap.distance,
            known.from_plan(left, tap.rotation, box),
            heading + aside[running],
            orientation,
            evaluation.settings.cone_slope,
        )
        if model is not None:
            commanded = contact_taps(
                seen[running], goal[running], commanded, known.value, planner, model
            )
            struck = ~np.isnan(commanded[:, 0])
            stuck = running[~struck]
            end[stuck] = np.where(taps[stuck] == 0, End.REFUSED_BEFORE, End.REFUSED_LATER)
            running, commanded, orientation = (
                running[struck],
                commanded[struck],
                orientation[struck],
            )
            known = gains.of(running)
        asked = known.predict(commanded, orientation)
        moved = evaluation.simulation.answer(
            pose[running], seen[running], commanded, true_gains[running], rng
        )
        pose[running] += moved
        before = seen[running]
        seen[running] = pose[running] + camera_noise * rng.standard_normal((running.size, 3))
        taps[running] += 1
        measured = seen[running] - before
        missed = np.hypot(measured[:, 0], measured[:, 1]) < MISSED * np.hypot(
            asked[:, 0], asked[:, 1]
        )
        aside[running] = np.where(missed, rng.uniform(-ASIDE, ASIDE, running.size), 0.0)
        if evaluation.adapt:
            slid = evaluation.track_of(pose[running], moved, true_gains[running], rng)
            learnt = known.observe(
                commanded, measured, orientation, evaluation.settings.scatter, camera, slid
            )
            if evaluation.track == TRUTH:
                learnt = known_exactly(learnt, true_gains[running])
            gains.put(running, learnt)
    left = difference(pose, goal)
    distance, rotation = np.hypot(left[:, 0], left[:, 1]), left[:, 2]
    within = evaluation.settings.within_tolerance(left)
    never = np.zeros(count, dtype=bool)
    seconds = np.asarray(taps * evaluation.mean_tap, dtype=float)
    return Results(taps, end, within, distance, rotation, never, seconds)


def known_exactly(gains: Gains, truth: Array) -> Gains:
    """Return ``gains`` with the true gains (n, 4) of distance and rotation and the true offsets in
    all filters."""
    zero = np.zeros(len(truth))
    for belief, numbers in (
        (gains.distance, np.stack([zero, np.log(truth[:, 0])], axis=-1)),
        (
            gains.rotation,
            np.stack([zero, truth[:, 1] / truth[:, 0], *truth[:, 2:].T, zero, zero], axis=-1),
        ),
    ):
        belief.mean[...] = numbers[:, None, :]
        belief.covariance[...] = 1e-8 * np.eye(numbers.shape[-1])
    return gains


def observe_longer(
    seen: Array,
    pose: Array,
    goal: Array,
    rows: NDArray[np.intp],
    settings: PlannerSettings,
    rng: np.random.Generator,
) -> NDArray[np.bool_]:
    """Return which objects in ``rows`` are at their goals with the required confidence.

    While this is uncertain, an object is observed again, up to ``LONG_OBSERVATION`` observations in
    total. ``seen`` is overwritten with the mean of the observations."""
    camera_noise = settings.camera.deviations
    inside = np.zeros(rows.size, dtype=bool)
    open_rows: NDArray[np.intp] = np.arange(rows.size)
    for observations in range(1, LONG_OBSERVATION + 1):
        at = rows[open_rows]
        if observations > 1:
            fresh = pose[at] + camera_noise * rng.standard_normal((at.size, 3))
            seen[at] += (fresh - seen[at]) / observations
        found = settings.arrival(
            difference(seen[at], goal[at]), settings.camera.covariance / observations
        )
        inside[open_rows[found.done]] = True
        open_rows = open_rows[~found.done & found.doubtful]
        if open_rows.size == 0 or not np.any(camera_noise):
            break
    return inside
