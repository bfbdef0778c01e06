"""The arm's node with a six-axis arm that has its own driver, over DDS."""

from __future__ import annotations

import math
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from harness import bench
from rclpy.duration import Duration
from ros_controller import RosController
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, TapCommand
from trajectory_controller import ControllerSettings, TrajectoryController

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.chain_link import upright
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.se2 import Pose

ROOT = Path(__file__).parents[2]
STRIKE = Pose(-0.08, 0.02, 0.3)


def test_a_tap_and_back_with_six_joints(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "config", tmp_path / "config")
    shutil.copytree(ROOT / "examples" / "six_axis_cell", tmp_path / "examples" / "six")
    file = tmp_path / "examples" / "six" / "cell.yaml"
    content = yaml.safe_load(file.read_text())
    content["arm"]["ros2_control"] |= {
        "controller": "/scara_controller",
        "joint_states": "/robot/joint_states",
        "state_timeout": 1.0,
    }
    file.write_text(yaml.safe_dump(content))
    cell = load_cell(file)
    chain = cell.arm.chain()
    assert chain is not None
    tip = np.array(cell.arm.geometry().forward(cell.arm.park)) + np.array([0.02, 0.0, 0.01, 0.0])
    start = chain.inverse(upright(tip), (1.75, 0.86, 0.14, 0.0, 0.58, -0.64))
    assert start.success
    made: list[RosController] = []

    def make() -> list[Any]:
        emulated = TrajectoryController(
            ControllerSettings(chain.names), start.joints.tolist(), time.monotonic()
        )
        made.append(RosController(emulated))
        return [ScaraArm()]

    with bench(make, {"scara_arm": {"cell_file": file}}) as b:
        try:
            node = b.probe
            assert node is not None
            states = b.listen(ArmState, "arm_state", LATCHED)
            commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
            home = node.create_client(Trigger, "scara_arm/home")
            b.wait(lambda: states and states[-1].state == ArmState.NOT_HOMED, "it is received")
            b.wait(home.service_is_ready, "home is there")
            future = home.call_async(Trigger.Request())
            b.wait(future.done, "it is homed")
            assert future.result().success, future.result().message
            b.wait(lambda: states[-1].state == ArmState.IDLE, "it is parked")
            b.wait(lambda: commands.get_subscription_count() == 1, "the node listens")
            command = TapCommand(request=TapCommand.TAP, tap_id=100, striker_speed=0.3)
            command.header.frame_id = "table"
            command.strike_pose = to_message(STRIKE)
            command.expiry = (node.get_clock().now() + Duration(seconds=20)).to_msg()
            commands.publish(command)
            b.wait(lambda: states[-1].state == ArmState.IN_POSITION, "it is in position")
            with made[0].lock:
                joints, _ = made[0].controller.state(time.monotonic())
            pose = chain.forward(joints)
            there = cell.arm_base @ Pose(
                float(pose[0, 3]), float(pose[1, 3]), math.atan2(pose[1, 0], pose[0, 0])
            )
            assert there.distance_to(STRIKE) < 1e-3
            assert pose[2, 3] == pytest.approx(cell.strike_height, abs=5e-4)
            assert pose[2, 2] > math.cos(0.01)
            commands.publish(TapCommand(request=TapCommand.WITHDRAW, tap_id=100))
            b.wait(lambda: states[-1].state == ArmState.IDLE, "it has withdrawn")
            assert states[-1].clear_of_camera
        finally:
            made[0].close()
