"""Number of simulated goals until each mutant of the safety guards is detected.

Each mutant runs in processes of its own, as with ``python -m tapping_cell faults --mutants``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

from tapping_cell.cli.goal_faults import hunt
from tapping_cell.verification.all_mutants import ALL_MUTANTS

DEFAULT_COUNT = 400
"""Maximum number of goals of each mutant."""
SEED = 1


def partial_reports(count: int) -> Iterator[list[dict[str, Any]]]:
    """Yield the results of all mutants so far, after each mutant."""
    results: list[dict[str, Any]] = []
    for mutant in ALL_MUTANTS:
        results.append(hunt(mutant, count, SEED, len(os.sched_getaffinity(0))))
        yield results


def lines(report: list[dict[str, Any]]) -> list[str]:
    """Return one line per mutant: its number of goals and the violated invariant."""
    caught = sum(bool(result["caught by"]) for result in report)
    width = max(len(result["name"]) for result in report)
    return [
        f"{caught} of {len(report)} mutants caught ({len(ALL_MUTANTS)} in all), first seed {SEED}"
    ] + [
        f"{result['goals']:>5} goals  {result['name']:<{width}} {result['caught by'] or 'SURVIVED'}"
        for result in report
    ]
