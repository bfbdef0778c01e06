"""Processor time of rclpy's executor per callback, with one node in a process and with all nodes in
one process.

Before each callback, the executor rebuilds its wait set from all entities of all nodes that it
spins. Nodes in one process share the executor, so the entities of each node slow down the callbacks
of the other nodes. No messages are sent: a guard condition triggers the measured callback.
"""

from __future__ import annotations

import importlib
import os
import time
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor

from tapping_cell.cli.graph import RECORDER, SIMULATED, own_domain
from tapping_cell.nodes import MODULES
from tapping_cell.nodes.cell_node import CellNode

DEFAULT_COUNT = 300
"""Number of callbacks."""
WARM_UP = 20


def measure(count: int) -> dict[str, Any]:
    """Return the processor time of a callback (µs) for each node alone, and with all nodes in one
    process."""
    domain = own_domain()  # the domain stays reserved until this function returns
    domain.use()
    rclpy.init(args=["--ros-args", "-p", "autostart:=false"])
    nodes = {name: _make(name) for name in (*SIMULATED, RECORDER)}
    try:
        alone = {name: _cost([node], count) for name, node in nodes.items()}
        return {
            "alone_us": alone,
            "composed_us": _cost(list(nodes.values()), count),
            "load": os.getloadavg()[0],
        }
    finally:
        for node in nodes.values():
            node.cleanup()
            node.destroy_node()
        rclpy.try_shutdown()


def _make(name: str) -> CellNode[Any]:
    module = importlib.import_module(MODULES[name])
    make: type[CellNode[Any]] = getattr(module, name.title().replace("_", ""))
    node = make()
    for timer in list(node.timers):
        timer.cancel()
    return node


def _cost(nodes: list[CellNode[Any]], count: int) -> float:
    executor = SingleThreadedExecutor()
    for node in nodes:
        executor.add_node(node)
    guard = nodes[0].create_guard_condition(lambda: None)
    began = 0.0
    for number in range(WARM_UP + count):
        if number == WARM_UP:
            began = time.process_time()
        guard.trigger()
        executor.spin_once(timeout_sec=1.0)
    took = time.process_time() - began
    nodes[0].destroy_guard_condition(guard)
    for node in nodes:
        executor.remove_node(node)
    return 1e6 * took / count


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    alone = report["alone_us"]
    mean = sum(alone.values()) / len(alone)
    listed = ", ".join(f"{name} {cost:.0f}" for name, cost in alone.items())
    return [
        f"one node in a process: {mean:.0f} us of processor time per callback ({listed})",
        f"all {len(alone)} nodes on one executor: {report['composed_us']:.0f} us, "
        f"{report['composed_us'] / mean:.1f} times (load {report['load']:.1f})",
    ]
