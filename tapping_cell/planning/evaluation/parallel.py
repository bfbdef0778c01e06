"""Parallel trials; the result depends only on the seed and not on the number of cores."""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from tapping_cell.planning.evaluation.on_table import run_table_trials
from tapping_cell.planning.evaluation.open_table import run_open_trials
from tapping_cell.planning.evaluation.task import Evaluation, Results
from tapping_cell.planning.registry import load_planner

OPEN_CHUNK = 4000
"""Number of trials on an open table per chunk; each chunk has its own random stream."""

TABLE_CHUNK = 50

WORTH_PROCESSES = 4.0
"""Minimum expected computing time, s, for which processes are started; starting takes 1 to 2 s."""

Progress = Callable[[int], None]


def evaluate(
    evaluation: Evaluation, processes: int | None = None, progress: Progress | None = None
) -> Results:
    """Run all trials of an evaluation.

    Args:
        evaluation: parameters of the evaluation.
        processes: number of processes; None uses one per core.
        progress: called with the number of trials just finished.

    Raises:
        UnknownPlannerError: unknown method.
        PlanningError: the method rejects the settings.
    """
    # Creating the planner solves its policy once and stores it in the cache, from which the
    # processes then load it.
    load_planner(evaluation.planner, evaluation.settings)
    chunk = OPEN_CHUNK if evaluation.space is None else TABLE_CHUNK
    sizes = [chunk] * (evaluation.trials // chunk)
    if evaluation.trials % chunk:
        sizes.append(evaluation.trials % chunk)
    seeds = np.random.SeedSequence(evaluation.seed).spawn(len(sizes))
    note = progress or (lambda count: None)
    began = time.perf_counter()
    parts = [run_chunk(evaluation, sizes[0], seeds[0])]
    note(sizes[0])
    rest, run = sizes[1:], functools.partial(run_chunk, evaluation)
    expected = (time.perf_counter() - began) * len(rest)
    workers = min(processes or os.cpu_count() or 1, len(rest))
    with contextlib.ExitStack() as stack:
        if workers <= 1 or expected < WORTH_PROCESSES:
            made: Iterator[Results] = map(run, rest, seeds[1:])
        else:
            pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"))
            made = stack.enter_context(pool).map(run, rest, seeds[1:])
        for size, part in zip(rest, made, strict=True):
            parts.append(part)
            note(size)
    return join(parts)


def run_chunk(evaluation: Evaluation, count: int, seed: np.random.SeedSequence) -> Results:
    """Run one chunk of trials with its own random stream."""
    planner = load_planner(evaluation.planner, evaluation.settings)
    rng = np.random.default_rng(seed)
    if evaluation.space is not None:
        return run_table_trials(evaluation, planner, count, rng)
    return run_open_trials(evaluation, planner, count, rng)


def join(parts: list[Results]) -> Results:
    """Concatenate the results of all chunks."""
    return Results(*(np.concatenate(column) for column in zip(*parts, strict=True)))
