"""Show the state of a running cell: whether it would accept a goal and, if not, the remedy.

With --watch, state, taps, nodes and events are shown until Ctrl-C.

python -m tapping_cell status
python -m tapping_cell status --watch
python -m tapping_cell status --json
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

from rich.console import Console
from rich.live import Live

from tapping_cell.cli import argument_types, cell_arguments, cell_words
from tapping_cell.cli.deployment.places import Places
from tapping_cell.cli.deployment.service_state import service_state
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.nodes import computer
from tapping_cell.nodes.clients.cell_client import CellClient

PERIOD_S = 0.2
"""Time between two updates of the state that is watched."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    cell_arguments.add_arguments(parser)
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument("--json", action="store_true", help="print the state as JSON")
    shown.add_argument(
        "--watch",
        nargs="?",
        const=math.inf,
        type=argument_types.within(0, 1e6),
        metavar="SECONDS",
        help="show the changing state until Ctrl-C, or for this time in seconds",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 if the cell is ready or at work, 1 if it is not ready or does not
    respond; with --watch, return 0 after Ctrl-C."""
    if arguments.watch is None:
        return _print(arguments)
    status = _watch(arguments)
    return ExitStatus.DONE if status == ExitStatus.INTERRUPTED else status


@cell_arguments.with_cell
def _watch(arguments: argparse.Namespace, client: CellClient) -> int:
    console = Console(highlight=False)
    began = time.monotonic()
    client.wait_for_cell(cell_arguments.TIMEOUT_S)
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
        while time.monotonic() < began + arguments.watch:
            live.update(cell_words.overview(client.state(), log=True), refresh=True)
            time.sleep(PERIOD_S)
    return ExitStatus.DONE


@cell_arguments.with_cell
def _print(arguments: argparse.Namespace, client: CellClient) -> int:
    state = client.wait_for_cell(cell_arguments.TIMEOUT_S)
    if arguments.json:
        places = Places()
        folder = places.runs if places.manifest() is not None else Path.cwd()
        state |= {"computer": computer.state(folder), "service": service_state(places)}
        print(json.dumps(state, indent=2, allow_nan=False))
    else:
        Console(highlight=False, soft_wrap=True).print(cell_words.overview(state))
    return ExitStatus.DONE if state["mode"] in ("ready", "moving") else ExitStatus.FAILED
