"""Stop arm, tapper and planner of a running cell immediately. The stop remains in effect until it
is cleared.

Only the wired emergency stop is a safety function: this command depends on computer and network.

    python -m tapping_cell stop
"""

from __future__ import annotations

import argparse

from tapping_cell.cli import cell_arguments
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.nodes.clients.cell_client import CellClient


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    cell_arguments.add_arguments(parser)


@cell_arguments.with_cell
def run(arguments: argparse.Namespace, client: CellClient) -> int:
    """Run the verb. Return 0 if arm and tapper have confirmed the stop, otherwise 1."""
    client.stop()
    print("stopped: arm and tapper; python -m tapping_cell clear ends the stop")
    return ExitStatus.DONE
