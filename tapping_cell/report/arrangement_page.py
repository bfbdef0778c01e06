"""``report.html`` of an arrangement of several objects, in one file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from html import escape
from pathlib import Path

import numpy as np

from tapping_cell.report.arrangement_run import (
    ArrangedMove,
    ArrangedObject,
    ArrangementRun,
    moves_of,
)
from tapping_cell.report.page_style import (
    cards_section,
    document,
    failure_section,
    scrolling_table,
)
from tapping_cell.report.palette import INK, LINE, SERIES, TABLE
from tapping_cell.report.photograph import photograph
from tapping_cell.report.run import Picture
from tapping_cell.report.run_folder import PAGE
from tapping_cell.report.svg import Plan
from tapping_cell.report.words import counted
from tapping_cell.se2 import Array, Pose

REACHED = "reached"
_MARGIN_MM = 12.0


def write_page(run: ArrangementRun, folder: Path, pictures: Sequence[Picture] = ()) -> Path:
    """Write ``report.html`` to the folder; return its path. ``pictures``: see :func:`page`."""
    path = folder / PAGE
    path.write_text(page(run, pictures), encoding="utf-8")
    return path


def page(run: ArrangementRun, pictures: Sequence[Picture] = ()) -> str:
    """Return the page of an arrangement, which loads no other files.

    ``pictures``: camera images in the order of time. The page shows the images taken before,
    half-way through and after the moves.
    """
    moves = moves_of(run)
    parts = [
        _head(run),
        failure_section(run.error_code, run.error_msg),
        _cards(run, moves),
        _scenes(run, moves, pictures),
        _objects(run),
        _order(run, moves),
        _taps(run),
    ]
    return document(f"{headline(run)} - {run.name}", "".join(parts))


def headline(run: ArrangementRun) -> str:
    """Summarise the outcome of an arrangement in a few words."""
    goals = [one for one in run.objects if one.goal is not None]
    reached = sum(one.outcome == REACHED for one in goals)
    if not run.error_code:
        return f"Arrangement reached: {counted(reached, 'object')}, {counted(len(run.taps), 'tap')}"
    return (
        f"Arrangement failed: {reached} of {counted(len(goals), 'object')} at the goal after "
        f"{counted(len(run.taps), 'tap')}"
    )


def _head(run: ArrangementRun) -> str:
    when = datetime.fromtimestamp(run.began).strftime("%d %B %Y, %H:%M:%S")
    kind, badge = ("bad", "failed") if run.error_code else ("good", REACHED)
    return (
        f'<header class="{kind}"><p class="badge">{badge}</p><h1>{escape(headline(run))}</h1>'
        f"<p>{escape(when)} &middot; {escape(run.name)}</p></header>"
    )


def _cards(run: ArrangementRun, moves: Sequence[ArrangedMove]) -> str:
    limits = {_tolerance(one) for one in run.objects if one.goal is not None}
    limit = f"tolerance {limits.pop()}" if len(limits) == 1 else "tolerances: see the objects"
    cards = []
    for word, poses in (
        ("measured", {one.name: one.end for one in run.objects}),
        ("true", {one.name: one.end_true for one in run.objects}),
    ):
        left = [
            (pose.distance_to(one.goal), abs(pose.rotation_to(one.goal)))
            for one in run.objects
            if one.goal is not None and (pose := poses[one.name]) is not None
        ]
        if left:
            far, turned = (max(each[axis] for each in left) for axis in (0, 1))
            worst = f"{1000 * far:.2f} mm, {math.degrees(turned):.2f} deg"
            cards.append((f"largest {word} residual", worst, limit))
    cards.append(("taps", str(len(run.taps)), f"in {counted(len(moves), 'move')}"))
    each = f"{run.seconds / len(run.taps):.1f} s per tap" if run.taps else ""
    cards.append(("time", f"{run.seconds:.0f} s", each))
    if run.contacts is not None:
        touched = ", ".join(f"'{one}' and '{other}'" for one, other in run.contacts)
        cards.append(("contacts between objects", str(len(run.contacts)), touched or "none"))
    return cards_section(cards)


def _scenes(run: ArrangementRun, moves: Sequence[ArrangedMove], pictures: Sequence[Picture]) -> str:
    """Show the table before the first move, half-way and at the end."""
    start = {one.name: one.start for one in run.objects if one.start is not None}
    end = {one.name: one.end for one in run.objects if one.end is not None}
    scenes: list[tuple[str, Plan, float | None]] = [("before", _plan(run, start), 0.0)]
    if len(moves) > 1:
        middle = moves[(len(moves) - 1) // 2]
        done = middle.taps[-1]
        words = f"after {counted(done.number, 'tap')}"
        scenes.append((words, _plan(run, middle.after), done.at_rest_at))
    words = f"at the end, after {counted(len(run.taps), 'tap')}"
    scenes.append((words, _plan(run, end), math.inf))
    figures = "".join(
        f"<figure>{plan.drawing(f'the table {words}')}<figcaption>{words}</figcaption></figure>"
        for words, plan, _ in scenes
    )
    photographs = "".join(
        photograph(_nearest(pictures, at), f"camera image {words}")
        for words, _, at in scenes
        if pictures and at is not None
    )
    if photographs:
        photographs = f'<div class="three">{photographs}</div>'
    legend = " ".join(
        f'<span class="key"><i style="background:{_colour(number)}"></i>{number + 1} '
        f"{escape(one.name)}</span>"
        for number, one in enumerate(run.objects)
    )
    return (
        f'<section><h2>Start, middle and end of the run</h2><div class="three">{figures}</div>'
        f"<p>{legend} Dashed: goals.</p>{photographs}</section>"
    )


def _nearest(pictures: Sequence[Picture], at: float) -> Picture:
    """Return the first image at or after the time ``at`` (s since the beginning). If there is none,
    return the last image."""
    return next((each for each in pictures if each.at >= at), pictures[-1])


def _plan(run: ArrangementRun, poses: Mapping[str, Pose], moved: str = "") -> Plan:
    """Create a plan of the table with the objects at these poses. Goals are drawn dashed.

    ``moved``: name of an object to emphasise; empty for none.
    """
    half = 500 * np.asarray(run.table_size)
    plan = Plan(
        (-half[0] - _MARGIN_MM, -half[1] - _MARGIN_MM), (half[0] + _MARGIN_MM, half[1] + _MARGIN_MM)
    )
    plan.rectangle(-half, half, f'fill="{TABLE}" stroke="{LINE}" stroke-width="1"')
    for number, one in enumerate(run.objects):
        if one.goal is not None and moved in ("", one.name):
            plan.outline(_outline(one), one.goal, _colour(number), dashed=True)
    for number, one in enumerate(run.objects):
        pose = poses.get(one.name)
        if pose is None:
            continue
        faint = moved not in ("", one.name)
        plan.outline(_outline(one), pose, _colour(number), fill=0.08 if faint else 0.35)
        plan.text(1000 * pose.x, 1000 * pose.y, str(number + 1), INK, 5.0)
    return plan


def _outline(one: ArrangedObject) -> Array:
    return np.asarray(one.outline, dtype=float).reshape(-1, 2)


def _colour(number: int) -> str:
    return SERIES[number % len(SERIES)]


def _objects(run: ArrangementRun) -> str:
    head = (
        *("object", "start", "goal", "tolerance", "measured residual", "true residual"),
        *("taps", "outcome"),
    )
    rows = [
        (
            f"{number + 1} {one.name}",
            _place(one.start),
            _place(one.goal) if one.goal is not None else "none; it may be moved out of the way",
            _tolerance(one),
            _residual(one.end, one.goal),
            _residual(one.end_true, one.goal),
            str(one.taps),
            one.outcome,
        )
        for number, one in enumerate(run.objects)
    ]
    return f"<section><h2>Objects</h2>{_table('Objects', head, rows)}</section>"


def _tolerance(one: ArrangedObject) -> str:
    """Return the tolerance of an object's goal as text, or a dash if the object has no goal."""
    if one.tolerance is None:
        return "-"
    return f"{1000 * one.tolerance[0]:g} mm, {math.degrees(one.tolerance[1]):g} deg"


