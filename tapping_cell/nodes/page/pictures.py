"""Convert an image message to a JPEG for the page."""

from __future__ import annotations

import cv2
import numpy as np
from sensor_msgs.msg import Image

from tapping_cell.nodes.camera.images import ImageRefused, to_grey, unpack


def to_jpeg(message: Image, quality: int) -> bytes:
    """Return an image message as JPEG, quality 1 to 100, in colour if its encoding is bgr8 or rgb8.

    Raises:
        ImageRefused: the encoding is unknown, or there are fewer bytes than the size requires.
    """
    picture = unpack(message) if message.encoding in ("bgr8", "rgb8") else to_grey(message)
    if message.encoding == "rgb8":
        picture = picture[..., ::-1]
    made, jpeg = cv2.imencode(
        ".jpg", np.ascontiguousarray(picture), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    if not made:
        raise ImageRefused("the image cannot be encoded as JPEG")
    return jpeg.tobytes()
