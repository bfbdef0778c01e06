"""The arm's node: homed before it moves, in position only by read-back, withdrawn when told."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import Bench, bench
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, StopState, TapCommand, TapperState
from tapping_cell_msgs.srv import HoldStill
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.nodes.drivers.scara_arm import ScaraArm
from tapping_cell.se2 import Pose
from tapping_cell.simulation.devices import arm_emulator
from tapping_cell.simulation.grbl_emulator import GrblEmulator
from tapping_cell.simulation.marlin_emulator import MarlinEmulator
from tapping_cell.simulation.pseudo_terminal import PseudoTerminal
from tapping_cell.simulation.truth import ArmTruth

STRIKE = Pose(-0.08, 0.02, 0.3)
JOINT_NAMES = ["shoulder", "elbow", "quill", "tool"]


@dataclass
class Cell:
    """The node, its emulated controller, and hands to play the planner."""

    bench: Bench
    device: GrblEmulator | MarlinEmulator
    terminal: PseudoTerminal
    states: list[ArmState]
    joints: list[JointState]
    arm: ScaraArm

    def __post_init__(self) -> None:
        node = self.bench.probe
        assert node is not None
        self.node = node
        self.commands = node.create_publisher(TapCommand, "tap_command", COMMAND)
        self.stop = node.create_publisher(Bool, "emergency_stop", LATCHED)
        self.trajectory = node.create_publisher(JointTrajectory, "joint_trajectory", COMMAND)
        self.services = {
            name: node.create_client(Trigger, f"scara_arm/{name}")
            for name in ("home", "stop", "clear_fault")
        }
        self.services["hold_still"] = node.create_client(HoldStill, "hold_still")

    @property
    def last(self) -> ArmState:
        return self.states[-1]

    def wait_state(self, state: int) -> None:
        self.bench.wait(lambda: self.states and self.last.state == state, f"state {state}")

    def command(self, tap_id: int, strike: Pose = STRIKE, frame: str = "table") -> None:
        message = TapCommand(request=TapCommand.TAP, tap_id=tap_id, striker_speed=0.3)
        message.header.frame_id = frame
        message.strike_pose = to_message(strike)
        message.expiry = (self.node.get_clock().now() + Duration(seconds=20)).to_msg()
        self.commands.publish(message)

    def withdraw(self, tap_id: int) -> None:
        self.commands.publish(TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id))

    def call(self, service: str, request: object = None) -> Any:
        """The answer of one of the arm's services."""
        future = self.services[service].call_async(request or Trigger.Request())
        self.bench.wait(future.done, f"{service} answers")
        return future.result()

    def moving(self) -> bool:
        """Whether the emulated arm moves now."""
        with self.terminal.lock:
            return self.device.moving(time.monotonic())

    def moves(self, seconds: float) -> bool:
        """Whether the emulated arm moves at any time in the next seconds."""
        end = time.monotonic() + seconds
        moved = False
        while time.monotonic() < end:
            moved = moved or self.moving()
            time.sleep(0.01)
        return moved


@contextmanager
def arm_cell(folder: Path, dialect: str = "grbl", **parameters: object) -> Iterator[Cell]:
    shutil.copytree(shared_folder(), folder / "config")
    cell_file = folder / "config" / "cell.yaml"
    cell_file.write_text(cell_file.read_text().replace("dialect: grbl", f"dialect: {dialect}"))
    settings = load_cell(cell_file).file.arm
    device = arm_emulator(settings, ArmTruth(), 1, time.monotonic())
    path = folder / "arm"
    nodes: list[ScaraArm] = []

    def make() -> list[ScaraArm]:
        nodes.append(ScaraArm())
        return nodes

    given = {"port": path, "cell_file": cell_file, "home_on_activate": True} | parameters
    with PseudoTerminal(device, path) as terminal, bench(make, {"scara_arm": given}) as b:
        made = Cell(
            b,
            device,
            terminal,
            b.listen(ArmState, "arm_state", LATCHED),
            b.listen(JointState, "joint_states"),
            nodes[0],
        )
        b.wait(
            lambda: (
                made.commands.get_subscription_count() == 1
                and all(service.service_is_ready() for service in made.services.values())
            ),
            "the node listens",
        )
        yield made


