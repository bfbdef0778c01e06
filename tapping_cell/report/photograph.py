"""Camera images embedded in a report."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import cv2
import numpy as np

from tapping_cell.report.run import Picture

WIDTH = 720
"""Maximum width of an embedded image in pixels."""


@dataclass(frozen=True, slots=True)
class Photograph:
    """An image to embed: time in s since run start, and the image as a ``data:`` URL."""

    at: float
    url: str


def photograph(picture: Picture) -> Photograph | None:
    """Downscale a camera image to at most ``WIDTH`` pixels; None if it is unreadable."""
    data = picture.jpeg
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return None
    if image.shape[1] > WIDTH:
        size = (WIDTH, round(image.shape[0] * WIDTH / image.shape[1]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        coded, jpeg = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, 82))
        data = jpeg.tobytes() if coded else data
    return Photograph(picture.at, data_url("image/jpeg", data))


def data_url(kind: str, data: bytes) -> str:
    """Return the ``data:`` URL of a file; ``kind`` is its media type."""
    return f"data:{kind};base64,{base64.b64encode(data).decode('ascii')}"
