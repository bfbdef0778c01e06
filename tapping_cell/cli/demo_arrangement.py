"""Demo with several objects: bring each to its goal, and write a report that includes the true
poses."""

from __future__ import annotations

import contextlib
import json
import math
import time
from pathlib import Path

import numpy as np
from rich.console import Console

from tapping_cell.cli.arrange import follow, result_of, wait_for
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.graph import Graph
from tapping_cell.configuration.cell import Cell, cells_of
from tapping_cell.configuration.layout_file import LayoutFile, LayoutGoal
from tapping_cell.nodes.clients.arrange_client import (
    ArrangeClient,
    ArrangementEnded,
    ObjectEnd,
    residuals,
)
from tapping_cell.planning.evaluation.arrangements import ArrangementTrial
from tapping_cell.report.arrangement_page import write_page
from tapping_cell.report.arrangement_run import (
    SUMMARY,
    ArrangedObject,
    ArrangementRun,
    to_content,
)
from tapping_cell.report.run_folder import PAGE
from tapping_cell.se2 import Pose

READY_TIMEOUT_S = 90.0
TRUTH_S = 0.5
"""Waiting time (s) after the end of the arrangement, so that the final true poses are received."""
PICTURE = "arrangement.png"


def arrange(
    layout: LayoutFile, cell: Cell, graph: Graph, folder: Path, console: Console, as_json: bool
) -> int:
    """Arrange the objects and write report, image and summary to the folder. Return 0 if the true
    pose of every object is within its tolerance, otherwise 1.

    Raises:
        NotReadyInTime, GraphError: the cell did not become ready, or a node ended.
    """
    names = frozenset(goal.object for goal in layout.goals)
    with ArrangeClient("demo") as client:
        wait_for(client, names, READY_TIMEOUT_S, graph.check, console)
        history = [dict(client.true_poses)]
        starts, began_at = dict(client.poses), time.time()
        began = time.monotonic()
        client.send(layout)
        try:
            ended = follow(
                client,
                graph.check,
                console,
                on_tap=lambda: history.append(dict(client.true_poses)),
            )
        except KeyboardInterrupt:
            with contextlib.suppress(RuntimeError):
                client.cancel()
            raise
        took = time.monotonic() - began
        time.sleep(TRUTH_S)
        history[max(1, ended.taps) :] = [dict(client.true_poses)]
        last_true, contacts = dict(client.true_poses), list(client.contacts)
    record = _record(folder.name, began_at, took, cell, layout, starts, ended, contacts, last_true)
    true = residuals(last_true, layout)
    # Whether the true pose of every object is within the tolerance of its goal.
    inside = all(
        true[one.name][0] <= one.tolerance[0] and true[one.name][1] <= one.tolerance[1]
        for one in record.objects
        if one.tolerance is not None
    )
    summary = {
        **result_of(ended),
        "truly_inside": inside,
        "true": {
            name: {"residual_mm": 1000 * distance, "residual_deg": math.degrees(turn)}
            for name, (distance, turn) in true.items()
            if math.isfinite(distance)
        },
        "contacts": contacts,
        "seconds": round(took, 1),
        "run": to_content(record),
    }
    write_page(record, folder)
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    _draw(history, record, ended, true, folder / PICTURE)
    if as_json:
        print(json.dumps(summary, indent=2, allow_nan=False))
    for name, (distance, turn) in true.items():
        console.print(
            f"'{name}' true residual {1000 * distance:.3f} mm and {math.degrees(turn):.3f} deg",
            highlight=False,
        )
    for first, second in contacts:
        console.print(f"'{first}' touched '{second}'", highlight=False)
    if ended.error_code or not inside:
        reason = ended.error_msg or "the true pose of at least one object is outside its tolerance"
        print_error(f"arrangement not reached: {reason}", ended.error_code)
        return 1
    console.print(
        f"[green]arrangement reached[/green] in {ended.taps} taps, {took:.0f} s, "
        f"{len(contacts)} contacts between objects; see {folder / PAGE}"
    )
    return 0


def _record(
    name: str,
    began: float,
    seconds: float,
    cell: Cell,
    layout: LayoutFile,
    starts: dict[str, Pose],
    ended: ArrangementEnded,
    contacts: list[tuple[str, str]],
    true: dict[str, Pose],
) -> ArrangementRun:
    """Return the record of the arrangement for its report."""
    goals = {goal.object: goal for goal in layout.goals}
    ends = {one.name: one for one in ended.objects}
    objects = []
    for each, own in cells_of(cell).items():
        goal, end = goals.get(each), ends.get(each)
        objects.append(
            ArrangedObject(
                name=each,
                outline=tuple((float(x), float(y)) for x, y in own.outline()),
                start=starts.get(each),
                goal=None if goal is None else Pose(*goal.pose),
                end=starts.get(each) if end is None else end.pose,
                end_true=true.get(each),
                outcome="not moved" if end is None else end.state,
                taps=0 if end is None else end.taps,
                tolerance=None if goal is None else _tolerance(goal, own),
            )
        )
    table = cell.file.table
    return ArrangementRun(
        name=name,
        began=began,
        seconds=seconds,
        table_size=(table.length, table.width),
        objects=tuple(objects),
        taps=ended.records,
        contacts=tuple(contacts),
        error_code=ended.error_code,
        error_msg=ended.error_msg,
    )


def _tolerance(goal: LayoutGoal, cell: Cell) -> tuple[float, float]:
    """Return the tolerance of a goal, in m and rad."""
    distance, angle = cell.tolerance
    return goal.position_tolerance or distance, goal.angle_tolerance or angle


def _draw(
    history: list[dict[str, Pose]],
    record: ArrangementRun,
    ended: ArrangementEnded,
    true: dict[str, tuple[float, float]],
    file: Path,
) -> None:
    """Draw the scene at the start, between the taps and at the end, with the objects' paths and
    outcomes."""
    goals = {one.name: one.goal for one in record.objects if one.goal is not None}
    # Imported here, because importing matplotlib takes half a second and would delay error messages
    # about wrong options.
    from tapping_cell.report.arrangement_figures import draw_scene

    draw_scene(
        ArrangementTrial(
            end="done" if not ended.error_code else "refused later",
            history=history,
            goals=goals,
            outlines={one.name: np.asarray(one.outline) for one in record.objects},
            table=record.table_size,
        ),
        file,
        [HEAD, *(_outcome(one, goals.get(one.name), true.get(one.name)) for one in ended.objects)],
    )


HEAD = ("object", "goal", "outcome", "taps", "residual, measured", "residual, true")


def _outcome(
    one: ObjectEnd, goal: Pose | None, true: tuple[float, float] | None
) -> tuple[str, ...]:
    """Return the outcome of one object as a row of texts, with the columns of ``HEAD``."""
    place = "only moved out of the way"
    if goal is not None:
        angle = math.degrees(goal.theta)
        place = f"{1000 * goal.x:.1f} mm, {1000 * goal.y:.1f} mm, {angle:.1f} deg"
    measured = one.residual_distance, one.residual_rotation
    texts = (_residual(*each) if each is not None else "" for each in (measured, true))
    return (one.name, place, one.state, str(one.taps), *texts)


def _residual(distance: float, turn: float) -> str:
    if not math.isfinite(distance):
        return ""
    return f"{1000 * distance:.2f} mm, {math.degrees(turn):.2f} deg"
