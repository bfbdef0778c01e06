"""Conversions between ROS messages and library types, with no mathematics beyond quaternions."""

from __future__ import annotations

import math

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Pose as PoseMessage
from scipy.spatial.transform import Rotation

from tapping_cell.se2 import Pose
from tapping_cell.vision import CameraPose


def to_message(pose: Pose, height: float = 0.0) -> PoseMessage:
    """Convert a planar pose at a height in m to a ROS pose."""
    message = PoseMessage()
    message.position.x, message.position.y, message.position.z = pose.x, pose.y, height
    message.orientation.z = math.sin(pose.theta / 2)
    message.orientation.w = math.cos(pose.theta / 2)
    return message


def from_message(message: PoseMessage) -> Pose:
    """Return the planar part of a ROS pose."""
    q = message.orientation
    theta = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return Pose(message.position.x, message.position.y, theta)


def is_finite(message: PoseMessage) -> bool:
    """Return whether every number of a ROS pose is finite."""
    p, q = message.position, message.orientation
    return all(math.isfinite(value) for value in (p.x, p.y, p.z, q.x, q.y, q.z, q.w))


def camera_to_message(camera: CameraPose) -> PoseMessage:
    """Return X_TC, the pose of ``camera_optical`` in ``table``, of a camera above the table."""
    message = PoseMessage()
    place, q = message.position, message.orientation
    place.x, place.y, place.z = (float(value) for value in camera.position)
    q.x, q.y, q.z, q.w = (float(v) for v in Rotation.from_matrix(camera.rotation.T).as_quat())
    return message


def camera_from_message(message: PoseMessage) -> CameraPose:
    """Invert :func:`camera_to_message`.

    Raises:
        ValueError: the quaternion has zero norm.
    """
    place, q = message.position, message.orientation
    rotation = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix().T
    return CameraPose(rotation, -rotation @ np.array([place.x, place.y, place.z]))


def seconds(stamp: TimeMessage) -> float:
    """Convert a ROS stamp to seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
