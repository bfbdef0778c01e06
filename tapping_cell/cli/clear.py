"""Clear the stop and the faults of arm and tapper of a running cell. Nothing moves. Press the clear
button at the tapper first. If a node remains stopped, the command fails and names this node.

    python -m tapping_cell clear
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from tapping_cell.cli import cell_arguments, cell_words
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.nodes.clients.cell_client import CellClient

TIMEOUT_S = 10.0
BUTTON_S = 1.0
"""Maximum time in s for which the simulated button is pressed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    cell_arguments.add_arguments(parser)
    parser.add_argument(
        "--press-button",
        action="store_true",
        help="first press the clear button at the tapper (only in a simulated cell)",
    )


@cell_arguments.with_cell
def run(arguments: argparse.Namespace, client: CellClient) -> int:
    """Run the verb. Return 0 if neither a stop nor a fault remains, otherwise 1 with a message."""
    client.wait_for_cell(cell_arguments.TIMEOUT_S)
    if arguments.press_button:
        print(client.press_button())
        time.sleep(BUTTON_S)
    for message in client.clear():
        print(message)
    state = _settled(client)
    if state["mode"] in ("stopped", "fault"):
        print_error(state["sentence"])
    for line in cell_words.recovery(state):
        print(line)
    return ExitStatus.FAILED if state["mode"] in ("stopped", "fault") else ExitStatus.DONE


def _settled(client: CellClient) -> dict[str, Any]:
    """Return the state once neither a stop nor a fault remains, or the state at the timeout."""
    deadline = time.monotonic() + TIMEOUT_S
    while True:
        state = client.state()
        if state["mode"] not in ("stopped", "fault") or time.monotonic() > deadline:
            return state
        time.sleep(0.1)
