"""Home the arm of a running cell, and wait until homing is complete. Before you call it, check that
the arm's path is free. In set-up mode, hold the enabling device; in the simulated cell the command
holds the key itself.

python -m tapping_cell home
"""

from __future__ import annotations

import argparse
import time

from tapping_cell.cli import argument_types, cell_arguments
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.nodes.clients.cell_client import CellClient


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    cell_arguments.add_arguments(parser)
    parser.add_argument(
        "--wait",
        type=argument_types.within(1, 3600),
        default=120.0,
        help="longest time for homing, in seconds (default: 120)",
    )


@cell_arguments.with_cell
def run(arguments: argparse.Namespace, client: CellClient) -> int:
    """Run the verb. Return 0 if the arm is homed and idle, otherwise 1 with a message."""
    client.wait_for_cell(cell_arguments.TIMEOUT_S)
    with cell_arguments.key_held(arguments, client):
        return _home(client, arguments.wait)


def _home(client: CellClient, patience: float) -> int:
    """Home the arm, and wait until it is homed. Return the exit code."""
    print(client.home())
    deadline = time.monotonic() + patience
    begun = False
    while time.monotonic() < deadline:
        arm = client.state()["arm"]
        begun = begun or arm["state"] == "homing"
        if begun and arm["state"] == "idle":
            print("the arm is homed")
            return ExitStatus.DONE
        if begun and arm["state"] != "homing":
            print_error(f"the arm is {arm['state']}: {arm['sentence']}", arm["code"])
            return ExitStatus.FAILED
        time.sleep(0.05)
    print_error(
        f"the arm was not homed within {patience:.0f} s; check it with  "
        "python -m tapping_cell status"
    )
    return ExitStatus.FAILED
