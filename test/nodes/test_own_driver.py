"""The arm's node with an arm that has its own ROS driver."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from harness import Bench, bench
from rclpy.duration import Duration
from ros_controller import RosController
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, TapCommand
from tapping_cell_msgs.srv import HoldStill
from trajectory_controller import ControllerSettings, TrajectoryController

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.se2 import Pose

STRIKE = Pose(-0.08, 0.02, 0.3)
NAMES = ("joint_1", "joint_2", "joint_3", "joint_4")


def own_driver_cell(folder: Path) -> Path:
    """Write a copy of the package's cell file for an arm that has its own driver."""
    shutil.copytree(shared_folder(), folder / "config")
    cell_file = folder / "config" / "cell.yaml"
    content = yaml.safe_load(cell_file.read_text())
    arm = content["arm"]
    del arm["port"], arm["baud"]
    arm |= {
        "dialect": "ros2_control",
        "homing": "none",
        "ros2_control": {
            "controller": "/scara_controller",
            "joints": list(NAMES),
            "joint_states": "/robot/joint_states",
            "interface": "topic",
            "state_timeout": 1.0,
        },
    }
    cell_file.write_text(yaml.safe_dump(content))
    return cell_file


@dataclass
class Cell:
    bench: Bench
    controller: RosController
    states: list[ArmState]
    file: Path

    def __post_init__(self) -> None:
        node = self.bench.probe
        assert node is not None
        self.commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
        self.services = {
            name: node.create_client(Trigger, f"scara_arm/{name}")
            for name in ("home", "stop", "clear_fault")
        }
        self.services["hold_still"] = node.create_client(HoldStill, "hold_still")
        self.node = node

    @property
    def last(self) -> ArmState:
        return self.states[-1]

    def wait_state(self, state: int) -> None:
        self.bench.wait(lambda: self.states and self.last.state == state, f"state {state}")

    def call(self, service: str, request: object = None) -> Any:
        client = self.services[service]
        self.bench.wait(client.service_is_ready, f"{service} is there")
        future = client.call_async(request or Trigger.Request())
        self.bench.wait(future.done, f"{service} answers")
        return future.result()

    def tap(self, tap_id: int) -> None:
        message = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=0.3)
        message.header.frame_id = "table"
        message.strike_pose = to_message(STRIKE)
        message.expiry = (self.node.get_clock().now() + Duration(seconds=20)).to_msg()
        self.commands.publish(message)

    def homed(self) -> None:
        self.wait_state(ArmState.NOT_HOMED)
        assert self.call("home").success
        self.wait_state(ArmState.IDLE)
        self.bench.wait(lambda: self.commands.get_subscription_count() == 1, "the node listens")

    def true_tip(self) -> tuple[Pose, float]:
        """Return the true pose, computed from the emulated arm by forward kinematics."""
        configuration = load_cell(self.file)
        with self.controller.lock:
            joints, _ = self.controller.controller.state(time.monotonic())
        tip = configuration.file.arm.geometry().forward(joints)
        return configuration.arm_base @ Pose(tip.x, tip.y, tip.yaw), tip.z

    def moving(self) -> bool:
        with self.controller.lock:
            return self.controller.controller.moving(time.monotonic())


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    file = own_driver_cell(tmp_path)
    start = (0.3, 1.0, -0.02, 0.0)
    made: list[RosController] = []

    def make() -> list[Any]:
        emulated = TrajectoryController(ControllerSettings(NAMES), start, time.monotonic())
        made.append(RosController(emulated))
        return [ScaraArm()]

    with bench(make, {"scara_arm": {"cell_file": file}}) as b:
        try:
            yield Cell(b, made[0], b.listen(ArmState, "arm_state", LATCHED), file)
        finally:
            made[0].close()


