"""Part of the verb evaluate for a cell with fixed tappers: a table with one row per start angle."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from tapping_cell.cli.evaluate_scatter import scatter_of
from tapping_cell.configuration.assembly import make_fixed_space, make_planner_settings
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import CameraNoise, PlanningError
from tapping_cell.planning.evaluation.fixed_cell import FixedEvaluation, evaluate_fixed
from tapping_cell.planning.evaluation.summary import summarise

COLUMNS = (
    "start angle",
    "mean taps",
    "seconds",
    "taps, 99 %",
    "taps, maximum",
    "reached",
    "truly inside",
    "refused",
)


def add_fixed_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that apply only to a cell with fixed tappers."""
    numbers: Callable[..., Any] = parser.add_argument
    numbers(
        "--start-angles",
        type=float,
        nargs="+",
        default=(10.0, 30.0, 90.0),
        metavar="DEG",
        help="maximum angle between start pose and goal pose, in degrees. Several values may be "
        "given; each gives one row of the table (only for a cell with fixed tappers; default: "
        "10 30 90)",
    )
    numbers(
        "--goal-pose",
        type=float,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "THETA"),
        help="goal pose on the table, in mm, mm and degrees (only for a cell with fixed tappers; "
        "default: 0 0 0)",
    )
    numbers(
        "--mount-error",
        type=float,
        nargs=2,
        default=(0.0, 0.0),
        metavar=("MM", "DEG"),
        help="standard deviations of each tapper's mounting error: the sideways offset of its line "
        "of motion, in mm, and the error of its direction, in degrees; new random errors for each "
        "trial (only for a cell with fixed tappers; default: 0 0)",
    )


def run_fixed(arguments: argparse.Namespace, cell: Cell) -> int:
    """Evaluate the cell at each start angle and print the table. Return 0.

    Raises:
        PlanningError: an option does not apply to a cell with fixed tappers.
    """
    without_meaning = {
        "--all": arguments.all,
        "--table": arguments.table,
        "--probe": arguments.probe,
        "--random-tasks": arguments.random_tasks is not None,
        f"--model {arguments.model}": arguments.model != "abstract",
        "--report": arguments.report is not None,
        "--box": arguments.box is not None,
        "--gain-bias": tuple(arguments.gain_bias) != (0.0, 0.0),
        "--unknown": tuple(arguments.unknown) != (1.0, 1.0),
        "--off-centre": arguments.off_centre != 0.0,
    }
    given = [name for name, is_set in without_meaning.items() if is_set]
    if given:
        raise PlanningError(
            f"a cell with fixed tappers does not support {', '.join(given)}: remove what is named "
            "here, or give a cell file with an arm"
        )
    rows = []
    for angle in arguments.start_angles:
        evaluation = _evaluation(arguments, cell, angle)
        with _progress(arguments, evaluation.trials) as note:
            began = time.perf_counter()
            results = evaluate_fixed(evaluation, note)
            elapsed = time.perf_counter() - began
        figures = summarise(results)
        figures["start_angle_deg"] = angle
        figures["trials_per_second"] = evaluation.trials / elapsed
        rows.append(figures)
    if arguments.json:
        inputs = {
            name: str(value) if isinstance(value, Path) else value
            for name, value in sorted(vars(arguments).items())
            if name not in {"json", "report", "processes", "verb"}
        }
        print(json.dumps({"cell": cell.file.name, "rows": rows, "inputs": inputs}, indent=2))
    else:
        _print(cell, arguments, rows)
    return 0


def _evaluation(arguments: argparse.Namespace, cell: Cell, angle: float) -> FixedEvaluation:
    scatter = scatter_of(arguments)
    tolerance = 1e-3 * arguments.tolerance[0], math.radians(arguments.tolerance[1])
    camera = CameraNoise(1e-3 * arguments.camera_noise[0], math.radians(arguments.camera_noise[1]))
    settings = make_planner_settings(cell, tolerance, scatter=scatter, camera=camera)
    x, y, theta = arguments.goal_pose
    off, turned = arguments.mount_error
    return FixedEvaluation(
        space=make_fixed_space(cell, scatter, arguments.objective or ""),
        settings=settings,
        trials=arguments.trials,
        goal=(1e-3 * x, 1e-3 * y, math.radians(theta)),
        start_angle=math.radians(angle),
        mount_error=(1e-3 * off, math.radians(turned)),
        adapt=arguments.adapt,
        seed=arguments.seed,
        most_taps=arguments.most_taps,
    )


def _print(cell: Cell, arguments: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    x, y, theta = arguments.goal_pose
    table = Table(
        *COLUMNS,
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
            f"{100 * row['success_rate']:.2f} %",
            f"{100 * row['truly_inside_rate']:.2f} %",
            str(row["refused_before"] + row["refused_later"]),
        )
    Console(width=110).print(table)


@contextlib.contextmanager
def _progress(arguments: argparse.Namespace, total: int) -> Iterator[Callable[[int], None]]:
    """Show a progress bar on stderr if it is a terminal."""
    if arguments.json or not sys.stderr.isatty():
        yield lambda count: None
        return
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("trials", total=total)
        yield lambda count: bar.advance(task, count)
