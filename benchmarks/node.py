"""Processor load of each node in the running graph, and time of camera_pose per image.

The benchmark starts the simulated cell as processes with a stationary object. For several seconds
the benchmark records the processor times of the processes and the ages of the object_state stamps.
Afterwards, the benchmark sends several kinds of images to camera_pose alone.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from tapping_cell_msgs.msg import ObjectState

from benchmarks import node_pictures
from tapping_cell.cli.graph import SIMULATED, Graph, own_domain, with_own_ports
from tapping_cell.nodes.cell_node import LATCHED

DEFAULT_COUNT = 10
"""Duration of the measurement, s."""
TIMEOUT_S = 60.0


def measure(seconds: int) -> dict[str, Any]:
    """Return the load of each node as a share of a core, rate and age of object_state, and the time
    per image (ms)."""
    domain = own_domain()
    local = {"ROS_DOMAIN_ID": str(domain.number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    os.environ.update(local)
    with tempfile.TemporaryDirectory() as folder:
        parameters = with_own_ports({name: {} for name in SIMULATED}, Path(folder))
        with Graph(SIMULATED, parameters, Path(folder) / "logs", local) as graph:
            rclpy.init()
            try:
                report = _watch(graph, seconds)
            except BaseException:
                rclpy.try_shutdown()
                raise
    try:
        return report | {"pictures": node_pictures.measure(seconds, local, cpu_seconds)}
    finally:
        rclpy.try_shutdown()


def _watch(graph: Graph, seconds: int) -> dict[str, Any]:
    node = rclpy.create_node("node_benchmark")
    states: list[tuple[float, bool]] = []
    values: dict[str, str] = {}

    def on_state(message: ObjectState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        states.append((time.time() - stamp, message.at_rest))

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("camera_pose"):
                values.update({entry.key: entry.value for entry in status.values})

    node.create_subscription(ObjectState, "object_state", on_state, LATCHED)
    node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, 10)
    deadline = time.monotonic() + TIMEOUT_S
    while not (states and states[-1][1]):
        graph.check()
        if time.monotonic() > deadline:
            raise TimeoutError(f"the object was not seen at rest within {TIMEOUT_S:.0f} s")
        rclpy.spin_once(node, timeout_sec=0.1)
    states.clear()
    before = {name: cpu_seconds(pid) for name, pid in graph.process_ids.items()}
    begin = time.monotonic()
    while time.monotonic() - begin < seconds:
        rclpy.spin_once(node, timeout_sec=0.05)
    took = time.monotonic() - begin
    shares = {
        name: (cpu_seconds(pid) - before[name]) / took for name, pid in graph.process_ids.items()
    }
    node.destroy_node()
    return {
        "cores": shares,
        "rate_hz": len(states) / took,
        "age_ms": statistics.median(age for age, _ in states) * 1e3,
        "picture_ms": float(values.get("milliseconds a picture", "nan")),
        "load": os.getloadavg()[0],
    }


def cpu_seconds(pid: int) -> float:
    """Return the user and system time of a process with all its threads, s (proc(5), fields 14 and
    15)."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [f"{name:<16}{100 * share:5.1f} % of a core" for name, share in report["cores"].items()]
    text.append(
        f"object_state at {report['rate_hz']:.1f} Hz, {report['age_ms']:.1f} ms after the middle "
        f"of the exposure; camera_pose takes {report['picture_ms']:.2f} ms a picture "
        f"(load {report['load']:.1f})"
    )
    return [*text, "camera_pose alone:", *node_pictures.lines(report["pictures"])]
