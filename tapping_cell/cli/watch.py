"""Display state, taps, nodes and events of a running cell in the terminal, until Ctrl-C.

python -m tapping_cell watch
"""

from __future__ import annotations

import argparse
import time

from rich.console import Console
from rich.live import Live

from tapping_cell.cli import argument_types, cell_arguments, cell_words
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.nodes.clients.cell_client import CellClient

PERIOD_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    cell_arguments.add_arguments(parser)
    parser.add_argument(
        "--seconds",
        type=argument_types.within(0, 1e6),
        help="duration in seconds after which to end (default: watch until Ctrl-C)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb. Return 0 after Ctrl-C, 1 if no cell responds."""
    status = _follow(arguments)
    return ExitStatus.DONE if status == ExitStatus.INTERRUPTED else status


@cell_arguments.with_cell
def _follow(arguments: argparse.Namespace, client: CellClient) -> int:
    console = Console(highlight=False)
    began = time.monotonic()
    client.wait_for_cell(cell_arguments.TIMEOUT_S)
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
        while arguments.seconds is None or time.monotonic() - began < arguments.seconds:
            live.update(cell_words.overview(client.state(), log=True), refresh=True)
            time.sleep(PERIOD_S)
    return ExitStatus.DONE
