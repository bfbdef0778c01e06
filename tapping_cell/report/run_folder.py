"""Files of a run folder: ``summary.json``, ``taps.csv``, ``cell.png`` and ``report.html``.

All files are generated from the bag in the same folder and can be regenerated. Without the bag,
figure and page can still be generated from summary and taps.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from tapping_cell.durable_file import replace_text
from tapping_cell.report.bag import BagError
from tapping_cell.report.run import (
    FAILED,
    UNFINISHED,
    Covariance,
    ErrorEvent,
    Learnt,
    Phase,
    Picture,
    Run,
    TapRow,
)
from tapping_cell.report.run_reader import IllustratedRun, read_illustrated_run
from tapping_cell.report.versions import versions
from tapping_cell.se2 import Pose

SUMMARY, TAPS, CELL, PAGE, BAG = "summary.json", "taps.csv", "cell.png", "report.html", "bag"
_POSE_KEYS = ("x_mm", "y_mm", "theta_deg")
_NO_POSE = Pose(0.0, 0.0, 0.0)
_BLANK_TAP = TapRow(0, 0, "", *(_NO_POSE,) * 6, striker_speed=0.0, contact_angle=0.0, outcome="")
_TIMES = ("commanded_at", "fired_at", "at_rest_at")
_LEARNT_UNITS = {
    "direction": ("_deg", math.degrees(1.0)),
    "offset": ("_deg_mm", math.degrees(1e-3)),
}


class RunError(ValueError):
    """Raised for an unreadable run folder; the message gives the file and a remedy."""


def residual(goal: Pose | None, pose: Pose | None) -> dict[str, float] | None:
    """Return the residual to the goal in mm and degrees; None if goal or pose is unknown."""
    if pose is None or goal is None:
        return None
    return {
        "distance_mm": 1000 * pose.distance_to(goal),
        "rotation_deg": math.degrees(abs(pose.rotation_to(goal))),
        "x_mm": 1000 * (goal.x - pose.x),
        "y_mm": 1000 * (goal.y - pose.y),
        "theta_deg": math.degrees(pose.rotation_to(goal)),
    }


def in_display_units(pose: Pose | None) -> dict[str, float] | None:
    """Convert a pose to mm and degrees."""
    if pose is None:
        return None
    return {
        "x_mm": 1000 * pose.x,
        "y_mm": 1000 * pose.y,
        "theta_deg": math.degrees(pose.theta),
    }


_DEGREES = math.degrees(1.0)
_COVARIANCE = (
    ("predicted_variance_x_mm2", 0, 0, 1e6),
    ("predicted_covariance_x_y_mm2", 0, 1, 1e6),
    ("predicted_covariance_x_theta_mm_deg", 0, 2, 1e3 * _DEGREES),
    ("predicted_variance_y_mm2", 1, 1, 1e6),
    ("predicted_covariance_y_theta_mm_deg", 1, 2, 1e3 * _DEGREES),
    ("predicted_variance_theta_deg2", 2, 2, _DEGREES**2),
)
"""Columns for the covariance of the predicted pose: name, row, column, and factor from SI."""


def summary(run: Run) -> dict[str, Any]:
    """Return the content of ``summary.json``."""
    return {
        **({"note": run.note} if run.note else {}),
        "name": run.name,
        "outcome": run.outcome,
        "goal": in_display_units(run.goal),
        "start": in_display_units(run.start),
        "tolerance": {
            "distance_mm": 1000 * run.tolerance[0],
            "rotation_deg": math.degrees(run.tolerance[1]),
        },
        "reached": run.reached,
        "taps": len(run.taps),
        "planner": run.planner,
        "object": run.object_name,
        "final_measured": in_display_units(run.final_measured),
        "final_true": in_display_units(run.final_true),
        "measured_residual": residual(run.goal, run.final_measured),
        "true_residual": residual(run.goal, run.final_true),
        "began": run.began if math.isfinite(run.began) else None,
        "wall_time": run.wall_time,
        "seed": run.seed,
        "versions": run.versions,
        "error_code": run.error_code,
        "error_msg": run.error_msg,
        "phases": [[phase.began, phase.name] for phase in run.phases],
        "activities": [[step.began, step.name] for step in run.activities],
        "errors": [[t.at, t.source, t.code, t.sentence] for t in run.errors],
        "outline_mm": [[1000 * x, 1000 * y] for x, y in run.outline],
        "table_mm": [1000 * size for size in run.table_size],
        "files": run.files,
    }


def tap_columns(tap: TapRow) -> dict[str, object]:
    """Return a row of ``taps.csv``; column names include the units."""
    row: dict[str, object] = {
        "tap": tap.number,
        "tap_id": tap.tap_id,
        "method": tap.method,
        "outcome": tap.outcome,
    }
    poses = {
        "before_": tap.before,
        "commanded_d": tap.commanded,
        "predicted_": tap.predicted,
        "measured_": tap.measured,
        "true_": tap.true_pose,
        "strike_": tap.strike,
    }
    for name, pose in poses.items():
        for key, value in (in_display_units(pose) or dict.fromkeys(_POSE_KEYS, math.nan)).items():
            row[name + key] = f"{value:.4f}"
    row["striker_speed_mm_s"] = f"{1000 * tap.striker_speed:.2f}"
    row["contact_angle_deg"] = f"{math.degrees(tap.contact_angle):.3f}"
    row["measured_speed_mm_s"] = f"{1000 * tap.measured_speed:.2f}"
    for name in _TIMES:
        row[f"{name}_s"] = f"{getattr(tap, name):.3f}"
    for name, (column, unit) in _learnt_columns().items():
        row[column] = f"{unit * getattr(tap.learnt, name):.5f}"
    for column, first, second, unit in _COVARIANCE:
        known = tap.predicted_covariance
        row[column] = f"{unit * (known[first][second] if known else math.nan):.6g}"
    row["reason"] = tap.reason
    row["tapper"] = tap.tapper
    row["expected_taps"] = f"{tap.expected_taps:.3f}"
    row["expected_s"] = f"{tap.expected_seconds:.3f}"
    return row


def _covariance(row: dict[str, str]) -> Covariance | None:
    """Return the covariance of the predicted pose; None if the table does not contain it."""
    matrix = np.zeros((3, 3))
    for column, first, second, unit in _COVARIANCE:
        matrix[first, second] = matrix[second, first] = float(row.get(column, "nan")) / unit
    if not np.all(np.isfinite(matrix)):
        return None
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = matrix.tolist()
    return ((xx, xy, xt), (xy, yy, yt), (xt, yt, tt))


def _learnt_columns() -> dict[str, tuple[str, float]]:
    """Return column name in ``taps.csv`` and factor from SI units for each field of ``Learnt``."""
    columns = {}
    for field in fields(Learnt):
        suffix, unit = _LEARNT_UNITS.get(field.name.split("_")[0], ("", 1.0))
        columns[field.name] = (f"learnt_{field.name}{suffix}", unit)
    return columns


def write_folder(folder: Path, pictures: bool = True, source: Path | None = None) -> Run:
    """Write all files of a run folder from its bag, replacing existing files. Summary and taps that
    contain more of the run than the bag are kept; figure and page are then made from them.

    ``source``: path of the bag; None means the bag in the folder.

    Raises:
        tapping_cell.report.bag.BagError: there is no bag, or the bag has no goal.
        OSError: the folder cannot be written.
    """
    bag = source or folder / BAG
    own = bag if bag.is_dir() else bag.parent
    name = (own.parent if own.name == BAG else own).resolve().name
    illustrated = read_illustrated_run(bag, name)
    run = illustrated.run
    with contextlib.suppress(RunError):
        kept = read_run(folder)
        same = kept.began == run.began
        if kept.goal is None and run.outcome == UNFINISHED:
            # write_failure has recorded why the run ended, without a bag that it could read.
            run = replace(
                run, outcome=kept.outcome, error_code=kept.error_code, error_msg=kept.error_msg
            )
        elif (same or bag == folder / BAG) and _extent(kept) > _extent(run):
            reason = run.note or f"{bag} does not contain the end of the run"
            run = replace(kept, note=f"{SUMMARY} and {TAPS} are kept, because {reason}")
            shown = illustrated.pictures if same else ()
            _write_page(folder, IllustratedRun(run, shown), pictures)
            return run
    write_illustrated_run(folder, IllustratedRun(run, illustrated.pictures), pictures)
    return run


def _extent(run: Run) -> tuple[bool, bool, int, bool]:
    """Return how much of a run its record contains, for comparison: a complete bag before anything
    else, then whether the end is known, the taps, and the true pose."""
    complete = not run.note
    ended = run.outcome != UNFINISHED
    return (complete and ended, ended, len(run.taps), run.final_true is not None)


def write_failure(
    folder: Path, code: int, sentence: str, seed: int | None, wall_time: float
) -> None:
    """Record why a run ended, if the cell did not record the end; ``wall_time`` in s.

    A run that was recorded to its end is not changed.

    Raises:
        OSError: the folder cannot be written.
    """
    run = Run(
        name=folder.name,
        goal=None,
        start=None,
        tolerance=(0.0, 0.0),
        taps=(),
        final_measured=None,
        final_true=None,
        outcome=FAILED,
        wall_time=wall_time,
        seed=seed,
        versions=versions(),
        error_code=code,
        error_msg=sentence,
        outline=(),
        table_size=(0.0, 0.0),
    )
    with contextlib.suppress(RunError):
        run = read_run(folder)
        if run.outcome != UNFINISHED:
            return
        run = replace(run, outcome=FAILED, error_code=code, error_msg=sentence)
    pictures: tuple[Picture, ...] = ()
    with contextlib.suppress(BagError):
        pictures = read_illustrated_run(folder / BAG, folder.name).pictures
    write_illustrated_run(folder, IllustratedRun(run, pictures))


def write_illustrated_run(folder: Path, illustrated: IllustratedRun, pictures: bool = True) -> None:
    """Write summary and taps of a run and, if ``pictures`` is True, also figure and page.

    Raises:
        OSError: the folder cannot be written.
    """
    run = illustrated.run
    text = json.dumps(summary(run), indent=2, allow_nan=False)
    replace_text(folder / SUMMARY, text + "\n")
    rows = io.StringIO(newline="")
    writer = csv.DictWriter(rows, fieldnames=list(tap_columns(_BLANK_TAP)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(tap_columns(tap) for tap in run.taps)
    replace_text(folder / TAPS, rows.getvalue())
    _write_page(folder, illustrated, pictures)


def _write_page(folder: Path, illustrated: IllustratedRun, pictures: bool) -> None:
    if pictures:
        # Import here because loading the plotting modules takes a second.
        from tapping_cell.report.cell_view import draw_cell
        from tapping_cell.report.run_page import page

        draw_cell(illustrated.run, folder / CELL)
        replace_text(folder / PAGE, page(illustrated))


def read_run(folder: Path) -> Run:
    """Read a run from its summary and taps, for a run folder without a bag.

    Raises:
        RunError: a file is missing or damaged.
    """
    summary, table, place = folder / SUMMARY, folder / TAPS, "a run folder"
    with run_errors(summary, place):
        content = json.loads(summary.read_text(encoding="utf-8"))
    with run_errors(table, place), table.open(newline="", encoding="utf-8") as stream:
        taps = tuple(_tap(row) for row in csv.DictReader(stream))
    with run_errors(summary, place):
        return _run(content, taps)


@contextlib.contextmanager
def run_errors(path: Path, place: str) -> Iterator[None]:
    """Convert exceptions that occur while the file ``path`` of a run is read to RunError.
    ``place``: kind of folder in which the file was expected, for the message.

    Raises:
        RunError: the file is missing or damaged.
    """
    try:
        yield
    except OSError as error:
        raise RunError(f"{path} cannot be read ({error.strerror}); is this {place}?") from error
    except (KeyError, TypeError, ValueError) as error:
        raise RunError(f"{path} is damaged or of another version: {error!r}") from error


def _run(content: dict[str, Any], taps: tuple[TapRow, ...]) -> Run:
    tolerance, table = content["tolerance"], content["table_mm"]
    return Run(
        name=content["name"],
        goal=_pose(content["goal"]),
        start=_pose(content["start"]),
        tolerance=(tolerance["distance_mm"] / 1000, math.radians(tolerance["rotation_deg"])),
        taps=taps,
        final_measured=_pose(content["final_measured"]),
        final_true=_pose(content["final_true"]),
        outcome=content["outcome"],
        wall_time=content["wall_time"],
        seed=content["seed"],
        versions=content["versions"],
        error_code=content["error_code"],
        error_msg=content["error_msg"],
        outline=tuple((x / 1000, y / 1000) for x, y in content["outline_mm"]),
        table_size=(table[0] / 1000, table[1] / 1000),
        planner=content["planner"],
        object_name=content["object"],
        began=math.nan if content["began"] is None else content["began"],
        phases=tuple(Phase(*phase) for phase in content["phases"]),
        activities=tuple(Phase(*step) for step in content.get("activities", ())),
        errors=tuple(ErrorEvent(*event) for event in content["errors"]),
        files=content["files"],
        note=content.get("note", ""),
    )


def _pose(content: dict[str, float] | None) -> Pose | None:
    if content is None:
        return None
    x, y, theta = (content[key] for key in _POSE_KEYS)
    return Pose(x / 1000, y / 1000, math.radians(theta))


def _tap(row: dict[str, str]) -> TapRow:
    def pose(prefix: str) -> Pose:
        found = _pose({key: float(row[prefix + key]) for key in _POSE_KEYS})
        assert found is not None
        return found

    true = pose("true_")
    return TapRow(
        number=int(row["tap"]),
        tap_id=int(row["tap_id"]),
        method=row["method"],
        before=pose("before_"),
        commanded=pose("commanded_d"),
        predicted=pose("predicted_"),
        measured=pose("measured_"),
        true_pose=true if math.isfinite(true.x) else None,
        strike=pose("strike_"),
        striker_speed=float(row["striker_speed_mm_s"]) / 1000,
        contact_angle=math.radians(float(row["contact_angle_deg"])),
        outcome=row["outcome"],
        measured_speed=float(row["measured_speed_mm_s"]) / 1000,
        commanded_at=float(row["commanded_at_s"]),
        fired_at=float(row["fired_at_s"]),
        at_rest_at=float(row["at_rest_at_s"]),
        learnt=Learnt(
            **{
                name: float(row.get(column, math.nan)) / unit
                for name, (column, unit) in _learnt_columns().items()
            }
        ),
        reason=row.get("reason", ""),
        predicted_covariance=_covariance(row),
        tapper=row.get("tapper", ""),
        expected_taps=float(row.get("expected_taps", math.nan)),
        expected_seconds=float(row.get("expected_s", math.nan)),
    )
