"""Between ROS images and numpy arrays."""

from __future__ import annotations

import array

import numpy as np
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from tapping_cell.vision import CameraModel

PICTURES = QoSProfile(
    depth=15, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)
"""Sensor data with a queue of half a second: a busy machine delays pictures, but loses none."""

CHANNELS = {"mono8": 1, "8UC1": 1, "bgr8": 3, "rgb8": 3}
"""Encodings that a camera may send, with their bytes a pixel."""


class ImageRefused(ValueError):
    """An image message that does not hold what it says."""


def to_grey(message: Image) -> NDArray[np.uint8]:
    """The grey picture of an image message, shape (height, width).

    Raises:
        ImageRefused: unknown encoding, or fewer bytes than the size needs.
    """
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise ImageRefused(
            f"the image's encoding is '{message.encoding}'; known are {', '.join(CHANNELS)}"
        )
    needed = message.step * message.height
    if message.step < message.width * channels or len(message.data) < needed or needed == 0:
        raise ImageRefused(
            f"the image says {message.width} x {message.height} with {message.step} bytes a row "
            f"but holds {len(message.data)} bytes"
        )
    rows = np.frombuffer(message.data, dtype=np.uint8, count=needed)
    rows = rows.reshape(message.height, message.step)[:, : message.width * channels]
    if channels == 1:
        return np.ascontiguousarray(rows)
    colour = rows.reshape(message.height, message.width, channels)
    # ITU-R BT.601 luma, as OpenCV converts; green is in the middle of both orders.
    order = (0.299, 0.587, 0.114) if message.encoding == "rgb8" else (0.114, 0.587, 0.299)
    return np.asarray(np.rint(colour @ np.array(order)), dtype=np.uint8)


def to_message(picture: NDArray[np.uint8], encoding: str) -> Image:
    """An image message; the header is the caller's."""
    message = Image()
    message.height, message.width = picture.shape[:2]
    message.encoding = encoding
    message.step = int(picture.strides[0])
    # An array.array is handed over as it is; a list would be checked number by number.
    message.data = array.array("B", picture.tobytes())
    return message


def to_camera_info(camera: CameraModel) -> CameraInfo:
    """The calibration as ROS publishes it; the header is the caller's."""
    message = CameraInfo(width=camera.width, height=camera.height)
    message.distortion_model = camera.distortion_model
    message.d = list(camera.distortion)
    message.k = camera.matrix.reshape(-1).tolist()
    message.r = np.eye(3).reshape(-1).tolist()
    message.p = np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(-1).tolist()
    return message


def from_camera_info(message: CameraInfo) -> CameraModel:
    """The calibration of a camera_info message.

    Raises:
        tapping_cell.vision.CameraError: the camera is not calibrated or its lens model not known.
    """
    return CameraModel.from_camera_info(
        message.width, message.height, message.distortion_model, list(message.d), list(message.k)
    )
