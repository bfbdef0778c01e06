"""The state machine of the arm with its driver and its emulated controller, in virtual time: it
homes before it moves, reports IN_POSITION only after reading the position back, and withdraws on
request."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from virtual_node import VirtualNode

from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.configuration.arm_assembly import make_arm_driver
from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.logic import arm_jobs
from tapping_cell.logic.arm import ArmLogic, ArmOptions
from tapping_cell.logic.host import Activated, Deactivated
from tapping_cell.logic.permit import longest_hold
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.logic.stops import CONFIRM_WITHIN_S
from tapping_cell.messages import (
    ArmState,
    Bool,
    ErrorCode,
    HoldStill,
    JointTrajectory,
    JointTrajectoryPoint,
    Point,
    PoseStamped,
    TapCommand,
    TapperState,
)
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.se2 import Pose
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.truth import ArmTruth

STRIKE = Pose(-0.08, 0.02, 0.3)
JOINT_NAMES = ["shoulder", "elbow", "quill", "tool"]


class Cell(VirtualNode):
    """The node, its emulated controller, and a probe that replaces the planner."""

    def __init__(self, dialect: str = "grbl", home: bool = True, started: bool = True) -> None:
        settings = replace(load_cell().file.arm, dialect=dialect)
        self.device = arm_emulator(settings, ArmTruth(), 1, 0.0)

        def make(line: SerialLine | None) -> tuple[ArmLogic, ArmDriver]:
            assert line is not None
            return ArmLogic(ArmOptions(home)), make_arm_driver(settings, line)

        def connect(driver: ArmDriver, patience: float, _: object) -> arm_jobs.Reading:
            driver.connect(timeout=patience)
            return arm_jobs.reading_of(driver)

        super().__init__("scara_arm", self.device, make, connect, "arm_state", started=started)
        self.joints = self.listen("joint_states")

    def command(self, tap_id: int, strike: Pose = STRIKE, frame: str = "table") -> None:
        message = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=0.3)
        message.header.frame_id = frame
        message.strike_pose = to_message(strike)
        message.expiry = self.stamp(20.0)
        self.publish("tap_command", message)

    def withdraw(self, tap_id: int) -> None:
        self.publish("tap_command", TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id))

    def clear_view(self, tap_id: int, valid_for: float = 20.0) -> None:
        message = TapCommand(request=TapCommand.CLEAR_VIEW, tap_id=tap_id)
        message.header.frame_id = "table"
        message.expiry = self.stamp(valid_for)
        self.publish("tap_command", message)

    def place(self, tap_id: int) -> None:
        """Command a tap and wait until the arm is in position for it."""
        self.command(tap_id)
        self.wait_state(ArmState.IN_POSITION)

    def retreat(self, tap_id: int) -> None:
        """Withdraw a tap and wait until the arm is idle."""
        self.withdraw(tap_id)
        self.wait_state(ArmState.IDLE)

    def clear_fault(self) -> None:
        assert self.call("~/clear_fault").success
        self.wait_state(ArmState.NOT_HOMED)

    def release_stop(self) -> None:
        self.publish("emergency_stop", Bool(data=False))
        self.run(0.1)

    def home(self) -> None:
        self.ask("~/home")
        self.wait_state(ArmState.IDLE)

    def moving(self) -> bool:
        """Return whether the emulated arm moves now."""
        return self.device.moving(self.now())

    def moves(self, seconds: float) -> bool:
        """Return whether the emulated arm moves at any time in the next ``seconds`` s."""
        end = self.now() + seconds
        moved = False
        while self.now() < end:
            moved = moved or self.moving()
            self.run(0.01)
        return moved


@pytest.fixture
def cell(request: pytest.FixtureRequest) -> Cell:
    made = Cell(getattr(request, "param", "grbl"))
    made.wait_state(ArmState.IDLE)
    return made


def test_the_arm_homes_automatically_and_reports_joints_only_afterwards(cell: Cell) -> None:
    unhomed = [s for s in cell.states if s.state in (ArmState.DISCONNECTED, ArmState.NOT_HOMED)]
    assert not any(state.homed for state in unhomed)
    assert cell.last.homed and cell.last.clear_of_camera
    cell.wait(lambda: cell.joints, "joint states")
    park = load_cell().file.arm.park
    assert list(cell.joints[-1].name) == JOINT_NAMES
    assert list(cell.joints[-1].position) == pytest.approx(park, abs=2e-3)


@pytest.mark.parametrize("cell", ["grbl", "marlin"], indirect=True)
def test_a_tap_command_brings_the_tip_to_the_strike_pose_and_back(cell: Cell) -> None:
    cell.place(100)
    assert cell.last.tap_id == 100 and not cell.last.clear_of_camera
    tip = from_message(cell.last.tip_pose)
    assert tip.distance_to(STRIKE) < 0.0005 and abs(tip.rotation_to(STRIKE)) < 0.002
    assert cell.last.tip_pose.position.z == pytest.approx(0.006, abs=2e-4)
    # Compute the arm's true pose by forward kinematics from the emulator's joints, independently of
    # the node's messages.
    configuration = load_cell()
    joints = cell.device.joints(cell.now())
    true = configuration.file.arm.geometry().forward(joints)
    assert (configuration.arm_base @ Pose(true.x, true.y, true.yaw)).distance_to(STRIKE) < 0.0005
    first = cell.last.header.stamp
    cell.wait(lambda: cell.last.header.stamp != first, "read back again and again")
    cell.retreat(100)
    assert cell.last.clear_of_camera and cell.last.tap_id == 0


def test_the_striker_is_lowered_only_at_the_strike_pose(cell: Cell) -> None:
    """The arm raises its quill, travels, and lowers the quill. Below travel height, the tip moves
    only vertically, above its strike pose."""
    configuration = load_cell()
    geometry = configuration.file.arm.geometry()
    cell.command(100)
    low = []
    while cell.last.state != ArmState.IN_POSITION:
        tip = geometry.forward(cell.device.joints(cell.now()))
        if tip.z < configuration.file.arm.travel_height - 0.002:
            low.append((configuration.arm_base @ Pose(tip.x, tip.y, tip.yaw)).distance_to(STRIKE))
        cell.run(0.005)
    assert low and max(low) < 0.001


@pytest.mark.parametrize(
    ("strike", "frame"),
    [
        (STRIKE, "map"),
        (Pose(math.nan, 0.0, 0.0), "table"),
    ],
    ids=["frame", "not finite"],
)
def test_an_invalid_command_moves_nothing(cell: Cell, strike: Pose, frame: str) -> None:
    cell.command(100, strike, frame)
    assert not cell.moves(0.5)
    assert cell.last.state == ArmState.IDLE


def test_an_unreachable_pose_ends_the_tap_with_a_message_and_the_next_tap_is_served(cell):
    cell.command(100, Pose(0.0, -3.0, 0.0))
    cell.wait(lambda: cell.last.error_code == ErrorCode.ARM_OUT_OF_REACH, "the refusal")
    assert "reach" in cell.last.error_msg
    cell.wait_state(ArmState.IDLE)
    assert cell.last.error_code == ErrorCode.ARM_OUT_OF_REACH
    cell.place(101)


def test_a_tap_id_is_served_once(cell: Cell) -> None:
    cell.place(100)
    cell.retreat(100)
    cell.command(100)
    cell.command(99)
    assert not cell.moves(0.5)


@pytest.mark.parametrize("cell", ["grbl", "marlin"], indirect=True)
def test_an_emergency_stop_during_a_move_stops_the_arm_and_requires_homing(cell: Cell) -> None:
    cell.command(100, Pose(0.15, -0.1, 0.0))
    cell.wait(cell.moving, "the arm moves")
    cell.publish("emergency_stop", Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    cell.run(0.2)
    assert not cell.moves(0.5)
    cell.command(101)
    assert not cell.moves(0.5)
    refused = cell.call("~/clear_fault")
    assert (
        not refused.success and "still held; publishers of emergency_stop: probe" in refused.message
    )
    assert cell.last.state == ArmState.STOPPED
    cell.release_stop()
    cell.clear_fault()
    assert not cell.moves(0.3)
    cell.home()
    cell.place(102)


def test_a_withdrawal_without_a_tap_moves_nothing(cell: Cell) -> None:
    """The default id of a message is 0, which must not be taken for a tap."""
    cell.withdraw(0)
    cell.withdraw(7)
    assert not cell.moves(0.5)
    cell.publish("joint_trajectory", a_trajectory(np.array([0.3, 1.0, -0.01, 0.5]), 2.0))
    cell.wait_state(ArmState.MOVING)
    cell.retreat(0)
    cell.wait(
        lambda: np.allclose(cell.joints[-1].position, [0.3, 1.0, -0.01, 0.5], atol=2e-3),
        "the trajectory was not cut off",
    )


def test_only_the_withdrawal_of_the_last_tap_parks_an_idle_arm(cell: Cell) -> None:
    """A second withdrawal of the last tap means that the arm still hides the object. A withdrawal
    of any other tap has no effect."""
    camera = Point(x=0.0, y=0.0, z=0.7)
    cell.publish("camera/pose", PoseStamped(pose=PoseMessage(position=camera)))
    cell.place(100)
    cell.retreat(100)
    for tap_id in (0, 99, 101):
        cell.withdraw(tap_id)
    assert not cell.moves(0.5)
    cell.withdraw(100)
    assert cell.moves(0.5)


def test_the_view_is_cleared_once_per_id_and_only_in_time(cell: Cell) -> None:
    over_the_table = [0.4, 1.3, 0.0, 0.2]
    cell.publish("joint_trajectory", a_trajectory(np.array(over_the_table), 2.0))
    cell.wait_state(ArmState.MOVING)
    cell.wait_state(ArmState.IDLE)
    for tap_id, valid_for, code in (
        (0, 20.0, ErrorCode.COMMAND_INVALID),
        (5, -0.1, ErrorCode.ARM_COMMAND_EXPIRED),
    ):
        cell.clear_view(tap_id, valid_for)
        assert not cell.moves(0.5) and cell.last.error_code == code
    cell.clear_view(5)
    cell.wait_state(ArmState.WITHDRAWING)
    cell.wait_state(ArmState.IDLE)
    assert cell.last.clear_of_camera and cell.last.tap_id == 0 and not cell.last.error_code
    assert not np.allclose(cell.joints[-1].position, over_the_table, atol=0.05)
    cell.clear_view(5)
    assert not cell.moves(0.5) and cell.last.error_code == ErrorCode.COMMAND_REPEATED


def test_an_arm_that_is_not_homed_does_not_clear_the_view() -> None:
    cell = Cell(home=False)
    cell.wait_state(ArmState.NOT_HOMED)
    cell.clear_view(5)
    assert not cell.moves(0.5) and cell.last.state == ArmState.NOT_HOMED


def test_an_inactive_arm_does_not_move(cell: Cell) -> None:
    cell.process.lifecycle(Deactivated())
    cell.wait_state(ArmState.FAULT)
    cell.withdraw(0)
    cell.clear_view(5)
    assert not cell.call("~/home").success
    assert not cell.moves(0.5)


MOTIONS: dict[str, Callable[[Cell], object]] = {
    "home": lambda cell: cell.ask("~/home"),
    "trajectory": lambda cell: cell.publish(
        "joint_trajectory", a_trajectory(np.array([0.3, 1.0, -0.01, 0.5]), 2.0)
    ),
    "tap": lambda cell: cell.command(101),
    "clear view": lambda cell: cell.clear_view(101),
}


@pytest.mark.parametrize("motion", MOTIONS)
def test_a_motion_that_waits_for_the_striker_does_not_begin_after_the_deactivation(cell, motion):
    cell.place(100)
    cell.retreat(100)
    cell.publish("tapper_state", TapperState(tap_id=100, state=TapperState.CHARGED))
    cell.run(0.1)
    MOTIONS[motion](cell)
    cell.run(0.1)
    assert cell.last.state != ArmState.IDLE and not cell.moving()
    cell.process.lifecycle(Deactivated())
    assert not cell.moves(2.0)
    assert cell.last.error_code == ErrorCode.NOT_ACTIVE
    cell.process.lifecycle(Activated())
    cell.wait_state(ArmState.IDLE)


def hold(cell: Cell, tap_id: int, duration: float = 0.25) -> Any:
    return cell.call("hold_still", HoldStill.Request(tap_id=tap_id, duration=duration))


def test_the_arm_stands_still_for_as_long_as_it_promised(cell: Cell) -> None:
    """A withdrawal from any node is delayed until the promise has ended."""
    assert not hold(cell, 100).granted
    cell.place(100)
    assert not hold(cell, 99).granted
    longest = longest_hold(load_cell())
    assert not hold(cell, 100, duration=1.01 * longest).granted
    asked = cell.now()
    answer = hold(cell, 100)
    assert answer.granted and answer.duration == 0.25
    cell.withdraw(100)
    cell.wait(cell.moving, "it withdraws in the end")
    assert cell.now() - asked > 0.25
    cell.wait_state(ArmState.IDLE)


def test_a_tap_outcome_ends_the_promise_to_stand_still(cell: Cell) -> None:
    cell.place(100)
    assert hold(cell, 100).granted
    cell.publish("tapper_state", TapperState(tap_id=100, outcome=TapperState.FIRED))
    cell.wait(lambda: not hold(cell, 100).granted, "the tap is over")


def test_withdrawing_during_a_move_never_reports_in_position(cell: Cell) -> None:
    cell.command(100)
    cell.wait(cell.moving, "the arm moves")
    received = len(cell.states)
    cell.retreat(100)
    assert all(state.state != ArmState.IN_POSITION for state in cell.states[received:])


def a_trajectory(target: np.ndarray, seconds: float) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=target.tolist())
    point.time_from_start.sec = int(seconds)
    return JointTrajectory(joint_names=JOINT_NAMES, points=[point])


def test_a_joint_trajectory_is_followed_for_any_order_of_joint_names(cell: Cell) -> None:
    order = [2, 0, 3, 1]
    target = np.array([0.3, 1.0, -0.01, 0.5])
    message = JointTrajectory(joint_names=[JOINT_NAMES[index] for index in order])
    point = JointTrajectoryPoint(positions=target[order].tolist())
    point.time_from_start.sec = 2
    message.points = [point]
    cell.publish("joint_trajectory", message)
    cell.wait_state(ArmState.MOVING)
    cell.wait_state(ArmState.IDLE)
    cell.wait(
        lambda: np.allclose(cell.joints[-1].position, target, atol=2e-3), "the target is reported"
    )
    assert not cell.last.clear_of_camera


BAD_TRAJECTORIES: dict[str, tuple[list[str], list[tuple[list[float], float]], str]] = {
    "three joints": (JOINT_NAMES[:3], [([0.0, 0.0, 0.0], 1.0)], "its joints are"),
    "a name twice": (["shoulder", *JOINT_NAMES[:3]], [([0.0] * 4, 1.0)], "its joints are"),
    "no points": (JOINT_NAMES, [], "0 points"),
    "NaN": (JOINT_NAMES, [([0.0, math.nan, 0.0, 0.0], 1.0)], "four finite"),
    "two positions": (JOINT_NAMES, [([0.0, 0.0], 1.0)], "four finite"),
    "beyond a limit": (
        JOINT_NAMES,
        [([0.3, 1.0, -0.01, 0.5], 1.0), ([3.0, 1.0, -0.01, 0.5], 2.0)],
        "171.89 deg is outside -131.78 to 131.78 deg",
    ),
    "back in time": (
        JOINT_NAMES,
        [([0.3, 1.0, -0.01, 0.5], 2.0), ([0.2, 1.0, -0.01, 0.5], 1.0)],
        "point 2 is due at 1 s, but must be later than 2 s",
    ),
}


def test_an_invalid_trajectory_is_refused_with_a_message_and_moves_nothing(cell: Cell) -> None:
    for names, points, words in BAD_TRAJECTORIES.values():
        message = JointTrajectory(joint_names=names)
        for positions, at in points:
            point = JointTrajectoryPoint(positions=positions)
            point.time_from_start.sec = int(at)
            message.points.append(point)
        cell.publish("joint_trajectory", message)
        cell.wait(lambda w=words: w in cell.last.error_msg, words)
        assert cell.last.error_code == ErrorCode.TRAJECTORY_INVALID
    assert not cell.moves(0.3)
    assert cell.last.state == ArmState.IDLE
    cell.place(100)
    assert cell.last.error_code == 0


def test_foreign_clients_on_the_bus_do_not_disturb_a_tap(cell: Cell) -> None:
    cell.command(100)
    cell.wait_state(ArmState.MOVING)
    cell.command(999, Pose(0.1, 0.1, 0.0))
    cell.withdraw(999)
    cell.ask("~/home")
    cell.ask("~/clear_fault")
    foreign = a_trajectory(np.array([0.3, 1.0, -0.01, 0.5]), 2.0)
    cell.publish("joint_trajectory", foreign)
    cell.wait_state(ArmState.IN_POSITION)
    cell.publish("joint_trajectory", foreign)
    assert not cell.moves(0.5)
    assert cell.last.tap_id == 100 and cell.last.error_code == 0
    assert from_message(cell.last.tip_pose).distance_to(STRIKE) < 0.0005
    cell.retreat(100)
    cell.command(101)
    cell.wait_state(ArmState.MOVING)


def test_a_deactivated_arm_stops_and_reports_what_it_needs(cell: Cell) -> None:
    cell.command(100, Pose(0.15, -0.1, 0.0))
    cell.wait_state(ArmState.MOVING)
    cell.process.lifecycle(Deactivated())
    cell.wait_state(ArmState.FAULT)
    assert cell.last.error_code == ErrorCode.NOT_ACTIVE and cell.last.tap_id == 0
    assert not cell.moves(0.5)
    cell.command(101)
    assert not cell.moves(0.3)
    cell.process.lifecycle(Activated())
    cell.wait_state(ArmState.IDLE)
    cell.place(102)


def test_a_stop_survives_a_node_restart_and_prevents_homing(cell: Cell) -> None:
    """After a stop, an arm whose node was killed and restarted must not home by itself."""
    assert cell.call("~/stop").success
    cell.wait_state(ArmState.STOPPED)
    cell.process.kill()
    cell.run(1.0)
    cell.process.start()
    assert not cell.moves(3.0)
    assert cell.last.state == ArmState.STOPPED
    cell.clear_fault()
    assert not cell.moves(0.5)


def test_the_arm_homes_automatically_only_if_an_option_is_set() -> None:
    cell = Cell(home=False)
    cell.wait_state(ArmState.NOT_HOMED)
    assert not cell.moves(1.0)
    assert cell.call("~/home").success
    cell.wait_state(ArmState.IDLE)


@pytest.mark.parametrize("cell", ["grbl", "marlin"], indirect=True)
def test_a_stop_while_the_port_is_away_is_sent_as_soon_as_the_port_is_back(cell: Cell) -> None:
    assert cell.line is not None
    target = a_trajectory(np.array([-0.5, 1.0, -0.01, 0.5]), 20.0)
    cell.publish("joint_trajectory", target)
    cell.wait(cell.moving, "the arm moves")
    cell.run(0.5)
    cell.line.layer.hang_up(cell.now(), 1.0)
    cell.line.schedule()
    assert cell.call("~/stop").success
    cell.run(0.9)
    assert cell.moving() and cell.last.state == ArmState.STOPPED
    cell.run(0.6)
    assert not cell.moves(0.5)
    assert cell.last.state == ArmState.STOPPED and not cell.last.homed
    cell.clear_fault()
    cell.home()


def stop_and_leave(cell: Cell) -> None:
    """A panel asserts its stop and vanishes."""
    cell.network.publish("panel", "emergency_stop", Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    cell.network.leave("panel")


def test_a_stop_source_lost_while_active_requires_a_confirmation(cell: Cell) -> None:
    """If the panel that stopped the cell disappears, a person must confirm that they have checked
    it before the stop can be cleared."""
    stop_and_leave(cell)
    cell.run(0.5)
    first = cell.call("~/clear_fault")
    assert not first.success and "disappeared without releasing it" in first.message
    assert cell.last.state == ArmState.STOPPED
    cell.clear_fault()


def test_a_vanished_stop_source_is_remembered_until_the_reset(cell: Cell) -> None:
    """The confirmation came too late, so the second refusal must name the publisher again."""
    stop_and_leave(cell)
    cell.publish("emergency_stop", Bool(data=False))
    cell.run(0.5)
    for _ in range(2):
        refused = cell.call("~/clear_fault")
        assert not refused.success and "(panel) disappeared" in refused.message
        cell.run(CONFIRM_WITHIN_S + 1.0)
    assert cell.last.state == ArmState.STOPPED


def test_a_second_request_to_clear_before_the_first_is_answered_is_no_confirmation(cell):
    stop_and_leave(cell)
    cell.run(0.5)
    cell.ask("~/clear_fault")
    cell.run(0.1)
    second = cell.call("~/clear_fault")
    assert not second.success and "disappeared without releasing it" in second.message
    assert cell.last.state == ArmState.STOPPED
    cell.clear_fault()


def test_a_restart_does_not_replace_the_confirmation_of_a_vanished_stop_source(cell: Cell) -> None:
    """After the restart, another panel publishes its level False."""
    stop_and_leave(cell)
    cell.process.kill()
    cell.process.start()
    cell.run(3.0)
    cell.wait_state(ArmState.STOPPED)
    cell.publish("emergency_stop", Bool(data=False))
    cell.run(0.1)
    first = cell.call("~/clear_fault")
    assert not first.success and "restarted" in first.message
    assert cell.last.state == ArmState.STOPPED
    cell.clear_fault()


def test_a_stop_published_before_the_node_started_prevents_homing() -> None:
    cell = Cell(started=False)
    cell.publish("emergency_stop", Bool(data=True))
    cell.run(1.0)
    cell.process.start()
    assert not cell.moves(3.0)
    cell.wait_state(ArmState.STOPPED)
    cell.release_stop()
    cell.clear_fault()
    assert not cell.moves(0.3)


def test_a_controller_asleep_when_the_node_starts_can_be_cleared() -> None:
    cell = Cell(home=False, started=False)
    assert isinstance(cell.device, GrblEmulator)
    cell.device.enter_sleep(0.0)
    cell.process.start()
    cell.wait(lambda: cell.states and cell.last.error_code == ErrorCode.ARM_ALARM, "the refusal")
    assert "asleep" in cell.last.error_msg and "then clear" in cell.last.error_msg
    cell.clear_fault()
    assert cell.call("~/home").success
    cell.wait_state(ArmState.IDLE)
