"""Conversion of the camera's pose from and to ROS messages."""

from __future__ import annotations

import math

import cv2
import numpy as np
from geometry_msgs.msg import Pose as PoseMessage

from tapping_cell.vision import CameraPose


def camera_to_message(camera: CameraPose) -> PoseMessage:
    """Return X_TC, the pose of the frame ``camera_optical`` in the frame ``table``."""
    message = PoseMessage()
    place, q = message.position, message.orientation
    place.x, place.y, place.z = (float(value) for value in camera.position)
    turn = np.ravel(cv2.Rodrigues(camera.rotation.T)[0])  # axis times angle
    half = float(np.linalg.norm(turn)) / 2
    # np.sinc(x) is sin(pi x) / (pi x), also at 0.
    q.x, q.y, q.z = (float(v) for v in turn * (np.sinc(half / np.pi) / 2))
    q.w = float(math.cos(half))
    return message


def camera_from_message(message: PoseMessage) -> CameraPose:
    """Invert :func:`camera_to_message`.

    Raises:
        ValueError: the quaternion has zero norm.
    """
    place, q = message.position, message.orientation
    axis = np.array([q.x, q.y, q.z])
    length = float(np.linalg.norm(axis))
    if math.hypot(length, q.w) == 0.0:
        raise ValueError("the quaternion of the camera's pose has zero norm")
    turn = axis * (2 * math.atan2(length, q.w) / length) if length > 0.0 else axis
    rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=float).T
    return CameraPose(rotation, -rotation @ np.array([place.x, place.y, place.z]))
