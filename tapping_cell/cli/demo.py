"""Start the simulated cell, bring an object to one goal, and write a report.

Starts every node as a separate process, waits until the cell is ready, sends one goal, shows the
taps as they happen and stops the nodes. The run folder contains report.html, summary.json,
taps.csv, cell.png, a bag of every topic and the nodes' logs. The exit code is 0 only if the
measured and the true pose of the object are within the tolerance.

    python -m tapping_cell demo --move 10 0 10 --seed 1

With --objects, several objects lie on the table, and each is brought to its own goal. Start and
goal poses are random and depend on --seed. With --goals swap, the goals are not random: the objects
exchange their places in pairs. The run folder then also contains the scene's files.

    python -m tapping_cell demo --objects 3
    python -m tapping_cell demo --objects 2 --goals swap
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.cli import argument_types, arrangement, session
from tapping_cell.cli.demo_scene import GOALS, MAX_OBJECTS, write_scene
from tapping_cell.cli.errors import ExitStatus, print_error, print_refusal
from tapping_cell.cli.graph import (
    RECORDER,
    Graph,
    GraphError,
    nodes_of,
    own_domain,
    with_own_ports,
)
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.start_checks import (
    check_simulation_files,
    off_table,
    refuse_unused,
    require_folder,
)
from tapping_cell.cli.up import node_parameters
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.layout_file import LayoutFile
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes.clients.action_follower import ActionFollower
from tapping_cell.nodes.clients.arrange_client import ArrangeClient
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.conversions import from_message
from tapping_cell.planning import UnknownPlannerError, require_planner
from tapping_cell.report.run import Run
from tapping_cell.report.run_folder import (
    SUMMARY,
    RunError,
    read_run,
    residual,
    summary,
    write_failure,
)
from tapping_cell.report.words import counted
from tapping_cell.se2 import Pose, wrap_angle

READY_TIMEOUT_S = 90.0
RECORD_TIMEOUT_S = 60.0
INTERRUPTED_TIMEOUT_S = 8.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    task = parser.add_mutually_exclusive_group()
    task.add_argument(
        "--move",
        nargs=3,
        type=float,
        metavar=("DX", "DY", "DTHETA"),
        help="goal relative to the object's start pose, in mm, mm and degrees (default: 10 0 10)",
    )
    task.add_argument(
        "--goal",
        nargs=3,
        type=float,
        metavar=("X", "Y", "THETA"),
        help="goal pose in the table frame, in mm, mm and degrees",
    )
    task.add_argument(
        "--objects",
        type=int,
        choices=range(1, MAX_OBJECTS + 1),
        metavar="N",
        help=f"number of objects (1 to {MAX_OBJECTS}), each brought to a goal of its own",
    )
    parser.add_argument(
        "--goals",
        choices=GOALS,
        default=GOALS[0],
        help="goals of the objects: random poses, or the objects exchange their places in pairs "
        "(only with --objects; default: random)",
    )
    argument_types.add_seed(
        parser, 1, "random seed of the simulated world's noise and scatter (default: 1)"
    )
    argument_types.add_cell(parser)
    argument_types.add_object(parser)
    argument_types.add_truth(parser)
    parser.add_argument("--planner", help="planning method (default: the cell's)")
    parser.add_argument("--out", type=Path, help="run folder (default: a new folder in runs)")
    session.add_output_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the goal was reached, 1 if not, 2 for invalid input, 130 if
    interrupted."""
    console = session.console_of(arguments)
    end_on_signals()
    began = time.monotonic()
    scene = None
    try:
        cell = load_cell(arguments.cell, object_path=arguments.object)
        require_planner(arguments.planner or cell.file.goal.planner)
        check_simulation_files(arguments)
        if arguments.goals != GOALS[0] and arguments.objects is None:
            refuse_unused(arguments, "only with --objects", "goals")
        require_folder(arguments.out, "--out")
        if arguments.goal and (reason := off_table(cell, *_metres(arguments.goal))):
            print_error(reason, ErrorCode.GOAL_OFF_TABLE)
            return ExitStatus.REFUSED
        domain = own_domain()
        folder = _run_folder(arguments.out)
        if arguments.objects is not None:
            scene = write_scene(
                folder / "scene",
                arguments.objects,
                arguments.seed,
                arguments.cell,
                arguments.object,
                arguments.truth,
                arguments.goals,
            )
            arguments.cell, arguments.object, arguments.truth = scene.cell, None, scene.truth
            cell = load_cell(scene.cell)
    except (ConfigurationError, UnknownPlannerError, GraphError, OSError) as error:
        return print_refusal(error)
    domain.use()
    watch = f"ROS_DOMAIN_ID={domain.number} python -m tapping_cell status --watch"
    console.print(f"run folder {folder}; to watch the cell, run {watch}", soft_wrap=True)
    parameters = node_parameters(arguments, cell)
    parameters[RECORDER] |= {"folder": folder.parent, "name": folder.name}
    nodes = (*nodes_of(cell, hardware=False), RECORDER)
    try:
        with (
            tempfile.TemporaryDirectory(prefix="tapping_cell-") as ports,
            Graph(nodes, with_own_ports(parameters, Path(ports)), folder / "logs") as graph,
        ):
            if scene is not None:
                written = _arrange(scene.layout, graph, console)
            else:
                written = _position(arguments, graph, console)
            record = read_run(written)
    except (GraphError, session.NotReadyInTime, session.NotRecorded, RunError) as error:
        print_error(str(error))
        not_ready = isinstance(error, session.NotReadyInTime)
        code = ErrorCode.NOT_READY if not_ready else ErrorCode.INTERNAL
        write_failure(folder, code, str(error), arguments.seed, time.monotonic() - began)
        return 1
    except KeyboardInterrupt:
        console.print("interrupted; every node has ended")
        elapsed = time.monotonic() - began
        write_failure(folder, ErrorCode.GOAL_CANCELED, "interrupted", arguments.seed, elapsed)
        return 130
    if arguments.json:
        print(json.dumps(summary(record), indent=2, allow_nan=False))
    return _verdict(record, Path(folder.parent / record.name), time.monotonic() - began, console)


