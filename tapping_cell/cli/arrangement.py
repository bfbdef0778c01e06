"""Send an arrangement to a running graph and show its progress: what ``goal --layout`` and
``demo --objects`` have in common."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable

from rich.console import Console

from tapping_cell.cli import session
from tapping_cell.cli.errors import print_error, print_refusal
from tapping_cell.configuration.cell import cells_of, load_cell
from tapping_cell.configuration.layout_file import LayoutFile, LayoutGoal
from tapping_cell.configuration.preset_layout import preset_layout
from tapping_cell.configuration.schema import ConfigurationError, load
from tapping_cell.nodes.clients.arrange_client import (
    ArrangeClient,
    ArrangementEnded,
    ObjectEnd,
    ObjectTapped,
)
from tapping_cell.planning import PlanningError
from tapping_cell.report.error_codes import hint


def run(arguments: argparse.Namespace, console: Console) -> int:
    """Bring the objects of a running cell to the goals of a layout file or a preset. Return the
    exit code, as the verb ``goal``."""
    try:
        cells = {} if arguments.preset is None else cells_of(load_cell(arguments.cell))
        if len(cells) == 1:
            raise ConfigurationError(
                f"a preset needs at least two objects, and {arguments.cell or 'cell.yaml'} has "
                "one; give the file of the running cell with --cell"
            )
        layout = None if arguments.layout is None else load(LayoutFile, arguments.layout)
    except ConfigurationError as error:
        return print_refusal(error)
    with ArrangeClient("arrange", arguments.namespace) as client:
        try:
            patience, check = arguments.wait, lambda: None
            if patience is None:
                patience, check = session.WAIT_S, lambda: session.refuse_empty_domain(client)
            wait_for(client, frozenset(cells), patience, check, console)
            if layout is None:
                poses = {name: client.poses[name] for name in cells}
                goals = preset_layout(cells, arguments.preset, poses)
                layout = LayoutFile(tuple(LayoutGoal(*goal) for goal in goals.items()))
            client.send(layout)
            ended = follow(client, lambda: None, console)
        except session.NotReadyInTime as error:
            print_error(str(error))
            return 1
        except PlanningError as error:
            return print_refusal(error)
        except KeyboardInterrupt:
            return session.cancel(client, "arrangement", console)
    if arguments.json:
        print(json.dumps(result_of(ended), indent=2, allow_nan=False))
    if ended.error_code:
        print_error(f"arrangement not reached: {ended.error_msg}", ended.error_code)
        return 1
    console.print(f"[green]arrangement reached[/green] in {ended.taps} taps", highlight=False)
    return 0


def wait_for(
    client: ArrangeClient,
    names: frozenset[str],
    patience: float,
    check: Callable[[], None],
    console: Console,
) -> None:
    """Wait until the cell can arrange these objects.

    Raises:
        NotReadyInTime: the cell is not ready after ``patience`` s. The message names the missing
            conditions.
    """
    session.wait_for(lambda: client.missing(names), patience, check, console)
    # Wait until the planner has discovered this client too: before that, the planner's response to
    # a request would be lost.
    time.sleep(session.MUTUAL_DISCOVERY_S)


def follow(
    client: ArrangeClient,
    check: Callable[[], None],
    console: Console,
) -> ArrangementEnded:
    """Show an arrangement's progress until it ends. ``check`` is called at every event and may
    raise an exception to abort."""
    with console.status("arrangement sent") as status:
        for event in client.events():
            check()
            if isinstance(event, ObjectTapped):
                one = next(each for each in event.objects if each.name == event.name)
                console.print(f"tap {event.number}: {end_text(one)}", highlight=False)
                reached = sum(each.state == "reached" for each in event.objects)
                status.update(f"{reached} of {len(event.objects)} objects reached")
            elif isinstance(event, ArrangementEnded):
                for one in event.objects:
                    console.print(f"  {end_text(one)}, {one.taps} taps", highlight=False)
                return event
    raise AssertionError("the event stream ended before the arrangement")


def end_text(one: ObjectEnd) -> str:
    """Format the state of an object and its remaining distance and rotation to the goal."""
    if not math.isfinite(one.residual_distance):
        return f"'{one.name}' {one.state}"
    return (
        f"'{one.name}' {one.state}; {1000 * one.residual_distance:.2f} mm and "
        f"{math.degrees(one.residual_rotation):.2f} deg from its goal"
    )


def result_of(ended: ArrangementEnded) -> dict[str, object]:
    """Return the result of an arrangement for JSON output, in mm and degrees, with None for unknown
    values."""

    def known(value: float, factor: float) -> float | None:
        return factor * value if math.isfinite(value) else None

    return {
        "reached": ended.error_code == 0,
        "taps": ended.taps,
        "objects": [
            {
                "object": one.name,
                "state": one.state,
                "has_goal": one.has_goal,
                "taps": one.taps,
                "residual_mm": known(one.residual_distance, 1000.0),
                "residual_deg": known(one.residual_rotation, math.degrees(1.0)),
            }
            for one in ended.objects
        ],
        "error_code": ended.error_code,
        "error_msg": ended.error_msg,
        "hint": hint(ended.error_code),
    }
