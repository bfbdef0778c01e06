"""Learn an object's friction, torque factor, smallest tap and scatter by tapping it.

Starts the simulated cell (or the hardware with --hardware, or joins a running cell with --attach)
with the object file. Then sends goals near the object's position. The first goal begins with a few
of the smallest taps, to estimate the friction. When the values are known well enough, or --goals
goals have been sent, the values are fitted to the taps. `object new` makes the object file from an
image.

  python -m tapping_cell object learn --object bracket.yaml --output bracket_learnt.yaml

With RUNS, the values are learnt from run folders of earlier goals, and nothing moves. --object is
then the object file used in those runs. The learnt values are written to --output; all other values
are copied.

  python -m tapping_cell object learn runs/* --object guess.yaml --output my_disk.yaml
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.keep import KeptFile, write_kept
from tapping_cell.cli import argument_types
from tapping_cell.cli.calibration_arguments import add_output_arguments, output_of
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.measured_taps import measured_taps
from tapping_cell.cli.measuring_graph import add_graph_arguments
from tapping_cell.cli.report import no_run
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.report.run import Launch, TapRow
from tapping_cell.report.run_folder import TAPS, RunError
from tapping_cell.se2 import Array, Pose

if TYPE_CHECKING:
    from tapping_cell.calibration.estimates import Estimate
    from tapping_cell.calibration.learnt_object import Launches

Move = tuple[float, float, float]
Moves = tuple[Move, Move, tuple[float, float, float, float]]
"""Commanded and measured displacement of a tap, each as x, y (m) and rotation (rad), and its launch
with the fields of ``Launches``."""

MAX_GOALS = 9
MIN_TAPS = 15
FRICTION_KNOWN, FACTOR_KNOWN = 0.02, 0.1
"""Sufficient relative standard deviations of friction and torque factor for a known launch
(``LearntObject.precision``). These deviations are well below the scatter of a tap, so more accurate
values would hardly improve the next goals."""


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
    from tapping_cell.calibration.learnt_object import advice, learn_object, learning_record
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
    for sentence in advice(learnt):
        print(sentence)
    if output is not None:
        print(f"wrote {arguments.output}; check it with  python -m tapping_cell check-config")
    return 0


LEARNT = "Learnt from taps (tapping_cell object learn)."


def _probed(
    arguments: argparse.Namespace, content: ObjectFile
) -> tuple[list[Path], list[Moves], int]:
    """Send goals until their taps determine the object well enough. Return the folders, the taps
    and the exit code (0 on success)."""
    # Imported here, because only this part needs ROS.
    from tapping_cell.cli.objects.probing import probed

    taps: list[Moves] = []

    def is_enough(folder: Path) -> bool:
        taps.extend(_taps(folder, content.name))
        return _known(taps, content)

    folders, status = probed(arguments, is_enough)
    return folders, taps, status


def _known(taps: list[Moves], content: ObjectFile) -> bool:
    """Return whether these taps determine friction and torque factor well enough."""
    from tapping_cell.calibration.learnt_object import learn_object

    try:
        learnt = learn_object(content, *_arrays(taps))
    except RecordError:
        return False  # too few taps so far
    if learnt.used < MIN_TAPS:
        return False
    friction, factor = learnt.precision
    return friction < FRICTION_KNOWN and factor < FACTOR_KNOWN


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
        taps.append((_turned(tap.commanded, tap), _turned(moved, tap), _launch(tap.launch)))
    return taps


def _arrays(taps: list[Moves]) -> tuple[Array, Array, Launches]:
    """Return the commanded and the measured displacements of the taps, as two arrays (n, 3), and
    their launches.

    Raises:
        RecordError: there are no taps.
    """
    if not taps:
        raise RecordError("these runs contain no fired tap with a measured result")
    from tapping_cell.calibration.learnt_object import Launches

    commanded, measured, launches = zip(*taps, strict=True)
    return np.array(commanded), np.array(measured), Launches(*np.array(launches).T)


def _launch(launch: Launch) -> tuple[float, float, float, float]:
    """Return the launch with the fields of ``Launches``; NaN if the slide was not seen."""
    if not launch.is_known:
        return (math.nan,) * 4
    speed_std, ratio = launch.speed_deviation / launch.speed, math.nan
    if launch.spin != 0.0:
        # The deviation in the table is that of the spin, which contains that of the speed.
        total = launch.spin_deviation / abs(launch.spin)
        ratio = math.sqrt(max(total**2 - speed_std**2, 0.0))
    return launch.speed, launch.spin, speed_std, ratio


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
