"""Options and client that all verbs for a running cell have in common."""

from __future__ import annotations

import argparse
import contextlib
import functools
import time
from collections.abc import Callable, Iterator

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import ExitStatus, print_error
from tapping_cell.cli.signals import end_on_signals
from tapping_cell.nodes.clients.cell_client import CellClient, NoCell, NotDone
from tapping_cell.nodes.clients.enabling_client import EnablingClient

TIMEOUT_S = 6.0
"""Timeout for the first message of every node."""
ENABLED_S = 2.0
"""Time for which a verb waits until the arm reports that an enabling device is held, s."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that select the cell."""
    argument_types.add_namespace(
        parser,
        "namespace of the cell's nodes (default: none); the ROS domain is set by ROS_DOMAIN_ID",
    )


def with_cell(
    act: Callable[[argparse.Namespace, CellClient], int],
) -> Callable[[argparse.Namespace], int]:
    """Make the ``run`` function of a verb from a function that gets the options and a client of the
    cell, and returns the exit code. After an error, ``run`` prints a message and returns the exit
    code of the error."""

    @functools.wraps(act)
    def run(arguments: argparse.Namespace) -> int:
        end_on_signals()
        try:
            with CellClient(arguments.namespace) as client:
                return act(arguments, client)
        except (NoCell, NotDone, TimeoutError) as error:
            print_error(str(error))
            return ExitStatus.FAILED
        except KeyboardInterrupt:
            return ExitStatus.INTERRUPTED

    return run


@contextlib.contextmanager
def key_held(arguments: argparse.Namespace, client: CellClient) -> Iterator[None]:
    """Hold the enabling key of a simulated cell in set-up mode. On hardware a person must hold a
    device; wait for a moment until one is held. If none is, the arm's refusal says so."""
    state = client.state()
    if not state["set_up"]["on"]:
        yield
        return
    with EnablingClient(held=state["simulated"], namespace=arguments.namespace):
        deadline = time.monotonic() + ENABLED_S
        while not client.state()["set_up"]["enabled"] and time.monotonic() < deadline:
            time.sleep(0.05)
        yield
