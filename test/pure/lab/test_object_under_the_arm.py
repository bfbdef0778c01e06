"""An object that is hidden by the resting arm, in the complete simulated cell."""

from __future__ import annotations

import numpy as np
import pytest
from test_scenarios import FINAL, GOAL, ScenarioCell

from tapping_cell.logic.clock import NANOSECONDS, to_stamp
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    JointTrajectory,
    JointTrajectoryPoint,
    PlanState,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose

OVER_THE_TABLE = [0.4, 1.3, 0.0, 0.2]


@pytest.fixture
def cell() -> ScenarioCell:
    made = ScenarioCell()
    made.trial.arm_covers = True
    return made


def idle(cell: ScenarioCell) -> bool:
    return cell.arm.state == ArmState.IDLE


def put_under_the_arm(cell: ScenarioCell) -> None:
    """Put the object at the place nearest to the middle where the resting arm hides it."""
    now = cell.trial.scheduler.now
    grid = [(x, y) for x in np.arange(-0.18, 0.19, 0.03) for y in np.arange(-0.12, 0.13, 0.03)]
    for x, y in sorted(grid, key=lambda place: float(np.hypot(*place))):
        cell.trial.physical.world.place(Pose(float(x), float(y), 0.2))
        if cell.trial.physical.view(now) is None:
            return
    raise AssertionError("the arm hides no place")


def move_by_hand(cell: ScenarioCell) -> None:
    """Simulate a person who moves the arm over the table and leaves it there."""
    point = JointTrajectoryPoint(positions=OVER_THE_TABLE)
    point.time_from_start.sec = 4
    names = ["shoulder", "elbow", "quill", "tool"]
    message = JointTrajectory(joint_names=names, points=[point])
    cell.trial.network.publish("person", "joint_trajectory", message)
    assert cell.run(5.0, lambda: cell.arm.state == ArmState.MOVING)
    assert cell.run(20.0, lambda: idle(cell))


def tap_by_a_program(cell: ScenarioCell) -> None:
    """Let another program repeat a tap that the planner has made before."""
    cell.begin()
    assert cell.run(120.0, lambda: bool(cell.ends()))
    cell.run(5.0)  # the arm parks
    command = cell.trial._program_tap()
    assert command is not None
    cell.trial.network.publish("program", "tap_command", command)
    assert cell.run(20.0, lambda: cell.tapper.tap_id == command.tap_id and cell.tapper.outcome > 0)
    assert cell.tapper.outcome == TapperState.FIRED
    withdrawal = TapCommand(request=TapCommand.WITHDRAW, tap_id=command.tap_id)
    withdrawal.header = command.header
    cell.trial.network.publish("program", "tap_command", withdrawal)
    assert cell.run(20.0, lambda: idle(cell))


def send_goal(cell: ScenarioCell) -> None:
    """Send the goal and discard the messages that report the end of the previous goal. The planner
    publishes them until it has received the new goal."""
    cell.trial.send_goal(GOAL)
    assert cell.run(5.0, lambda: cell.plans[-1].state not in FINAL)
    cell.plans.clear()


def cleared(cell: ScenarioCell) -> list[TapCommand]:
    return [command for command in cell.commands if command.request == TapCommand.CLEAR_VIEW]


@pytest.mark.parametrize("leave_arm", [move_by_hand, tap_by_a_program])
def test_the_arm_moves_off_the_object_and_the_goal_is_reached(
    cell: ScenarioCell, leave_arm: object
) -> None:
    assert callable(leave_arm)
    leave_arm(cell)
    put_under_the_arm(cell)
    assert not cell.run(3.0, lambda: cell.arm.state != ArmState.IDLE), "moved without a goal"
    cell.commands.clear()
    send_goal(cell)
    assert cell.run(120.0, lambda: bool(cell.ends()))
    assert cell.ends() == [0] and cell.at(GOAL), cell.plans[-1].error_msg
    assert len(cleared(cell)) == 1
    assert cell.trial.oracle.violations == []


def test_without_an_object_the_arm_is_moved_once_per_goal_and_then_reported(
    cell: ScenarioCell,
) -> None:
    move_by_hand(cell)
    cell.trial.hide_object(600.0)
    for goals in (1, 2):
        send_goal(cell)
        assert cell.run(60.0, lambda: bool(cell.ends()))
        assert cell.ends() == [ErrorCode.OBJECT_NOT_SEEN]
        assert len(cleared(cell)) == goals
        end = next(plan for plan in cell.plans if plan.state in FINAL)
        assert "was moved once more because the object was not seen" in end.error_msg
    assert cell.trial.oracle.violations == []


def test_a_stopped_arm_is_not_moved_off_the_object(cell: ScenarioCell) -> None:
    """An arm that was stopped is moved neither by a goal nor by a command to clear the view."""
    move_by_hand(cell)
    put_under_the_arm(cell)
    cell.trial.press_emergency_stop(60.0)
    assert cell.run(2.0, lambda: cell.arm.state == ArmState.STOPPED)
    cell.trial.send_goal(GOAL)
    now = cell.trial.clocks["tap_planner"].now().ros
    command = TapCommand(request=TapCommand.CLEAR_VIEW, tap_id=now // NANOSECONDS + 5)
    command.header.frame_id = "table"
    command.expiry = to_stamp(now + 30 * NANOSECONDS)
    cell.trial.network.publish("program", "tap_command", command)
    tip = from_message(cell.arm.tip_pose)
    assert not cell.run(10.0, lambda: cell.arm.state != ArmState.STOPPED)
    assert from_message(cell.arm.tip_pose).distance_to(tip) < 1e-4
    assert not cell.run(0.1, lambda: any(p.state == PlanState.PLACING for p in cell.plans))
    assert cell.trial.oracle.violations == []
