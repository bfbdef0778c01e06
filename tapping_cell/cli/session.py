"""Following one goal on a running graph: words for people, rows for the run folder."""

from __future__ import annotations

import argparse
import math
import signal
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from rich.console import Console

from tapping_cell.cli.confirmation import Person
from tapping_cell.nodes.clients.goal_client import (
    Finished,
    GoalClient,
    PhaseChanged,
    PlannerLost,
    TapDone,
)
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose


class NotReadyInTime(RuntimeError):
    """The graph did not become ready; the sentence says what is missing."""


class NotRecorded(RuntimeError):
    """The recorder did not say that it has written the run."""


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """How a verb that follows a goal speaks."""
    parser.add_argument("--json", action="store_true", help="print the result for a program")
    parser.add_argument("--quiet", action="store_true", help="say nothing but errors")


def console_of(arguments: argparse.Namespace) -> Console:
    """Where a verb's words go: beside a program's figures, and nowhere where it is to be quiet."""
    return Console(stderr=arguments.json, quiet=arguments.quiet)


def end_on_signals() -> None:
    """Make Ctrl-C and a termination request end the verb in order, as a KeyboardInterrupt.

    Both are set, because a shell starts background jobs with the interrupt signal ignored, and
    Python leaves it so.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def pose_text(pose: Pose) -> str:
    """A pose for people."""
    return f"x {1000 * pose.x:.1f} mm, y {1000 * pose.y:.1f} mm, {math.degrees(pose.theta):.1f} deg"


MUTUAL_DISCOVERY_S = 0.5
ANSWER_S = 10.0
SENDINGS = 3


def send(
    client: GoalClient,
    goal: Pose,
    tolerance: tuple[float, float],
    console: Console,
    probe: bool = False,
    ask: bool = False,
) -> None:
    """Send a goal, and again where nobody answers: an answer can be lost while nodes start.

    Raises:
        NotReadyInTime: the planner answers none.
    """
    for _ in range(SENDINGS):
        client.send(goal, tolerance, probe=probe, ask=ask)
        deadline = time.monotonic() + ANSWER_S
        with console.status("goal sent"):
            while time.monotonic() < deadline:
                if client.answered:
                    return
                time.sleep(0.02)
    raise NotReadyInTime(
        f"the planner did not answer the goal within {SENDINGS * ANSWER_S:.0f} s; look at its log"
    )


def wait_for_planner(client: GoalClient, patience: float, console: Console) -> None:
    """Wait until the planner takes goals; what else is missing it waits for, and tells, itself.

    Raises:
        NotReadyInTime: it did not after ``patience`` seconds.
    """
    deadline = time.monotonic() + patience
    found = math.inf
    with console.status("waiting for the planner"):
        # The planner must have found this client as well, or its answer goes nowhere.
        while time.monotonic() < found + MUTUAL_DISCOVERY_S:
            there = client.planner_active and client.accepts_goals()
            found = min(found, time.monotonic()) if there else math.inf
            if not there and time.monotonic() > deadline:
                raise NotReadyInTime(
                    f"no planner answered within {patience:.0f} s in ROS domain"
                    f" {client.node.context.get_domain_id()}, namespace"
                    f" '{client.node.get_namespace()}': start a cell with python -m tapping_cell"
                    " up, or choose one with ROS_DOMAIN_ID and --namespace"
                )
            time.sleep(0.05)


def wait_until_ready(
    client: GoalClient, patience: float, check: Callable[[], None], console: Console
) -> None:
    """Wait until the cell can take a goal, as ``wait_for`` does."""
    wait_for(client.missing, patience, check, console)


def wait_for(
    missing: Callable[[], list[str]],
    patience: float,
    check: Callable[[], None],
    console: Console,
) -> None:
    """Wait until nothing is missing of what the cell needs.

    Raises:
        NotReadyInTime: names what is missing after ``patience`` seconds.
    """
    deadline = time.monotonic() + patience
    with console.status("waiting for the cell") as status:
        while reasons := missing():
            check()
            if time.monotonic() > deadline:
                raise NotReadyInTime(
                    f"the cell was not ready after {patience:.0f} s: " + "; ".join(reasons)
                )
            status.update("waiting for the cell: " + reasons[0])
            time.sleep(0.05)


LOST = "the planner is not heard any more; waiting for it to come back"


def follow(
    client: GoalClient,
    check: Callable[[], None],
    console: Console,
    person: Person | None = None,
) -> Finished:
    """Show a goal's progress tap by tap until it ends. ``check`` may raise to give up; ``person``
    answers for taps that wait for confirmation."""
    # A moving line would tear apart what a person types.
    with console.status("goal sent") if person is None else nullcontext() as status:
        for event in client.events():
            check()
            if person is not None:
                person.hear(event)
            if isinstance(event, PhaseChanged) and status is not None:
                status.update(f"tap {event.taps + 1}: {event.phase}")
            elif isinstance(event, PlannerLost):
                console.print(LOST)
            elif isinstance(event, TapDone):
                console.print(tap_text(event))
            elif isinstance(event, Finished):
                return event
    raise AssertionError("events end only with the goal")


def wait_for_record(
    client: GoalClient, patience: float, check: Callable[[], None], console: Console
) -> Path:
    """The folder of the run just finished, once the recorder has written it.

    Raises:
        NotRecorded: it has not after ``patience`` seconds.
    """
    deadline = time.monotonic() + patience
    with console.status("writing the run folder"):
        while not client.last_run:
            check()
            if time.monotonic() > deadline:
                raise NotRecorded(
                    f"the run recorder wrote no record within {patience:.0f} s; its log "
                    "run_recorder.log says why"
                )
            time.sleep(0.05)
    return Path(client.last_run)


def tap_text(event: TapDone) -> str:
    """One line for people about one tap."""
    record = event.record
    before, measured = from_message(record.object_pose), from_message(record.measured_pose.pose)
    return (
        f"tap {record.number} ({record.planner}): striker {1000 * record.striker_speed:.0f} mm/s, "
        f"moved {1000 * before.distance_to(measured):.1f} mm and "
        f"{math.degrees(before.rotation_to(measured)):+.1f} deg; to go "
        f"{1000 * event.residual_distance:.2f} mm and "
        f"{math.degrees(event.residual_rotation):.2f} deg"
    )
