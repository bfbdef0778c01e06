"""Client for arm calibration: moves the arm to postures and measures the marker that it holds.

The verb `calibrate arm --record` uses this client. There is no separate executable for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import NamedTuple

from rclpy.duration import Duration
from rclpy.time import Time
from sensor_msgs.msg import JointState
from tapping_cell_msgs.msg import ArmState, ObjectState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tapping_cell.configuration.cell import Ros2ControlSection
from tapping_cell.hardware.scara import REVOLUTE, Joints
from tapping_cell.nodes.cell_node import COMMAND
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose

ARRIVED = 0.01
"""A posture is reached when every revolute joint is within this angle (rad) of its target."""
MOVE_TIMEOUT_S = 30.0
OBSERVATION_TIMEOUT_S = 10.0
UNSEEN_TIMEOUT_S = 3.0
"""``OBSERVATION_TIMEOUT_S`` is the timeout for an observation of the marker at rest. The wait ends
earlier if the marker has not been visible for ``UNSEEN_TIMEOUT_S``."""
PICTURES = 10
"""Number of images at rest that are fused into an observation."""
_POLL_S = 0.02


class ArmRefused(RuntimeError):
    """The arm did not reach its target, for the reason in the message."""


class Seen(NamedTuple):
    """Measured joint positions and the pose in ``table`` of the marker that the arm holds."""

    joints: Joints
    pose: Pose


class ArmPoseClient(GoalClient):
    """:class:`GoalClient` that moves the arm to postures. Use as a context manager."""

    def __init__(self, namespace: str = "", own_driver: Ros2ControlSection | None = None) -> None:
        """``own_driver``: section of the cell file for an arm with its own ROS driver. The section
        names the joints and the topic of the joint states."""
        super().__init__("arm_pose_client", namespace)
        self._names = own_driver.joints if own_driver else Joints._fields
        self._joints: JointState | None = None
        self._trajectories = self.node.create_publisher(
            JointTrajectory, "joint_trajectory", COMMAND
        )
        topic = own_driver.joint_states if own_driver else "joint_states"
        self.node.create_subscription(JointState, topic, self._on_joints, 10)

    def missing(self) -> list[str]:
        """Return the conditions that still prevent motion of the arm, as text; empty when the arm
        is ready."""
        if self.arm_state is None or self._trajectories.get_subscription_count() == 0:
            return ["the arm's driver is not running"]
        if self.arm_state.state != ArmState.IDLE:
            return [f"the arm is not idle ({self.arm_state.error_msg or 'busy'})"]
        if not self.arm_state.homed:
            return ["the arm is not homed; home the arm"]
        if self.joints() is None:
            return ["the arm's joint positions have not been received yet"]
        if self.object_state is None:
            return ["camera_pose has not reported the object yet"]
        return []

    def joints(self) -> Joints | None:
        """Return the last measured joint positions, or None before the first measurement."""
        if self._joints is None:
            return None
        known = dict(zip(self._joints.name, self._joints.position, strict=True))
        return Joints(*(known[name] for name in self._names))

    def visit(self, target: Joints, speed: float, check: Callable[[], None]) -> Seen | None:
        """Go to a posture at ``speed`` (rad/s of the fastest joint) and take an observation. Return
        None if the camera does not detect the marker at rest there.

        Raises:
            ArmRefused: the arm does not arrive in time, or reports why it does not move.
        """
        sent = self.node.get_clock().now()
        arrived = self.go(target, speed, check)
        seen = self._observe(sent, arrived, check)
        here = self.joints()
        assert here is not None
        return None if seen is None else Seen(here, from_message(seen.pose.pose))

    def go(self, target: Joints, speed: float, check: Callable[[], None]) -> Time:
        """Go to a posture at ``speed`` (rad/s of the fastest joint). Return the time at which the
        measured joints reached the posture.

        Raises:
            ArmRefused: the arm does not arrive in time, or reports why it does not move.
        """
        sent = self.node.get_clock().now()
        self._command(target, speed)
        return self._arrival(target, sent, check)

    def _command(self, target: Joints, speed: float) -> None:
        here = self.joints()
        assert here is not None
        far = max(abs(a - b) for a, b in zip(target, here, strict=True))
        point = JointTrajectoryPoint(positions=list(target))
        point.time_from_start = Duration(seconds=max(far / speed, 0.5)).to_msg()
        message = JointTrajectory(joint_names=list(Joints._fields), points=[point])
        self._executor.create_task(self._trajectories.publish, message)

    def _arrival(self, target: Joints, sent: Time, check: Callable[[], None]) -> Time:
        """Return the time at which the measured joints reached the posture."""
        deadline = time.monotonic() + MOVE_TIMEOUT_S
        while time.monotonic() < deadline:
            check()
            state, here = self.arm_state, self.joints()
            assert state is not None and here is not None and self._joints is not None
            read = Time.from_msg(self._joints.header.stamp)
            error = max(abs(here[i] - target[i]) for i in REVOLUTE)
            if state.state == ArmState.IDLE and error < ARRIVED and read > sent:
                return read
            if state.error_code and Time.from_msg(state.header.stamp) > sent:
                raise ArmRefused(f"the arm rejected the motion: {state.error_msg}")
            time.sleep(_POLL_S)
        raise ArmRefused(
            f"the arm did not reach its posture within {MOVE_TIMEOUT_S:.0f} s; check its "
            "driver, then continue with --resume"
        )

    def _observe(self, sent: Time, arrived: Time, check: Callable[[], None]) -> ObjectState | None:
        """Return an observation of the marker at rest; None after a timeout.

        The marker must have come to rest after ``sent``, and the last of the fused images must have
        been taken after ``arrived``.
        """
        begun = shown = time.monotonic()
        while (now := time.monotonic()) < min(
            begun + OBSERVATION_TIMEOUT_S, shown + UNSEEN_TIMEOUT_S
        ):
            check()
            seen = self.object_state
            if seen is not None and seen.visible and Time.from_msg(seen.header.stamp) > arrived:
                shown = now
                if (
                    seen.at_rest
                    and not seen.error_code
                    and seen.frames_fused >= PICTURES
                    and Time.from_msg(seen.at_rest_since) > sent
                ):
                    return seen
            time.sleep(_POLL_S)
        return None

    def _on_joints(self, message: JointState) -> None:
        if set(self._names) <= set(message.name):
            self._joints = message