def _order(run: ArrangementRun, moves: Sequence[ArrangedMove]) -> str:
    """Describe every move with its reason and a drawing."""
    if not moves:
        return ""
    entries = "".join(
        f"<figure>{_drawing(run, number, move)}<figcaption><b>{number}. "
        f"{escape(_sentence(move))}</b> {escape(_how(run, move))}</figcaption></figure>"
        for number, move in enumerate(moves, start=1)
    )
    return (
        '<section><h2>Order of the moves, with the reasons</h2><div class="three">'
        f"{entries}</div></section>"
    )


def _drawing(run: ArrangementRun, number: int, move: ArrangedMove) -> str:
    plan = _plan(run, move.after, move.name)
    index = next(n for n, one in enumerate(run.objects) if one.name == move.name)
    before, colour = move.before[move.name], _colour(index)
    plan.outline(_outline(run.objects[index]), before, colour)
    way = [before, *(tap.measured for tap in move.taps if tap.measured is not None)]
    for one, other in itertools.pairwise(way):
        plan.arrow((1000 * one.x, 1000 * one.y), (1000 * other.x, 1000 * other.y), colour, 0.6)
    return plan.drawing(f"move {number}: {move.name}")


def _sentence(move: ArrangedMove) -> str:
    return f"{move.purpose}." if move.purpose else f"'{move.name}' is tapped."


