"""Goals that ``object learn`` sends to a cell to learn from their taps."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path

from rich.console import Console

from tapping_cell.cli import session
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.graph import RECORDER, GraphError, nodes_of
from tapping_cell.cli.measuring_graph import measuring_graph
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.up import node_parameters
from tapping_cell.configuration.cell import (
    load_cell,
    refuse_own_drivers,
    refuse_simulated_ports,
)
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.se2 import Pose, wrap_angle

READY_TIMEOUT_S = 60.0
RECORD_TIMEOUT_S = 60.0
REACH, TURN = 0.025, math.radians(20.0)
"""Radius (m) of the circle of goals about the first position, and their rotation (rad). Large
enough to measure friction, small enough to stay clear of the table's edges."""
BETWEEN = math.radians(137.5)
"""Angle (rad) between the directions of successive goals. This is the golden angle, with which any
number of goals is spread evenly."""
IN_A_ROW = 3
"""Number of consecutive goals without a tap after which the session ends."""


class ProbingStopped(RuntimeError):
    """No further goal can be sent; the message states why. Recorded runs are kept."""


def probed(
    arguments: argparse.Namespace, is_enough: Callable[[Path], bool]
) -> tuple[list[Path], int]:
    """Send goals until their taps determine the object well enough, which ``is_enough`` tells from
    the folder of the last run. Return the folders and the exit code (0 on success).

    Raises:
        ConfigurationError: the cell's files are unusable.
    """
    console = Console(stderr=arguments.json)
    end_on_signals()
    folders: list[Path] = []
    try:
        with closing(_probe(arguments, console)) as runs:
            for folder in runs:
                folders.append(folder)
                if is_enough(folder):
                    break
    except (GraphError, session.NotReadyInTime, session.NotRecorded, ProbingStopped) as error:
        print_error(str(error))
        if folders:
            print(_resume(arguments, folders), file=sys.stderr)
        return folders, 1
    except KeyboardInterrupt:
        if folders:
            print(f"interrupted; {_resume(arguments, folders)}", file=sys.stderr)
        return folders, 130
    return folders, 0


def _resume(arguments: argparse.Namespace, folders: list[Path]) -> str:
    """Return a message with the command that learns from the runs recorded so far."""
    runs = " ".join(str(folder) for folder in folders)
    return (
        "the recorded runs are kept; to use them, run python -m tapping_cell object learn "
        f"{runs} --object {arguments.object}"
    )


def _probe(arguments: argparse.Namespace, console: Console) -> Generator[Path, None, None]:
    """Send up to ``arguments.goals`` goals one by one, and yield the folder of each run. The caller
    may stop iterating earlier.

    Raises:
        ConfigurationError: the cell's files are unusable, or another object is in the cell.
        GraphError, NotReadyInTime, NotRecorded, ProbingStopped: the cell did not start, record a
        run or continue.
    """
    cell = load_cell(arguments.cell, object_path=arguments.object)
    if arguments.hardware:
        refuse_simulated_ports(cell)
    elif not arguments.attach:
        refuse_own_drivers(cell)
    runs: Path = arguments.runs_folder.resolve()
    parameters = node_parameters(arguments, cell)
    parameters[RECORDER]["folder"] = runs
    nodes = (*nodes_of(cell, hardware=arguments.hardware), RECORDER)
    logs = runs / "learn-object_logs"
    with (
        measuring_graph(arguments, nodes, parameters, logs, console.print) as check,
        GoalClient("learn_object", arguments.namespace) as client,
    ):
        session.wait_until_ready(client, READY_TIMEOUT_S, check, console)
        session.require_object(client, cell)
        middle, without_taps = client.object_pose(), 0
        for number in range(arguments.goals):
            goal = goal_of(middle, client.object_pose(), number)
            console.print(f"goal {number + 1}: {session.pose_text(goal)}")
            client.last_run = ""
            session.send(client, goal, (0.0, 0.0), console, probe=number == 0)
            try:
                finished = session.follow(client, check, console)
            except BaseException:
                client.cancel()
                raise
            folder = session.wait_for_record(client, RECORD_TIMEOUT_S, check, console)
            if finished.error_code:
                console.print(f"goal not reached: {finished.error_msg}")
            yield folder
            without_taps = without_taps + 1 if finished.taps == 0 and finished.error_code else 0
            if without_taps == IN_A_ROW:
                raise ProbingStopped(
                    f"{IN_A_ROW} consecutive goals ended without a tap: {finished.error_msg}"
                )
            session.wait_until_ready(client, READY_TIMEOUT_S, check, console)


def goal_of(middle: Pose, here: Pose, number: int) -> Pose:
    """Return goal ``number`` (from 0), on the circle about ``middle``. The goal is rotated by TURN
    from the object's pose ``here``, alternately in the positive and the negative direction."""
    heading = number * BETWEEN
    turn = TURN if number % 2 == 0 else -TURN
    return Pose(
        middle.x + REACH * math.cos(heading),
        middle.y + REACH * math.sin(heading),
        float(wrap_angle(here.theta + turn)),
    )
