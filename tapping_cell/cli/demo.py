"""Position an object in the simulated world, from nothing to the goal.

Starts every node as a process of its own, waits until the cell is ready, sends one goal, shows the
taps as they happen, ends the nodes and writes a run folder (summary.json, taps.csv,
cell.png, logs).
The exit status is 0 only where the object is measured to be, and truly is, within the tolerance.

    python -m tapping_cell demo --move 10 0 10 --seed 1
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
import time
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rich.console import Console
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.cli import session
from tapping_cell.cli.graph import SIMULATED, Graph, NodeDied, own_domain, with_own_ports
from tapping_cell.cli.up import node_parameters
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes.goal_client import GoalClient
from tapping_cell.report.run import Failure, Run
from tapping_cell.report.run_folder import inside, residual, write_failure, write_run
from tapping_cell.se2 import Pose, wrap_angle

READY_PATIENCE_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the verb."""
    task = parser.add_mutually_exclusive_group()
    task.add_argument(
        "--move",
        nargs=3,
        type=float,
        metavar=("DX", "DY", "DTHETA"),
        help="goal from where the object starts, in mm, mm and degrees (default: 10 0 10)",
    )
    task.add_argument(
        "--goal",
        nargs=3,
        type=float,
        metavar=("X", "Y", "THETA"),
        help="goal in the table frame, in mm, mm and degrees",
    )
    parser.add_argument("--seed", type=int, default=1, help="of the world's noise and scatter")
    parser.add_argument("--cell", type=Path, help="cell file (default: the package's cell.yaml)")
    parser.add_argument("--object", type=Path, help="object file (default: the cell's)")
    parser.add_argument("--truth", type=Path, help="truth file of the simulated world")
    parser.add_argument("--planner", help="planning method (default: the cell's)")
    parser.add_argument("--out", type=Path, help="run folder (default: a new one under runs/)")


@dataclass(frozen=True, slots=True)
class _Heard:
    """What a run knows when the nodes are about to be ended."""

    start: Pose
    goal: Pose
    followed: session.Followed
    final_true: Pose | None


def run(arguments: argparse.Namespace) -> int:
    """Run the verb; 0 reached, 1 not reached, 2 wrong input, 130 interrupted."""
    console = Console()
    session.end_on_signals()
    began = time.monotonic()
    try:
        cell = load_cell(arguments.cell, object_path=arguments.object)
        folder = _run_folder(arguments.out)
    except (ConfigurationError, OSError) as error:
        console.print(f"[red]error:[/red] {error}", highlight=False)
        return 2
    domain = own_domain()
    # The client below runs in this process and must meet the nodes.
    os.environ["ROS_DOMAIN_ID"] = str(domain.number)
    # Whatever the shell says: a demo is nobody else's business on the network.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    console.print(f"run folder {folder}; watch it with ROS_DOMAIN_ID={domain.number}")
    try:
        with (
            tempfile.TemporaryDirectory(prefix="tapping_cell-") as ports,
            Graph(
                SIMULATED,
                with_own_ports(node_parameters(arguments, cell), Path(ports)),
                folder / "logs",
            ) as graph,
            GoalClient("demo") as client,
        ):
            heard = _position(arguments, cell, graph, client, console)
    except (NodeDied, session.NotReadyInTime) as error:
        console.print(f"[red]failed:[/red] {error}", highlight=False)
        code = ErrorCode.INTERNAL if isinstance(error, NodeDied) else ErrorCode.NOT_READY
        _write_failure(arguments, folder, code, str(error), time.monotonic() - began)
        return 1
    except KeyboardInterrupt:
        console.print("interrupted; every node has ended")
        elapsed = time.monotonic() - began
        _write_failure(arguments, folder, ErrorCode.GOAL_CANCELED, "interrupted", elapsed)
        return 130
    record = _record(arguments, cell, heard, time.monotonic() - began)
    write_run(folder, record)
    return _verdict(record, folder, console)


def _write_failure(
    arguments: argparse.Namespace, folder: Path, code: int, sentence: str, wall_time: float
) -> None:
    write_failure(
        folder,
        Failure(
            wall_time=wall_time,
            seed=arguments.seed,
            versions=session.versions(),
            error_code=code,
            error_msg=sentence,
        ),
    )


def _run_folder(out: Path | None) -> Path:
    folder = out or Path("runs") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S_%f")
    folder.mkdir(parents=True, exist_ok=True)
    return folder.resolve()


def _position(
    arguments: argparse.Namespace, cell: Cell, graph: Graph, client: GoalClient, console: Console
) -> _Heard:
    session.wait_until_ready(client, READY_PATIENCE_S, graph.check, console)
    start = client.object_pose()
    if arguments.goal:
        x, y, theta = arguments.goal
        goal = Pose(x / 1000, y / 1000, math.radians(theta))
    else:
        dx, dy, dtheta = arguments.move or (10.0, 0.0, 10.0)
        turned = float(wrap_angle(start.theta + math.radians(dtheta)))
        goal = Pose(start.x + dx / 1000, start.y + dy / 1000, turned)
    console.print(f"start {session.pose_text(start)}; goal {session.pose_text(goal)}")
    client.send(goal)
    try:
        followed = session.follow(client, graph.check, console)
    except KeyboardInterrupt:
        client.cancel()
        raise
    return _Heard(start, goal, followed, client.settled_truth())


def _record(arguments: argparse.Namespace, cell: Cell, heard: _Heard, wall_time: float) -> Run:
    finished = heard.followed.finished
    assert finished is not None
    tolerance = cell.tolerance
    reached = (
        finished.error_code == 0
        and inside(heard.goal, finished.final_pose, tolerance)
        and inside(heard.goal, heard.final_true, tolerance)
    )
    return Run(
        goal=heard.goal,
        start=heard.start,
        tolerance=tolerance,
        taps=tuple(heard.followed.taps),
        final_measured=finished.final_pose,
        final_true=heard.final_true,
        reached=reached,
        wall_time=wall_time,
        seed=arguments.seed,
        versions=session.versions(),
        error_code=finished.error_code,
        error_msg=finished.error_msg,
        outline=cell.outline(),
        table_size=(cell.file.table.length, cell.file.table.width),
    )


def _verdict(record: Run, folder: Path, console: Console) -> int:
    measured = residual(record.goal, record.final_measured)
    true = residual(record.goal, record.final_true)
    for name, values in (("measured", measured), ("true", true)):
        if values is not None:
            console.print(
                f"{name} residual {values['distance_mm']:.3f} mm and "
                f"{values['rotation_deg']:.3f} deg"
            )
    if record.reached:
        console.print(
            f"[green]goal reached[/green] in {len(record.taps)} taps, {record.wall_time:.0f} s; "
            f"see {folder / 'cell.png'}"
        )
        return 0
    reason = record.error_msg or "the object is not truly within the tolerance"
    console.print(
        f"[red]goal not reached[/red] (code {record.error_code}): {reason}", highlight=False
    )
    return 1
