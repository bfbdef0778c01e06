"""Start a graph for benchmarks, wait for events in it, and measure processor times."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tapping_cell_msgs.msg import ObjectStates

from tapping_cell.cli.graph import Graph, with_own_ports
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.client_node import ClientNode

TIMEOUT_S = 60.0


@contextmanager
def simulated_graph(
    nodes: Sequence[str], parameters: dict[str, dict[str, object]] | None = None
) -> Iterator[Graph]:
    """Run nodes of the simulated cell as processes. Ports, logs and runs are in a temporary folder.

    ``parameters``: parameters of the nodes, by node.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        own = with_own_ports({node: {} for node in nodes} | (parameters or {}), folder)
        if "run_recorder" in own:
            own["run_recorder"]["folder"] = folder / "runs"
        with Graph(nodes, own, folder / "logs") as graph:
            yield graph


def wait_until(
    condition: Callable[[], object],
    what: str,
    graph: Graph,
    patience: float = TIMEOUT_S,
    poll: float = 0.02,
) -> None:
    """Wait for a condition.

    Raises:
        TimeoutError: the condition is not met within ``patience`` s; the message contains ``what``.
        NodeDied: a node of the graph has ended.
    """
    deadline = time.monotonic() + patience
    while not condition():
        graph.check()
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what} within {patience:.0f} s")
        time.sleep(poll)


def wait_for_rest(graph: Graph) -> None:
    """Wait until the camera has seen the object at rest. The node that waits ends before this
    function returns, so that it does not add to the load of the graph."""
    states: list[ObjectStates] = []
    with ClientNode("waiting_for_rest") as client:
        client.node.create_subscription(ObjectStates, "object_states", states.append, LATCHED)
        wait_until(
            lambda: states and states[-1].objects[0].at_rest,
            "the object was not seen at rest",
            graph,
        )


def cpu_seconds(pid: int) -> float:
    """Return the processor time (user plus system) of a process and all its threads, in s: the sum
    of fields 14 and 15 of ``/proc/PID/stat`` (proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
