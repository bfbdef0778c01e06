"""Tables with one row for each trial, run or tap, as CSV and Parquet (docs/reference/tables.md)."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tapping_cell.durable_file import part_of, replace_text
from tapping_cell.planning.evaluation.task import End, Results
from tapping_cell.report.columns import declared, headers
from tapping_cell.report.run import Run, TapRow
from tapping_cell.report.run_comparison import row_of

TRIALS, RUNS, TAPS = "trials.csv", "runs.csv", "runs_taps.csv"
TRIAL_COLUMNS = {
    "method": "planning method and variant",
    "trial": "number of the trial; trials with the same number have the same task",
    "taps": "number of fired taps",
    "end": "`done`, `endless`, `refused_before` or `refused_later` the first tap",
    "inside": "whether the true pose is inside the tolerance",
    "distance_mm": "true remaining distance",
    "rotation_deg": "true remaining rotation",
    "seconds": "duration of the taps, s; `nan` if unknown",
}
"""Columns of ``trials.csv`` and their meanings."""
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
        table.writerow([f"{cell:.9g}" if isinstance(cell, float) else cell for cell in row])
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


def write_trials(path: Path, trials: Mapping[str, Results]) -> None:
    """Write one row for each trial of each method."""
    columns: dict[str, list[Any]] = {name: [] for name in TRIAL_COLUMNS}
    for label, results in trials.items():
        count = len(results.taps)
        values = (
            [label] * count,
            range(count),
            results.taps.tolist(),
            [End(code).name.lower() for code in results.end.tolist()],
            results.inside.tolist(),
            (1e3 * results.distance).tolist(),
            np.degrees(results.rotation).tolist(),
            results.seconds.tolist(),
        )
        for column, more in zip(columns.values(), values, strict=True):
            column.extend(more)
    write_table(path, columns)


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
