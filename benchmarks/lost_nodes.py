"""Safety while nodes are frozen, killed, restarted and stopped during taps, in simulated time.

After every event the invariants of ``tapping_cell.verification`` are checked against the true state
of the boards, for example that no striker is released outside the arm's promise and that nothing
moves without a person's permission. Runs continue until each node was frozen ``count`` times, and
lost half as many times. Every violation is printed.
"""

from __future__ import annotations

import os
import time
from typing import Any

from tapping_cell.verification.campaign import Summary, reports_of
from tapping_cell.verification.faults import NODES, Mix

DEFAULT_COUNT = 1000
"""Number of freezes of each node; its crashes, restarts and stops together are half as many."""
FREEZES = Mix(("freeze",), 8.0)
"""Freezes of 1 ms to 5 s, log-uniform, at random times of goals and of a program's taps."""
LOSSES = Mix((*("kill",) * 8, "restart", "stop service"), 8.0)
"""All four nodes can be killed; only arm and tapper have a service to stop them."""
STRUCK = (*NODES, "camera_pose")
GOALS, SEED = 10, 41


def measure(count: int) -> dict[str, Any]:
    """Return the results of both campaigns."""
    return {
        "freezes": _campaign(FREEZES, ("freeze",), count, SEED),
        "losses": _campaign(LOSSES, ("kill", "restart", "stop"), count // 2, SEED + 1),
    }


def _campaign(mix: Mix, ways: tuple[str, ...], count: int, seed: int) -> dict[str, Any]:
    began, jobs, number = time.monotonic(), len(os.sched_getaffinity(0)), 0
    summary = Summary()
    while min(_times(summary, node, ways) for node in STRUCK) < count:
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


def _times(summary: Summary, node: str, ways: tuple[str, ...]) -> int:
    """Return how often a node was struck in one of these ways."""
    return sum(summary.by_node[f"{way} {node}"] for way in ways)


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
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
