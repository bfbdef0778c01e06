"""An arm with its own ROS driver: the emulated trajectory controller on real topics."""

from __future__ import annotations

import threading
import time

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_controller import TrajectoryController
from trajectory_msgs.msg import JointTrajectory

from tapping_cell.hardware.joint_trajectory import TrajectoryPoint

STATE_RATE = 50.0
OTHER_JOINT = "gripper"


class RosController(Node):
    """Node that spins in its own thread. Its joint states contain an additional joint and list the
    arm's joints in reverse order."""

    def __init__(self, controller: TrajectoryController, name: str = "scara_controller") -> None:
        super().__init__(name, use_global_arguments=False)
        self.controller = controller
        self.lock = threading.Lock()
        self.silent = False
        self.sent: list[JointTrajectory] = []
        self._states = self.create_publisher(JointState, "/robot/joint_states", 10)
        self.create_subscription(JointTrajectory, f"/{name}/joint_trajectory", self._take, 10)
        self.create_timer(1 / STATE_RATE, self._publish)
        self._executor_here = SingleThreadedExecutor()
        self._executor_here.add_node(self)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._spin_here, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Destroy the node, as if the arm's computer were switched off."""
        self._ended.set()
        self._executor_here.wake()
        self._thread.join(5.0)
        self._executor_here.shutdown()
        self.destroy_node()

    def _spin_here(self) -> None:
        while not self._ended.is_set():
            self._executor_here.spin_once(timeout_sec=0.2)

    def _take(self, message: JointTrajectory) -> None:
        self.sent.append(message)
        points = [
            TrajectoryPoint(
                point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec,
                tuple(point.positions),
                tuple(point.velocities),
            )
            for point in message.points
        ]
        with self.lock:
            refusal = self.controller.take(message.joint_names, points, time.monotonic())
        if refusal:
            self.get_logger().error(f"trajectory refused: {refusal}")

    def _publish(self) -> None:
        if self.silent:
            return
        with self.lock:
            positions, speeds = self.controller.state(time.monotonic())
        names = self.controller.settings.names
        message = JointState(
            name=[OTHER_JOINT, *reversed(names)],
            position=[0.5, *reversed(positions)],
            velocity=[0.0, *reversed(speeds)],
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._states.publish(message)
