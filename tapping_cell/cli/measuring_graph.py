"""ROS graph of a measuring verb: started by the verb (simulated or hardware) or already running."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tapping_cell.cli import argument_types
from tapping_cell.cli.graph import Graph, own_domain, with_own_ports


def add_graph_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options that select graph and cell."""
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--hardware",
        action="store_true",
        help="use the real camera, arm and tapper (default: simulated)",
    )
    how.add_argument(
        "--attach", action="store_true", help="use a running cell instead of starting the nodes"
    )
    argument_types.add_namespace(
        parser, "namespace of the running cell's nodes (only with --attach; default: none)"
    )
    parser.add_argument(
        "--camera",
        default="/dev/video0",
        help="camera device, video file or image folder (only with --hardware; default: "
        "/dev/video0)",
    )
    argument_types.add_cell(parser)
    argument_types.add_truth(parser)
    parser.set_defaults(planner=None)


@contextmanager
def measuring_graph(
    arguments: argparse.Namespace,
    nodes: Sequence[str],
    parameters: dict[str, dict[str, object]],
    logs: Path,
    report: Callable[[str], None],
) -> Iterator[Callable[[], None]]:
    """Start the graph or attach to a running one. Yield a function that raises an exception if a
    node has died.

    If the graph is started, ``report`` is called with a message that names the folder of the
    records and the ROS domain.

    Raises:
        GraphError: the graph cannot be started.
    """
    if arguments.attach:
        yield lambda: None
        return
    domain = own_domain()
    domain.use()
    report(
        f"records in {logs.parent}; to watch the cell, run"
        f" ROS_DOMAIN_ID={domain.number} python -m tapping_cell status --watch"
    )
    with tempfile.TemporaryDirectory(prefix="tapping_cell-") as ports:
        if not arguments.hardware:
            parameters = with_own_ports(parameters, Path(ports))
        with Graph(nodes, parameters, logs) as graph:
            yield graph.check
