"""A pose estimator of your own in place of ``camera_pose``: poses of a motion-capture system.

It converts ``mocap_pose`` (geometry_msgs/PoseStamped in ``table``) to ``object_states``. Check it
with

    python -m tapping_cell conformance camera_pose
"""

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.time import Time
from tapping_cell_msgs.msg import ObjectState, ObjectStates

from tapping_cell.logic.poses import covariance_to_message
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message, seconds, to_message
from tapping_cell.se2 import Pose
from tapping_cell.vision.rest_detection import RestSettings, Track

COVARIANCE = np.diag([1e-4, 1e-4, 1e-3]) ** 2  # of one measurement: m, m, rad


class PoseEstimator(Node):
    """Publishes the state of one object; the parameter ``object`` is its name in the cell."""

    def __init__(self) -> None:
        super().__init__("pose_estimator")
        self.name = self.declare_parameter("object", "aluminium disk").value
        self.track = Track(RestSettings())
        self.states = self.create_publisher(ObjectStates, "object_states", LATCHED)
        self.create_subscription(PoseStamped, "mocap_pose", self.on_pose, 10)

    def on_pose(self, message: PoseStamped) -> None:
        """Fuse a measurement with those since the object came to rest."""
        pose, at = from_message(message.pose), seconds(message.header.stamp)
        motion = self.track.add(at, np.array(pose), COVARIANCE)
        state = ObjectState(header=message.header, object_id=self.name, visible=True)
        state.frames_fused, state.at_rest = motion.frames, motion.rest_since is not None
        if state.at_rest:
            since = Time(nanoseconds=round(1e9 * motion.rest_since))
            state.at_rest_since = since.to_msg()
        state.pose.pose = to_message(Pose(*map(float, motion.pose)))
        state.pose.covariance = covariance_to_message(motion.covariance)
        vx, vy, state.velocity.angular.z = map(float, motion.velocity)
        state.velocity.linear.x, state.velocity.linear.y = vx, vy
        self.states.publish(ObjectStates(header=state.header, objects=[state]))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(PoseEstimator())
