"""Stop a running cell at once: arm, tapper and planner; the stop stays until it is cleared.

The wired emergency stop is the safe one: this goes over the computer and the network.

    python -m tapping_cell stop
"""

from __future__ import annotations

import argparse

from tapping_cell.cli import cell_arguments
from tapping_cell.cli.errors import ExitStatus
from tapping_cell.nodes.clients.cell_client import CellClient


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of the verb."""
    cell_arguments.add_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the verb; 0 arm and tapper have said that they are stopped, 1 they have not."""

    def stop(client: CellClient) -> int:
        client.stop()
        print("stopped: arm and tapper; python -m tapping_cell clear ends the stop")
        return ExitStatus.DONE

    return cell_arguments.with_cell(arguments, stop)
