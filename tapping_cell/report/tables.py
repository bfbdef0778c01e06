"""Tables with one row for each trial, run or tap, as CSV and Parquet (docs/runs.md)."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tapping_cell.durable_file import part_of, replace_text
from tapping_cell.planning.evaluation.arrangements import ArrangementTrial
from tapping_cell.planning.evaluation.task import End, Results
from tapping_cell.report.columns import declared, headers
from tapping_cell.report.run import Run, TapRow
from tapping_cell.report.run_comparison import row_of

TRIALS, SCENES, RUNS, TAPS = "trials.csv", "scenes.csv", "runs.csv", "runs_taps.csv"
METHOD = {"method": "planning method and variant"}
TRIAL_COLUMNS = {
    "trial": "number of the trial; trials with the same number have the same task",
    "taps": "number of fired taps",
    "end": "`done`, `endless`, `refused_before` or `refused_later` the first tap",
    "inside": "whether the true pose is inside the tolerance",
    "distance_mm": "true remaining distance",
    "rotation_deg": "true remaining rotation",
    "seconds": "duration of the taps, s; without `--table` the number of taps times the cell's "
    "mean time of a tap; `nan` if unknown",
}
"""Columns of ``trials.csv`` and their meanings, after those that tell the evaluations apart."""
SCENE_COLUMNS = {
    "method": "method that chooses the next object",
    "scene": "number of the scene; scenes with the same number have the same objects and goals",
    "objects": "number of objects",
    "taps": "number of fired taps",
    "lone_taps": "number of taps that the same objects need if each is alone on the table",
    "end": "`done`, `refused_before` or `refused_later` the first tap",
    "inside": "whether every true pose is inside its tolerance",
    "contacts": "number of contacts between objects",
    "tool_contacts": "number of strikes in which the tool would have touched another object",
    "made_way": "number of moves out of the way of another object",
    "decision_s": "processor time of the slowest decision",
    "reason": "why the scene was refused; empty if it was done",
}
"""Columns of ``scenes.csv`` and their meanings."""
RUN_COLUMNS = {
    "run": "name of the run",
    "folder": "run folder, with report, bag and images",
    "began_unix_s": "start of the run, s since 1970",
    "seed": "random seed of the simulation; empty on hardware",
    "outcome": "outcome of the run (docs/runs.md)",
    "error_code": "error code; 0 if the goal was reached",
    "planner": "planning method",
    "object": "object, or the number of objects",
    "taps": "number of taps",
    "start_distance_mm": "distance from the goal at the start; of several objects the largest",
    "start_rotation_deg": "rotation from the goal at the start",
    "distance_mm": "measured remaining distance",
    "rotation_deg": "measured remaining rotation",
    "true_distance_mm": "true remaining distance; `nan` on hardware",
    "true_rotation_deg": "true remaining rotation; `nan` on hardware",
    "time_s": "duration of the run",
}
"""Columns of ``runs.csv`` and their meanings."""


def write_table(path: Path, columns: Mapping[str, Sequence[Any]]) -> None:
    """Write a table as CSV and, if pyarrow is installed, the same as Parquet beside it."""
    text = io.StringIO(newline="")
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        table.writerow([f"{cell:.13g}" if isinstance(cell, float) else cell for cell in row])
    replace_text(path, text.getvalue())
    other = path.with_suffix(".parquet")
    other.unlink(missing_ok=True)  # it would not match the new CSV file
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return
    parquet.write_table(pyarrow.table(dict(columns)), part_of(other))
    part_of(other).replace(other)


def trial_columns(results: Results) -> dict[str, list[Any]]:
    """Return the columns of ``trials.csv`` of one evaluation."""
    values = (
        list(range(len(results.taps))),
        results.taps.tolist(),
        [End(code).name.lower() for code in results.end.tolist()],
        results.inside.tolist(),
        (1e3 * results.distance).tolist(),
        np.degrees(results.rotation).tolist(),
        results.seconds.tolist(),
    )
    return dict(zip(TRIAL_COLUMNS, values, strict=True))


def write_trials(
    path: Path, evaluations: Sequence[tuple[Mapping[str, Any], Mapping[str, Sequence[Any]]]]
) -> None:
    """Write one row for each trial, and create the folder if missing.

    ``evaluations``: for each, the columns and values that tell it apart from the others, and its
    ``trial_columns``.
    """
    columns: dict[str, list[Any]] = {name: [] for name in (*evaluations[0][0], *TRIAL_COLUMNS)}
    for apart, trials in evaluations:
        for name, value in apart.items():
            columns[name] += [value] * len(trials["trial"])
        for name, values in trials.items():
            columns[name] += values
    path.parent.mkdir(parents=True, exist_ok=True)
    write_table(path, columns)


def write_scenes(path: Path, scenes: Mapping[str, Sequence[ArrangementTrial]]) -> None:
    """Write one row for each scene of each method of arranging objects."""
    rows = [
        (
            *(method, number, len(scene.goals), scene.taps, scene.lone_taps),
            *(
                scene.end.replace(" ", "_"),
                scene.inside,
                scene.contacts,
                scene.tool_contacts,
                scene.made_way,
            ),
            *(scene.slowest, "" if scene.end == "done" else scene.sentence),
        )
        for method, trials in scenes.items()
        for number, scene in enumerate(trials)
    ]
    write_table(path, _columns(list(SCENE_COLUMNS), rows))


def write_runs(folder: Path, runs: Sequence[tuple[Run, Path]]) -> None:
    """Write ``runs.csv``, one row for each run and its folder, and ``runs_taps.csv``, one row for
    each tap of these runs."""
    rows = []
    for run, place in runs:
        row = row_of(run)
        began = (row.name, str(place), run.began, run.seed, row.outcome, run.error_code)
        what = (row.planner, row.object_name, row.taps)
        start = (row.start_distance, row.start_rotation)
        end = (row.distance, row.rotation, row.true_distance, row.true_rotation, row.time)
        rows.append((*began, *what, *start, *end))
    write_table(folder / RUNS, _columns(list(RUN_COLUMNS), rows))
    taps = [(run.name, *_tap_values(tap)) for run, _ in runs for tap in run.taps]
    write_table(folder / TAPS, _columns(["run", *headers(TapRow)], taps))


def _tap_values(tap: TapRow) -> list[Any]:
    return [
        value if column.factor is None else column.factor * float(value)
        for each, columns in declared(TapRow)
        for column, value in zip(
            columns.columns, columns.split(getattr(tap, each.name)), strict=True
        )
    ]


def _columns(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, list[Any]]:
    return {name: [row[index] for row in rows] for index, name in enumerate(names)}
