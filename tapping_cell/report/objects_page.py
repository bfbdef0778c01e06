"""``report.html`` of a run with several objects, in one file."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from tapping_cell.report.palette import INK, SERIES
from tapping_cell.report.photograph import photograph
from tapping_cell.report.rendering import render
from tapping_cell.report.replay import player
from tapping_cell.report.run import NOT_TRULY_REACHED, REACHED, Picture, Run, RunObject, TapRow
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.report.svg import Plan
from tapping_cell.report.words import counted, motion
from tapping_cell.se2 import Array, Pose

_MARGIN_MM = 12.0


@dataclass(frozen=True, slots=True)
class Move:
    """Consecutive taps of one object with one purpose.

    ``before``, ``after``: measured poses of all objects, by name.
    """

    name: str
    purpose: str
    taps: tuple[TapRow, ...]
    before: dict[str, Pose]
    after: dict[str, Pose]


def moves_of(run: Run) -> list[Move]:
    """Group the taps of a run into moves."""
    poses = {one.name: one.start for one in run.objects if one.start is not None}
    moves = []
    for (name, purpose), group in itertools.groupby(
        run.taps, lambda tap: (tap.object_name, tap.purpose)
    ):
        taps = tuple(group)
        poses = {**poses, name: taps[0].before}
        seen = [tap.measured for tap in taps if tap.seen]
        after = {**poses, name: seen[-1]} if seen else poses
        moves.append(Move(name, purpose, taps, poses, after))
        poses = after
    return moves


def page(illustrated: IllustratedRun) -> str:
    """Return the page of a run, which loads no other files. It shows the images taken before,
    half-way through and after the moves."""
    run, pictures = illustrated.run, illustrated.pictures
    moves = moves_of(run)
    return render(
        "objects.html",
        run=run,
        headline=headline(run),
        began=datetime.fromtimestamp(run.began).strftime("%d %B %Y, %H:%M:%S")
        if math.isfinite(run.began)
        else "time unknown",
        results=_results(run, moves),
        scenes=_scenes(run, moves, pictures),
        legend=[(f"{n + 1} {one.name}", _colour(n)) for n, one in enumerate(run.objects)],
        objects=_objects(run),
        replay=player(run, illustrated.tracks, _plan(run, {})),
        moves=[_move(run, number, move) for number, move in enumerate(moves, start=1)],
        taps=_taps(run),
    )


def headline(run: Run) -> str:
    """Summarise the outcome of an arrangement in a few words."""
    goals = [one for one in run.objects if one.goal is not None]
    reached = sum(one.outcome == REACHED for one in goals)
    objects, taps = counted(len(goals), "object"), counted(len(run.taps), "tap")
    if run.reached:
        return f"Arrangement reached: {counted(reached, 'object')}, {taps}"
    if run.outcome == NOT_TRULY_REACHED:
        return f"Measured at the goals, but not truly reached: {objects}, {taps}"
    return f"Arrangement failed: {reached} of {objects} at the goal after {taps}"


def _results(run: Run, moves: Sequence[Move]) -> list[tuple[str, str, str]]:
    """Return name, value and note of every main result."""
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
    each = f"{run.wall_time / len(run.taps):.1f} s per tap" if run.taps else ""
    cards.append(("time", f"{run.wall_time:.0f} s", each))
    if run.contacts is not None:
        touched = ", ".join(f"'{one}' and '{other}'" for one, other in run.contacts)
        cards.append(("contacts between objects", str(len(run.contacts)), touched or "none"))
    return cards


def _scenes(
    run: Run, moves: Sequence[Move], pictures: Sequence[Picture]
) -> list[dict[str, object]]:
    """Show the table before the first move, half-way and at the end."""
    start = {one.name: one.start for one in run.objects if one.start is not None}
    end = {one.name: one.end for one in run.objects if one.end is not None}
    scenes: list[tuple[str, Mapping[str, Pose], float | None]] = [("before", start, 0.0)]
    if len(moves) > 1:
        middle = moves[(len(moves) - 1) // 2]
        done = middle.taps[-1]
        scenes.append(
            (
                f"after {counted(done.number, 'tap')}",
                middle.after,
                done.at_rest_at if math.isfinite(done.at_rest_at) else None,
            )
        )
    scenes.append((f"at the end, after {counted(len(run.taps), 'tap')}", end, math.inf))
    return [
        {
            "words": words,
            "drawing": _plan(run, poses).drawing(f"the table {words}"),
            "image": photograph(_nearest(pictures, at)) if pictures and at is not None else None,
        }
        for words, poses, at in scenes
    ]


def _nearest(pictures: Sequence[Picture], at: float) -> Picture:
    """Return the first image at or after the time ``at`` (s since the beginning). If there is none,
    return the last image."""
    return next((each for each in pictures if each.at >= at), pictures[-1])


def _plan(run: Run, poses: Mapping[str, Pose], moved: str = "") -> Plan:
    """Create a plan of the table with the objects at these poses. Goals are drawn dashed.

    ``moved``: name of an object to emphasise; empty for none.
    """
    half = 500 * np.asarray(run.table_size)
    plan = Plan(
        (-half[0] - _MARGIN_MM, -half[1] - _MARGIN_MM), (half[0] + _MARGIN_MM, half[1] + _MARGIN_MM)
    )
    plan.table(half)
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


def _outline(one: RunObject) -> Array:
    return np.asarray(one.outline, dtype=float).reshape(-1, 2)


def _colour(number: int) -> str:
    return SERIES[number % len(SERIES)]


def _objects(run: Run) -> list[tuple[str, ...]]:
    return [
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


def _tolerance(one: RunObject) -> str:
    """Return the tolerance of an object's goal as text, or a dash if the object has no goal."""
    if one.goal is None:
        return "-"
    return f"{1000 * one.tolerance[0]:g} mm, {math.degrees(one.tolerance[1]):g} deg"