def _how(run: ArrangementRun, move: ArrangedMove) -> str:
    """Describe taps, travel and remaining error of a move."""
    first, last = move.taps[0].number, move.taps[-1].number
    taps = f"Tap {first}" if first == last else f"Taps {first} to {last}"
    before, after = move.before[move.name], move.after[move.name]
    parts = [f"{taps}: {1000 * before.distance_to(after):.0f} mm"]
    one = next(each for each in run.objects if each.name == move.name)
    if one.goal is not None:
        parts.append(f"then {_residual(after, one.goal)} from its goal")
    return ", ".join(parts) + "."


def _taps(run: ArrangementRun) -> str:
    if not run.taps:
        return ""
    head = ("tap", "object", "predicted", "measured", "striker", "outcome", "note")
    rows = [
        (
            str(tap.number),
            tap.name,
            _between(tap.before, tap.predicted),
            _between(tap.before, tap.measured),
            f"{1000 * tap.striker_speed:.0f} mm/s",
            tap.outcome,
            tap.reason,
        )
        for tap in run.taps
    ]
    return f"<section><h2>Taps</h2>{_table('Taps', head, rows)}</section>"


def _table(name: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    titles = "".join(f"<th>{escape(title)}</th>" for title in head)
    lines = "".join(
        "<tr>" + "".join(f"<td>{_unbroken(text)}</td>" for text in row) + "</tr>" for row in rows
    )
    return scrolling_table(name, f"<tr>{titles}</tr>{lines}")


def _unbroken(text: str) -> str:
    """Escape a text and keep numbers and their units on one line."""
    return escape(text).replace(" mm", "&nbsp;mm").replace(" deg", "&nbsp;deg")


def _place(pose: Pose | None) -> str:
    if pose is None:
        return "not seen"
    return f"{1000 * pose.x:.1f} mm, {1000 * pose.y:.1f} mm, {math.degrees(pose.theta):.1f} deg"


def _residual(pose: Pose | None, goal: Pose | None) -> str:
    if pose is None or goal is None:
        return "-"
    turn = math.degrees(abs(pose.rotation_to(goal)))
    return f"{1000 * pose.distance_to(goal):.2f} mm, {turn:.2f} deg"


def _between(one: Pose, other: Pose | None) -> str:
    if other is None:
        return "not seen"
    turn = math.degrees(one.rotation_to(other))
    return f"{1000 * one.distance_to(other):.1f} mm, {turn:+.1f} deg"
