"""A manager configures and activates the nodes, as Nav2's lifecycle_manager does: one after the
other, in the order of its list, and in the reverse order to pause and reset them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rclpy
from cell_processes import TIMEOUT_S, run
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_srvs.srv import Trigger

from tapping_cell.nodes import MODULES

MANAGED = ("camera_pose", "scara_arm", "tapper_trigger", "tap_planner")
pytestmark = pytest.mark.timeout(4 * TIMEOUT_S)


TARGETS = {
    Transition.TRANSITION_CONFIGURE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_ACTIVATE: State.PRIMARY_STATE_ACTIVE,
    Transition.TRANSITION_DEACTIVATE: State.PRIMARY_STATE_INACTIVE,
    Transition.TRANSITION_CLEANUP: State.PRIMARY_STATE_UNCONFIGURED,
}
ATTEMPTS = 5
"""Number of attempts at a transition, because a device may be late on a busy machine."""
ANSWER_S = 30.0
"""Time after which a call is repeated, s."""


class Manager:
    """Stand-in for the manager."""

    def __init__(self) -> None:
        self._node = rclpy.create_node("lifecycle_manager")

    def call(self, kind: Any, service: str, request: object) -> Any:
        client = self._node.create_client(kind, service)
        assert client.wait_for_service(TIMEOUT_S), service
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self._node, future, timeout_sec=ANSWER_S)
        if future.done():
            return future.result()
        # The response is lost if the server had not discovered this client yet.
        return self.call(kind, service, request)

    def state(self, name: str) -> int:
        return self.call(GetState, f"{name}/get_state", GetState.Request()).current_state.id

    def change(self, transition: int, names: tuple[str, ...]) -> None:
        for name in names:
            self.state(name)
            request = ChangeState.Request(transition=Transition(id=transition))
            for _ in range(ATTEMPTS):
                self.call(ChangeState, f"{name}/change_state", request)
                if self.state(name) == TARGETS[transition]:
                    break
                time.sleep(1.0)
            else:
                raise AssertionError(f"{name} refuses transition {transition}")

    def start(self) -> None:
        self.change(Transition.TRANSITION_CONFIGURE, MANAGED)
        self.change(Transition.TRANSITION_ACTIVATE, MANAGED)

    def pause(self) -> None:
        self.change(Transition.TRANSITION_DEACTIVATE, MANAGED[::-1])

    def reset(self) -> None:
        self.change(Transition.TRANSITION_CLEANUP, MANAGED[::-1])


@contextmanager
def nodes() -> Iterator[None]:
    """Run the nodes of a cell. Only the simulated world activates itself."""
    command = [sys.executable, "-m"]
    started = [subprocess.Popen([*command, MODULES["sim_world"]])]
    by_manager = ("--ros-args", "-p", "autostart:=false")
    started += [subprocess.Popen([*command, MODULES[name], *by_manager]) for name in MANAGED]
    try:
        yield
        assert all(process.poll() is None for process in started)
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait(TIMEOUT_S)


def test_a_manager_starts_pauses_resumes_and_resets_the_nodes(tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": str(tmp_path)}

    def goal(x: str) -> Any:
        words = ("goal", x, "10", "5", "--wait", str(TIMEOUT_S), "--json")
        return json.loads(run(*words, env=environment, cwd=tmp_path, stderr=None)[1])

    rclpy.init()
    try:
        with nodes():
            manager = Manager()
            assert manager.state("sim_world")
            while manager.state("sim_world") != State.PRIMARY_STATE_ACTIVE:
                time.sleep(0.1)
            manager.start()
            assert manager.call(Trigger, "scara_arm/home", Trigger.Request()).success
            assert goal("20")["reached"]
            manager.pause()
            assert {manager.state(name) for name in MANAGED} == {State.PRIMARY_STATE_INACTIVE}
            manager.change(Transition.TRANSITION_ACTIVATE, MANAGED)
            assert goal("-20")["reached"]
            manager.pause()
            manager.reset()
            assert {manager.state(name) for name in MANAGED} == {State.PRIMARY_STATE_UNCONFIGURED}
            manager.start()
            assert manager.state("tap_planner") == State.PRIMARY_STATE_ACTIVE
    finally:
        rclpy.shutdown()
