"""Campaign of the whole cell in simulated time, with faults: outcomes, violations, processor time.

The runs are those of ``python -m lab faults --goals N --seed SEED``.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

from lab.campaign import Summary, reports_of, seeds_of
from lab.goal_faults import as_json_object

DEFAULT_COUNT = 2000
"""Number of goals."""
SEED = 43
"""Seed of the campaign. A new record takes a new seed: an earlier seed's defects are mended, so it
says less about the rest."""
GOALS_IN_A_STEP = 500
"""Number of goals after which the results so far are reported."""
MOST_OUTCOMES = 12
"""Number of different outcomes that are listed."""


def partial_reports(count: int) -> Iterator[dict[str, Any]]:
    """Yield the results so far, after every ``GOALS_IN_A_STEP`` goals and at the end."""
    summary, began = Summary(), time.monotonic()
    for report in reports_of(seeds_of(SEED, count), len(os.sched_getaffinity(0))):
        before = summary.goals // GOALS_IN_A_STEP
        summary.add(report)
        if summary.goals // GOALS_IN_A_STEP > before:
            yield as_json_object(summary, SEED, time.monotonic() - began)
    yield as_json_object(summary, SEED, time.monotonic() - began)


def lines(report: dict[str, Any]) -> list[str]:
    """Return the counts, the most frequent outcomes, and every violation."""
    faults, wall, hours = report["by_fault"], report["wall_time"], report["cell_hours"]
    outcomes = list(report["by_outcome"].items())
    rest = sum(count for _, count in outcomes[MOST_OUTCOMES:])
    return [
        f"seed {report['seed']}: {report['goals']} goals, {report['taps']} taps for them and"
        f" {report['program_taps']} of another program, {report['releases']} shots",
        f"{sum(faults.values())} faults of {len(faults)} kinds",
        f"{hours:.1f} h of cell time in {wall:.0f} s ({3600 * hours / max(wall, 1e-9):.0f} times"
        f" real time, {report['goals'] / max(wall, 1e-9):.1f} goals a second)",
        f"{len(report['violations'])} violations",
        *(f"  run {one['seed']}: {one['name']}: {one['what']}" for one in report["violations"]),
        *(f"{count:>6}  {name}" for name, count in outcomes[:MOST_OUTCOMES]),
        *([f"{rest:>6}  {len(outcomes) - MOST_OUTCOMES} other outcomes"] if rest else []),
    ]
