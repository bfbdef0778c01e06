"""Many runs on all cores: counts by fault and by outcome, and what was violated."""

from __future__ import annotations

import gc
import multiprocessing
import os
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing.sharedctypes import Synchronized

from tapping_cell.verification.faults import ALL, Mix
from tapping_cell.verification.invariants import Violation
from tapping_cell.verification.trial import Report, run_trial

GOALS_A_RUN = 10
"""Goals of one cell, from one seed: results do not depend on the number of processes."""


@dataclass(slots=True)
class Summary:
    """What a campaign brought."""

    goals: int = 0
    taps: int = 0
    program_taps: int = 0
    """Commanded by a program, beside the goals."""
    cell_seconds: float = 0.0
    by_fault: Counter[str] = field(default_factory=Counter)
    by_code: Counter[int] = field(default_factory=Counter)
    by_node: Counter[str] = field(default_factory=Counter)
    """What has struck a node."""
    releases: int = 0
    violations: list[tuple[int, Violation]] = field(default_factory=list)
    """With the seed that repeats each."""

    def add(self, report: Report) -> None:
        """Count one run."""
        self.goals += len(report.outcomes)
        self.taps += sum(outcome.taps for outcome in report.outcomes)
        self.program_taps += report.program_taps
        self.cell_seconds += report.cell_seconds
        self.by_fault.update(report.faults)
        self.by_node.update(report.by_node)
        self.releases += report.releases
        self.by_code.update(outcome.code for outcome in report.outcomes)
        self.violations += [(report.seed, violation) for violation in report.violations]


def seeds_of(seed: int, goals: int) -> list[tuple[int, int]]:
    """The runs of a campaign: the seed of each and how many goals it has."""
    return [
        (seed * 1_000_000 + number, min(GOALS_A_RUN, goals - first))
        for number, first in enumerate(range(0, goals, GOALS_A_RUN))
    ]


def settle_on(core: int) -> None:
    """Keep this process on one core, counted through those that it may use.

    Of a run's threads one goes on at a time: on one core a change from one to the next takes
    microseconds, between cores that others use too it takes milliseconds.
    """
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[core % len(cores)]})
    gc.set_threshold(200_000, 50, 100)


def _settle(taken: Synchronized[int]) -> None:
    with taken.get_lock():
        core = taken.value
        taken.value += 1
    settle_on(core)


def reports_of(runs: list[tuple[int, int]], jobs: int, mix: Mix = ALL) -> Iterator[Report]:
    """Work through runs on so many processes."""
    if jobs == 1 or len(runs) == 1:
        for seed, goals in runs:
            yield run_trial(seed, goals, mix=mix)
        return
    taken = multiprocessing.Value("i", 0)
    with ProcessPoolExecutor(min(jobs, len(runs)), initializer=_settle, initargs=(taken,)) as pool:
        for future in as_completed([pool.submit(run_trial, *run, False, mix) for run in runs]):
            yield future.result()


def run_campaign(
    goals: int,
    seed: int,
    jobs: int = os.cpu_count() or 1,
    progress: Callable[[Summary], None] = lambda summary: None,
    stop_at_violation: bool = False,
    mix: Mix = ALL,
) -> Summary:
    """Run so many goals; ``progress`` is told after every run."""
    summary = Summary()
    for report in reports_of(seeds_of(seed, goals), jobs, mix):
        summary.add(report)
        progress(summary)
        if stop_at_violation and summary.violations:
            break
    return summary
