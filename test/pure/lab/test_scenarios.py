"""Actions of clients and people during a goal, in a simulated cell in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import pytest

from lab.trial import Trial
from tapping_cell.messages import (
    ArmState,
    Bool,
    ErrorCode,
    PlanState,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose

START, GOAL, SECOND = Pose(0.0, 0.0, 0.0), Pose(0.04, -0.02, 0.3), Pose(-0.02, 0.01, 0.0)
FINAL = (PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)


class ScenarioCell:
    """A cell that is ready, with the messages that its nodes publish from then on."""

    def __init__(self) -> None:
        self.trial = Trial(seed=21, faults=False)
        self.trial.bring_up()
        self.trial.physical.world.place(START)
        self.plans: list[PlanState] = []
        self.commands: list[TapCommand] = []
        self.arm, self.tapper = ArmState(), TapperState()
        received = {
            "plan_state": self.plans.append,
            "tap_command": self.commands.append,
            "arm_state": lambda message: setattr(self, "arm", message),
            "tapper_state": lambda message: setattr(self, "tapper", message),
        }
        for topic, receive in received.items():
            self.trial.network.subscribe(
                "test", topic, lambda _, message, receive=receive: receive(message)
            )
        self.run(2.0)
        self.plans.clear()

    def run(self, duration: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Let virtual time pass until the condition is met; return whether it was met in time."""
        self.trial.scheduler.run(self.trial.scheduler.now + duration, until)
        return until()

    def ends(self) -> list[int]:
        """Return the error codes of the goals that have ended. The end of a goal is published until
        the next goal."""
        return list(dict.fromkeys(plan.error_code for plan in self.plans if plan.state in FINAL))

    def begin(self) -> None:
        """Send the goal and wait until the arm moves to the first tap."""
        self.trial.send_goal(GOAL)
        assert self.run(20.0, lambda: self.arm.state == ArmState.MOVING and self.arm.tap_id > 0)

    def object_pose(self) -> Pose:
        return self.trial.physical.object_pose(self.trial.scheduler.now)

    def at(self, goal: Pose) -> bool:
        pose = self.object_pose()
        return pose.distance_to(goal) <= 1e-3 and abs(pose.rotation_to(goal)) <= 0.01745


@pytest.fixture
def cell() -> ScenarioCell:
    return ScenarioCell()


def test_a_second_goal_replaces_the_first_and_is_reached(cell: ScenarioCell) -> None:
    cell.begin()
    cell.trial.send_goal(SECOND, foreign=True)
    assert cell.run(120.0, lambda: any(plan.state == PlanState.REACHED for plan in cell.plans))
    assert ErrorCode.GOAL_REPLACED in cell.ends()
    assert cell.at(SECOND)
    assert cell.trial.oracle.violations == []


def test_an_object_moved_by_hand_between_taps_is_still_brought_to_the_goal(
    cell: ScenarioCell,
) -> None:
    cell.begin()
    assert cell.run(60.0, lambda: any(plan.taps == 1 for plan in cell.plans))
    cell.trial.move_object(Pose(0.02, -0.03, -0.2))
    assert cell.run(120.0, lambda: bool(cell.ends()))
    assert cell.ends() == [0] and cell.at(GOAL)
    assert cell.trial.oracle.violations == []


def test_a_canceled_goal_withdraws_the_arm_and_fires_nothing(cell: ScenarioCell) -> None:
    cell.begin()
    cell.trial.cancel_goal()
    assert cell.run(20.0, lambda: cell.arm.state == ArmState.IDLE)
    assert cell.ends() == [ErrorCode.GOAL_CANCELED]
    assert cell.object_pose() == START and cell.tapper.state == TapperState.SAFE


def test_an_emergency_stop_ends_the_goal_and_latches_both_devices(cell: ScenarioCell) -> None:
    cell.begin()
    cell.trial.press_emergency_stop(60.0)
    stopped = (ArmState.STOPPED, TapperState.STOPPED)
    assert cell.run(
        1.0, lambda: (cell.arm.state, cell.tapper.state) == stopped and bool(cell.ends())
    )
    assert cell.ends() == [ErrorCode.EMERGENCY_STOP]
    taps = {command.tap_id for command in cell.commands}
    cell.trial.send_goal(GOAL)
    assert not cell.run(5.0, lambda: any(c.tap_id not in taps for c in cell.commands))
    assert cell.object_pose() == START


@pytest.mark.parametrize("node", ["tap_planner", "camera_pose"])
def test_the_striker_is_not_charged_while_a_node_hangs_and_the_tap_continues_afterwards(
    cell: ScenarioCell, node: str
) -> None:
    cell.begin()
    tap = cell.arm.tap_id
    cell.trial.freeze(node, 8.0)
    assert cell.run(8.0, lambda: cell.arm.state == ArmState.IN_POSITION)
    assert not cell.run(1.5, lambda: cell.tapper.state != TapperState.SAFE)
    assert cell.tapper.tap_id != tap or cell.tapper.outcome == TapperState.NONE
    assert cell.run(120.0, lambda: bool(cell.ends()))
    assert cell.ends() == [0] and cell.at(GOAL)


def test_nothing_moves_during_a_flapping_emergency_stop_despite_clear_and_home_requests(
    cell: ScenarioCell,
) -> None:
    """The emergency stop has a loose contact that switches at 100 Hz, while each service is called
    50 times per second."""
    cell.begin()
    trial = cell.trial
    for step in range(200):
        level = Bool(data=step % 2 == 0)
        later = 0.005 * step
        press = partial(trial.network.publish, "panel", "emergency_stop", level)
        trial.scheduler.after(later, press)
        if step % 4 == 0:
            for node in ("scara_arm", "tapper_trigger"):
                trial.scheduler.after(
                    later, lambda node=node: trial.call_service(node, "~/clear_fault")
                )
            trial.scheduler.after(later, lambda: trial.call_service("scara_arm", "~/home"))
    assert cell.run(0.5, lambda: cell.arm.state == ArmState.STOPPED)
    cell.run(0.2)
    assert not cell.run(2.0, lambda: trial.physical.moving(trial.scheduler.now))
    assert cell.tapper.state == TapperState.STOPPED and cell.ends() == [ErrorCode.EMERGENCY_STOP]
    trial.recover()
    trial.send_goal(GOAL)
    assert cell.run(120.0, lambda: cell.at(GOAL) and cell.plans[-1].state == PlanState.REACHED)
    assert trial.oracle.violations == []
