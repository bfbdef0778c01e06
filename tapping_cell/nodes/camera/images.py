"""Conversions between ROS images and numpy arrays."""

from __future__ import annotations

import array

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from tapping_cell.vision import CameraError, CameraModel
from tapping_cell.vision.images import GreyImage, ImageRefused, read_compressed, read_raw, rows

PICTURES = QoSProfile(
    depth=15, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE
)
"""Best effort, as usual for sensor data. The queue holds the images of half a second, so that no
image is lost if this process is delayed for a short time."""
COMPRESSED_PICTURES = QoSProfile(
    depth=15, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.VOLATILE
)
"""Reliable, because a network loses packets: lost data are sent again."""
RAW = "camera/image_raw"
COMPRESSED = f"{RAW}/compressed"
"""Topic name according to image_transport."""
OPTICAL_FRAME = "camera_optical"
ANNOTATED = "camera/image_annotated"
ANNOTATED_COMPRESSED = f"{ANNOTATED}/compressed"


def compress(message: Image, quality: int) -> CompressedImage:
    """Compress a mono8 image message to JPEG, in the format of image_transport."""
    form = f"{message.encoding}; jpeg compressed "
    return _compressed(rows(*_content(message))[..., 0], quality, message.header, form)


def compress_colour(
    picture: NDArray[np.uint8], width: int, quality: int, header: Header
) -> CompressedImage:
    """Compress a colour image (BGR, height x width x 3) to JPEG, in the format of image_transport.

    A wider image is reduced to ``width`` pixels. ``quality``: 1 to 100.
    """
    scale = width / picture.shape[1]
    if scale < 1.0:
        size = (width, round(scale * picture.shape[0]))
        reduced = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        picture = np.asarray(reduced, dtype=np.uint8)
    return _compressed(picture, quality, header, "bgr8; jpeg compressed bgr8")


def _compressed(
    picture: NDArray[np.uint8], quality: int, header: Header, form: str
) -> CompressedImage:
    _, coded = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, quality))
    return CompressedImage(header=header, format=form, data=_sequence(coded))


def to_jpeg(message: Image, quality: int) -> bytes:
    """Return an image message as JPEG, quality 1 to 100, in colour if its encoding is bgr8 or rgb8.

    Raises:
        ImageRefused: the encoding is unknown, or there are fewer bytes than the size requires.
    """
    colour = message.encoding in ("bgr8", "rgb8")
    picture = rows(*_content(message)) if colour else to_grey(message)
    if message.encoding == "rgb8":
        picture = picture[..., ::-1]
    made, jpeg = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture), (cv2.IMWRITE_JPEG_QUALITY, quality)
    )
    if not made:
        raise ImageRefused("the image cannot be encoded as JPEG")
    return jpeg.tobytes()


def to_grey(message: Image | CompressedImage) -> NDArray[np.uint8]:
    """Return the grey image of an image message, shape (height, width).

    Raises:
        ImageRefused: see :func:`read`.
    """
    return read(message).pixels


def read(
    message: Image | CompressedImage, size: tuple[int, int] | None = None, bits: int = 8
) -> GreyImage:
    """Read an image message. ``size``: width and height of the calibration; ``bits``: bits in
    samples of 16 in earlier images.

    Raises:
        ImageRefused: the encoding is unknown, there are fewer bytes than the size requires, or
            compressed data cannot be decoded.
    """
    if isinstance(message, CompressedImage):
        return read_compressed(message.data, message.format, size, bits)
    return read_raw(*_content(message), bits)


def _content(message: Image) -> tuple[array.array[int], int, int, int, str, bool]:
    size = (message.width, message.height, message.step)
    return message.data, *size, message.encoding, bool(message.is_bigendian)


def to_message(picture: NDArray[np.uint8], encoding: str) -> Image:
    """Convert an image to a message. The caller fills in the header."""
    height, width = picture.shape[:2]
    step, data = picture.nbytes // height, _sequence(np.ascontiguousarray(picture))
    return Image(height=height, width=width, encoding=encoding, step=step, data=data)


def _sequence(data: NDArray[np.uint8]) -> array.array[int]:
    """Return bytes as a field of a message. rclpy accepts an array.array directly, but checks a
    list element by element."""
    made = array.array("B")
    made.frombytes(data.data)
    return made


def to_camera_info(camera: CameraModel) -> CameraInfo:
    """Convert the calibration to a camera_info message. The caller fills in the stamp."""
    message = CameraInfo(width=camera.width, height=camera.height)
    message.header.frame_id = OPTICAL_FRAME
    message.distortion_model = camera.distortion_model
    message.d = list(camera.distortion)
    message.k = camera.matrix.reshape(-1).tolist()
    message.r = np.eye(3).reshape(-1).tolist()
    message.p = np.hstack([camera.matrix, np.zeros((3, 1))]).reshape(-1).tolist()
    return message


def calibration_of(message: CameraInfo) -> tuple[object, ...]:
    """Return the fields of a camera_info message that :func:`from_camera_info` reads, for
    comparison."""
    d, k, roi = bytes(message.d), message.k.tobytes(), message.roi
    part = (roi.x_offset, roi.y_offset, roi.width, roi.height)
    binning = (message.binning_x, message.binning_y)
    return message.width, message.height, message.distortion_model, d, k, binning, part


def from_camera_info(message: CameraInfo) -> CameraModel:
    """Convert a camera_info message to a camera model.

    Raises:
        tapping_cell.vision.CameraError: the camera is not calibrated, its lens model is unknown, or
            its images do not show the whole sensor.
    """
    roi = message.roi
    whole = (0, 0, message.width, message.height)
    if max(message.binning_x, message.binning_y) > 1:
        raise CameraError(
            f"camera_info has binning {message.binning_x} x {message.binning_y}, which is not "
            "supported; set the camera to full resolution, or calibrate the binned images and "
            "publish camera_info without binning"
        )
    if (roi.x_offset, roi.y_offset, roi.width, roi.height) not in ((0, 0, 0, 0), whole):
        raise CameraError(
            f"camera_info has a region of interest of {roi.width} x {roi.height} pixels at "
            f"({roi.x_offset}, {roi.y_offset}); set the camera to the full image"
        )
    return CameraModel.from_camera_info(
        message.width, message.height, message.distortion_model, list(message.d), list(message.k)
    )
