"""Send a goal pose, or goals of several objects, to a running graph and show every tap; Ctrl-C
cancels the goal.

    python -m tapping_cell goal 50 -20 90
    python -m tapping_cell goal 50 -20 90 --tolerance 0.5 1 --json
    python -m tapping_cell goal 50 -20 90 --ask
    python -m tapping_cell goal --layout layout.yaml
    python -m tapping_cell goal --preset grid --cell my_cell.yaml

A layout file contains the names of objects and their goal poses, in m and rad:

    goals:
      - {object: red disk, pose: [0.10, -0.05, 0.0]}
      - {object: blue square, pose: [-0.10, 0.05, 1.5708]}
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

from tapping_cell.cli import argument_types, arrangement, session
from tapping_cell.cli.confirmation import Person
from tapping_cell.cli.errors import print_error
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.messages import ErrorCode
from tapping_cell.nodes.clients.goal_client import Finished, GoalClient
from tapping_cell.planning.arrangement import PRESETS
from tapping_cell.report.error_codes import hint
from tapping_cell.report.run_folder import in_display_units
from tapping_cell.se2 import Pose

STARTING = (
    ErrorCode.NOT_READY,
    ErrorCode.ARM_NOT_CONNECTED,
    ErrorCode.ARM_SILENT,
    ErrorCode.TAPPER_NOT_CONNECTED,
    ErrorCode.TAPPER_SILENT,
    ErrorCode.CAMERA_SILENT,
)
"""A cell that is still starting ends a goal with one of these codes, so the goal is sent again."""
AGAIN_S = 1.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "x",
        nargs="?",
        type=argument_types.within(-10000, 10000),
        help="x of the goal in the table frame, in mm",
    )
    parser.add_argument(
        "y",
        nargs="?",
        type=argument_types.within(-10000, 10000),
        help="y of the goal in the table frame, in mm",
    )
    parser.add_argument(
        "theta", nargs="?", type=float, help="angle of the goal in the table frame, in degrees"
    )
    several = parser.add_mutually_exclusive_group()
    several.add_argument(
        "--layout",
        type=Path,
        metavar="FILE",
        help="layout file with the names of several objects and their goal poses",
    )
    several.add_argument(
        "--preset",
        choices=PRESETS,
        help="preset layout of all objects of the cell. line, circle, grid: the objects are "
        "arranged in this shape at the centre of the area in which objects can be tapped. swap: "
        "the objects exchange places in pairs",
    )
    parser.add_argument(
        "--cell",
        type=argument_types.configuration_file,
        default=None,
        help="cell file of the running cell (only with --preset; default: the package's cell.yaml)",
    )
    argument_types.add_namespace(parser)
    parser.add_argument(
        "--tolerance",
        action=argument_types.Tolerance,
        nargs=2,
        type=argument_types.within(0, 1000),
        default=(0.0, 0.0),
        metavar=("MM", "DEG"),
        help="position and angle tolerance, in mm and degrees (default: the cell's)",
    )
    parser.add_argument(
        "--probe",
        action="store_true",
        help="begin with a few of the smallest taps, to measure the friction of an unknown object",
    )
    parser.add_argument(
        "--ask",
        action="store_true",
        help="show every planned tap, and make it only after confirmation here or on the "
        "operator's page",
    )
    argument_types.add_wait(parser)
    session.add_output_arguments(parser)


def result_of(finished: Finished) -> dict[str, object]:
    """Return the result of a goal for JSON output, in mm and degrees, with None for unknown
    values."""
    known = math.isfinite(finished.residual_distance)
    return {
        "reached": finished.error_code == 0,
        "taps": finished.taps,
        "residual_mm": 1000 * finished.residual_distance if known else None,
        "residual_deg": math.degrees(finished.residual_rotation) if known else None,
        "final_pose": in_display_units(finished.final_pose),
        "error_code": finished.error_code,
        "error_msg": finished.error_msg,
        "hint": hint(finished.error_code),
    }


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the goal was reached, 1 if not or if it may go on after Ctrl-C, 2
    for invalid input, 130 if canceled."""
    console = session.console_of(arguments)
    end_on_signals()
    several = arguments.layout is not None or arguments.preset is not None
    given = sum(value is not None for value in (arguments.x, arguments.y, arguments.theta))
    if given != (0 if several else 3):
        missing = ""
        if given and not several:
            missing = (
                "; Y and THETA are missing" if given == 1 else "; THETA, in degrees, is missing"
            )
        print_error(f"give either X Y THETA of a goal, or --layout FILE, or --preset NAME{missing}")
        return 2
    if several:
        if arguments.probe or arguments.ask or any(arguments.tolerance):
            print_error("--probe, --ask and --tolerance are for the goal of one object")
            return 2
        return arrangement.run(arguments, console)
    goal = Pose(arguments.x / 1000, arguments.y / 1000, math.radians(arguments.theta))
    distance, angle = arguments.tolerance
    with GoalClient("goal", arguments.namespace) as client:
        try:
            wait = session.WAIT_S if arguments.wait is None else arguments.wait
            deadline = time.monotonic() + wait
            session.wait_for_planner(client, arguments.wait, console)
            tolerance = (distance / 1000, math.radians(angle))
            while True:
                session.send(
                    client, goal, tolerance, console, probe=arguments.probe, ask=arguments.ask
                )
                person = Person(client, console, sys.stdin) if arguments.ask else None
                finished = session.follow(client, lambda: None, console, person)
                if finished.error_code not in STARTING or time.monotonic() > deadline:
                    break
                time.sleep(AGAIN_S)
        except session.NotReadyInTime as error:
            print_error(str(error))
            return 1
        except KeyboardInterrupt:
            return session.cancel(client, "goal", console)
    if arguments.json:
        print(json.dumps(result_of(finished), indent=2, allow_nan=False))
    if finished.error_code:
        print_error(f"goal not reached: {finished.error_msg}", finished.error_code)
        return 1
    console.print(
        f"[green]goal reached[/green] in {finished.taps} taps; measured residual "
        f"{1000 * finished.residual_distance:.3f} mm and "
        f"{math.degrees(abs(finished.residual_rotation)):.3f} deg",
        highlight=False,
    )
    return 0
