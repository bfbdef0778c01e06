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
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tapping_cell.durable_file import replace_text
from tapping_cell.report.columns import from_texts, headers, to_texts
from tapping_cell.report.recorded import BagError
from tapping_cell.report.run import (
    FAILED,
    UNFINISHED,
    ErrorEvent,
    Phase,
    Run,
    RunObject,
    TapRow,
)
from tapping_cell.report.run_reader import IllustratedRun, read_illustrated_run
from tapping_cell.report.versions import versions
from tapping_cell.se2 import Pose

SUMMARY, TAPS, CELL, PAGE, BAG = "summary.json", "taps.csv", "cell.png", "report.html", "bag"
_POSE_KEYS = ("x_mm", "y_mm", "theta_deg")


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


def summary(run: Run) -> dict[str, Any]:
    """Return the content of ``summary.json``. Goal, start and poses at the top are those of the
    object if one object has a goal; ``objects`` lists all objects."""
    goals = [one for one in run.objects if one.goal is not None] or run.objects
    one = goals[0] if len(goals) == 1 else RunObject()
    measured = [residual(each.goal, each.end) for each in goals]
    true = [residual(each.goal, each.end_true) for each in goals]
    return {
        **({"note": run.note} if run.note else {}),
        "name": run.name,
        "outcome": run.outcome,
        "goal": in_display_units(one.goal),
        "start": in_display_units(one.start),
        "tolerance": _tolerance(one),
        "reached": run.reached,
        "taps": len(run.taps),
        "planner": run.planner,
        "object": one.name,
        "final_measured": in_display_units(one.end),
        "final_true": in_display_units(one.end_true),
        "measured_residual": _largest(measured),
        "true_residual": _largest(true),
        "began": run.began if math.isfinite(run.began) else None,
        "wall_time": run.wall_time,
        "seed": run.seed,
        "versions": run.versions,
        "error_code": run.error_code,
        "error_msg": run.error_msg,
        "phases": [[phase.began, phase.name] for phase in run.phases],
        "activities": [[step.began, step.name] for step in run.activities],
        "errors": [[t.at, t.source, t.code, t.sentence] for t in run.errors],
        "outline_mm": [[1000 * x, 1000 * y] for x, y in one.outline],
        "table_mm": [1000 * size for size in run.table_size],
        "mounts": [
            [name, 1000 * tip.x, 1000 * tip.y, math.degrees(tip.theta)] for name, tip in run.mounts
        ],
        "files": run.files,
        "objects": [_object_content(each) for each in run.objects],
        "contacts": None if run.contacts is None else [list(pair) for pair in run.contacts],
    }


def _tolerance(one: RunObject) -> dict[str, float]:
    return {
        "distance_mm": 1000 * one.tolerance[0],
        "rotation_deg": math.degrees(one.tolerance[1]),
    }


def _largest(residuals: Sequence[dict[str, float] | None]) -> dict[str, float] | None:
    """Return the residual of one object, or the largest distance and rotation of several."""
    known = [each for each in residuals if each is not None]
    if len(residuals) == 1 or not known:
        return residuals[0]
    return {key: max(each[key] for each in known) for key in ("distance_mm", "rotation_deg")}


def _object_content(one: RunObject) -> dict[str, Any]:
    return {
        "object": one.name,
        "goal": in_display_units(one.goal),
        "start": in_display_units(one.start),
        "tolerance": _tolerance(one),
        "final_measured": in_display_units(one.end),
        "final_true": in_display_units(one.end_true),
        "measured_residual": residual(one.goal, one.end),
        "true_residual": residual(one.goal, one.end_true),
        "outcome": one.outcome,
        "taps": one.taps,
        "outline_mm": [[1000 * x, 1000 * y] for x, y in one.outline],
    }


