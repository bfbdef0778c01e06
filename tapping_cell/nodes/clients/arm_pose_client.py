"""The client that calibrates the arm: bring it to postures, and look where the camera sees what it
holds.

Not an executable of its own: the command line's `calibrate arm --record` uses it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

from builtin_interfaces.msg import Duration
from rclpy.time import Time
from sensor_msgs.msg import JointState
from tapping_cell_msgs.msg import ArmState, ObjectState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tapping_cell.configuration.cell import Ros2ControlSection
from tapping_cell.hardware.scara import Joints
from tapping_cell.nodes.cell_node import COMMAND
from tapping_cell.nodes.clients.goal_client import GoalClient
from tapping_cell.nodes.conversions import from_message
from tapping_cell.se2 import Pose

ARRIVED = 0.01
"""Joints this near to those asked for, in rad, are the posture."""
MOVE_PATIENCE_S = 30.0
LOOK_PATIENCE_S = 10.0
UNSEEN_PATIENCE_S = 3.0
"""The longest wait for a look at rest, and for the marker to come into view at all."""
PICTURES = 10
"""At rest, that a look is fused of."""
_POLL_S = 0.02


class ArmRefused(RuntimeError):
    """The arm did not go where it was sent; the sentence is its own."""


class Seen(NamedTuple):
    """The arm's joints as read back, and the pose of what it holds in ``table``."""

    joints: Joints
    pose: Pose


class ArmPoseClient(GoalClient):
    """A :class:`GoalClient` that sends the arm to postures; use as a context manager."""

    def __init__(self, namespace: str = "", own_driver: Ros2ControlSection | None = None) -> None:
        """``own_driver``: of an arm that tells its joints itself, by its own names."""
        super().__init__("arm_pose_client", namespace)
        self._names = own_driver.joints if own_driver else Joints._fields
        self._joints: JointState | None = None
        self._trajectories = self.node.create_publisher(
            JointTrajectory, "joint_trajectory", COMMAND
        )
        topic = own_driver.joint_states if own_driver else "joint_states"
        self.node.create_subscription(JointState, topic, self._on_joints, 10)

    def missing(self) -> list[str]:
        """What still keeps the arm from being sent, in words; empty when it is ready."""
        if self.arm_state is None or self._trajectories.get_subscription_count() == 0:
            return ["the arm's driver is not up"]
        if self.arm_state.state != ArmState.IDLE:
            return [f"the arm is not idle ({self.arm_state.error_msg or 'busy'})"]
        if self.joints() is None or not self.arm_state.homed:
            return ["the arm's joints have not been read back yet: is it homed?"]
        if self.object_state is None:
            return ["the camera has not looked yet"]
        return []

    def joints(self) -> Joints | None:
        """As read back last; None before."""
        if self._joints is None:
            return None
        known = dict(zip(self._joints.name, self._joints.position, strict=True))
        return Joints(*(known[name] for name in self._names))

    def visit(self, target: Joints, speed: float, check: Callable[[], None]) -> Seen | None:
        """Go to a posture at ``speed`` (rad/s of the farthest joint) and look; None where the
        camera does not see what the arm holds at rest there.

        Raises:
            ArmRefused: the arm is not there in time, or says why it does not go.
        """
        sent = self.node.get_clock().now()
        self._go(target, speed)
        arrived = self._arrival(target, sent, check)
        seen = self._look(sent, arrived, check)
        here = self.joints()
        assert here is not None
        return None if seen is None else Seen(here, from_message(seen.pose.pose))

    def _go(self, target: Joints, speed: float) -> None:
        here = self.joints()
        assert here is not None
        far = max(abs(a - b) for a, b in zip(target, here, strict=True))
        seconds = max(far / speed, 0.5)
        point = JointTrajectoryPoint(positions=list(target))
        point.time_from_start = Duration(
            sec=int(seconds), nanosec=round(1e9 * math.fmod(seconds, 1.0)) % 10**9
        )
        message = JointTrajectory(joint_names=list(Joints._fields), points=[point])
        self._executor.create_task(self._trajectories.publish, message)

    def _arrival(self, target: Joints, sent: Time, check: Callable[[], None]) -> Time:
        """When the arm was read back at the posture."""
        deadline = time.monotonic() + MOVE_PATIENCE_S
        while time.monotonic() < deadline:
            check()
            state, here = self.arm_state, self.joints()
            assert state is not None and here is not None and self._joints is not None
            read = Time.from_msg(self._joints.header.stamp)
            far = max(abs(here[i] - target[i]) for i in (0, 1, 3))
            if state.state == ArmState.IDLE and far < ARRIVED and read > sent:
                return read
            if state.error_code and Time.from_msg(state.header.stamp) > sent:
                raise ArmRefused(f"the arm does not go there: {state.error_msg}")
            time.sleep(_POLL_S)
        raise ArmRefused(
            f"the arm was not in its posture within {MOVE_PATIENCE_S:.0f} s; look after its driver,"
            " then go on with --resume"
        )

    def _look(self, sent: Time, arrived: Time, check: Callable[[], None]) -> ObjectState | None:
        """The first look at rest that began after the arm was sent and ended after it arrived."""
        begun = shown = time.monotonic()
        while (now := time.monotonic()) < min(begun + LOOK_PATIENCE_S, shown + UNSEEN_PATIENCE_S):
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