def _run_folder(out: Path | None) -> Path:
    """Return a folder for this run.

    Raises:
        FileExistsError: the folder already contains a run.
    """
    folder = out or Path("runs") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
    folder.mkdir(parents=True, exist_ok=True)
    if (folder / SUMMARY).exists():
        raise FileExistsError(
            f"{folder} already contains a run, which is not overwritten; choose another folder"
        )
    return folder.resolve()


def _metres(goal: Sequence[float]) -> tuple[float, float]:
    """Convert x and y of a goal from mm to m."""
    return goal[0] / 1000, goal[1] / 1000


def _arrange(layout: LayoutFile, graph: Graph, console: Console) -> Path:
    """Arrange the objects. Return the folder in which the run was recorded."""
    names = frozenset(goal.object for goal in layout.goals)
    with ArrangeClient("demo") as client:
        arrangement.wait_for(client, names, READY_TIMEOUT_S, graph.check, console)
        client.send(layout)
        return _recorded(
            client, lambda: arrangement.follow(client, graph.check, console), graph, console
        )


def _position(arguments: argparse.Namespace, graph: Graph, console: Console) -> Path:
    """Send the goal and follow it to its end. Return the folder in which the run was recorded."""
    with GoalClient("demo") as client:
        _send(arguments, graph, client, console)
        return _recorded(
            client, lambda: session.follow(client, graph.check, console), graph, console
        )


def _send(
    arguments: argparse.Namespace, graph: Graph, client: GoalClient, console: Console
) -> None:
    session.wait_until_ready(client, READY_TIMEOUT_S, graph.check, console)
    observed = client.object_state
    assert observed is not None
    start = from_message(observed.pose.pose)
    if arguments.goal:
        goal = Pose(*_metres(arguments.goal), math.radians(arguments.goal[2]))
    else:
        dx, dy, dtheta = arguments.move or (10.0, 0.0, 10.0)
        turned = float(wrap_angle(start.theta + math.radians(dtheta)))
        goal = Pose(start.x + dx / 1000, start.y + dy / 1000, turned)
    console.print(f"start {session.pose_text(start)}; goal {session.pose_text(goal)}")
    client.send(goal, observed=observed)


def _recorded(
    client: ActionFollower[Any], follow: Callable[[], object], graph: Graph, console: Console
) -> Path:
    """Follow a goal to its end. Return the folder in which the run was recorded."""
    try:
        follow()
    except KeyboardInterrupt:
        if client.cancel():
            with contextlib.suppress(session.NotRecorded, GraphError):
                session.wait_for_record(client, INTERRUPTED_TIMEOUT_S, graph.check, console)
        raise
    return session.wait_for_record(client, RECORD_TIMEOUT_S, graph.check, console)


def _verdict(record: Run, folder: Path, wall_time: float, console: Console) -> int:
    several = len(record.objects) > 1
    for one in record.objects:
        for name, pose in (("measured", one.end), ("true", one.end_true)):
            values = residual(one.goal, pose)
            if values is not None:
                console.print(
                    (f"'{one.name}' " if several else "")
                    + f"{name} residual {values['distance_mm']:.3f} mm and "
                    f"{values['rotation_deg']:.3f} deg",
                    highlight=False,
                )
    for first, second in record.contacts or ():
        console.print(f"'{first}' touched '{second}'", highlight=False)
    what = "arrangement" if several else "goal"
    if record.reached:
        console.print(
            f"[green]{what} reached[/green] in {counted(len(record.taps), 'tap')}, "
            f"{record.wall_time:.1f} s from goal to end ({wall_time:.0f} s with start-up); "
            f"see {folder / 'report.html'}"
        )
        return 0
    reason = record.error_msg or "the true pose of an object is outside its tolerance"
    print_error(f"{what} not reached: {reason}", record.error_code)
    return 1
