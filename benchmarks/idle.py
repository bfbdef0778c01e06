"""Processor load of the idle cell, compared with minimal processes in the same run.

The cell is the complete simulated graph with recorder and operator's page and a stationary object.
The minimal processes show the cost of the messages alone. One process publishes images of the size
and at the rate of the cell's images, and another one subscribes to these images. In addition, there
are six idle nodes. Each of them publishes messages on two topics at 10 Hz and subscribes to the two
topics of another idle node.

The cell and the minimal processes run at the same time, in two ROS domains, and are measured in the
same short periods. Simultaneous measurement is necessary because the load of a machine varies, and
because a second of processor time does less work if other programs use the same caches and cores.
The reported ratio of the loads is the median over the periods.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from benchmarks.rigs import cpu_seconds, simulated_graph, wait_for_rest
from tapping_cell.cli.graph import RECORDER, SIMULATED, Graph, own_domain
from tapping_cell.nodes.camera.images import PICTURES, to_message
from tapping_cell.nodes.cell_node import choose_transport

DEFAULT_COUNT = 20
"""Duration of the measurement, in s."""
TURN_S = 2.0
SETTLE_S = 5.0
"""Waiting time before the measurement, in s. It begins when the object is stationary and the
minimal processes have been started."""
RATE_HZ = 30.0
SIZE = (1024, 1280)
IDLE_NODES = 6
LIMIT = 2.0


def measure(seconds: int) -> dict[str, Any]:
    """Return the load of each process as a share of a core, and the ratio of the cell's total load
    to that of the minimal processes."""
    domain, other = own_domain(), own_domain()
    domain.use()
    choose_transport(pictures=True)
    turns = max(1, round(seconds / TURN_S))
    with _cell() as graph, _pair({**os.environ, "ROS_DOMAIN_ID": str(other.number)}) as pair:
        time.sleep(SETTLE_S)
        groups = {"cell": graph.process_ids, "pair": {n: each.pid for n, each in pair.items()}}
        spent = [_spent(groups, TURN_S) for _ in range(turns)]
        graph.check()
        for role, process in pair.items():
            if process.poll() is not None:
                raise RuntimeError(
                    f"the minimal process {role} ended with exit code {process.returncode}"
                )
    ratios = [sum(turn["cell"].values()) / sum(turn["pair"].values()) for turn in spent]
    shares = {
        group: {
            name: statistics.mean(turn[group][name] for turn in spent) for name in groups[group]
        }
        for group in groups
    }
    return {
        **shares,
        "ratio": statistics.median(ratios),
        "lowest_ratio": min(ratios),
        "highest_ratio": max(ratios),
        "limit": LIMIT,
        "load": os.getloadavg()[0],
    }


@contextmanager
def _cell() -> Iterator[Graph]:
    nodes = (*SIMULATED, RECORDER, "operator_page")
    with simulated_graph(nodes, {"operator_page": {"port": 0}}) as graph:
        wait_for_rest(graph)
        yield graph


@contextmanager
def _pair(environment: dict[str, str]) -> Iterator[dict[str, subprocess.Popen[bytes]]]:
    roles = ["publisher", "subscriber", *(f"idle_{number}" for number in range(IDLE_NODES))]
    started: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for role in roles:
            command = [sys.executable, "-m", "benchmarks.idle", role]
            started[role] = subprocess.Popen(command, env=environment)
        yield started
    finally:
        for process in started.values():
            process.kill()
            process.wait()


def _spent(groups: dict[str, dict[str, int]], seconds: float) -> dict[str, dict[str, float]]:
    """Measure for ``seconds`` and return the load of each process of each group as a share of a
    core."""

    def read() -> dict[str, dict[str, float]]:
        return {
            group: {name: cpu_seconds(process) for name, process in processes.items()}
            for group, processes in groups.items()
        }

    before, began = read(), time.monotonic()
    time.sleep(seconds)
    after, took = read(), time.monotonic() - began
    return {
        group: {name: (after[group][name] - at) / took for name, at in values.items()}
        for group, values in before.items()
    }


def _run_bare(role: str) -> None:
    """Run one of the minimal processes until it is killed."""
    rclpy.init()
    node = rclpy.create_node(role)
    if role == "publisher":
        import numpy as np

        picture = to_message(np.full(SIZE, 128, dtype=np.uint8), "mono8")
        publisher = node.create_publisher(Image, "bare/image_raw", PICTURES)
        node.create_timer(1.0 / RATE_HZ, lambda: publisher.publish(picture))
    elif role == "subscriber":
        node.create_subscription(Image, "bare/image_raw", lambda _: None, PICTURES)
    else:
        _idle(node, int(role.rsplit("_", 1)[1]))
    rclpy.spin(node)


def _idle(node: rclpy.node.Node, number: int) -> None:
    following = (number + 1) % IDLE_NODES
    for topic in range(2):
        publisher = node.create_publisher(Float64, f"bare/node_{number}/topic_{topic}", 10)
        node.create_timer(0.1, lambda chosen=publisher: chosen.publish(Float64()))
        node.create_subscription(
            Float64, f"bare/node_{following}/topic_{topic}", lambda _: None, 10
        )


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = []
    for name in ("cell", "pair"):
        shares = report[name]
        listed = ", ".join(f"{node} {100 * share:.1f}" for node, share in shares.items())
        text.append(f"{name}: {100 * sum(shares.values()):.1f} % of a core ({listed})")
    return [
        *text,
        f"ratio {report['ratio']:.2f} (limit {report['limit']:.1f}; in single turns"
        f" {report['lowest_ratio']:.2f} to {report['highest_ratio']:.2f}; load"
        f" {report['load']:.1f})",
    ]


if __name__ == "__main__":
    _run_bare(sys.argv[1])