@pytest.fixture
def cell(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Cell]:
    with arm_cell(tmp_path, getattr(request, "param", "grbl")) as made:
        made.wait_state(ArmState.IDLE)
        yield made


def test_it_homes_by_itself_and_reports_joints_only_then(cell: Cell) -> None:
    unhomed = [s for s in cell.states if s.state in (ArmState.DISCONNECTED, ArmState.NOT_HOMED)]
    assert not any(state.homed for state in unhomed)
    assert cell.last.homed and cell.last.clear_of_camera
    cell.bench.wait(lambda: cell.joints, "joint states")
    park = load_cell().file.arm.park
    assert list(cell.joints[-1].name) == JOINT_NAMES
    assert list(cell.joints[-1].position) == pytest.approx(park, abs=2e-3)


@pytest.mark.parametrize("cell", ["grbl", "marlin"], indirect=True)
def test_a_tap_command_brings_the_tip_to_the_strike_pose_and_back(cell: Cell) -> None:
    cell.command(100)
    cell.wait_state(ArmState.IN_POSITION)
    assert cell.last.tap_id == 100 and not cell.last.clear_of_camera
    tip = from_message(cell.last.tip_pose)
    assert tip.distance_to(STRIKE) < 0.0005 and abs(tip.rotation_to(STRIKE)) < 0.002
    assert cell.last.tip_pose.position.z == pytest.approx(0.006, abs=2e-4)
    # Where the arm truly is, by the emulator and forward kinematics, not by what it says.
    configuration = load_cell()
    with cell.terminal.lock:
        joints = cell.device.joints(time.monotonic())
    true = configuration.file.arm.geometry().forward(joints)
    assert (configuration.arm_base @ Pose(true.x, true.y, true.yaw)).distance_to(STRIKE) < 0.0005
    first = cell.last.header.stamp
    cell.bench.wait(lambda: cell.last.header.stamp != first, "read back again and again")
    cell.withdraw(100)
    cell.wait_state(ArmState.IDLE)
    assert cell.last.clear_of_camera and cell.last.tap_id == 0


def test_the_striker_is_lowered_only_at_its_place(cell: Cell) -> None:
    """Raise, travel, lower: below travel height the tip is over the strike pose alone."""
    configuration = load_cell()
    geometry = configuration.file.arm.geometry()
    cell.command(100)
    low = []
    while cell.last.state != ArmState.IN_POSITION:
        with cell.terminal.lock:
            tip = geometry.forward(cell.device.joints(time.monotonic()))
        if tip.z < configuration.file.arm.travel_height - 0.002:
            low.append((configuration.arm_base @ Pose(tip.x, tip.y, tip.yaw)).distance_to(STRIKE))
        time.sleep(0.005)
    assert low and max(low) < 0.001


@pytest.mark.parametrize(
    ("strike", "frame"),
    [
        (STRIKE, "map"),
        (Pose(math.nan, 0.0, 0.0), "table"),
    ],
    ids=["frame", "not finite"],
)
def test_a_bad_command_moves_nothing(cell: Cell, strike: Pose, frame: str) -> None:
    cell.command(100, strike, frame)
    assert not cell.moves(0.5)
    assert cell.last.state == ArmState.IDLE


def test_a_pose_out_of_reach_is_a_worded_fault_and_moves_nothing(cell: Cell) -> None:
    cell.command(100, Pose(0.0, -3.0, 0.0))
    cell.wait_state(ArmState.FAULT)
    assert cell.last.error_code == ErrorCode.ARM_OUT_OF_REACH
    assert "reach" in cell.last.error_msg
    assert not cell.moves(0.3)


