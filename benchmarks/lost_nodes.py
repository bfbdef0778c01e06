"""Safety while nodes are frozen, killed, restarted and stopped during taps, in simulated time.

After every event the invariants of ``lab.oracle`` are checked against the true state
of the boards. For example, a striker may be fired only while the arm is committed to stand still,
and nothing may move without a person's permission. Runs continue until each node was frozen
``count`` times, and killed, restarted or stopped half as many times. Every violation is printed.

Before it fires, the tapper requests ``hold_still`` from the arm. If the arm grants the request, it
is committed to stand still for a given time. The grant is called the permit. The benchmark also
measures how much longer a tap takes because of the permit, in goals without faults. This time has
two parts. The first part is the time from the tapper's request to the arm's answer. The second part
begins when the striker has completed its stroke and the tap has been withdrawn, and ends when the
arm begins to move.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lab.campaign import Summary, reports_of
from lab.faults.faults import NODES, Mix
from lab.trial import Trial
from tapping_cell.messages import TapCommand

DEFAULT_COUNT = 1000
"""Minimum number of freezes of each node. The minimum number of all kills, restarts and stops of a
node together is half of that."""
FREEZES = Mix(("freeze",), 8.0)
"""Freezes of 1 ms to 5 s (log-uniform), at random times during goals and during taps commanded by
another program."""
LOSSES = Mix((*("kill",) * 8, "restart", "stop service"), 8.0)
"""All four nodes can be killed; only arm and tapper have a service to stop them."""
STRUCK = (*NODES, "camera_pose")
GOALS, SEED = 10, 41
COST_SEEDS, COST_GOALS = range(1, 5), 5


def measure(count: int) -> dict[str, Any]:
    """Run the campaigns of freezes and of losses, and measure the cost of the permit."""
    return {
        "cost": _cost(),
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
    """Return how often a node had a fault of these kinds."""
    return sum(summary.by_node[f"{way} {node}"] for way in ways)


@dataclass(slots=True)
class _Waits:
    """Times in one run for which the tapper or the arm waited because of the permit, in s."""

    trial: Trial
    for_answer: list[float] = field(default_factory=list)
    after_stroke: list[float] = field(default_factory=list)
    _asked: float = 0.0
    _free_at: float | None = None
    """Time, in s, at which the arm could leave if it were not committed to stand still; None while
    no tap has been withdrawn."""
    _moving: bool = False

    def begin(self) -> None:
        """Start to observe the run."""
        network, scheduler = self.trial.network, self.trial.scheduler
        arm = self.trial.processes["scara_arm"]
        on_call, on_answer, on_handled = network.on_call, network.on_answer, arm.on_handled
        after_event = scheduler.after_event

        def call(service: str, request: Any) -> None:
            on_call(service, request)
            if service == "hold_still":
                self._asked = scheduler.now

        def answer(node: str, service: str, request: Any, response: Any) -> None:
            on_answer(node, service, request, response)
            if service == "hold_still":
                self.for_answer.append(scheduler.now - self._asked)

        def handled(process: str, topic: str, message: Any) -> None:
            on_handled(process, topic, message)
            if topic == "tap_command" and message.request == TapCommand.WITHDRAW:
                self._withdrawn(message.tap_id)

        def event() -> None:
            after_event()
            self._watch(self.trial.physical.moving(scheduler.now))

        network.on_call, network.on_answer, arm.on_handled = call, answer, handled
        scheduler.after_event = event

    def _withdrawn(self, tap_id: int) -> None:
        for release in self.trial.physical.releases[-1:]:
            if release.shot == tap_id and not self._moving:
                speed = self.trial.oracle.commands[tap_id].striker_speed
                struck = release.time + self.trial.physical.flight(speed)
                self._free_at = max(struck, self.trial.scheduler.now)

    def _watch(self, moving: bool) -> None:
        if moving and not self._moving and self._free_at is not None:
            self.after_stroke.append(self.trial.scheduler.now - self._free_at)
            self._free_at = None
        self._moving = moving


def _cost() -> dict[str, Any]:
    """Return the time that the permit adds to a tap, in ms."""
    answers: list[float] = []
    waits: list[float] = []
    for seed in COST_SEEDS:
        trial = Trial(seed, faults=False)
        observed = _Waits(trial)
        observed.begin()
        trial.run(COST_GOALS)
        answers += observed.for_answer
        waits += observed.after_stroke
    return {
        "taps": len(waits),
        "answer_ms": round(1e3 * float(np.mean(answers)), 1),
        "standing_ms": round(1e3 * float(np.mean(waits)), 1),
        "longest_standing_ms": round(1e3 * max(waits), 1),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the faults, the violations and the cost of the permit as lines of text."""
    cost = report["cost"]
    summary = [
        f"permit: {cost['answer_ms'] + cost['standing_ms']:.1f} ms a tap ({cost['taps']} taps):"
        f" {cost['answer_ms']:.1f} ms for the arm's answer, {cost['standing_ms']:.1f} ms (at most"
        f" {cost['longest_standing_ms']:.1f} ms) after the stroke"
    ]
    for title in ("freezes", "losses"):
        part = report[title]
        summary.append(
            f"{title}: {part['goals']} goals, {part['taps']} taps, {part['releases']} releases,"
            f" first seed {part['seed']}000000, {part['wall_time']} s"
        )
        summary += [f"  {count:>6}  {name}" for name, count in part["struck"].items() if count]
        summary.append(f"  {len(part['violations'])} violations")
        summary += [f"    {violation}" for violation in part["violations"]]
    return summary
