"""The folder that a positioning run leaves: ``summary.json``, ``taps.csv`` and ``cell.png``."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from pathlib import Path
from typing import Any

from tapping_cell.report.cell_view import draw_cell
from tapping_cell.report.run import Failure, Run, TapRow
from tapping_cell.se2 import Pose

_POSE_KEYS = ("x_mm", "y_mm", "theta_deg")
_NO_POSE = Pose(0.0, 0.0, 0.0)
_BLANK_TAP = TapRow(0, 0, "", *(_NO_POSE,) * 6, striker_speed=0.0, contact_angle=0.0, outcome="")


def residual(goal: Pose, pose: Pose | None) -> dict[str, float] | None:
    """What remains to the goal, in mm and degrees; None where the pose is not known."""
    if pose is None:
        return None
    return {
        "distance_mm": 1000 * pose.distance_to(goal),
        "rotation_deg": math.degrees(abs(pose.rotation_to(goal))),
        "x_mm": 1000 * (goal.x - pose.x),
        "y_mm": 1000 * (goal.y - pose.y),
        "theta_deg": math.degrees(pose.rotation_to(goal)),
    }


def inside(goal: Pose, pose: Pose | None, tolerance: tuple[float, float]) -> bool:
    """True where the pose is known and within (m, rad) of the goal."""
    return (
        pose is not None
        and pose.distance_to(goal) <= tolerance[0]
        and abs(pose.rotation_to(goal)) <= tolerance[1]
    )


def for_people(pose: Pose | None) -> dict[str, float] | None:
    """A pose in mm and degrees."""
    if pose is None:
        return None
    return {
        "x_mm": 1000 * pose.x,
        "y_mm": 1000 * pose.y,
        "theta_deg": math.degrees(pose.theta),
    }


def summary(run: Run) -> dict[str, Any]:
    """The content of ``summary.json``."""
    return {
        "goal": for_people(run.goal),
        "start": for_people(run.start),
        "tolerance": {
            "distance_mm": 1000 * run.tolerance[0],
            "rotation_deg": math.degrees(run.tolerance[1]),
        },
        "reached": run.reached,
        "taps": len(run.taps),
        "measured_residual": residual(run.goal, run.final_measured),
        "true_residual": residual(run.goal, run.final_true),
        "wall_time": run.wall_time,
        "seed": run.seed,
        "versions": run.versions,
        "error_code": run.error_code,
        "error_msg": run.error_msg,
    }


def tap_columns(tap: TapRow) -> dict[str, object]:
    """A row of ``taps.csv``; every column that has a unit names it."""
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
        for key, value in (for_people(pose) or dict.fromkeys(_POSE_KEYS, math.nan)).items():
            row[name + key] = f"{value:.4f}"
    row["striker_speed_mm_s"] = f"{1000 * tap.striker_speed:.2f}"
    row["contact_angle_deg"] = f"{math.degrees(tap.contact_angle):.3f}"
    return row


def write_failure(folder: Path, failure: Failure) -> None:
    """Write the summary of a run that ended before it had a result into an existing folder."""
    content = {
        "goal": None,
        "reached": False,
        "taps": 0,
        "measured_residual": None,
        "true_residual": None,
        **dataclasses.asdict(failure),
    }
    _write_summary(folder, content)


def _write_summary(folder: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def write_run(folder: Path, run: Run) -> None:
    """Write the three files into an existing folder."""
    _write_summary(folder, summary(run))
    with (folder / "taps.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(tap_columns(_BLANK_TAP)))
        writer.writeheader()
        writer.writerows(tap_columns(tap) for tap in run.taps)
    draw_cell(run, folder / "cell.png")