def test_a_tap_id_is_served_once(cell: Cell) -> None:
    cell.command(100)
    cell.wait_state(ArmState.IN_POSITION)
    cell.withdraw(100)
    cell.wait_state(ArmState.IDLE)
    cell.command(100)
    cell.command(99)
    assert not cell.moves(0.5)


@pytest.mark.parametrize("cell", ["grbl", "marlin"], indirect=True)
def test_an_emergency_stop_stops_in_mid_move_and_asks_for_homing(cell: Cell) -> None:
    cell.command(100, Pose(0.15, -0.1, 0.0))
    cell.bench.wait(cell.moving, "the arm moves")
    cell.stop.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    time.sleep(0.2)
    assert not cell.moves(0.5)
    cell.command(101)
    assert not cell.moves(0.5)
    refused = cell.call("clear_fault")
    assert (
        not refused.success
        and "still held; publishers of emergency_stop: /probe" in refused.message
    )
    assert cell.last.state == ArmState.STOPPED
    cell.stop.publish(Bool(data=False))
    time.sleep(0.1)
    assert cell.call("clear_fault").success
    cell.wait_state(ArmState.NOT_HOMED)
    assert not cell.moves(0.3)
    cell.services["home"].call_async(Trigger.Request())
    cell.wait_state(ArmState.IDLE)
    cell.command(102)
    cell.wait_state(ArmState.IN_POSITION)


def test_a_stop_outlives_its_node_and_homes_nothing(tmp_path: Path) -> None:
    """S5: killed and started again after a stop, the arm must not home by itself."""
    with arm_cell(tmp_path) as cell:
        cell.wait_state(ArmState.IDLE)
        assert cell.call("stop").success
        cell.wait_state(ArmState.STOPPED)
    shutil.rmtree(tmp_path / "config")
    with arm_cell(tmp_path) as cell:
        cell.wait_state(ArmState.STOPPED)
        assert not cell.moves(1.0)
        assert cell.call("clear_fault").success
        cell.wait_state(ArmState.NOT_HOMED)
        assert not cell.moves(0.5)


def test_nothing_homes_by_itself_unless_a_parameter_says_so(tmp_path: Path) -> None:
    with arm_cell(tmp_path, home_on_activate=False) as cell:
        cell.wait_state(ArmState.NOT_HOMED)
        assert not cell.moves(1.0)
        assert cell.call("home").success
        cell.wait_state(ArmState.IDLE)


def test_a_source_that_vanished_while_it_held_asks_for_a_confirmation(cell: Cell) -> None:
    """S4: who clears must have seen what became of the panel that stopped the cell."""
    panel = Node("panel")
    lost = panel.create_publisher(Bool, "emergency_stop", LATCHED)
    cell.bench.wait(lambda: lost.get_subscription_count() >= 1, "the panel is known")
    lost.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    panel.destroy_node()
    time.sleep(0.5)
    first = cell.call("clear_fault")
    assert not first.success and "vanished without releasing it" in first.message
    assert cell.last.state == ArmState.STOPPED
    assert cell.call("clear_fault").success
    cell.wait_state(ArmState.NOT_HOMED)


def test_the_stops_that_hold_are_told_to_late_joiners(cell: Cell) -> None:
    cell.stop.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    heard = cell.bench.listen(StopState, "scara_arm/stop_state", LATCHED)
    cell.bench.wait(lambda: heard, "the level is told")
    assert heard[-1].stopped and list(heard[-1].sources) == ["emergency_stop"]
    assert "release the emergency stop" in heard[-1].error_msg


