"""Link to an arm's own ROS driver: receives joint states, sends trajectories by topic or action."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.serialization import deserialize_message
from rclpy.task import Future
from rclpy.time import Time
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tapping_cell.configuration.cell import Ros2ControlSection
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.joint_trajectory import MIN_TIME, Course, TrajectoryPoint
from tapping_cell.hardware.trajectory_link import (
    GoalState,
    JointSample,
    Progress,
    braking_point,
)
from tapping_cell.nodes.cell_node import COMMAND
from tapping_cell.nodes.drivers.ros_link import RosLink
from tapping_cell.nodes.own_joints import OwnJoints

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:
    FollowJointTrajectory = None

KEPT_S = 1.0
"""Time for which samples are kept."""
STATUS = {4: GoalState.SUCCEEDED}
"""Goal state for each status code of an action result. Every other code means failure."""
ENDINGS = {5: "cancelled, perhaps by another program", 6: "aborted"}


class RosTrajectoryLink(RosLink):
    """See :class:`~tapping_cell.hardware.trajectory_link.TrajectoryLink`.

    Raises:
        ConfigurationError: the action interface is requested, but control_msgs is not installed.
    """

    def __init__(
        self,
        parent: Node,
        section: Ros2ControlSection,
        max_acceleration: Sequence[float],
    ) -> None:
        if section.interface == "action" and FollowJointTrajectory is None:
            raise ConfigurationError(
                "key 'arm.ros2_control.interface' is action, which needs the package control_msgs"
                " (apt install ros-jazzy-control-msgs): install it, or use topic"
            )
        super().__init__(parent, "controller")
        self._section = section
        self._joints = section.joints
        self._max_acceleration = tuple(max_acceleration)
        self._samples: deque[JointSample] = deque()
        self._own = OwnJoints(section.joints)
        self._other: bytes | None = None
        self._goal = 0
        self._course: Course | None = None
        self._handle: Any = None
        self._progress = Progress(GoalState.UNREPORTED)
        self._topic = f"{section.controller}/joint_trajectory"
        self._publisher = self._node.create_publisher(JointTrajectory, self._topic, COMMAND)
        # A best-effort subscription also matches reliable publishers. A lost state does no harm,
        # because the next message replaces it.
        self._node.create_subscription(
            JointState, section.joint_states, self._receive, qos_profile_sensor_data, raw=True
        )
        self._action: Any = None
        if section.interface != "topic" and FollowJointTrajectory is not None:
            self._action = ActionClient(
                self._node, FollowJointTrajectory, f"{section.controller}/follow_joint_trajectory"
            )
        self._start()

    # Connection

    @property
    def name(self) -> str:
        """The controller's name."""
        return self._section.controller

    def stop(self, data: bytes) -> bool:
        """Latch the stop and brake, from any thread."""
        self._stopped = True
        reached = self.brake()
        with self._received:
            self._received.notify_all()
        return reached

    def brake(self) -> bool:
        """Make the controller bring the arm to rest, and cancel the controller's goal. May be
        called from any thread.

        A joint_trajectory_controller rejects an empty trajectory on its topic, so the brake command
        is a trajectory with a single point.
        """
        with self._lock:
            reached = self._publisher.get_subscription_count() > 0
            course, self._course = self._course, None
            point = braking_point(self.samples, course, self.now(), self._max_acceleration)
            if point is not None:
                self._publisher.publish(self._message([point]))
            handle, self._handle = self._handle, None
            self._goal += 1
        if handle is not None:
            self._executor.create_task(handle.cancel_goal_async)
        return reached and point is not None

    # Joint states

    @property
    def samples(self) -> Sequence[JointSample]:
        """Samples received in the last second, newest last."""
        with self._received:
            return tuple(self._samples)

    @property
    def other_names(self) -> Sequence[str]:
        """Joint names in the last message that did not contain all joints of this arm."""
        other = self._other
        return () if other is None else tuple(deserialize_message(other, JointState).name)

    @property
    def other_commanders(self) -> Sequence[str]:
        """Other nodes that publish on the controller's topic."""
        return self._publishers(self._topic)

    def _receive(self, data: bytes) -> None:
        received = self.now()
        if not self._own.may_be_in(data):
            self._other = data
            return
        message = deserialize_message(data, JointState)
        places = {name: index for index, name in enumerate(message.name)}
        if not all(name in places for name in self._joints):
            self._other = data
            return
        order = [places[name] for name in self._joints]
        if max(order) >= len(message.position):
            return
        reported = message.velocity if len(message.velocity) == len(message.name) else None
        speeds = None if reported is None else tuple(reported[index] for index in order)
        if speeds is not None and not all(map(math.isfinite, speeds)):
            speeds = None
        stamp = Time.from_msg(message.header.stamp).nanoseconds
        # A state without a stamp counts as measured on arrival. The states of
        # joint_state_broadcaster have stamps.
        age = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp) if stamp else 0.0
        sample = JointSample(
            received - max(age, 0.0),
            received,
            tuple(message.position[index] for index in order),
            speeds,
            max(-age, 0.0),
        )
        with self._received:
            self._samples.append(sample)
            while self._samples[0].received < received - KEPT_S:
                self._samples.popleft()
            self._received.notify_all()

    # Trajectories

    @property
    def interface(self) -> str:
        """How trajectories are sent: by topic or by action."""
        by_action = self._action is not None and (
            self._section.interface == "action" or self._action.server_is_ready()
        )
        return "action" if by_action else "topic"

    def send(self, points: Sequence[TrajectoryPoint]) -> None:
        """Send a trajectory. It replaces the current trajectory."""
        self._require()
        if not self._present():
            self._open = False
            raise HardwareFault(
                FaultReason.DISCONNECTED,
                f"no controller accepts trajectories on {self._way()} any longer: check that the "
                "arm's driver is running and its joint_trajectory_controller is active",
            )
        message = self._message(points)
        with self._lock:
            # A stop that arrives now waits for the lock, so it also ends this trajectory: ``brake``
            # replaces the trajectory, a goal that is not sent yet is dropped, and a goal that is
            # not accepted yet is cancelled.
            self._require()
            self._goal += 1
            self._course = Course(self.samples[-1].positions, points)
            if self.interface == "topic":
                self._progress = Progress(GoalState.UNREPORTED)
                self._publisher.publish(message)
                return
            self._progress = Progress(GoalState.ACTIVE)
            number = self._goal
        self._executor.create_task(self._send_goal, number, message)

    def progress(self) -> Progress:
        """Return the progress of the last trajectory."""
        return self._progress

    def _send_goal(self, number: int, message: JointTrajectory) -> None:
        """Send a goal, unless a stop was latched in the meantime. Runs in the link's thread."""
        with self._lock:
            if number != self._goal:
                return
            goal = FollowJointTrajectory.Goal(trajectory=message)
            future = self._action.send_goal_async(goal)
        future.add_done_callback(lambda answer: self._goal_answered(number, answer))

    def _goal_answered(self, number: int, answer: Future) -> None:
        handle = answer.result()
        with self._lock:
            if number != self._goal:
                # A stop or another trajectory arrived while the goal was being sent.
                if handle.accepted:
                    handle.cancel_goal_async()
                return
            if not handle.accepted:
                self._progress = Progress(
                    GoalState.FAILED, "the controller refused the goal (see its log)"
                )
                return
            self._handle = handle
        handle.get_result_async().add_done_callback(
            lambda answer: self._goal_ended(number, answer.result())
        )

    def _goal_ended(self, number: int, ended: Any) -> None:
        with self._lock:
            if number != self._goal:
                return
            self._handle = None
            text = ENDINGS.get(ended.status, f"ended with status {ended.status}")
            detail = f"{ended.result.error_string} (code {ended.result.error_code})"
            self._progress = Progress(
                STATUS.get(ended.status, GoalState.FAILED), f"{text}: {detail}".strip()
            )

    def _message(self, points: Sequence[TrajectoryPoint]) -> JointTrajectory:
        """Build the message with a zero stamp, so that the trajectory starts immediately."""
        message = JointTrajectory(joint_names=list(self._joints))
        for point in points:
            command = JointTrajectoryPoint(
                positions=list(point.positions), velocities=list(point.velocities)
            )
            nanoseconds = round(1e9 * max(point.time, MIN_TIME))
            command.time_from_start.sec, command.time_from_start.nanosec = divmod(
                nanoseconds, 10**9
            )
            message.points.append(command)
        return message

    def _present(self) -> bool:
        """Return whether the controller is present."""
        if self._section.interface == "action":
            return bool(self._action.server_is_ready())
        return self._publisher.get_subscription_count() > 0

    def _way(self) -> str:
        if self._section.interface == "action":
            return f"the action {self._section.controller}/follow_joint_trajectory"
        return f"the topic {self._topic}"

    def _absence(self) -> str:
        return (
            f"no controller accepts trajectories on {self._way()}: start the arm's driver and "
            "activate its joint_trajectory_controller, or correct arm.ros2_control.controller"
        )

    def _found(self) -> None:
        with self._received:
            self._samples.clear()

    def _before_destruction(self) -> None:
        if self._action is not None:
            self._action.destroy()
