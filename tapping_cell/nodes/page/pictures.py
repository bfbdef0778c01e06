"""From an image message to a JPEG for the page."""

from __future__ import annotations

import cv2
import numpy as np
from sensor_msgs.msg import Image

from tapping_cell.nodes.images import CHANNELS, ImageRefused


def to_jpeg(message: Image, quality: int) -> bytes:
    """A JPEG of an image message (mono8, bgr8 or rgb8), quality 1 to 100.

    Raises:
        ImageRefused: unknown encoding, or fewer bytes than the size needs.
    """
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise ImageRefused(f"the picture's encoding is '{message.encoding}'")
    row, needed = message.width * channels, message.step * message.height
    if not needed or message.step < row or len(message.data) < needed:
        raise ImageRefused(
            f"the picture says {message.width} x {message.height} with {message.step} bytes a row "
            f"but holds {len(message.data)} bytes"
        )
    rows = np.frombuffer(message.data, dtype=np.uint8, count=needed)
    picture = rows.reshape(message.height, message.step)[:, :row]
    picture = picture.reshape(message.height, message.width, channels)
    if message.encoding == "rgb8":
        picture = picture[..., ::-1]
    made, jpeg = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not made:
        raise ImageRefused("the picture cannot be made a JPEG")
    return jpeg.tobytes()
