"""The options of the verbs that speak to a running cell, and the client that they use."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import ExitStatus, tell_error
from tapping_cell.cli.session import end_on_signals
from tapping_cell.nodes.clients.cell_client import CellClient, NoCell, NotDone

PATIENCE_S = 6.0
"""For the first words of every node."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Which cell is meant."""
    parser.add_argument(
        "--namespace",
        type=argument_types.namespace,
        default="",
        help="namespace of the cell's nodes; the ROS domain is that of ROS_DOMAIN_ID",
    )


def with_cell(arguments: argparse.Namespace, act: Callable[[CellClient], int]) -> int:
    """Do something with a client; errors become a sentence and an exit status."""
    end_on_signals()
    try:
        with CellClient(arguments.namespace) as client:
            return act(client)
    except (NoCell, NotDone, TimeoutError) as error:
        tell_error(str(error))
        return ExitStatus.FAILED
    except KeyboardInterrupt:
        return ExitStatus.INTERRUPTED
