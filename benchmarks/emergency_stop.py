"""Latency from a message on the topic ``emergency_stop`` to the stop bytes on the serial line, with
the real nodes.

Each driver node runs as a separate process with an emulated board in this process. The latency
includes publisher, middleware, executor, driver, terminal and the reading thread in this process.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.client import Client
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, TapperState

from benchmarks.rigs import wait_until
from tapping_cell.cli.graph import Graph, own_domain
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.simulation.device_emulator import DeviceEmulator
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.tapper_emulator import TapperEmulator

STOPS = 100
TIMEOUT_S = 20.0


class StopTimer:
    """An emulated board that records the time of a received stop byte."""

    def __init__(self, board: DeviceEmulator) -> None:
        self.board = board
        self.stopped_at = 0.0

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes from the host."""
        if b"!" in data and not self.stopped_at:
            self.stopped_at = time.monotonic()
        self.board.receive(data, now)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.board, name)


def measure() -> dict[str, Any]:
    """Return the latencies for each node, in s."""
    domain = own_domain()
    domain.use()
    tapper = TapperEmulator(now=time.monotonic())
    return {
        "scara_arm": _stops(
            "scara_arm",
            GrblEmulator(now=time.monotonic()),
            lambda client: (
                client.arm_state is not None
                and client.arm_state.state in (ArmState.NOT_HOMED, ArmState.IDLE)
            ),
            lambda: None,
            {"home_on_activate": False},
        ),
        "tapper_trigger": _stops(
            "tapper_trigger",
            tapper,
            lambda client: (
                client.tapper_state is not None and client.tapper_state.state == TapperState.SAFE
            ),
            lambda: tapper.press_clear_button(time.monotonic()),
            {},
        ),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return [
        f"{node}: emergency_stop to the wire: median {1e3 * figures['median']:.1f} ms, p99"
        f" {1e3 * figures['p99']:.1f} ms of {figures['stops']} stops; load"
        f" {figures['load']:.1f}"
        for node, figures in report.items()
    ]


def _stops(
    name: str,
    board: DeviceEmulator,
    ready: Callable[[GoalClient], bool],
    person: Callable[[], None],
    parameters: dict[str, object],
) -> dict[str, float]:
    device = StopTimer(board)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "port"
        given = {name: {"port": path, **parameters}}
        with (
            PseudoTerminal(device, path) as terminal,
            Graph((name,), given, Path(folder) / "logs") as graph,
            GoalClient("stop_bench") as client,
        ):
            publisher = client.node.create_publisher(Bool, "emergency_stop", LATCHED)
            clear = client.node.create_client(Trigger, f"{name}/clear_fault")
            wait = partial(
                wait_until,
                what="the awaited event did not occur",
                graph=graph,
                patience=TIMEOUT_S,
                poll=0.001,
            )
            times: list[float] = []
            for _ in range(STOPS):
                wait(lambda: ready(client) and clear.service_is_ready())
                device.stopped_at = 0.0
                began = time.monotonic()
                publisher.publish(Bool(data=True))
                wait(lambda: device.stopped_at > 0)
                times.append(device.stopped_at - began)
                wait(lambda: not ready(client))
                with terminal.lock:
                    person()
                publisher.publish(Bool(data=False))
                wait(lambda: _cleared(clear, wait))
    return {
        "stops": STOPS,
        "median": float(np.median(times)),
        "p99": float(np.percentile(times, 99)),
        "load": os.getloadavg()[0],
    }


def _cleared(clear: Client, wait: Callable[..., None]) -> bool:
    """Request that the stop is cleared. The node refuses the request until it has received the
    release of the emergency stop."""
    answer = clear.call_async(Trigger.Request())
    wait(answer.done)
    return bool(answer.result().success)
