"""Nodes frozen, killed, restarted and stopped in mid-tap, in simulated time: is anything released
outside the arm's permit, or does anything move without a person's word?

The invariants of ``tapping_cell.verification`` are checked after every event, against the truth of
the boards. Runs go on until each node was struck ``count`` times; any violation is printed.
"""

from __future__ import annotations

import os
import time
from typing import Any

from tapping_cell.verification.campaign import Summary, reports_of
from tapping_cell.verification.faults import NODES, Mix

DEFAULT_COUNT = 1000
"""Freezes of each node; crashes, restarts and stops together half as many."""
FREEZES = Mix(("freeze",), 8.0)
"""1 ms to 5 s, log-uniform, at random moments of goals and of a program's taps."""
LOSSES = Mix(("kill", "restart", "stop service"), 4.0)
FROZEN = tuple(f"freeze {node}" for node in (*NODES, "camera_pose"))
GOALS, SEED = 10, 41


def measure(count: int) -> dict[str, Any]:
    """Both campaigns."""
    return {"freezes": _campaign(FREEZES, count, SEED), "losses": _losses(count // 2)}


def _losses(count: int) -> dict[str, Any]:
    return _campaign(LOSSES, count, SEED + 1, together=True)


def _campaign(mix: Mix, count: int, seed: int, together: bool = False) -> dict[str, Any]:
    began, jobs, number = time.monotonic(), len(os.sched_getaffinity(0)), 0
    summary = Summary()
    while _least(summary, together) < count:
        runs = [(seed * 1_000_000 + number + job, GOALS) for job in range(jobs)]
        number += jobs
        for report in reports_of(runs, jobs, mix):
            summary.add(report)
    return {
        "struck": dict(sorted(summary.by_node.items())),
        "goals": summary.goals,
        "taps": summary.taps + summary.program_taps,
        "releases": summary.releases,
        "seed": seed,
        "wall_time": round(time.monotonic() - began),
        "violations": [f"seed {at}: {v.name}: {v.sentence}" for at, v in summary.violations],
    }


def _least(summary: Summary, together: bool) -> int:
    if together:
        return sum(
            count for name, count in summary.by_node.items() if not name.startswith("freeze")
        )
    return min(summary.by_node[name] for name in FROZEN)


def lines(report: dict[str, Any]) -> list[str]:
    """What struck whom, and what was violated."""
    told = []
    for title, part in report.items():
        told.append(
            f"{title}: {part['goals']} goals, {part['taps']} taps, {part['releases']} releases,"
            f" first seed {part['seed']}000000, {part['wall_time']} s"
        )
        told += [f"  {count:>6}  {name}" for name, count in part["struck"].items() if count]
        told.append(f"  {len(part['violations'])} violations")
        told += [f"    {violation}" for violation in part["violations"]]
    return told
