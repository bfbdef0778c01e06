"""The tapper's node over DDS, with a striker that is fired by a robot's digital output."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness import TIMEOUT_S, Bench, bench
from rclpy.duration import Duration
from ros_output import RosOutput
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import (
    ArmState,
    ErrorCode,
    ObjectState,
    ObjectStates,
    PlanState,
    TapCommand,
)
from tapping_cell_msgs.msg import TapperState as TapperMessage
from tapping_cell_msgs.srv import HoldStill

from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.drivers.tapper_trigger import TapperTrigger

TRIES = 5
"""Number of attempts to measure a pulse. The expected length is 12 ms: a striker speed of 0.6 m/s
requires 20 mJ, and 20 mJ require a pulse of 12 ms. The emulated robot measures the length from the
arrival of its commands. A busy machine may delay a command, but is unlikely to do so in each of
five taps."""


def output_cell(folder: Path, interface: str, reads_back: bool) -> Path:
    """Write a copy of the package's cell file whose tapper is fired by a digital output."""
    shutil.copytree(shared_folder(), folder / "config")
    path = folder / "config" / "cell.yaml"
    content = yaml.safe_load(path.read_text())
    tapper = content["tapper"]
    del tapper["port"], tapper["baud"]
    tapper |= {
        "dialect": "io",
        "energies": [1e-4, 2e-2, 0.35],
        "speeds": [0.02, 0.6, 2.5],
        "output": {
            "interface": interface,
            "name": "/robot/set_output",
            "guard": "/robot/guard_closed",
            "pulses": [0.004, 0.012, 0.030],
            "latency": 0.03,
        }
        | ({"read_back": "/robot/output_is_on"} if reads_back else {}),
    }
    path.write_text(yaml.safe_dump(content))
    return path


@dataclass
class Cell:
    """The node, the robot's output, and publishers that replace planner, camera and arm."""

    bench: Bench
    robot: RosOutput
    states: list[TapperMessage]
    file: Path

    def __post_init__(self) -> None:
        node = self.bench.probe
        assert node is not None
        self.node = node
        self.commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
        self.arm = node.create_publisher(ArmState, "arm_state", LATCHED)
        self.plan = node.create_publisher(PlanState, "plan_state", LATCHED)
        self.camera = node.create_publisher(ObjectStates, "object_states", LATCHED)
        self.stop = node.create_client(Trigger, "tapper_trigger/stop")
        self.clear = node.create_client(Trigger, "tapper_trigger/clear_fault")
        node.create_service(HoldStill, "hold_still", self._hold_still)

    def _hold_still(
        self, request: HoldStill.Request, response: HoldStill.Response
    ) -> HoldStill.Response:
        response.granted = True
        response.duration = request.duration
        return response

    def ready(self) -> None:
        self.bench.wait(
            lambda: (
                self.states
                and self.states[-1].state == TapperMessage.SAFE
                and self.commands.get_subscription_count() == 1
                and self.arm.get_subscription_count() == 1
                and self.clear.service_is_ready()
            ),
            "the tapper is safe",
        )

    def tap(self, tap_id: int) -> None:
        """Command a tap and publish valid states of arm, planner and camera until it ends."""
        message = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=0.6)
        message.header.frame_id = "table"
        message.expiry = (self.node.get_clock().now() + Duration(seconds=20)).to_msg()
        self.commands.publish(message)
        self.bench.wait(lambda: self._tap_ended(tap_id), f"tap {tap_id} ends")

    def _tap_ended(self, tap_id: int) -> bool:
        now = self.node.get_clock().now().to_msg()
        arm = ArmState(state=ArmState.IN_POSITION, tap_id=tap_id, homed=True)
        plan = PlanState(tap_id=tap_id)
        seen = ObjectState(visible=True, at_rest=True)
        for each in (arm, plan, seen):
            each.header.stamp = now
        self.plan.publish(plan)
        self.camera.publish(ObjectStates(header=seen.header, objects=[seen]))
        self.arm.publish(arm)
        time.sleep(0.03)
        last = self.states[-1]
        return bool(last.tap_id == tap_id and last.outcome != TapperMessage.NONE)

    def call(self, client: Any) -> Any:
        future = client.call_async(Trigger.Request())
        self.bench.wait(future.done, "the service answers")
        return future.result()