def _move(run: Run, number: int, move: Move) -> dict[str, str]:
    """Return the reason of a move, its taps, travel and remaining error, and a drawing."""
    index, one = next((n, one) for n, one in enumerate(run.objects) if one.name == move.name)
    before, after, colour = move.before[move.name], move.after[move.name], _colour(index)
    plan = _plan(run, move.after, move.name)
    plan.outline(_outline(one), before, colour)
    way = [before, *(tap.measured for tap in move.taps if tap.seen)]
    for here, there in itertools.pairwise(way):
        plan.arrow((1000 * here.x, 1000 * here.y), (1000 * there.x, 1000 * there.y), colour, 0.6)
    first, last = move.taps[0].number, move.taps[-1].number
    result = f"Tap {first}" if first == last else f"Taps {first} to {last}"
    result += f": moved by {1000 * before.distance_to(after):.0f} mm"
    if one.goal is not None:
        result += f"; remaining error {_residual(after, one.goal)}"
    return {
        "reason": f"{move.purpose}." if move.purpose else f"'{move.name}' is tapped.",
        "result": f"{result}.",
        "drawing": plan.drawing(f"move {number}: {move.name}"),
    }


def _taps(run: Run) -> list[tuple[str, ...]]:
    return [
        (
            str(tap.number),
            tap.object_name,
            motion(tap.before, tap.predicted),
            motion(tap.before, tap.measured),
            f"{1000 * tap.striker_speed:.0f} mm/s",
            tap.outcome,
            tap.reason,
        )
        for tap in run.taps
    ]


def _place(pose: Pose | None) -> str:
    if pose is None:
        return "not seen"
    return f"{1000 * pose.x:.1f} mm, {1000 * pose.y:.1f} mm, {math.degrees(pose.theta):.1f} deg"


def _residual(pose: Pose | None, goal: Pose | None) -> str:
    if pose is None or goal is None:
        return "-"
    turn = math.degrees(abs(pose.rotation_to(goal)))
    return f"{1000 * pose.distance_to(goal):.2f} mm, {turn:.2f} deg"