def test_a_withdrawal_of_no_tap_moves_nothing(cell: Cell) -> None:
    """S6: the default id of a message is 0."""
    cell.withdraw(0)
    cell.withdraw(7)
    assert not cell.moves(0.5)
    cell.trajectory.publish(a_trajectory(np.array([0.3, 1.0, -0.01, 0.5]), 2.0))
    cell.wait_state(ArmState.MOVING)
    cell.withdraw(0)
    cell.wait_state(ArmState.IDLE)
    cell.bench.wait(
        lambda: np.allclose(cell.joints[-1].position, [0.3, 1.0, -0.01, 0.5], atol=2e-3),
        "the trajectory was not cut off",
    )


def test_an_inactive_arm_is_still(cell: Cell) -> None:
    cell.arm.trigger_deactivate()
    cell.wait_state(ArmState.FAULT)
    cell.withdraw(0)
    assert not cell.call("home").success
    assert not cell.moves(0.5)


def hold(cell: Cell, tap_id: int, duration: float = 0.25) -> Any:
    return cell.call("hold_still", HoldStill.Request(tap_id=tap_id, duration=duration))


def test_the_arm_stands_still_for_as_long_as_it_promised(cell: Cell) -> None:
    """S1: a withdrawal, whoever sends it, waits for the promise to end."""
    assert not hold(cell, 100).granted
    cell.command(100)
    cell.wait_state(ArmState.IN_POSITION)
    assert not hold(cell, 99).granted
    assert not hold(cell, 100, duration=0.3).granted
    asked = time.monotonic()
    answer = hold(cell, 100)
    assert answer.granted and answer.duration == 0.25
    cell.withdraw(100)
    cell.bench.wait(cell.moving, "it withdraws in the end")
    assert time.monotonic() - asked > 0.25
    cell.wait_state(ArmState.IDLE)


def test_an_outcome_ends_the_promise(cell: Cell) -> None:
    tapper = cell.node.create_publisher(TapperState, "tapper_state", LATCHED)
    cell.command(100)
    cell.wait_state(ArmState.IN_POSITION)
    assert hold(cell, 100).granted
    tapper.publish(TapperState(tap_id=100, outcome=TapperState.FIRED))
    cell.bench.wait(lambda: not hold(cell, 100).granted, "the tap is over")


def test_withdrawing_in_mid_move_never_reports_in_position(cell: Cell) -> None:
    cell.command(100)
    cell.bench.wait(cell.moving, "the arm moves")
    heard = len(cell.states)
    cell.withdraw(100)
    cell.wait_state(ArmState.IDLE)
    assert all(state.state != ArmState.IN_POSITION for state in cell.states[heard:])


def a_trajectory(target: np.ndarray, seconds: float) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=target.tolist())
    point.time_from_start.sec = int(seconds)
    return JointTrajectory(joint_names=JOINT_NAMES, points=[point])


def test_a_joint_trajectory_is_followed_in_any_order_of_names(cell: Cell) -> None:
    order = [2, 0, 3, 1]
    target = np.array([0.3, 1.0, -0.01, 0.5])
    message = JointTrajectory(joint_names=[JOINT_NAMES[index] for index in order])
    point = JointTrajectoryPoint(positions=target[order].tolist())
    point.time_from_start.sec = 2
    message.points = [point]
    cell.bench.wait(lambda: cell.trajectory.get_subscription_count() == 1, "the node listens")
    cell.trajectory.publish(message)
    cell.wait_state(ArmState.MOVING)
    cell.wait_state(ArmState.IDLE)
    cell.bench.wait(
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
        "point 2 is due at 1 s, the one before at 2 s",
    ),
}


def test_a_bad_trajectory_is_refused_in_words_and_moves_nothing(cell: Cell) -> None:
    cell.bench.wait(lambda: cell.trajectory.get_subscription_count() == 1, "the node listens")
    for names, points, words in BAD_TRAJECTORIES.values():
        message = JointTrajectory(joint_names=names)
        for positions, at in points:
            point = JointTrajectoryPoint(positions=positions)
            point.time_from_start.sec = int(at)
            message.points.append(point)
        cell.trajectory.publish(message)
        cell.bench.wait(lambda w=words: w in cell.last.error_msg, words)
        assert cell.last.error_code == ErrorCode.TRAJECTORY_INVALID
    assert not cell.moves(0.3)
    assert cell.last.state == ArmState.IDLE
    cell.command(100)
    cell.wait_state(ArmState.IN_POSITION)
    assert cell.last.error_code == 0


