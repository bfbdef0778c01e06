"""The arm's node with a controller that offers the action follow_joint_trajectory, over DDS.

Skipped if control_msgs is not installed, which is the case for the ROS wheels.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from harness import bench
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState
from test_own_driver import NAMES, STRIKE, Cell, own_driver_cell
from trajectory_controller import ControllerSettings, TrajectoryController

from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.drivers.scara_arm import ScaraArm

pytest.importorskip("control_msgs", reason="control_msgs is not installed")


@pytest.fixture(params=["action", "auto"])
def cell(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Cell]:
    from ros_action_controller import RosActionController

    file = own_driver_cell(tmp_path)
    content = yaml.safe_load(file.read_text())
    content["arm"]["ros2_control"]["interface"] = request.param
    file.write_text(yaml.safe_dump(content))
    made: list[RosActionController] = []

    def make() -> list[Any]:
        emulated = TrajectoryController(
            ControllerSettings(NAMES), (0.3, 1.0, -0.02, 0.0), time.monotonic()
        )
        made.append(RosActionController(emulated))
        return [ScaraArm()]

    with bench(make, {"scara_arm": {"cell_file": file}}) as b:
        try:
            yield Cell(b, made[0], b.listen(ArmState, "arm_state", LATCHED), file)
        finally:
            made[0].close()


def test_a_tap_by_action_goals(cell: Cell) -> None:
    cell.homed()
    cell.tap(100)
    cell.wait_state(ArmState.IN_POSITION)
    tip, height = cell.true_tip()
    assert tip.distance_to(STRIKE) < 5e-4 and height == pytest.approx(0.006, abs=2e-4)
    taken = cell.controller.controller.taken
    assert cell.controller.goals == taken >= 3, "the moves did not come by the action"
    assert not cell.controller.sent, "a trajectory came by the topic as well"


def test_a_stop_cancels_the_goal_and_brakes(cell: Cell) -> None:
    cell.homed()
    cell.tap(100)
    cell.bench.wait(cell.moving, "it moves")
    assert cell.call("stop", Trigger.Request()).success
    cell.wait_state(ArmState.STOPPED)
    cell.bench.wait(lambda: not cell.moving(), "it rests")
    tip, _ = cell.true_tip()
    assert tip.distance_to(STRIKE) > 0.01, "it went on to its goal"
    cell.call("clear_fault")
    cell.homed()


def test_an_aborted_goal_is_a_fault_with_the_controllers_message(cell: Cell) -> None:
    cell.homed()
    cell.tap(100)
    cell.bench.wait(cell.moving, "it moves")
    with cell.controller.lock:
        cell.controller.controller.block(time.monotonic())
    cell.wait_state(ArmState.FAULT)
    assert "path tolerance" in cell.last.error_msg