def test_a_tap_and_back_with_the_arms_own_driver(cell: Cell) -> None:
    cell.wait_state(ArmState.NOT_HOMED)
    assert not cell.controller.sent, "something was sent before it was homed"
    cell.homed()
    park = load_cell(cell.file).file.arm.park
    with cell.controller.lock:
        assert cell.controller.controller.state(time.monotonic())[0] == pytest.approx(
            park, abs=1e-3
        )
    cell.tap(100)
    cell.wait_state(ArmState.IN_POSITION)
    tip, height = cell.true_tip()
    assert tip.distance_to(STRIKE) < 5e-4 and height == pytest.approx(0.006, abs=2e-4)
    assert not cell.moving()
    # By granting the request, the arm promises to stand still for 0.2 s. The promise begins after
    # this line, so a motion that is seen before ``until`` breaks it.
    until = time.monotonic() + 0.2
    held = cell.call("hold_still", HoldStill.Request(tap_id=100, duration=0.2))
    assert held.granted
    cell.commands.publish(TapCommand(request=TapCommand.WITHDRAW, tap_id=100))
    while True:
        moved = cell.moving()
        if time.monotonic() >= until:
            break
        assert not moved, "it moved within its promise to stand still"
        time.sleep(0.005)
    cell.wait_state(ArmState.IDLE)
    assert cell.last.clear_of_camera


def test_a_stop_brakes_the_arm_and_demands_homing(cell: Cell) -> None:
    cell.homed()
    cell.tap(100)
    cell.bench.wait(cell.moving, "it moves")
    cell.call("stop")
    cell.wait_state(ArmState.STOPPED)
    cell.bench.wait(lambda: not cell.moving(), "it rests")
    tip, _ = cell.true_tip()
    assert tip.distance_to(STRIKE) > 0.01, "it went on to its goal"
    cell.call("clear_fault")
    cell.wait_state(ArmState.NOT_HOMED)
    cell.homed()


def test_a_joint_state_timeout_is_reported_and_recovery_is_detected(cell: Cell) -> None:
    cell.homed()
    cell.tap(100)
    cell.wait_state(ArmState.IN_POSITION)
    cell.controller.silent = True
    cell.wait_state(ArmState.DISCONNECTED)
    assert cell.last.error_code == ErrorCode.ARM_NOT_CONNECTED
    errors = " ".join(state.error_msg for state in cell.states)
    assert "joint_state_broadcaster" in errors
    refused = cell.call("hold_still", HoldStill.Request(tap_id=100, duration=0.2))
    assert not refused.granted
    cell.controller.silent = False
    cell.homed()


def test_check_config_receives_joint_states_and_moves_nothing(cell: Cell) -> None:
    cell.wait_state(ArmState.NOT_HOMED)
    rows = devices_in_a_process(cell.file)
    arm = [row for row in rows if row["device"] == "arm"]
    assert arm and all(row["ok"] for row in arm), arm
    assert "ros2_control topic on /scara_controller" in arm[0]["found"]
    other = "scara_arm_controller also publishes on the topic of the controller"
    assert any(other in row["found"] for row in arm)
    cell.controller.silent = True
    (silent,) = [row for row in devices_in_a_process(cell.file) if row["device"] == "arm"]
    assert not silent["ok"] and "joint_1, joint_2" in silent["remedy"]
    assert not cell.controller.sent


def devices_in_a_process(file: Path) -> list[dict[str, Any]]:
    """Return the findings of `check-config --devices`, run in a process of its own."""
    ran = subprocess.run(
        [sys.executable, "-m", "tapping_cell", "check-config", str(file), "--devices", "--json"],
        capture_output=True,
        text=True,
        timeout=150,
    )
    rows: list[dict[str, Any]] = json.loads(ran.stdout)["devices"]
    return rows


def test_an_arm_that_is_pushed_from_its_strike_pose_is_a_fault(cell: Cell) -> None:
    cell.homed()
    cell.tap(100)
    cell.wait_state(ArmState.IN_POSITION)
    with cell.controller.lock:
        cell.controller.controller.push((0.02, 0.0, 0.0, 0.0), time.monotonic())
    cell.wait_state(ArmState.FAULT)
    assert "does not stay" in cell.last.error_msg
    assert np.isfinite(cell.true_tip()[1])
