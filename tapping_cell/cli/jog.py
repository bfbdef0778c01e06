"""Move the arm of a running cell by hand in set-up mode: one step of the tip or of a joint, to the
park pose, or fire once at nothing.

The cell must run in set-up mode (up --set-up), homed and without a goal. On hardware, a person
holds the foot switch, or the key on the operator's page, until the motion has ended: its release
stops the arm. In the simulated cell the command holds the key itself. A step is at most 10 mm or 5
degrees; x, y and z are those of the table. The arm moves straight to the end of the step, whatever
stands in its way: watch it. A shot at nothing passes every check of a tap, at the lowest energy,
and away from every object.

    python -m tapping_cell jog x 5
    python -m tapping_cell jog shoulder -2
    python -m tapping_cell jog park
    python -m tapping_cell jog fire
"""

from __future__ import annotations

import argparse
import math
import time

from tapping_cell.cli import cell_arguments
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.logic import jogging
from tapping_cell.messages import Jog
from tapping_cell.nodes.clients.cell_client import CellClient
from tapping_cell.nodes.clients.single_tap_client import NoAnswer, SingleTapClient
from tapping_cell.nodes.page.calls import shot_words

PARK, FIRE = "park", "fire"
LONGEST_MOTION_S = 120.0
POLL_S = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "axis",
        choices=[*jogging.AXES, PARK, FIRE],
        help=f"axis of the tip, joint, {PARK} or {FIRE}",
    )
    parser.add_argument(
        "step", type=float, nargs="?", help="size of the step, in mm or degrees (yaw and joints)"
    )
    cell_arguments.add_arguments(parser)


@cell_arguments.with_cell
def run(arguments: argparse.Namespace, client: CellClient) -> int:
    """Run the verb. Return 0 when the motion has ended, 1 if it was refused or failed, 2 for
    invalid input."""
    axis, step = arguments.axis, arguments.step
    if (step is None) != (axis in (PARK, FIRE)):
        needed = "takes no step" if step is not None else "needs a step, such as  jog x 5"
        print_error(f"{axis} {needed}")
        return ExitStatus.REFUSED
    client.wait_for_cell(cell_arguments.TIMEOUT_S)
    with cell_arguments.key_held(arguments, client):
        if axis == FIRE:
            return _fire(arguments.namespace, client)
        if axis == PARK:
            request = Jog.Request(kind=Jog.Request.PARK)
        else:
            unit = 1e-3 if jogging.is_length(axis) else math.radians(1.0)
            request = jogging.request(axis, unit * step)
        client.jog(request)
        return _ended(client)


def _ended(client: CellClient) -> int:
    """Wait until the motion has ended. Return the exit code."""
    deadline = time.monotonic() + LONGEST_MOTION_S
    while time.monotonic() < deadline:
        time.sleep(POLL_S)
        arm = client.state()["arm"]
        if arm["state"] == "idle" and not arm["code"]:
            x, y, z, yaw = arm["tip"]
            print(f"the tip is at x {x:.1f} mm, y {y:.1f} mm, z {z:.1f} mm, yaw {yaw:.1f} deg")
            return ExitStatus.DONE
        if arm["state"] not in ("idle", "moving", "withdrawing"):
            print_error(f"the arm is {arm['state']}: {arm['sentence']}", arm["code"])
            return ExitStatus.FAILED
    print_error(f"the motion has not ended within {LONGEST_MOTION_S:.0f} s; stop the cell")
    return ExitStatus.FAILED


def _fire(namespace: str, client: CellClient) -> int:
    """Fire at nothing. Return the exit code."""
    if not client.state()["set_up"]["on"]:
        print_error("the cell is not in set-up mode; start it with  up --set-up")
        return ExitStatus.FAILED
    with SingleTapClient("jog", namespace) as shooter:
        deadline = time.monotonic() + cell_arguments.TIMEOUT_S
        while (missing := shooter.missing()) and time.monotonic() < deadline:
            time.sleep(POLL_S)
        if missing:
            print_error("; ".join(missing))
            return ExitStatus.FAILED
        try:
            result = shooter.fire_at_nothing(lambda: None)
        except NoAnswer as error:
            print_error(str(error))
            return ExitStatus.FAILED
    if result.error_code:
        print_error(result.error_msg, result.error_code)
        return ExitStatus.FAILED
    print(shot_words(result))
    # The key is held until the arm has withdrawn.
    return _ended(client)
