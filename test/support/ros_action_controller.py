"""The emulated trajectory controller with its action and its topic."""

from __future__ import annotations

import threading
import time
from typing import Any

from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.node import Node
from ros_controller import RosController
from trajectory_controller import TrajectoryController

from tapping_cell.hardware.joint_trajectory import TrajectoryPoint
from tapping_cell.hardware.trajectory_link import GoalState

POLL_S = 0.01


class RosActionController(RosController):
    """Offers the action follow_joint_trajectory. The emulated controller decides on acceptance,
    preemption, cancellation and result."""

    def __init__(self, controller: TrajectoryController, name: str = "scara_controller") -> None:
        super().__init__(controller, name)
        self.goals = 0
        self.cancelled = 0
        self._action_node = Node(f"{name}_action", use_global_arguments=False)
        self._server = ActionServer(
            self._action_node,
            FollowJointTrajectory,
            f"/{name}/follow_joint_trajectory",
            self._execute,
            goal_callback=self._goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
            callback_group=ReentrantCallbackGroup(),
        )
        self._action_executor = MultiThreadedExecutor(3)
        self._action_executor.add_node(self._action_node)
        self._action_thread = threading.Thread(target=self._spin_action, daemon=True)
        self._action_thread.start()

    def close(self) -> None:
        """Destroy both nodes."""
        self._ended.set()
        self._action_executor.wake()
        self._action_thread.join(5.0)
        self._action_executor.shutdown()
        self._server.destroy()
        self._action_node.destroy_node()
        super().close()

    def _spin_action(self) -> None:
        while not self._ended.is_set():
            self._action_executor.spin_once(timeout_sec=0.2)

    def _goal(self, goal: FollowJointTrajectory.Goal) -> GoalResponse:
        self.goals += 1
        names = goal.trajectory.joint_names
        points = [
            TrajectoryPoint(
                point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec,
                tuple(point.positions),
                tuple(point.velocities),
            )
            for point in goal.trajectory.points
        ]
        with self.lock:
            refusal = self.controller.take(names, points, time.monotonic(), as_goal=True)
        return GoalResponse.REJECT if refusal else GoalResponse.ACCEPT

    def _execute(self, handle: ServerGoalHandle) -> Any:
        result = FollowJointTrajectory.Result()
        while not self._ended.is_set():
            if handle.is_cancel_requested:
                self.cancelled += 1
                handle.canceled()
                return result
            with self.lock:
                progress = self.controller.progress(time.monotonic())
            if progress.state is GoalState.SUCCEEDED:
                handle.succeed()
                return result
            if progress.state is not GoalState.ACTIVE:
                result.error_code = FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED
                result.error_string = progress.words
                handle.abort()
                return result
            time.sleep(POLL_S)
        handle.abort()
        return result
