"""Campaign of many runs on all cores, with counts of faults, outcomes and violations."""

from __future__ import annotations

import gc
import os
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed
from dataclasses import dataclass, field

from lab.faults.faults import ALL, Mix
from lab.fixed_trial import FixedTrial
from lab.oracle.oracle import Violation
from lab.table_trial import TableTrial, has_several_objects
from lab.trial import Report, Trial
from lab.worker_processes import worker_processes

GOALS_A_RUN = 10
"""Goals per run. A campaign is divided into runs of this length, each with its own cell and seed,
so that the results do not depend on the number of processes."""


@dataclass(slots=True)
class Summary:
    """Results of a campaign."""

    goals: int = 0
    taps: int = 0
    program_taps: int = 0
    """Number of taps that another program commanded, in addition to the taps of the goals."""
    cell_seconds: float = 0.0
    by_fault: Counter[str] = field(default_factory=Counter)
    by_code: Counter[int] = field(default_factory=Counter)
    by_node: Counter[str] = field(default_factory=Counter)
    """Counts of the faults that were injected into each node."""
    releases: int = 0
    violations: list[tuple[int, Violation]] = field(default_factory=list)
    """Violations, each with the seed that reproduces it."""

    def add(self, report: Report) -> None:
        """Add the results of one run."""
        self.goals += len(report.outcomes)
        self.taps += sum(outcome.taps for outcome in report.outcomes)
        self.program_taps += report.program_taps
        self.cell_seconds += report.cell_seconds
        self.by_fault.update(report.faults)
        self.by_node.update(report.by_node)
        self.releases += report.releases
        self.by_code.update(outcome.code for outcome in report.outcomes)
        self.violations += [(report.seed, violation) for violation in report.violations]


def trial_of(seed: int, mix: Mix = ALL, trace: bool = False, faults: bool = True) -> Trial:
    """Return the run of a seed: its cell is that of the mix, or of the seed."""
    kind = Trial
    if mix.fixed:
        kind = FixedTrial
    elif mix.several or (has_several_objects(seed) and not (mix.set_up or mix.ask)):
        kind = TableTrial  # these cells have neither set-up mode nor confirmation
    return kind(seed, trace, faults=faults, mix=mix)


def run_trial(seed: int, goals: int, trace: bool = False, mix: Mix = ALL) -> Report:
    """Execute one run with faults of this mix."""
    return trial_of(seed, mix, trace).run(goals)


def seeds_of(seed: int, goals: int) -> list[tuple[int, int]]:
    """Return the seed and the number of goals of each run of a campaign."""
    return [
        (seed * 1_000_000 + number, min(GOALS_A_RUN, goals - first))
        for number, first in enumerate(range(0, goals, GOALS_A_RUN))
    ]


def settle_on(core: int) -> None:
    """Pin this process to one of the available cores; ``core`` is an index into these cores, modulo
    their number.

    Only one thread of a run is active at a time. Switching between threads takes microseconds on
    one core, but milliseconds between cores that other processes also use.
    """
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {cores[core % len(cores)]})
    gc.set_threshold(200_000, 50, 100)


def reports_of(runs: list[tuple[int, int]], jobs: int, mix: Mix = ALL) -> Iterator[Report]:
    """Execute runs on ``jobs`` processes and yield their reports."""
    if jobs == 1 or len(runs) == 1:
        for seed, goals in runs:
            yield run_trial(seed, goals, mix=mix)
        return
    with worker_processes(min(jobs, len(runs)), settle_on) as pool:
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
    """Run a campaign; ``progress`` is called after every run."""
    summary = Summary()
    for report in reports_of(seeds_of(seed, goals), jobs, mix):
        summary.add(report)
        progress(summary)
        if stop_at_violation and summary.violations:
            break
    return summary
