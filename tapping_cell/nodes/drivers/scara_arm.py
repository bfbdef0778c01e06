"""Node of the arm: hosts ``logic.arm`` with the arm's driver."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TransformStamped

from tapping_cell import messages
from tapping_cell.configuration.arm_assembly import joint_accelerations, make_arm_driver
from tapping_cell.configuration.cell import ArmSection
from tapping_cell.configuration.schema import quantity, text
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.link_frames import LINKS, LinkFrame, link_frames
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.hardware.serial_transport import SerialTransport
from tapping_cell.logic import arm_jobs, enabling
from tapping_cell.logic.arm import ArmLogic, ArmOptions
from tapping_cell.logic.arm_states import State
from tapping_cell.logic.frames import TABLE
from tapping_cell.nodes.cell_node import COMMAND, LATCHED
from tapping_cell.nodes.cell_parameters import ObjectParameters
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.drivers.driver_node import DriverNode, run_driver
from tapping_cell.nodes.drivers.trajectory_link import RosTrajectoryLink
from tapping_cell.nodes.frame_broadcaster import FrameBroadcaster, transform
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class Parameters(ObjectParameters):
    """Parameters of scara_arm."""

    port: str = text(
        "path of the arm's serial port; if empty, the one in the cell file", default=""
    )
    home_on_activate: bool = text(
        "home automatically when activated, if homing needs no operator; only for a cell that "
        "nobody can reach into",
        default=False,
    )
    state_rate: float = quantity("rate of arm_state", "Hz", 1.0, 200.0, default=20.0)
    set_up: bool = text(
        "set-up mode for commissioning and the first taps: move at a quarter of the speed and "
        "only while an enabling device is held",
        default=False,
    )
    withdraw_until_seen: bool = text(
        "after a tap, withdraw only until the camera sees the object; if false, withdraw "
        "to the park pose",
        default=True,
    )
    link_frames: bool = text(
        "publish the arm's links on /tf; set to false if robot_state_publisher does", default=True
    )


class ScaraArm(DriverNode[Parameters, ArmDriver]):
    """See the module's docstring."""

    logic: ArmLogic

    def __init__(self) -> None:
        super().__init__("scara_arm", Parameters, make_logic)
        self.host.publishes(messages.ArmState, "arm_state", LATCHED)
        self.host.publishes(messages.JointState, "joint_states", 10)
        self.host.subscribes(messages.TapCommand, "tap_command", COMMAND)
        self.host.subscribes(messages.JointTrajectory, "joint_trajectory", COMMAND)
        self.host.subscribes(messages.TapperState, "tapper_state", LATCHED)
        self.host.subscribes(messages.PoseStamped, "camera/pose", LATCHED)
        self.host.subscribes(messages.Bool, enabling.TOPIC, COMMAND)
        self.host.subscribes(messages.PlanState, "plan_state", LATCHED)
        self.host.serves(messages.Trigger, "~/home")
        self.host.serves(messages.Jog, "~/jog")
        self.host.serves(messages.HoldStill, "hold_still")
        self._broadcaster = FrameBroadcaster(self, moving=self.settings.link_frames)
        self._geometry = ScaraGeometry()
        if self._broadcaster.is_open and self.settings.link_frames:
            self.host.observes("joint_states", self._send_links)

    def configure(self) -> None:
        """Read the cell file, open the port and identify the controller."""
        cell = self.settings.load_cell()
        arm = cell.arm
        self._send_base(arm)
        if arm.ros2_control is None:
            port = str(self.port_path(self.settings.port or arm.port))
            driver = make_arm_driver(arm, SerialTransport(port, arm.baud))
        else:
            port = arm.ros2_control.controller
            accelerations = joint_accelerations(arm)
            link = self.link_to(
                arm.ros2_control, lambda section: RosTrajectoryLink(self, section, accelerations)
            )
            driver = make_arm_driver(arm, link)
        firmware = self.connect(driver, port, cell, lambda _: arm_jobs.reading_of(driver))
        for remark in firmware.remarks:
            self.get_logger().warning(remark)

    def health(self) -> tuple[bytes, str, dict[str, object]]:
        """Report port, firmware, homing and counters."""
        driver, (code, sentence) = self.driver, self.logic.error
        if driver is None:
            return DiagnosticStatus.WARN, sentence, {}
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
        if code:
            refused = self.logic.state is State.IDLE
            return (DiagnosticStatus.WARN if refused else DiagnosticStatus.ERROR), sentence, values
        return DiagnosticStatus.OK, "ok", values

    def _send_base(self, arm: ArmSection) -> None:
        x, y, yaw = arm.base
        now = self.get_clock().now().to_msg()
        frames = [transform(TABLE, LINKS[0], to_message(Pose(x, y, yaw)), now)]
        self._geometry = arm.geometry()
        if self.settings.link_frames:
            tip = link_frames(self._geometry, Joints(0.0, 0.0, 0.0, 0.0))[-1]
            frames.append(_link_transform(tip, now))
        self._broadcaster.send_fixed(frames)

    def _send_links(self, state: messages.JointState) -> None:
        links = link_frames(self._geometry, Joints(*state.position))[:-1]
        stamp = Time(sec=state.header.stamp.sec, nanosec=state.header.stamp.nanosec)
        self._broadcaster.send(_link_transform(link, stamp) for link in links)


def _link_transform(frame: LinkFrame, stamp: Time) -> TransformStamped:
    pose = to_message(Pose(frame.x, frame.y, frame.yaw), frame.z)
    return transform(frame.parent, frame.link, pose, stamp)


def make_logic(parameters: Parameters) -> ArmLogic:
    """Return the arm's state machine for these parameters."""
    return ArmLogic(
        ArmOptions(
            parameters.home_on_activate,
            parameters.state_rate,
            parameters.set_up,
            parameters.withdraw_until_seen,
        )
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_driver(ScaraArm, arguments)


if __name__ == "__main__":
    sys.exit(main())
