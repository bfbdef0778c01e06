"""Comparison of several runs: a table of the runs, mean results of each planner, and a page with
plots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from statistics import fmean

from tapping_cell.report.page_style import document, scrolling_table
from tapping_cell.report.palette import SERIES
from tapping_cell.report.run import Run
from tapping_cell.report.svg import chart
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class Row:
    """One run in a comparison, in mm, degrees and s. Unknown values are NaN."""

    name: str
    outcome: str
    planner: str
    object_name: str
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
    start, measured, true = (
        _to_go(pose, run.goal) for pose in (run.start, run.final_measured, run.final_true)
    )
    return Row(
        name=run.name,
        outcome=run.outcome,
        planner=run.planner,
        object_name=run.object_name,
        taps=len(run.taps),
        start_distance=start[0],
        start_rotation=start[1],
        distance=measured[0],
        rotation=measured[1],
        true_distance=true[0],
        true_rotation=true[1],
        time=run.wall_time,
    )


def _to_go(pose: Pose | None, goal: Pose | None) -> tuple[float, float]:
    if pose is None or goal is None:
        return math.nan, math.nan
    return 1000 * pose.distance_to(goal), abs(math.degrees(pose.rotation_to(goal)))


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
    reached = sum(row.outcome == "reached" for row in rows)
    body = (
        f'<header class="{"good" if reached == len(rows) else "so"}">'
        f'<p class="badge">comparison</p><h1>{len(rows)} runs, {reached} reached their goal</h1>'
        "</header>"
        f"<section><h2>By planner and object</h2>{_groups(groups_of(rows))}</section>"
        f"{_charts(runs)}"
        f"<section><h2>Runs</h2>{_table(rows, links)}</section>"
    )
    return document(f"{len(rows)} runs compared", body)


_COLUMNS = (
    "run",
    "outcome",
    "planner",
    "object",
    "taps",
    "distance at the start",
    "measured residual",
    "true residual",
    "time",
)
# Numbers sort by the `data-key` of their cell, words by their text. Unknown values stay last in
# both directions. A screen reader announces `aria-sort`.
_SORTING = """
for (const table of document.querySelectorAll("table.sorts")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => head.firstChild.addEventListener("click", () => {
    const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    const key = ({cells}) => cells[column].dataset.key ?? cells[column].textContent;
    const order = (a, b) => a - b || a.localeCompare(b, "en", {numeric: true});
    const compare = (a, b) =>
      key(a) && key(b) ? sign * order(key(a), key(b)) : !key(a) - !key(b);
    table.tBodies[0].append(...[...table.tBodies[0].rows].sort(compare));
    heads.forEach((each) => each.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", sign < 0 ? "descending" : "ascending");
  }));
}
"""


def _table(rows: Sequence[Row], links: Sequence[str]) -> str:
    """Return the table of the runs; a click on a column's heading sorts it."""
    head = "".join(f'<th><button type="button">{name}</button></th>' for name in _COLUMNS)
    lines = []
    for row, link in zip(rows, links, strict=True):
        kind = "good-word" if row.outcome == "reached" else "bad-word"
        cells = (
            f'<td><a href="{escape(link)}">{escape(row.name)}</a></td>',
            f'<td><span class="{kind}">{escape(row.outcome)}</span></td>',
            f"<td>{escape(row.planner)}</td>",
            f"<td>{escape(row.object_name)}</td>",
            _cell(row.taps, str(row.taps)),
            _cell(row.start_distance, _pair(row.start_distance, row.start_rotation)),
            _cell(row.distance, _pair(row.distance, row.rotation)),
            _cell(row.true_distance, _pair(row.true_distance, row.true_rotation)),
            _cell(row.time, f"{row.time:.1f} s"),
        )
        lines.append(f"<tr>{''.join(cells)}</tr>")
    content = f"<thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f"{scrolling_table('Runs', content, 'wide sorts')}<script>{_SORTING}</script>"


def _cell(value: float, text: str) -> str:
    """Return a table cell that shows ``text`` and is sorted by ``value``."""
    key = repr(value) if math.isfinite(value) else ""
    return f'<td data-key="{key}">{text}</td>'


def _groups(groups: Sequence[Group]) -> str:
    head = (
        "<tr><th>planner</th><th>object</th><th>reached</th><th>taps, mean</th><th>taps, "
        "maximum</th>"
        "<th>measured residual, mean</th><th>time, mean</th></tr>"
    )
    lines = [
        f"<tr><td>{escape(group.planner or '-')}</td><td>{escape(group.object_name or '-')}</td>"
        f"<td>{group.reached} of {group.runs}</td><td>{_number(group.taps, 2)}</td>"
        f"<td>{group.most_taps}</td><td>{_pair(group.distance, group.rotation)}</td>"
        f"<td>{_number(group.time, 1, ' s')}</td></tr>"
        for group in groups
    ]
    return scrolling_table("Groups of runs", head + "".join(lines))


def _charts(runs: Sequence[Run]) -> str:
    """Plot the residual of each run after each tap, coloured by planner."""
    planners = sorted({run.planner for run in runs})
    colours = {name: SERIES[index % len(SERIES)] for index, name in enumerate(planners)}
    distances, rotations = [], []
    for run in runs:
        goal = run.goal
        if goal is None or run.start is None or not run.taps:
            # A run without taps has no curve. It is left out, because a large distance at its start
            # would only compress the scale.
            continue
        poses = [run.start, *(tap.measured for tap in run.taps)]
        colour = colours[run.planner]
        distances.append((run.name, [1000 * pose.distance_to(goal) for pose in poses], colour))
        turns = [abs(math.degrees(pose.rotation_to(goal))) for pose in poses]
        rotations.append((run.name, turns, colour))
    if not distances:
        return ""
    limits = [run.tolerance for run in runs]
    distance_limit = 1000 * max(limit[0] for limit in limits)
    angle_limit = math.degrees(max(limit[1] for limit in limits))
    legend = " ".join(
        f'<span class="key"><i style="background:{colours[name]}"></i>{escape(name or "-")}</span>'
        for name in planners
    )
    return (
        f'<section class="two">{chart(distances, distance_limit, "remaining distance (mm)")}'
        f"{chart(rotations, angle_limit, 'remaining rotation (deg)')}<p>{legend}</p></section>"
    )


def _pair(distance: float, rotation: float) -> str:
    if not math.isfinite(distance):
        return "-"
    return f"{distance:.2f} mm, {rotation:.2f} deg"


def _number(value: float, digits: int, unit: str = "") -> str:
    return f"{value:.{digits}f}{unit}" if math.isfinite(value) else "-"