@pytest.mark.parametrize("interface", ["topic", "service"])
def test_an_orderly_shutdown_switches_the_output_off(interface: str, tmp_path: Path) -> None:
    file = output_cell(tmp_path, interface, reads_back=False)
    command = [sys.executable, "-m", "tapping_cell.nodes.drivers.tapper_trigger"]
    options = ["--ros-args", "-p", f"cell_file:={file}"]
    with bench(lambda: [], {}) as b:
        robot = RosOutput(interface, reads_back=False)
        states = b.listen(TapperMessage, "tapper_state", LATCHED)
        with subprocess.Popen(
            [*command, *options],
            env={**os.environ, "HOME": str(tmp_path)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            try:
                b.wait(lambda: states and states[-1].state == TapperMessage.SAFE, "it is safe")
                robot.set_level(True)  # as during a pulse
                process.send_signal(signal.SIGTERM)
                text, _ = process.communicate(timeout=TIMEOUT_S)
            finally:
                process.kill()
        assert (process.returncode, "Traceback" in text) == (0, False), text
        b.wait(lambda: not robot.level, "the output is off")
        assert states[-1].state == TapperMessage.DISCONNECTED
        robot.close()


@contextmanager
def output(folder: Path, interface: str, reads_back: bool = True) -> Iterator[Cell]:
    file = output_cell(folder, interface, reads_back)
    made: list[RosOutput] = []

    def make() -> list[Any]:
        made.append(RosOutput(interface, reads_back))
        return [TapperTrigger()]

    with bench(make, {"tapper_trigger": {"cell_file": file}}) as b:
        try:
            yield Cell(b, made[0], b.listen(TapperMessage, "tapper_state", LATCHED), file)
        finally:
            made[0].close()


@pytest.mark.parametrize("interface", ["service", "topic", "commands", "pulse"])
def test_a_tap_is_one_pulse_and_read_back(tmp_path: Path, interface: str) -> None:
    with output(tmp_path, interface) as cell:
        cell.ready()
        first = int(time.time())
        for tap_id in range(first, first + TRIES):
            cell.tap(tap_id)
            pulses = cell.robot.pulses()
            assert len(pulses) == tap_id - first + 1
            if cell.states[-1].outcome == TapperMessage.FIRED and 0.006 < pulses[-1] < 0.05:
                break
        else:
            raise AssertionError(f"no tap is as commanded: {pulses}, {cell.states[-1].error_msg}")
        cell.tap(tap_id)
        assert len(cell.robot.pulses()) == len(pulses), "a repeated id was fired"


def test_without_a_read_back_it_is_unknown_and_a_stop_latches(tmp_path: Path) -> None:
    with output(tmp_path, "service", reads_back=False) as cell:
        cell.ready()
        tap_id = int(time.time())
        cell.tap(tap_id)
        assert cell.states[-1].outcome == TapperMessage.UNKNOWN
        assert cell.states[-1].error_code == ErrorCode.TAPPER_OUTCOME_UNKNOWN
        assert len(cell.robot.pulses()) == 1
        assert cell.call(cell.stop).success
        cell.bench.wait(lambda: cell.states[-1].state == TapperMessage.STOPPED, "it is stopped")
        assert cell.call(cell.clear).success
        cell.ready()
        cell.tap(tap_id + 1)
        assert cell.states[-1].outcome == TapperMessage.UNKNOWN
        assert len(cell.robot.pulses()) == 2


def test_an_open_guard_and_a_timeout_are_reported_and_nothing_is_switched(tmp_path: Path) -> None:
    with output(tmp_path, "topic") as cell:
        cell.ready()
        cell.robot.guard_closed = False
        cell.bench.wait(lambda: not cell.states[-1].interlock_closed, "the guard is open")
        cell.tap(int(time.time()))
        assert cell.states[-1].outcome == TapperMessage.NOT_FIRED
        assert cell.states[-1].error_code == ErrorCode.TAPPER_INTERLOCK_OPEN
        cell.robot.silent = True
        cell.bench.wait(lambda: cell.states[-1].state == TapperMessage.DISCONNECTED, "it is lost")
        assert any("has been silent" in state.error_msg for state in cell.states)
        cell.robot.silent, cell.robot.guard_closed = False, True
        cell.ready()
        assert not cell.robot.pulses()


def test_check_config_detects_the_output_without_switching_it_on(tmp_path: Path) -> None:
    with output(tmp_path, "service") as cell:
        cell.ready()
        ran = subprocess.run(
            [
                sys.executable,
                "-m",
                "tapping_cell",
                "check-config",
                str(cell.file),
                "--devices",
                "--json",
            ],
            capture_output=True,
            text=True,
            timeout=150,
        )
        rows = [r for r in json.loads(ran.stdout)["devices"] if r["device"] == "tapper"]
        assert rows and all(row["ok"] for row in rows), rows
        assert "digital output by service on /robot/set_output" in rows[0]["found"]
        assert not cell.robot.edges
