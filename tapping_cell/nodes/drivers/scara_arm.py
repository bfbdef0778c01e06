"""The arm's node: tap commands and trajectories in, ``arm_state`` and ``joint_states`` out."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.duration import Duration
from rclpy.time import Time
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from tapping_cell_msgs.msg import ArmState, ErrorCode, TapCommand, TapperState
from trajectory_msgs.msg import JointTrajectory

from tapping_cell.configuration.arm_assembly import make_arm_driver
from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.schema import quantity, text
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import ArmReading, HomingStrategy
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.motion import (
    Waypoint,
    check_limits,
    move_duration,
    strike_path,
    withdraw_path,
)
from tapping_cell.hardware.scara import Joints, TipPose
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.logic.error_codes import of_arm
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.nodes.drivers import tap_commands
from tapping_cell.nodes.drivers.driver_node import DriverNode, answer, run_driver
from tapping_cell.se2 import Pose

RELEASE_GUARD_S = 0.1
"""From saying that it withdraws to moving, where the tapper has not said how the tap ended: longer
than arm_state takes to the tapper and a release takes to end."""
RELEASE_S = 0.03
"""From hearing that the striker was released to moving: longer than a release takes to end."""
READ_PERIOD_S = 0.05
"""Between read-backs while the arm stands: a strike pose is confirmed twenty times a second."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of scara_arm."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    port: str = text("path of the arm's serial port; empty for the cell file's", default="")
    home_on_activate: bool = text("home when activated, where homing needs no person", default=True)
    state_rate: float = quantity("rate of arm_state", "Hz", 1.0, 200.0, default=20.0)


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What the worker knows and the executor publishes."""

    state: int = ArmState.DISCONNECTED
    tap_id: int = 0
    joints: Joints | None = None
    read_at: Time | None = None
    clear_of_camera: bool = False
    expiry: Time | None = None
    error_code: int = ErrorCode.ARM_NOT_CONNECTED
    error_msg: str = "the arm is not connected yet"


class ScaraArm(DriverNode[Parameters, ArmDriver, Snapshot]):
    """See the module's docstring."""

    stopped_state = ArmState.STOPPED
    stopped_trouble = (
        ErrorCode.ARM_STOPPED,
        "the arm was stopped; make the cell safe, call clear_fault, then home",
    )
    fault_states: ClassVar[dict[FaultReason, int]] = {
        FaultReason.DISCONNECTED: ArmState.DISCONNECTED,
        FaultReason.PORT_MISSING: ArmState.DISCONNECTED,
        FaultReason.PORT_BUSY: ArmState.DISCONNECTED,
        FaultReason.NOT_HOMED: ArmState.NOT_HOMED,
        FaultReason.HOMING_FAILED: ArmState.NOT_HOMED,
    }
    fault_state = ArmState.FAULT
    healthy_states = frozenset(
        {
            ArmState.HOMING,
            ArmState.IDLE,
            ArmState.MOVING,
            ArmState.IN_POSITION,
            ArmState.WITHDRAWING,
        }
    )
    idle_period = READ_PERIOD_S

    def __init__(self) -> None:
        super().__init__("scara_arm", Parameters, Snapshot())
        self._cell: Cell | None = None
        self._published = Snapshot()
        self._last_tap_id = 0
        self._ended_tap = (-1, 0.0)
        self._state_publisher = self.create_publisher(ArmState, "arm_state", LATCHED)
        self._joint_publisher = self.create_publisher(JointState, "joint_states", 10)
        self.create_subscription(TapCommand, "tap_command", self._on_tap_command, COMMAND)
        self.create_subscription(JointTrajectory, "joint_trajectory", self._on_trajectory, COMMAND)
        self.create_subscription(TapperState, "tapper_state", self._on_tapper_state, LATCHED)
        self.create_service(Trigger, "~/home", self._on_home)
        self.create_timer(1.0 / self.settings.state_rate, self.publish_state)

    # Life cycle

    def configure(self) -> None:
        """Read the cell file, open the port, identify the controller."""
        cell = load_cell(self.settings.cell_file or None)
        arm = cell.file.arm
        port = str(self.port_path(self.settings.port or arm.port))
        driver = make_arm_driver(arm, SerialTransport(port, arm.baud))
        self._cell = cell
        for remark in self.connect(driver, port).remarks:
            self.get_logger().warning(remark)
        self._set_standing()

    def activate(self) -> None:
        """Home where that needs no person."""
        assert self._cell is not None
        if self.settings.home_on_activate and self._cell.file.arm.homes_alone:
            self.submit(self._home)
        else:
            self.submit(self._set_standing)

    def deactivate(self) -> None:
        """Abandon what is under way; the arm stays where it comes to a stand."""
        self.abandoned.set()
        self.submit(self._stand_inactive)

    def code_of(self, fault: HardwareFault) -> int:
        """The ErrorCode of a fault of the arm."""
        return of_arm(fault)

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Port, firmware, homing and counters."""
        driver, now = self.driver, self.snapshot
        if driver is None:
            return DiagnosticStatus.WARN, now.error_msg, {}
        firmware, counters, line = driver.firmware, driver.counters, driver.line_counters
        values: dict[str, object] = {
            "hardware_id": firmware.name if firmware else "",
            "port": self.port,
            "firmware": f"{firmware.name} {firmware.version}" if firmware else "",
            "remarks": " ".join(firmware.remarks) if firmware else "",
            "homed": driver.homed,
            "moves": counters.moves,
            "retries": counters.retries + line.retries,
            "resends": line.resends,
            "timeouts": line.timeouts,
            "bad lines": line.bad_lines,
            "reconnects": counters.reconnects,
            "stops": counters.stops,
            "last error": counters.last_error,
        }
        if self.defect is not None:
            return DiagnosticStatus.ERROR, f"defect: {self.defect!r}", values
        if now.error_code:
            refused = now.state == ArmState.IDLE
            level = DiagnosticStatus.WARN if refused else DiagnosticStatus.ERROR
            return level, now.error_msg, values
        return DiagnosticStatus.OK, "ok", values

    # Commands

    def _on_tap_command(self, command: TapCommand) -> None:
        if command.request == TapCommand.WITHDRAW:
            if command.tap_id == self.snapshot.tap_id and self.driver is not None:
                self.abandoned.set()
                self.submit(self._withdraw)
            return
        refusal = self._refusal(command)
        if refusal is not None:
            code, sentence = refusal
            self._refuse(code, f"tap {command.tap_id} refused: {sentence}")
            return
        self._last_tap_id = command.tap_id
        self.abandoned.clear()
        self.set(state=ArmState.MOVING, tap_id=command.tap_id, error_code=0, error_msg="")
        pose = from_message(command.strike_pose)
        expiry = Time.from_msg(command.expiry)
        self.submit(lambda: self._place(pose, command.tap_id, expiry))

    def _refusal(self, command: TapCommand) -> tuple[int, str] | None:
        """Why a tap command is not taken; None when it is."""
        now = self.get_clock().now()
        if not self.active:
            return ErrorCode.NOT_ACTIVE, "the node is not active; activate it first"
        if self.stopped or self.snapshot.state != ArmState.IDLE:
            reason = self.snapshot.error_msg or "it is busy"
            return ErrorCode.ARM_BUSY, f"the arm is not idle ({reason})"
        if tap_commands.expired(command, now):
            return ErrorCode.ARM_COMMAND_EXPIRED, "its expiry has passed"
        return tap_commands.refusal(command, now, self._last_tap_id)

    def _refuse(self, code: int, sentence: str) -> None:
        """Say why a command is not taken; an idle arm keeps saying it until the next command."""
        self.get_logger().error(sentence)
        if self.snapshot.state == ArmState.IDLE:
            self.set(error_code=code, error_msg=sentence)

    def _on_tapper_state(self, message: TapperState) -> None:
        over = message.outcome in (TapperState.FIRED, TapperState.NOT_FIRED)
        if over and message.tap_id != self._ended_tap[0]:
            # One assignment, because the worker reads it.
            self._ended_tap = (message.tap_id, time.monotonic())

    def _on_trajectory(self, message: JointTrajectory) -> None:
        if not self.active or self.snapshot.state != ArmState.IDLE:
            code = ErrorCode.ARM_BUSY if self.active else ErrorCode.NOT_ACTIVE
            reason = self.snapshot.error_msg or "busy"
            self._refuse(code, f"trajectory refused: the arm is not idle ({reason})")
            return
        try:
            targets = trajectory_targets(message)
            for target, _ in targets:
                check_limits(self.require().geometry, target)
        except (ValueError, HardwareFault) as error:
            self._refuse(ErrorCode.TRAJECTORY_INVALID, f"trajectory refused: {error}")
            return
        self.abandoned.clear()
        self.set(state=ArmState.MOVING, clear_of_camera=False, error_code=0, error_msg="")
        self.submit(lambda: self._follow_trajectory(targets))

    def _on_home(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self.active or self.driver is None:
            return answer(response, False, "the node is not active; activate it first")
        if self.snapshot.state not in (ArmState.NOT_HOMED, ArmState.IDLE):
            return answer(
                response, False, f"the arm cannot home now: {self.snapshot.error_msg or 'busy'}"
            )
        self.submit(self._home)
        return answer(response, True, "homing has begun; arm_state tells when it is done")

    # Jobs of the worker's thread

    def _home(self) -> None:
        driver, cell = self.require(), self._require_cell()
        self.abandoned.clear()
        self.set(state=ArmState.HOMING, error_code=0, error_msg="")
        driver.home(HomingStrategy(cell.file.arm.homing))
        self._park(driver.read_joints())

    def _place(self, strike: Pose, tap_id: int, expiry: Time) -> None:
        driver, cell = self.require(), self._require_cell()
        arm = cell.file.arm
        tip = cell.arm_base.inverse() @ strike
        path = strike_path(
            driver.geometry,
            driver.read_joints(),
            TipPose(tip.x, tip.y, arm.strike_height, tip.theta),
            arm.motion(),
        )
        self.set(clear_of_camera=False)
        if self._move_along(path, expiry):
            self._take_in(driver.settle(path[-1].joints if path else None))
            if not self.abandoned.is_set():
                self.set(state=ArmState.IN_POSITION, expiry=expiry)
                return
        if not self.abandoned.is_set():
            self._withdraw()

    def _withdraw(self) -> None:
        self.abandoned.clear()
        self.set(state=ArmState.WITHDRAWING, expiry=None)
        # A release that was commanded just before is over when the arm begins to move; once the
        # tapper has said how the tap ended, none can follow.
        ended, heard = self._ended_tap
        over = ended == self.snapshot.tap_id
        due = heard + RELEASE_S if over else time.monotonic() + RELEASE_GUARD_S
        here = self.require().read_joints()  # the arm stands until then: the wait serves to read
        time.sleep(max(due - time.monotonic(), 0.0))
        self._park(here)

    def _park(self, here: Joints) -> None:
        driver, cell = self.require(), self._require_cell()
        path = withdraw_path(driver.geometry, here, cell.file.arm.motion())
        if self._move_along(path):
            self.set(state=ArmState.IDLE, tap_id=0, clear_of_camera=True, expiry=None)

    def _follow_trajectory(self, targets: Sequence[tuple[Joints, float]]) -> None:
        driver = self.require()
        here, before = driver.read_joints(), 0.0
        for target, at in targets:
            fastest = move_duration(driver.geometry, here, target, 1.0)
            speed = min(1.0, fastest / (at - before)) if at > before else 1.0
            if speed > 0 and not self._move_along((Waypoint(target, speed, "trajectory"),)):
                break
            here, before = target, at
        self._take_in(driver.settle(None))
        self.set(state=ArmState.IDLE)

    def _move_along(self, path: Sequence[Waypoint], expiry: Time | None = None) -> bool:
        """Take the waypoints; False where the move was abandoned between two of them."""
        driver = self.require()
        for waypoint in path:
            if self.abandoned.is_set() or (expiry and self.get_clock().now() > expiry):
                return False
            self._take_in(driver.move_to(waypoint.joints, waypoint.speed, via=waypoint.via))
        return not self.abandoned.is_set()

    def _stand_inactive(self) -> None:
        if self.driver is not None and not self.stopped:
            self.set(
                state=ArmState.FAULT,
                tap_id=0,
                expiry=None,
                error_code=ErrorCode.NOT_ACTIVE,
                error_msg="the arm's node is not active; activate it",
            )

    def clear(self) -> None:
        """End a stop or a fault; the arm must be homed afterwards."""
        driver = self.require()
        driver.clear_fault()
        self._set_standing()

    def idle(self) -> None:
        """Between jobs: read back, notice a lost line, open it again."""
        driver = self.require()
        if self.snapshot.state == ArmState.STOPPED:
            return
        if not driver.connected:
            self.reach(driver)
            self._set_standing()
            if not self.active:
                self._stand_inactive()
        self._read()
        expiry = self.snapshot.expiry
        if expiry is not None and self.get_clock().now() > expiry:
            # Nobody came back for this tap: the planner may be gone.
            self._withdraw()

    def _read(self) -> None:
        self._take_in(self.require().read())

    def _take_in(self, reading: ArmReading) -> None:
        """Keep a reading with the time at which it was asked for."""
        driver = self.require()
        if driver.homed:
            age = Duration(seconds=max(driver.now() - reading.stamp, 0.0))
            self.set(joints=reading.joints, read_at=self.get_clock().now() - age)

    def _set_standing(self) -> None:
        """The state of an arm that was just connected or cleared."""
        assert self.driver is not None
        if self.driver.homed:
            self.set(state=ArmState.IDLE, tap_id=0, error_code=0, error_msg="")
        else:
            self.set(
                state=ArmState.NOT_HOMED,
                tap_id=0,
                joints=None,
                error_code=ErrorCode.ARM_NOT_HOMED,
                error_msg="the arm is not homed; call the service home",
            )

    def _require_cell(self) -> Cell:
        assert self._cell is not None
        return self._cell

    # State

    def publish_state(self) -> None:
        """Publish what is known of the arm."""
        now = self.snapshot
        message = ArmState(
            state=now.state,
            tap_id=now.tap_id,
            homed=now.joints is not None,
            clear_of_camera=now.clear_of_camera,
            error_code=now.error_code,
            error_msg=now.error_msg,
        )
        message.header.frame_id = "table"
        message.header.stamp = (now.read_at or self.get_clock().now()).to_msg()
        driver = self.driver
        if now.joints is not None and driver is not None:
            tip = driver.geometry.forward(now.joints)
            planar = self._require_cell().arm_base @ Pose(tip.x, tip.y, tip.yaw)
            message.tip_pose = to_message(planar, tip.z)
        self._state_publisher.publish(message)
        if now.joints is not None and now.read_at != self._published.read_at:
            joints = JointState(name=list(Joints._fields), position=list(now.joints))
            joints.header.stamp = message.header.stamp
            self._joint_publisher.publish(joints)
        self._published = now


def trajectory_targets(message: JointTrajectory) -> list[tuple[Joints, float]]:
    """Joints and time from the start in s of every point; ValueError with what is wrong."""
    names = list(Joints._fields)
    if sorted(message.joint_names) != sorted(names) or not message.points:
        raise ValueError(
            f"its joints are {list(message.joint_names)} with {len(message.points)} points; it"
            f" needs points for {names}"
        )
    order = [list(message.joint_names).index(name) for name in names]
    targets: list[tuple[Joints, float]] = []
    for number, point in enumerate(message.points, start=1):
        if len(point.positions) != len(names) or not all(map(math.isfinite, point.positions)):
            raise ValueError(
                f"point {number} has the positions {list(point.positions)}; it needs four finite"
                " numbers (rad, rad, m, rad)"
            )
        at = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        before = targets[-1][1] if targets else 0.0
        if at < 0 or (targets and at <= before):
            raise ValueError(f"point {number} is due at {at:g} s, the one before at {before:g} s")
        targets.append((Joints(*(point.positions[index] for index in order)), at))
    return targets


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_driver(ScaraArm, arguments)


if __name__ == "__main__":
    sys.exit(main())
