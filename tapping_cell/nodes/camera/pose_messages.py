"""Conversion of the camera's pose from and to ROS messages."""

from __future__ import annotations

import numpy as np
import scipy
from geometry_msgs.msg import Pose as PoseMessage

from tapping_cell.vision import CameraPose


def camera_to_message(camera: CameraPose) -> PoseMessage:
    """Return X_TC, the pose of the frame ``camera_optical`` in the frame ``table``."""
    message = PoseMessage()
    place, q = message.position, message.orientation
    place.x, place.y, place.z = (float(value) for value in camera.position)
    q.x, q.y, q.z, q.w = (
        float(v) for v in scipy.spatial.transform.Rotation.from_matrix(camera.rotation.T).as_quat()
    )
    return message


def camera_from_message(message: PoseMessage) -> CameraPose:
    """Invert :func:`camera_to_message`.

    Raises:
        ValueError: the quaternion has zero norm.
    """
    place, q = message.position, message.orientation
    rotation = scipy.spatial.transform.Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix().T
    return CameraPose(rotation, -rotation @ np.array([place.x, place.y, place.z]))
