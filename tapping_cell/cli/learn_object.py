"""Learn an object's friction, torque factor, smallest tap and scatter by tapping it.

Starts the simulated cell (or the hardware with --hardware, or joins a running cell with --attach)
with the object file. Then sends goals near the object's position. The first goal begins with a few
of the smallest taps, to estimate the friction. When the values are known well enough, or --goals
goals have been sent, the values are fitted to the taps. `new-object` makes the object file from an
image.

  python -m tapping_cell learn-object --object bracket.yaml --output bracket_learnt.yaml

With RUNS, the values are learnt from run folders of earlier goals, and nothing moves. --object is
then the object file used in those runs. The learnt values are written to --output; all other values
are copied.

  python -m tapping_cell learn-object runs/* --object guess.yaml --output my_disk.yaml
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Generator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.keep import KeptFile, write_kept
from tapping_cell.cli import argument_types, session
from tapping_cell.cli.calibration_arguments import add_output_arguments, output_of
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.graph import RECORDER, GraphError, nodes_of
from tapping_cell.cli.measured_taps import measured_taps
from tapping_cell.cli.measuring_graph import add_graph_arguments, measuring_graph
from tapping_cell.cli.report import no_run
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.cli.up import node_parameters
from tapping_cell.configuration.cell import (
    load_cell,
    refuse_own_drivers,
    refuse_simulated_ports,
)
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.report.run import TapRow
from tapping_cell.report.run_folder import TAPS, RunError
from tapping_cell.se2 import Array, Pose, wrap_angle

if TYPE_CHECKING:
    from tapping_cell.calibration.estimates import Estimate

Move = tuple[float, float, float]
Moves = tuple[Move, Move]
"""Commanded and measured displacement of a tap, each as x, y (m) and rotation (rad)."""

MAX_GOALS = 9
MIN_TAPS = 15
FRICTION_KNOWN, FACTOR_KNOWN = 0.02, 0.1
"""Sufficient relative standard deviations of friction and torque factor. These deviations are well
below the scatter of a tap, so more accurate values would hardly improve the next goals."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "runs",
        nargs="*",
        type=Path,
        metavar="RUNS",
        help="run folder of earlier goals to learn from (default: make new goals)",
    )
    parser.add_argument(
        "--object", type=Path, required=True, metavar="FILE", help="object file in use"
    )
    parser.add_argument(
        "--goals",
        type=argument_types.whole(1, 200),
        default=MAX_GOALS,
        help=f"maximum number of goals to send (default: {MAX_GOALS})",
    )
    add_graph_arguments(parser)
    argument_types.add_seed(
        parser, 1, "random seed of noise and scatter (only in simulation; default: 1)"
    )
    parser.add_argument(
        "--runs-folder",
        type=Path,
        default=Path("runs"),
        help="folder in which the new runs are recorded (default: runs)",
    )
    add_output_arguments(parser, required=False)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 on success, 1 if the goals failed, 2 for unusable runs or files."""
    # Imported here, because the modules of the fit import much of SciPy. This import takes a second
    # and would delay the help text.
    from tapping_cell.calibration.learnt_object import EQUIVALENT, learn_object, learning_record
    from tapping_cell.calibration.object_file import object_yaml

    try:
        output = None if arguments.output is None else output_of(arguments)
        content = load_object(arguments.object.expanduser())
        folders = _run_folders(arguments.runs)
        if folders:
            taps = [tap for folder in folders for tap in _taps(folder, content.name)]
        else:
            folders, taps, status = _probed(arguments, content)
            if status:
                return status
        learnt = learn_object(content, *_arrays(taps))
        record = learning_record(learnt, [folder / TAPS for folder in folders])
        if output is not None:
            made = replace(learnt.content, calibration=record)
            write_kept(output, object_yaml(made, record, LEARNT), record, load_object)
    except (RecordError, RunError, KeptFile, ConfigurationError, OSError) as error:
        print_error(str(error))
        return 2
    if arguments.json:
        values = {entry.name: _numbers(entry) for entry in learnt.estimates}
        print(json.dumps({"taps": learnt.used, "left_out": learnt.left_out, **values}, indent=2))
        return 0
    print(f"{learnt.used} taps, {learnt.left_out} left out")
    for entry in learnt.estimates:
        print(_line(entry))
    print(EQUIVALENT)
    if output is not None:
        print(f"wrote {arguments.output}; check it with  python -m tapping_cell check-config")
    return 0


LEARNT = "Learnt from taps (tapping_cell learn-object)."


def _probed(
    arguments: argparse.Namespace, content: ObjectFile
) -> tuple[list[Path], list[Moves], int]:
    """Send goals until their taps determine the object well enough. Return the folders, the taps
    and the exit code (0 on success).

    Raises:
        ConfigurationError: the cell's files are unusable.
    """
    console = Console(stderr=arguments.json)
    end_on_signals()
    folders: list[Path] = []
    taps: list[Moves] = []
    try:
        with closing(probe(arguments, console)) as runs:
            for folder in runs:
                folders.append(folder)
                taps += _taps(folder, content.name)
                if _known(taps, content):
                    break
    except (GraphError, session.NotReadyInTime, session.NotRecorded, ProbingStopped) as error:
        print_error(str(error))
        if folders:
            print(_resume(arguments, folders), file=sys.stderr)
        return folders, taps, 1
    except KeyboardInterrupt:
        if folders:
            print(f"interrupted; {_resume(arguments, folders)}", file=sys.stderr)
        return folders, taps, 130
    return folders, taps, 0


def _resume(arguments: argparse.Namespace, folders: list[Path]) -> str:
    """Return a message with the command that learns from the runs recorded so far."""
    runs = " ".join(str(folder) for folder in folders)
    return (
        "the recorded runs are kept; to use them, run python -m tapping_cell learn-object "
        f"{runs} --object {arguments.object}"
    )


def _known(taps: list[Moves], content: ObjectFile) -> bool:
    """Return whether these taps determine friction and torque factor well enough."""
    from tapping_cell.calibration.learnt_object import learn_object

    try:
        learnt = learn_object(content, *_arrays(taps))
    except RecordError:
        return False  # too few taps so far
    if learnt.used < MIN_TAPS:
        return False
    known = {entry.name: entry for entry in learnt.estimates}
    friction, factor = known["friction"], known["torque_factor"]
    return (
        factor.fitted
        and friction.std < FRICTION_KNOWN * friction.value
        and factor.std < FACTOR_KNOWN * factor.value
    )


def _run_folders(paths: list[Path]) -> list[Path]:
    """Return the given run folders. Among several paths, those that are no runs are skipped: a
    pattern such as runs/* also gives runs/comparison.html.

    Raises:
        RecordError: none of several paths is a run.
    """
    paths = [path.expanduser() for path in paths]
    if len(paths) < 2:
        return paths
    folders = [path for path in paths if not no_run(path)]
    for path in paths:
        if path not in folders:
            print(f"{path} is not a run: skipped", file=sys.stderr)
    if not folders:
        raise RecordError("none of these is a run folder; give folders such as those in runs")
    return folders


def _taps(folder: Path, name: str) -> list[Moves]:
    """Return the commanded and the measured displacement of each measured tap of a run, in the axes
    of the object before the tap.

    Raises:
        RecordError: the run was made with another object.
    """
    taps: list[Moves] = []
    for tap in measured_taps(folder, name):
        moved = Pose(
            tap.measured.x - tap.before.x,
            tap.measured.y - tap.before.y,
            tap.before.rotation_to(tap.measured),
        )
        taps.append((_turned(tap.commanded, tap), _turned(moved, tap)))
    return taps


def _arrays(taps: list[Moves]) -> tuple[Array, Array]:
    """Return the commanded and the measured displacements of the taps, as two arrays (n, 3).

    Raises:
        RecordError: there are no taps.
    """
    if not taps:
        raise RecordError("these runs contain no fired tap with a measured result")
    commanded, measured = zip(*taps, strict=True)
    return np.array(commanded), np.array(measured)


def _turned(move: Pose, tap: TapRow) -> Move:
    """Rotate a displacement from ``table`` to the axes of the object before the tap."""
    cos, sin = math.cos(tap.before.theta), math.sin(tap.before.theta)
    return cos * move.x + sin * move.y, cos * move.y - sin * move.x, move.theta


def _numbers(entry: Estimate) -> dict[str, float | None]:
    known = entry.fitted
    return {
        "value": entry.value,
        "low": entry.low if known else None,
        "high": entry.high if known else None,
        "before": entry.old,
    }


def _line(entry: Estimate) -> str:
    unit = f" {entry.unit}" if entry.unit else ""
    if not entry.fitted:
        return f"  {entry.name:<22} not determined by these taps; kept at {entry.value:.4g}{unit}"
    return (
        f"  {entry.name:<22} {entry.value:.4g}{unit}   95 %: {entry.low:.4g} to {entry.high:.4g}"
        f"   (before: {entry.old:.4g})"
    )


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


def probe(arguments: argparse.Namespace, console: Console) -> Generator[Path, None, None]:
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