def test_foreign_clients_on_the_bus_do_not_disturb_a_tap(cell: Cell) -> None:
    cell.command(100)
    cell.wait_state(ArmState.MOVING)
    cell.command(999, Pose(0.1, 0.1, 0.0))
    cell.withdraw(999)
    cell.services["home"].call_async(Trigger.Request())
    cell.services["clear_fault"].call_async(Trigger.Request())
    cell.trajectory.publish(JointTrajectory(joint_names=JOINT_NAMES))
    cell.wait_state(ArmState.IN_POSITION)
    assert cell.last.tap_id == 100 and cell.last.error_code == 0
    assert from_message(cell.last.tip_pose).distance_to(STRIKE) < 0.0005
    cell.withdraw(100)
    cell.wait_state(ArmState.IDLE)
    cell.command(101)
    cell.wait_state(ArmState.MOVING)


def test_a_deactivated_arm_comes_to_a_stand_and_says_what_it_needs(cell: Cell) -> None:
    cell.command(100, Pose(0.15, -0.1, 0.0))
    cell.wait_state(ArmState.MOVING)
    cell.arm.trigger_deactivate()
    cell.wait_state(ArmState.FAULT)
    assert cell.last.error_code == ErrorCode.NOT_ACTIVE and cell.last.tap_id == 0
    assert not cell.moves(0.5)
    cell.command(101)
    assert not cell.moves(0.3)
    cell.arm.trigger_activate()
    cell.wait_state(ArmState.IDLE)
    cell.command(102)
    cell.wait_state(ArmState.IN_POSITION)


def test_a_stop_published_before_the_node_was_there_keeps_it_from_homing(tmp_path: Path) -> None:
    with arm_cell(tmp_path, autostart=False) as cell:
        cell.stop.publish(Bool(data=True))
        cell.bench.wait(lambda: cell.arm.stopped, "the stop is heard")
        cell.arm.trigger_configure()
        cell.arm.trigger_activate()
        assert not cell.moves(1.0)
        cell.wait_state(ArmState.STOPPED)
        cell.stop.publish(Bool(data=False))
        time.sleep(0.1)
        assert cell.call("clear_fault").success
        cell.wait_state(ArmState.NOT_HOMED)
        assert not cell.moves(0.3)


@pytest.mark.parametrize("cell", ["marlin"], indirect=True)
def test_diagnostics_tell_of_port_firmware_homing_and_the_line(cell: Cell) -> None:
    heard = cell.bench.listen(DiagnosticArray, "/diagnostics")

    def values() -> dict[str, str]:
        ours = [s for m in heard for s in m.status if s.name == "/scara_arm"]
        return {entry.key: entry.value for entry in ours[-1].values} if ours else {}

    cell.bench.wait(values, "diagnostics")
    told = values()
    assert told["port"] == str(cell.terminal.path)
    assert told["firmware"].startswith("Marlin 2.1") and told["homed"] == "True"
    assert {"retries", "resends", "timeouts", "bad lines", "last error"} <= set(told)


def test_a_pulled_cable_is_noticed_and_mended(cell: Cell) -> None:
    cell.terminal.hang_up()
    cell.wait_state(ArmState.DISCONNECTED)
    assert cell.last.error_code == ErrorCode.ARM_NOT_CONNECTED
    cell.terminal.plug_in()
    cell.bench.wait(
        lambda: cell.last.state in (ArmState.IDLE, ArmState.NOT_HOMED), "connected again"
    )
