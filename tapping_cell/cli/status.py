"""Show the state of a running cell: whether it would accept a goal and, if not, the remedy.

python -m tapping_cell status
python -m tapping_cell status --json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console

from tapping_cell.cli import cell_arguments, cell_words
from tapping_cell.cli.deployment.places import Places
from tapping_cell.cli.deployment.service_state import service_state
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.nodes import computer
from tapping_cell.nodes.clients.cell_client import CellClient


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    cell_arguments.add_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the state as JSON")


@cell_arguments.with_cell
def run(arguments: argparse.Namespace, client: CellClient) -> int:
    """Run the verb. Return 0 if the cell is ready or at work, 1 if it is not ready or does not
    respond."""
    state = client.wait_for_cell(cell_arguments.TIMEOUT_S)
    if arguments.json:
        places = Places()
        folder = places.runs if places.manifest() is not None else Path.cwd()
        state |= {"computer": computer.state(folder), "service": service_state(places)}
        print(json.dumps(state, indent=2, allow_nan=False))
    else:
        Console(highlight=False, soft_wrap=True).print(cell_words.overview(state))
    return ExitStatus.DONE if state["mode"] in ("ready", "moving") else ExitStatus.FAILED
