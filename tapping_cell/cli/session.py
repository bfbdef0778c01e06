"""Send one goal to a running graph, show its progress as text, and wait for its run folder."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from rich.console import Console

from tapping_cell.cli.confirmation import Person
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes.clients.action_follower import ActionFollower
from tapping_cell.nodes.clients.client_node import ClientNode
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
    """The graph did not become ready. The message names the missing conditions."""


class NotRecorded(RuntimeError):
    """The recorder did not report that it has written the run."""


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the output options of a verb that follows a goal."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--quiet", action="store_true", help="print only errors")


def console_of(arguments: argparse.Namespace) -> Console:
    """Return the console for messages: stderr with --json, no output with --quiet."""
    return Console(stderr=arguments.json, quiet=arguments.quiet, soft_wrap=True)


def pose_text(pose: Pose) -> str:
    """Format a pose."""
    return f"x {1000 * pose.x:.1f} mm, y {1000 * pose.y:.1f} mm, {math.degrees(pose.theta):.1f} deg"


MUTUAL_DISCOVERY_S = 0.5
ANSWER_S = 10.0
SEND_COUNT = 3


def send(
    client: GoalClient,
    goal: Pose,
    tolerance: tuple[float, float],
    console: Console,
    probe: bool = False,
    ask: bool = False,
) -> None:
    """Send a goal, and send it again if no response arrives. While nodes start, responses can be
    lost.

    Raises:
        NotReadyInTime: the planner did not respond to any attempt.
    """
    for _ in range(SEND_COUNT):
        client.send(goal, tolerance, probe=probe, ask=ask)
        deadline = time.monotonic() + ANSWER_S
        with console.status("goal sent"):
            while time.monotonic() < deadline:
                if client.answered:
                    return
                time.sleep(0.02)
    raise NotReadyInTime(
        f"the planner did not answer the goal within {SEND_COUNT * ANSWER_S:.0f} s; see its log"
    )


def require_object(client: GoalClient, cell: Cell) -> None:
    """Check that the running cell tracks the object of these files.

    Raises:
        ConfigurationError: the cell tracks another object, or none.
    """
    state = client.object_state
    tracked = repr(state.object_id) if state is not None else "no object"
    if tracked != repr(cell.object.name):
        raise ConfigurationError(
            f"the running cell tracks {tracked}, but the object file {cell.object_path} is of "
            f"'{cell.object.name}'; with --object, give the file that the cell was started with"
        )


WAIT_S = 20.0
"""Default of the longest wait for a cell of which a node was found."""


def refuse_empty_domain(client: ClientNode) -> None:
    """Raise NotReadyInTime if there is no ROS node that could become ready."""
    if client.is_alone():
        raise NotReadyInTime(client.no_answer())


def wait_for_planner(client: GoalClient, patience: float | None, console: Console) -> None:
    """Wait until the planner accepts goals. ``patience``: longest wait in s; None for ``WAIT_S``,
    or a shorter wait if there is no other ROS node.

    Arm, tapper and camera are not checked here: after a goal is sent, the planner waits for them
    and reports what is missing.

    Raises:
        NotReadyInTime: the planner did not accept goals in time.
    """
    deadline = time.monotonic() + (WAIT_S if patience is None else patience)
    found = math.inf
    with console.status("waiting for the planner"):
        # Wait until the planner has discovered this client too: before that, the planner's response
        # to a request would be lost.
        while time.monotonic() < found + MUTUAL_DISCOVERY_S:
            there = client.planner_active and client.accepts_goals()
            found = min(found, time.monotonic()) if there else math.inf
            if not there and time.monotonic() > deadline:
                raise NotReadyInTime(client.no_answer())
            if not there and patience is None:
                refuse_empty_domain(client)
            time.sleep(0.05)


def wait_until_ready(
    client: GoalClient, patience: float, check: Callable[[], None], console: Console
) -> None:
    """Wait until the cell accepts a goal. Raises as :func:`wait_for`."""
    wait_for(client.missing, patience, check, console)


def wait_for(
    missing: Callable[[], list[str]],
    patience: float,
    check: Callable[[], None],
    console: Console,
) -> None:
    """Wait until ``missing`` returns no conditions.

    Raises:
        NotReadyInTime: conditions are missing after ``patience`` s. The message names them.
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


LOST = "the planner no longer sends messages; waiting for it to return"


def follow(
    client: GoalClient,
    check: Callable[[], None],
    console: Console,
    person: Person | None = None,
) -> Finished:
    """Show a goal's progress tap by tap until it ends. ``check`` is called at every event and may
    raise an exception to abort. ``person``, if given, is asked to confirm each tap."""
    # An animated status line would corrupt the operator's input.
    with console.status("goal sent") if person is None else nullcontext() as status:
        for event in client.events():
            check()
            if person is not None:
                person.on_event(event)
            if isinstance(event, PhaseChanged) and status is not None:
                status.update(f"tap {event.taps + 1}: {event.phase}")
            elif isinstance(event, PlannerLost):
                console.print(LOST)
            elif isinstance(event, TapDone):
                console.print(tap_text(event))
            elif isinstance(event, Finished):
                return event
    raise AssertionError("the event stream ended before the goal ended")


def cancel(client: ActionFollower[Any], what: str, console: Console) -> int:
    """Cancel a goal after Ctrl-C, and print whether the planner has confirmed this. Return the exit
    code. ``what``: name of the goal in messages."""
    try:
        confirmed = client.cancel()
    except KeyboardInterrupt:  # the person does not wait for the confirmation
        confirmed = False
    if confirmed:
        console.print(f"{what} canceled")
        return ExitStatus.INTERRUPTED
    print_error(
        f"the planner did not confirm that the {what} is canceled, so the {what} may go on: stop"
        " the cell with python -m tapping_cell stop"
    )
    return ExitStatus.FAILED


def wait_for_record(
    client: ActionFollower[Any], patience: float, check: Callable[[], None], console: Console
) -> Path:
    """Return the folder of the last run once the recorder has written it.

    Raises:
        NotRecorded: the recorder did not report the run within ``patience`` seconds.
    """
    deadline = time.monotonic() + patience
    with console.status("writing the run folder"):
        while not client.last_run:
            check()
            if time.monotonic() > deadline:
                raise NotRecorded(
                    f"the run recorder wrote no record within {patience:.0f} s; see its log "
                    "run_recorder.log"
                )
            time.sleep(0.05)
    return Path(client.last_run)


def tap_text(event: TapDone) -> str:
    """Format one tap as one line."""
    record = event.record
    before, measured = from_message(record.object_pose), from_message(record.measured_pose.pose)
    moved = (
        f"moved {1000 * before.distance_to(measured):.1f} mm and "
        f"{math.degrees(before.rotation_to(measured)):+.1f} deg"
        if math.isfinite(measured.x)
        else "the object was not seen afterwards"
    )
    return (
        f"tap {record.number} ({record.planner}): striker {1000 * record.striker_speed:.0f} mm/s, "
        f"{moved}; remaining "
        f"{1000 * event.residual_distance:.2f} mm and "
        f"{math.degrees(event.residual_rotation):.2f} deg"
    )
