"""Trials spread over the cores; the result depends on the seed alone, not on how many there are."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from tapping_cell.planning.evaluation.on_table import run_table_trials
from tapping_cell.planning.evaluation.open_table import run_open_trials
from tapping_cell.planning.evaluation.task import Evaluation, Results
from tapping_cell.planning.registry import make_planner

OPEN_CHUNK = 4000
"""Trials in lockstep: one random stream each chunk."""

TABLE_CHUNK = 50

WORTH_PROCESSES = 4.0
"""Work in s from which starting processes, which takes a second or two, pays."""

Progress = Callable[[int], None]


def evaluate(
    evaluation: Evaluation, processes: int | None = None, progress: Progress | None = None
) -> Results:
    """Run all trials of an evaluation.

    Args:
        evaluation: what to run.
        processes: how many to use; None for one a core.
        progress: called with the number of trials just finished.

    Raises:
        UnknownPlannerError: no such method.
        PlanningError: settings that the method refuses.
    """
    make_planner(evaluation.planner, evaluation.settings)  # solved once, found by every process
    chunk = OPEN_CHUNK if evaluation.space is None else TABLE_CHUNK
    sizes = [chunk] * (evaluation.trials // chunk)
    if evaluation.trials % chunk:
        sizes.append(evaluation.trials % chunk)
    seeds = np.random.SeedSequence(evaluation.seed).spawn(len(sizes))
    note = progress or (lambda count: None)
    began = time.perf_counter()
    parts = [run_chunk(evaluation, sizes[0], seeds[0])]
    note(sizes[0])
    rest = list(zip(sizes[1:], seeds[1:], strict=True))
    expected = (time.perf_counter() - began) * len(rest)
    workers = min(processes or os.cpu_count() or 1, len(rest))
    if workers <= 1 or expected < WORTH_PROCESSES:
        for size, seed in rest:
            parts.append(run_chunk(evaluation, size, seed))
            note(size)
        return join(parts)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(run_chunk, evaluation, size, seed) for size, seed in rest]
        for (size, _), future in zip(rest, futures, strict=True):
            parts.append(future.result())
            note(size)
    return join(parts)


def run_chunk(evaluation: Evaluation, count: int, seed: np.random.SeedSequence) -> Results:
    """One chunk of trials with its own random stream."""
    planner = make_planner(evaluation.planner, evaluation.settings)
    rng = np.random.default_rng(seed)
    if evaluation.space is not None:
        return run_table_trials(evaluation, planner, count, rng)
    return run_open_trials(evaluation, planner, count, rng)


def join(parts: list[Results]) -> Results:
    """The trials of all chunks as one."""
    return Results(*(np.concatenate(column) for column in zip(*parts, strict=True)))
