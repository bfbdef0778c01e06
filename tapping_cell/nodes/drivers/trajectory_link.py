"""The way to an arm's own ROS driver: joint states in, trajectories out, by topic or action.

It has a node and a thread of its own, so that the age of a joint state does not depend on what else
the arm's node does, and so that a driver's blocking call can wait for one.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

from rclpy.action import ActionClient
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.task import Future
from rclpy.time import Time
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from tapping_cell.configuration.cell import Ros2ControlSection
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.joint_trajectory import LEAST_TIME, Course, TrajectoryPoint
from tapping_cell.hardware.trajectory_link import (
    GoalState,
    JointSample,
    Progress,
    braking_point,
)
from tapping_cell.nodes.cell_node import COMMAND

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:
    FollowJointTrajectory = None

KEPT_S = 1.0
"""For how long samples are kept."""
POLL_S = 0.05
STATUS = {4: GoalState.SUCCEEDED}
"""Of an action's result; every other is a failure."""
ENDINGS = {5: "cancelled, as by another program's trajectory", 6: "aborted"}


class RosTrajectoryLink:
    """See :class:`~tapping_cell.hardware.trajectory_link.TrajectoryLink`.

    The topics are open as long as the object: an arm that comes later is found at the next
    ``open``.

    Raises:
        ConfigurationError: the action is asked for and control_msgs is not installed.
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
        self._section = section
        self._joints = section.joints
        self._max_acceleration = tuple(max_acceleration)
        self._heard = threading.Condition()
        self._samples: deque[JointSample] = deque()
        self._other_names: tuple[str, ...] = ()
        self._open = False
        self._stopped = False
        self._lock = threading.Lock()
        self._goal = 0
        self._course: Course | None = None
        self._handle: Any = None
        self._progress = Progress(GoalState.UNTOLD)
        self._node = Node(
            f"{parent.get_name()}_controller",
            namespace=parent.get_namespace(),
            context=parent.context,
            use_global_arguments=False,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self._topic = f"{section.controller}/joint_trajectory"
        self._publisher = self._node.create_publisher(JointTrajectory, self._topic, COMMAND)
        # Best effort hears reliable publishers too, and a lost state is followed by the next.
        self._node.create_subscription(
            JointState, section.joint_states, self._hear, qos_profile_sensor_data
        )
        self._action: Any = None
        if section.interface != "topic" and FollowJointTrajectory is not None:
            self._action = ActionClient(
                self._node, FollowJointTrajectory, f"{section.controller}/follow_joint_trajectory"
            )
        self._executor = SingleThreadedExecutor(context=parent.context)
        self._executor.add_node(self._node)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=self._node.get_name(), daemon=True)
        self._thread.start()

    # Connection

    @property
    def name(self) -> str:
        """The controller's name."""
        return self._section.controller

    @property
    def is_open(self) -> bool:
        """Whether the controller was there at the last ``open``."""
        return self._open

    def now(self) -> float:
        """The steady clock, s."""
        return time.monotonic()

    def open(self, timeout: float) -> None:
        """Wait until the controller takes trajectories.

        Raises HardwareFault: PORT_MISSING, STOPPED.
        """
        self._open = False
        deadline = self.now() + timeout
        while not self._present():
            if self._stopped:
                raise self._stop_fault()
            if self.now() >= deadline:
                raise HardwareFault(
                    FaultReason.PORT_MISSING,
                    f"nobody takes trajectories on {self._way()}: start the arm's driver and"
                    " activate its joint_trajectory_controller, or correct"
                    " arm.ros2_control.controller",
                )
            time.sleep(POLL_S)
        with self._heard:
            self._samples.clear()
        self._open = True

    def close(self) -> None:
        """Use the controller no more; the topics stay open."""
        self._open = False

    def destroy(self) -> None:
        """Close the topics and end the thread."""
        self.close()
        self._ended.set()
        self._executor.wake()
        self._thread.join(5.0)
        self._executor.shutdown()
        if self._action is not None:
            self._action.destroy()
        self._node.destroy_node()

    def stop(self, data: bytes) -> bool:
        """From any thread: latch the stop, and brake."""
        self._stopped = True
        reached = self.brake()
        with self._heard:
            self._heard.notify_all()
        return reached

    def brake(self) -> bool:
        """From any thread: have the controller bring the arm to rest, and cancel its goal.

        A joint_trajectory_controller refuses an empty trajectory on its topic, so that braking is a
        trajectory of one point.
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

    def release(self) -> None:
        """End the latch of ``stop``."""
        self._stopped = False

    # Joint states

    @property
    def samples(self) -> Sequence[JointSample]:
        """What was heard in the last second, the newest last."""
        with self._heard:
            return tuple(self._samples)

    @property
    def other_names(self) -> Sequence[str]:
        """Joint names of the last message that lacked some of ours."""
        return self._other_names

    @property
    def rivals(self) -> Sequence[str]:
        """Other nodes that publish on the controller's topic."""
        own = self._node.get_name(), self._node.get_namespace()
        found = self._node.get_publishers_info_by_topic(self._topic)
        return sorted(
            f"{info.node_namespace.rstrip('/')}/{info.node_name}"
            for info in found
            if (info.node_name, info.node_namespace) != own
        )

    def wait(self, duration: float) -> None:
        """Wait for the next sample, for up to ``duration`` s."""
        self._require()
        with self._heard:
            self._heard.wait(max(duration, 0.0))
        self._require()

    def _hear(self, message: JointState) -> None:
        received = self.now()
        places = {name: index for index, name in enumerate(message.name)}
        if not all(name in places for name in self._joints):
            self._other_names = tuple(message.name)
            return
        order = [places[name] for name in self._joints]
        if max(order) >= len(message.position):
            return
        told = message.velocity if len(message.velocity) == len(message.name) else None
        speeds = None if told is None else tuple(told[index] for index in order)
        if speeds is not None and not all(map(math.isfinite, speeds)):
            speeds = None
        stamp = Time.from_msg(message.header.stamp).nanoseconds
        # A state without a stamp is as old as the network makes it; its broadcaster should stamp.
        age = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp) if stamp else 0.0
        sample = JointSample(
            received - max(age, 0.0),
            received,
            tuple(message.position[index] for index in order),
            speeds,
            max(-age, 0.0),
        )
        with self._heard:
            self._samples.append(sample)
            while self._samples[0].received < received - KEPT_S:
                self._samples.popleft()
            self._heard.notify_all()

    # Trajectories

    @property
    def interface(self) -> str:
        """How trajectories are sent: topic or action."""
        by_action = self._action is not None and (
            self._section.interface == "action" or self._action.server_is_ready()
        )
        return "action" if by_action else "topic"

    def send(self, points: Sequence[TrajectoryPoint]) -> None:
        """Send a trajectory, which replaces the one under way."""
        self._require()
        if not self._present():
            self._open = False
            raise HardwareFault(
                FaultReason.DISCONNECTED,
                f"nobody takes trajectories on {self._way()} any more: check the arm's driver and"
                " that its joint_trajectory_controller is active",
            )
        message = self._message(points)
        with self._lock:
            # A stop that comes now finds the lock, and its braking follows the trajectory.
            self._require()
            self._goal += 1
            self._course = Course(self.samples[-1].positions, points)
            if self.interface == "topic":
                self._progress = Progress(GoalState.UNTOLD)
                self._publisher.publish(message)
                return
            self._progress = Progress(GoalState.ACTIVE)
            number = self._goal
        self._executor.create_task(self._send_goal, number, message)

    def progress(self) -> Progress:
        """What became of the trajectory that was sent last."""
        return self._progress

    def _send_goal(self, number: int, message: JointTrajectory) -> None:
        """In the link's thread: send a goal, unless a stop has come since."""
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
                # A stop came while the goal was on its way.
                if handle.accepted:
                    handle.cancel_goal_async()
                return
            if not handle.accepted:
                self._progress = Progress(
                    GoalState.FAILED, "it refused the goal (its log says why; is it active?)"
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
            words = ENDINGS.get(ended.status, f"ended with status {ended.status}")
            said = f"{ended.result.error_string} (code {ended.result.error_code})"
            self._progress = Progress(
                STATUS.get(ended.status, GoalState.FAILED), f"{words}: {said}".strip()
            )

    def _message(self, points: Sequence[TrajectoryPoint]) -> JointTrajectory:
        """With no stamp: to be begun at once."""
        message = JointTrajectory(joint_names=list(self._joints))
        for point in points:
            told = JointTrajectoryPoint(
                positions=list(point.positions), velocities=list(point.velocities)
            )
            nanoseconds = round(1e9 * max(point.time, LEAST_TIME))
            told.time_from_start.sec, told.time_from_start.nanosec = divmod(nanoseconds, 10**9)
            message.points.append(told)
        return message

    def _present(self) -> bool:
        """Whether the controller is there."""
        if self._section.interface == "action":
            return bool(self._action.server_is_ready())
        return self._publisher.get_subscription_count() > 0

    def _way(self) -> str:
        if self._section.interface == "action":
            return f"the action {self._section.controller}/follow_joint_trajectory"
        return f"the topic {self._topic}"

    def _require(self) -> None:
        if self._stopped:
            raise self._stop_fault()
        if not self._open:
            raise HardwareFault(
                FaultReason.DISCONNECTED, f"{self.name} is not connected: connect first"
            )

    def _stop_fault(self) -> HardwareFault:
        return HardwareFault(
            FaultReason.STOPPED, f"{self.name} was stopped: make the cell safe, clear the fault"
        )

    def _spin(self) -> None:
        try:
            while not self._ended.is_set():
                self._executor.spin_once(timeout_sec=0.5)
        except ExternalShutdownException:
            return
