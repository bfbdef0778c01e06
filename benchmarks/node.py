"""Processor load of each node in the running graph, and time of camera_pose per image.

The benchmark starts the simulated cell as processes with a stationary object. For several seconds
the benchmark records the processor times of the processes and the ages of the object_state stamps.
Afterwards, the benchmark sends several kinds of images to camera_pose alone.
"""

from __future__ import annotations

import os
import statistics
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from tapping_cell_msgs.msg import ObjectState

from benchmarks import node_pictures
from benchmarks.rigs import cpu_seconds, simulated_graph, wait_for_rest
from tapping_cell.cli.graph import SIMULATED, Graph, own_domain
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.goal_client import GoalClient

DEFAULT_COUNT = 10
"""Duration of the measurement, s."""


def measure(seconds: int) -> dict[str, Any]:
    """Return the load of each node as a share of a core, rate and age of object_state, and the time
    per image (ms)."""
    domain = own_domain()
    domain.use()
    with simulated_graph(SIMULATED) as graph:
        report = _watch(graph, seconds)
    return report | {"pictures": node_pictures.measure(seconds)}


def _watch(graph: Graph, seconds: int) -> dict[str, Any]:
    ages: list[float] = []
    values: dict[str, str] = {}

    def on_state(message: ObjectState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        ages.append(time.time() - stamp)

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("camera_pose"):
                values.update({entry.key: entry.value for entry in status.values})

    with GoalClient("node_benchmark") as client:
        wait_for_rest(graph, client)
        subscribe = client.node.create_subscription
        subscribe(ObjectState, "object_state", on_state, LATCHED)
        subscribe(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
        before = {name: cpu_seconds(pid) for name, pid in graph.process_ids.items()}
        begin = time.monotonic()
        time.sleep(seconds)
        took = time.monotonic() - begin
        after = {name: cpu_seconds(pid) for name, pid in graph.process_ids.items()}
    return {
        "cores": {name: (after[name] - before[name]) / took for name in before},
        "rate_hz": len(ages) / took,
        "age_ms": statistics.median(ages) * 1e3,
        "picture_ms": float(values.get("milliseconds a picture", "nan")),
        "load": os.getloadavg()[0],
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [f"{name:<16}{100 * share:5.1f} % of a core" for name, share in report["cores"].items()]
    text.append(
        f"object_state at {report['rate_hz']:.1f} Hz, {report['age_ms']:.1f} ms after the middle "
        f"of the exposure; camera_pose takes {report['picture_ms']:.2f} ms a picture "
        f"(load {report['load']:.1f})"
    )
    return [*text, "camera_pose alone:", *node_pictures.lines(report["pictures"])]