def write_folder(folder: Path, pictures: bool = True, source: Path | None = None) -> Run:
    """Write all files of a run folder from its bag, replacing existing files. Summary and taps that
    contain more of the run than the bag are kept; figure and page are then made from them.

    ``source``: path of the bag; None means the bag in the folder.

    Raises:
        tapping_cell.report.recorded.BagError: there is no bag, or the bag has no goal.
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
        if kept.first.goal is None and run.outcome == UNFINISHED:
            # write_failure has recorded why the run ended, without a bag that it could read.
            run = replace(
                run, outcome=kept.outcome, error_code=kept.error_code, error_msg=kept.error_msg
            )
        elif (same or bag == folder / BAG) and _extent(kept) > _extent(run):
            reason = run.note or f"{bag} does not contain the end of the run"
            run = replace(kept, note=f"{SUMMARY} and {TAPS} are kept, because {reason}")
            shown = replace(illustrated, run=run) if same else IllustratedRun(run, ())
            _write_page(folder, shown, pictures)
            return run
    write_illustrated_run(folder, replace(illustrated, run=run), pictures)
    return run


def _extent(run: Run) -> tuple[bool, bool, int, bool]:
    """Return how much of a run its record contains, for comparison: a complete bag before anything
    else, then whether the end is known, the taps, and the true pose."""
    complete = not run.note
    ended = run.outcome != UNFINISHED
    return (complete and ended, ended, len(run.taps), run.first.end_true is not None)


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
        objects=(RunObject(),),
        taps=(),
        outcome=FAILED,
        wall_time=wall_time,
        seed=seed,
        versions=versions(),
        error_code=code,
        error_msg=sentence,
        table_size=(0.0, 0.0),
    )
    with contextlib.suppress(RunError):
        run = read_run(folder)
        if run.outcome != UNFINISHED:
            return
        run = replace(run, outcome=FAILED, error_code=code, error_msg=sentence)
    illustrated = IllustratedRun(run, ())
    with contextlib.suppress(BagError):
        illustrated = replace(read_illustrated_run(folder / BAG, folder.name), run=run)
    write_illustrated_run(folder, illustrated)


def write_illustrated_run(folder: Path, illustrated: IllustratedRun, pictures: bool = True) -> None:
    """Write summary and taps of a run and, if ``pictures`` is True, also figure and page.

    Raises:
        OSError: the folder cannot be written.
    """
    run = illustrated.run
    text = json.dumps(summary(run), indent=2, allow_nan=False)
    replace_text(folder / SUMMARY, text + "\n")
    rows = io.StringIO(newline="")
    writer = csv.DictWriter(rows, fieldnames=headers(TapRow), lineterminator="\n")
    writer.writeheader()
    writer.writerows(to_texts(tap) for tap in run.taps)
    replace_text(folder / TAPS, rows.getvalue())
    _write_page(folder, illustrated, pictures)


def _write_page(folder: Path, illustrated: IllustratedRun, pictures: bool) -> None:
    if pictures:
        # Import here because loading the plotting modules takes a second.
        from tapping_cell.report import objects_page, run_page
        from tapping_cell.report.cell_view import draw_cell

        draw_cell(illustrated.run, folder / CELL)
        made = objects_page if len(illustrated.run.objects) > 1 else run_page
        replace_text(folder / PAGE, made.page(illustrated))


def read_run(folder: Path) -> Run:
    """Read a run from its summary and taps, for a run folder without a bag.

    Raises:
        RunError: a file is missing or damaged.
    """
    summary, table, place = folder / SUMMARY, folder / TAPS, "a run folder"
    with run_errors(summary, place):
        content = json.loads(summary.read_text(encoding="utf-8"))
    with run_errors(table, place), table.open(newline="", encoding="utf-8") as stream:
        taps = tuple(from_texts(TapRow, row) for row in csv.DictReader(stream))
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
    table = content["table_mm"]
    # The folder of an earlier version has no list of objects, and describes its object at the top.
    objects = content.get("objects") or [content]
    contacts = content.get("contacts")
    return Run(
        name=content["name"],
        objects=tuple(_object(each) for each in objects),
        taps=taps,
        outcome=content["outcome"],
        wall_time=content["wall_time"],
        seed=content["seed"],
        versions=content["versions"],
        error_code=content["error_code"],
        error_msg=content["error_msg"],
        table_size=(table[0] / 1000, table[1] / 1000),
        mounts=tuple(
            (name, Pose(x / 1000, y / 1000, math.radians(angle)))
            for name, x, y, angle in content.get("mounts", ())
        ),
        planner=content["planner"],
        began=math.nan if content["began"] is None else content["began"],
        phases=tuple(Phase(*phase) for phase in content["phases"]),
        activities=tuple(Phase(*step) for step in content.get("activities", ())),
        errors=tuple(ErrorEvent(*event) for event in content["errors"]),
        files=content["files"],
        contacts=None if contacts is None else tuple((str(a), str(b)) for a, b in contacts),
        note=content.get("note", ""),
    )


def _object(content: dict[str, Any]) -> RunObject:
    tolerance = content["tolerance"]
    return RunObject(
        name=content["object"],
        outline=tuple((x / 1000, y / 1000) for x, y in content["outline_mm"]),
        start=_pose(content["start"]),
        goal=_pose(content["goal"]),
        end=_pose(content["final_measured"]),
        end_true=_pose(content["final_true"]),
        tolerance=(tolerance["distance_mm"] / 1000, math.radians(tolerance["rotation_deg"])),
        taps=content["taps"],
        outcome=content["outcome"] if "files" not in content else "",
    )


def _pose(content: dict[str, float] | None) -> Pose | None:
    if content is None:
        return None
    x, y, theta = (content[key] for key in _POSE_KEYS)
    return Pose(x / 1000, y / 1000, math.radians(theta))
