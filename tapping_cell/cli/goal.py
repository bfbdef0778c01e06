"""Send a goal pose to a running graph and show every tap; Ctrl-C cancels the goal.

python -m tapping_cell goal 50 -20 90
python -m tapping_cell goal 50 -20 90 --tolerance 0.5 1 --json
"""

from __future__ import annotations

import argparse
import json
import math

from tapping_cell.cli import session
from tapping_cell.nodes.clients.goal_client import Finished, GoalClient
from tapping_cell.report.error_codes import hint
from tapping_cell.report.run_folder import for_people
from tapping_cell.se2 import Pose


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the verb."""
    parser.add_argument("x", type=float, help="goal in table, mm")
    parser.add_argument("y", type=float, help="goal in table, mm")
    parser.add_argument("theta", type=float, help="goal in table, degrees")
    parser.add_argument("--namespace", default="", help="namespace of the nodes")
    parser.add_argument(
        "--tolerance",
        nargs=2,
        type=float,
        default=(0.0, 0.0),
        metavar=("MM", "DEG"),
        help="tolerance in mm and degrees (default: the cell's own)",
    )
    parser.add_argument(
        "--probe",
        action="store_true",
        help="begin with a few of the smallest taps, to measure an unknown object's friction",
    )
    parser.add_argument(
        "--wait", type=float, default=20.0, help="longest wait for the cell, in seconds"
    )
    session.add_output_arguments(parser)


def result_of(finished: Finished) -> dict[str, object]:
    """The end of a goal for a program, in mm and degrees; None where nothing is known."""
    known = math.isfinite(finished.residual_distance)
    return {
        "reached": finished.error_code == 0,
        "taps": finished.taps,
        "residual_mm": 1000 * finished.residual_distance if known else None,
        "residual_deg": math.degrees(finished.residual_rotation) if known else None,
        "final_pose": for_people(finished.final_pose),
        "error_code": finished.error_code,
        "error_msg": finished.error_msg,
        "hint": hint(finished.error_code),
    }


def run(arguments: argparse.Namespace) -> int:
    """Run the verb; 0 reached, 1 not reached, 130 canceled."""
    console = session.console_of(arguments)
    session.end_on_signals()
    goal = Pose(arguments.x / 1000, arguments.y / 1000, math.radians(arguments.theta))
    distance, angle = arguments.tolerance
    with GoalClient("goal", arguments.namespace) as client:
        try:
            session.wait_until_ready(client, arguments.wait, lambda: None, console)
            tolerance = (distance / 1000, math.radians(angle))
            client.send(goal, tolerance, probe=arguments.probe)
            finished = session.follow(client, lambda: None, console)
        except session.NotReadyInTime as error:
            session.tell_error(console, f"{error}; is the graph up?")
            return 1
        except KeyboardInterrupt:
            client.cancel()
            console.print("goal canceled")
            return 130
    if arguments.json:
        print(json.dumps(result_of(finished), indent=2, allow_nan=False))
    if finished.error_code:
        session.tell_failure(console, finished.error_code, finished.error_msg)
        return 1
    console.print(
        f"[green]goal reached[/green] in {finished.taps} taps; measured residual "
        f"{1000 * finished.residual_distance:.3f} mm and "
        f"{math.degrees(abs(finished.residual_rotation)):.3f} deg",
        highlight=False,
    )
    return 0
