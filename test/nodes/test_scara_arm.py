"""The arm's node over DDS and a pseudo-terminal: topics, services, life cycle, cable.

The node's decisions are tested in virtual time
(``test/pure/logic/test_arm_with_its_controller.py``).
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import Bench, bench
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, StopState, TapCommand

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes import cell_identity
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
    """The node, its emulated controller, and publishers that replace the planner."""

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
        self.services = {
            name: node.create_client(Trigger, f"scara_arm/{name}")
            for name in ("home", "stop", "clear_fault")
        }

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

    def call(self, service: str) -> Any:
        """Return the answer of one of the arm's services."""
        future = self.services[service].call_async(Trigger.Request())
        self.bench.wait(future.done, f"{service} answers")
        return future.result()

    def moving(self) -> bool:
        """Return whether the emulated arm moves now."""
        with self.terminal.lock:
            return self.device.moving(time.monotonic())

    def moves(self, seconds: float) -> bool:
        """Return whether the emulated arm moves at any time in the next ``seconds`` s."""
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


def test_the_arm_homes_automatically_and_reports_joints_only_afterwards(cell: Cell) -> None:
    unhomed = [s for s in cell.states if s.state in (ArmState.DISCONNECTED, ArmState.NOT_HOMED)]
    assert not any(state.homed for state in unhomed)
    assert cell.last.homed and cell.last.clear_of_camera
    park = pytest.approx(load_cell().file.arm.park, abs=2e-3)
    # Messages on different topics are not ordered: joint states of the motion may arrive after the
    # state that reports its end.
    cell.bench.wait(
        lambda: cell.joints and list(cell.joints[-1].position) == park, "the joints where it parks"
    )
    assert list(cell.joints[-1].name) == JOINT_NAMES


def test_a_tap_command_brings_the_tip_to_the_strike_pose_and_back(cell: Cell) -> None:
    cell.command(100)
    cell.wait_state(ArmState.IN_POSITION)
    assert cell.last.tap_id == 100 and not cell.last.clear_of_camera
    tip = from_message(cell.last.tip_pose)
    assert tip.distance_to(STRIKE) < 0.0005 and abs(tip.rotation_to(STRIKE)) < 0.002
    assert cell.last.tip_pose.position.z == pytest.approx(0.006, abs=2e-4)
    # Compute the arm's true pose from the emulator by forward kinematics, not from the node's
    # messages.
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


def test_an_emergency_stop_during_a_move_stops_the_arm_and_requires_homing(cell: Cell) -> None:
    cell.command(100, Pose(0.15, -0.1, 0.0))
    cell.bench.wait(cell.moving, "the arm moves")
    cell.stop.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    cell.bench.wait(lambda: not cell.moving(), "it rests")
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
    # The stop is released by a message and cleared by a service request, and ROS does not order the
    # two. A request that is processed before the message is refused, so repeat it.
    cell.bench.wait(lambda: cell.call("clear_fault").success, "the stop is cleared")
    cell.wait_state(ArmState.NOT_HOMED)
    assert not cell.moves(0.3)
    cell.services["home"].call_async(Trigger.Request())
    cell.wait_state(ArmState.IDLE)
    cell.command(102)
    cell.wait_state(ArmState.IN_POSITION)


def test_a_stop_survives_a_node_restart_and_prevents_homing(tmp_path: Path) -> None:
    """After a stop, an arm whose node was killed and restarted must not home by itself."""
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


def test_a_stop_source_lost_while_active_requires_a_confirmation(cell: Cell) -> None:
    """If the panel that stopped the cell disappears, a person must confirm that they have checked
    it before the stop can be cleared."""
    panel = Node("panel")
    lost = panel.create_publisher(Bool, "emergency_stop", LATCHED)
    cell.bench.wait(lambda: lost.get_subscription_count() >= 1, "the panel is known")
    lost.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    panel.destroy_node()
    cell.bench.wait(lambda: cell.node.count_publishers("emergency_stop") == 1, "it has vanished")
    first = cell.call("clear_fault")
    assert not first.success and "disappeared without releasing it" in first.message
    assert cell.last.state == ArmState.STOPPED
    assert cell.call("clear_fault").success
    cell.wait_state(ArmState.NOT_HOMED)


