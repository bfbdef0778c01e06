"""Comparison of several runs: a table of the runs, mean results of each planner, and a page with
plots."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean

from tapping_cell.report.palette import SERIES
from tapping_cell.report.rendering import render
from tapping_cell.report.residual_charts import residual_charts
from tapping_cell.report.run import Run
from tapping_cell.report.words import counted
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class Row:
    """One run in a comparison, in mm, degrees and s. Unknown values are NaN."""

    name: str
    outcome: str
    planner: str
    object_name: str
    tolerance_distance: float
    tolerance_rotation: float
    taps: int
    start_distance: float
    start_rotation: float
    distance: float
    rotation: float
    true_distance: float
    true_rotation: float
    time: float


def row_of(run: Run) -> Row:
    """Compute the results of one run for the comparison."""
    return Row(
        run.name,
        run.outcome,
        run.planner,
        run.first.name if len(run.objects) == 1 else counted(len(run.objects), "object"),
        1000 * run.first.tolerance[0],
        math.degrees(run.first.tolerance[1]),
        len(run.taps),
        *_largest_residual((one.start, one.goal) for one in run.objects),
        *_largest_residual((one.end, one.goal) for one in run.objects),
        *_largest_residual((one.end_true, one.goal) for one in run.objects),
        run.wall_time,
    )


def _largest_residual(pairs: Iterable[tuple[Pose | None, Pose | None]]) -> tuple[float, float]:
    """Return the largest distance (mm) and rotation (degrees) of poses from their goals."""
    left = [
        (1000 * pose.distance_to(goal), abs(math.degrees(pose.rotation_to(goal))))
        for pose, goal in pairs
        if pose is not None and goal is not None
    ]
    return (max(d for d, _ in left), max(r for _, r in left)) if left else (math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class Group:
    """Results of the runs with one planner and one object. The means include only the runs that
    reached their goal."""

    planner: str
    object_name: str
    runs: int
    reached: int
    taps: float
    most_taps: int
    distance: float
    rotation: float
    time: float


def groups_of(rows: Sequence[Row]) -> tuple[Group, ...]:
    """Group the runs by planner and object, sorted by their names."""
    found = []
    for key in sorted({(row.planner, row.object_name) for row in rows}):
        own = [row for row in rows if (row.planner, row.object_name) == key]
        reached = [row for row in own if row.outcome == "reached"]
        found.append(
            Group(
                *key,
                runs=len(own),
                reached=len(reached),
                taps=_mean([row.taps for row in reached]),
                most_taps=max((row.taps for row in own), default=0),
                distance=_mean([row.distance for row in reached]),
                rotation=_mean([row.rotation for row in reached]),
                time=_mean([row.time for row in reached]),
            )
        )
    return tuple(found)


def _mean(values: Sequence[float]) -> float:
    return fmean(values) if values else math.nan


def comparison_page(runs: Sequence[Run], links: Sequence[str]) -> str:
    """Return a page that compares runs; ``links`` are the addresses of their pages."""
    rows = [row_of(run) for run in runs]
    # Each run has its own colour while there are enough; otherwise, each planner has one.
    named = [run.name if len(runs) <= len(SERIES) else run.planner for run in runs]
    legend = {name: SERIES[index % len(SERIES)] for index, name in enumerate(dict.fromkeys(named))}
    return render(
        "comparison.html",
        rows=[(row, link, _numbers(row)) for row, link in zip(rows, links, strict=True)],
        reached=sum(row.outcome == "reached" for row in rows),
        groups=[_group(group) for group in groups_of(rows)],
        charts=residual_charts(runs, [legend[name] for name in named]),
        legend=legend,
        tolerances_differ=len({run.first.tolerance for run in runs}) > 1,
    )


def _numbers(row: Row) -> list[tuple[str, str]]:
    """Return the sort key and the text of each number of a run."""
    numbers = (
        (row.tolerance_distance, _pair(row.tolerance_distance, row.tolerance_rotation)),
        (row.taps, str(row.taps)),
        (row.start_distance, _pair(row.start_distance, row.start_rotation)),
        (row.distance, _pair(row.distance, row.rotation)),
        (row.true_distance, _pair(row.true_distance, row.true_rotation)),
        (row.time, f"{row.time:.1f} s"),
    )
    return [(repr(value) if math.isfinite(value) else "", text) for value, text in numbers]


def _group(group: Group) -> tuple[str, ...]:
    return (
        group.planner or "-",
        group.object_name or "-",
        f"{group.reached} of {group.runs}",
        _number(group.taps, 2),
        str(group.most_taps),
        _pair(group.distance, group.rotation),
        _number(group.time, 1, " s"),
    )


def _pair(distance: float, rotation: float) -> str:
    if not math.isfinite(distance):
        return "-"
    return f"{distance:.2f} mm, {rotation:.2f} deg"


def _number(value: float, digits: int, unit: str = "") -> str:
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "-"
