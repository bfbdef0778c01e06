"""Part of the verb evaluate for a cell with fixed tappers: a table with one row per start angle."""

from __future__ import annotations

import argparse
import json
import math
import time
from typing import Any

from rich.console import Console
from rich.table import Table

from tapping_cell.cli.argument_types import MM_AND_DEGREES, POSE
from tapping_cell.cli.evaluate_common import (
    camera_of,
    inputs_of,
    scatter_of,
    share_text,
    si_pair,
)
from tapping_cell.cli.progress import progress
from tapping_cell.configuration.assembly import make_fixed_space, make_planner_settings
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import PlanningError
from tapping_cell.planning.evaluation.fixed_cell import FixedEvaluation, evaluate_fixed
from tapping_cell.planning.evaluation.summary import summarise

COLUMNS = (
    "start",
    "taps, mean",
    "s, mean",
    "taps, 99 %",
    "taps, max.",
    "reached, of all",
    "truly inside, of reached",
    "refused",
)


def add_fixed_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that apply only to a cell with fixed tappers."""
    parser.add_argument(
        "--start-angles",
        type=float,
        nargs="+",
        default=(10.0, 30.0, 90.0),
        metavar="DEG",
        help="maximum angle between start pose and goal pose, in degrees. Several values may be "
        "given; each gives one row of the table (only for a cell with fixed tappers; default: "
        "10 30 90)",
    )
    parser.add_argument(
        "--goal-pose",
        **POSE,
        default=(0.0, 0.0, 0.0),
        help="goal pose on the table, in mm, mm and degrees (only for a cell with fixed tappers; "
        "default: 0 0 0)",
    )
    parser.add_argument(
        "--mount-error",
        **MM_AND_DEGREES,
        default=(0.0, 0.0),
        help="standard deviations of each tapper's mounting error: the sideways offset of its line "
        "of motion, in mm, and the error of its direction, in degrees; new random errors for each "
        "trial (only for a cell with fixed tappers; default: 0 0)",
    )


def run_fixed(arguments: argparse.Namespace, cell: Cell) -> int:
    """Evaluate the cell at each start angle and print the table. Return 0.

    Raises:
        PlanningError: an option does not apply to a cell with fixed tappers.
    """
    from tapping_cell.report.tables import TRIALS, trial_columns, write_trials

    without_meaning = {
        "--all": arguments.all,
        "--table": arguments.table,
        "--probe": arguments.probe,
        "--random-tasks": arguments.random_tasks is not None,
        f"--model {arguments.model}": arguments.model != "abstract",
        "--box": arguments.box is not None,
        "--gain-bias": tuple(arguments.gain_bias) != (0.0, 0.0),
        "--unknown": arguments.unknown != [],
        "--track": arguments.track != "off",
        "--off-centre": arguments.off_centre != 0.0,
    }
    given = [name for name, is_set in without_meaning.items() if is_set]
    if given:
        raise PlanningError(
            f"a cell with fixed tappers does not support {', '.join(given)}: remove what is named "
            "here, or give a cell file with an arm"
        )
    rows, trials = [], []
    for angle in arguments.start_angles:
        evaluation = _evaluation(arguments, cell, angle)
        with progress("trials", evaluation.trials) as note:
            began = time.perf_counter()
            results = evaluate_fixed(evaluation, note)
            elapsed = time.perf_counter() - began
        figures = summarise(results)
        figures["start_angle_deg"] = angle
        figures["trials_per_second"] = evaluation.trials / elapsed
        rows.append(figures)
        trials.append(({"start_angle_deg": angle}, trial_columns(results)))
    if arguments.report is not None:
        write_trials(arguments.report / TRIALS, trials)
    if arguments.json:
        report = {"cell": cell.file.name, "rows": rows, "inputs": inputs_of(arguments)}
        print(json.dumps(report, indent=2))
    else:
        _print(cell, arguments, rows)
    return 0


def _evaluation(arguments: argparse.Namespace, cell: Cell, angle: float) -> FixedEvaluation:
    scatter, tolerance = scatter_of(arguments), si_pair(arguments.tolerance)
    x, y, theta = arguments.goal_pose
    return FixedEvaluation(
        space=make_fixed_space(cell, scatter, arguments.objective or ""),
        settings=make_planner_settings(
            cell, tolerance, scatter=scatter, camera=camera_of(arguments)
        ),
        trials=arguments.trials,
        goal=(1e-3 * x, 1e-3 * y, math.radians(theta)),
        start_angle=math.radians(angle),
        mount_error=si_pair(arguments.mount_error),
        adapt=arguments.adapt,
        seed=arguments.seed,
        most_taps=arguments.most_taps,
    )


def _print(cell: Cell, arguments: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    x, y, theta = arguments.goal_pose
    table = Table(
        *COLUMNS,
        box=None,
        pad_edge=False,
        title=f"{cell.file.name}, {cell.object.name}: {arguments.trials} trials per angle, goal "
        f"({x:g} mm, {y:g} mm, {theta:g} degrees)",
    )
    for row in rows:
        taps = row["taps"]
        low, high = taps["mean_interval"]
        table.add_row(
            f"{row['start_angle_deg']:g} deg",
            f"{taps['mean']:.2f} ({low:.2f} to {high:.2f})",
            f"{row['seconds']['mean']:.2f}" if "seconds" in row else "",
            str(taps.get("p99", "")),
            str(taps.get("max", "")),
            share_text(row["done"], row["trials"]),
            share_text(row["truly_inside"], row["done"]),
            str(row["refused_before"] + row["refused_later"]),
        )
    Console().print(table)