def test_a_stop_source_that_does_not_repeat_its_level_requires_a_confirmation(cell: Cell) -> None:
    """Some sources do not repeat their level, so nobody can check whether they still hold the stop.
    The stop of a source that does not repeat its level must remain if another source releases its
    own stop."""
    panel = Node("panel")
    held = panel.create_publisher(Bool, "emergency_stop", COMMAND)
    cell.bench.wait(lambda: held.get_subscription_count() >= 1, "the panel is known")
    held.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    cell.stop.publish(Bool(data=False))

    def released() -> bool:
        return (cell.arm.host.stop_file.recall() or {}).get("asserted") is False

    cell.bench.wait(released, "the other source's release is received")
    first = cell.call("clear_fault")
    assert not first.success and "its last message (/panel)" in first.message
    assert cell.last.state == ArmState.STOPPED
    assert cell.call("clear_fault").success
    cell.wait_state(ArmState.NOT_HOMED)
    panel.destroy_node()


@pytest.mark.parametrize("reliability", ["RELIABLE", "BEST_EFFORT"])
@pytest.mark.parametrize("durability", ["TRANSIENT_LOCAL", "VOLATILE"])
def test_a_stop_is_received_from_a_publisher_with_any_qos_profile(
    cell: Cell, reliability: str, durability: str
) -> None:
    profile = QoSProfile(
        depth=1,
        reliability=ReliabilityPolicy[reliability],
        durability=DurabilityPolicy[durability],
    )
    panel = Node("panel")
    publisher = panel.create_publisher(Bool, "emergency_stop", profile)
    cell.bench.wait(lambda: publisher.get_subscription_count() >= 1, "the arm listens to it")
    publisher.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    panel.destroy_node()


def test_a_stop_is_sent_before_the_graph_is_queried(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    stopped, ask = list[bool](), cell.arm.get_publishers_info_by_topic

    def watch(topic: str) -> Any:
        stopped.append(cell.arm.stopped)
        return ask(topic)

    monkeypatch.setattr(cell.arm, "get_publishers_info_by_topic", watch)
    cell.stop.publish(Bool(data=True))
    cell.bench.wait(lambda: stopped, "the publishers are asked for")
    assert stopped[0]


def test_an_arm_whose_stop_could_not_be_stored_does_not_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the stop is not stored, a restarted node does not know of it."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(cell_identity, "STATE", tmp_path / "file")
    with arm_cell(tmp_path) as cell:
        received = cell.bench.listen(DiagnosticArray, "/diagnostics")
        cell.bench.wait(
            lambda: any("cannot be written" in s.message for m in received for s in m.status),
            "the reason is reported",
        )
        assert not cell.arm.configured and not cell.moving()
        (tmp_path / "file").unlink()
        cell.wait_state(ArmState.IDLE)


def test_active_stops_are_published_to_late_joiners(cell: Cell) -> None:
    cell.stop.publish(Bool(data=True))
    cell.wait_state(ArmState.STOPPED)
    received = cell.bench.listen(StopState, "scara_arm/stop_state", LATCHED)
    cell.bench.wait(lambda: received, "the level is told")
    assert received[-1].stopped and list(received[-1].sources) == ["emergency_stop"]
    assert "release the emergency stop" in received[-1].error_msg


def test_an_inactive_arm_does_not_move(cell: Cell) -> None:
    cell.arm.trigger_deactivate()
    cell.wait_state(ArmState.FAULT)
    cell.withdraw(0)
    assert not cell.call("home").success
    assert not cell.moves(0.5)


@pytest.mark.parametrize("cell", ["marlin"], indirect=True)
def test_diagnostics_report_port_firmware_homing_and_line_quality(cell: Cell) -> None:
    received = cell.bench.listen(DiagnosticArray, "/diagnostics")

    def values() -> dict[str, str]:
        ours = [s for m in received for s in m.status if s.name == "/scara_arm"]
        return {entry.key: entry.value for entry in ours[-1].values} if ours else {}

    cell.bench.wait(values, "diagnostics")
    reported = values()
    assert reported["port"] == str(cell.terminal.path)
    assert reported["firmware"].startswith("Marlin 2.1") and reported["homed"] == "True"
    assert {"retries", "resends", "timeouts", "bad lines", "last error"} <= set(reported)


def test_a_disconnected_cable_is_detected_and_reconnected(cell: Cell) -> None:
    cell.terminal.hang_up()
    cell.wait_state(ArmState.DISCONNECTED)
    assert cell.last.error_code == ErrorCode.ARM_NOT_CONNECTED
    cell.terminal.plug_in()
    cell.bench.wait(
        lambda: cell.last.state in (ArmState.IDLE, ArmState.NOT_HOMED), "connected again"
    )
