"""Camera images embedded in a report."""

from __future__ import annotations

import base64
from html import escape

import cv2
import numpy as np

from tapping_cell.report.run import Picture

WIDTH = 720
"""Maximum width of an embedded image in pixels."""


def photograph(picture: Picture, caption: str) -> str:
    """Embed a camera image in a page, downscaled to at most ``WIDTH`` pixels; empty if it is
    unreadable."""
    data = picture.jpeg
    image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        return ""
    if image.shape[1] > WIDTH:
        size = (WIDTH, round(image.shape[0] * WIDTH / image.shape[1]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        coded, jpeg = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, 82))
        data = jpeg.tobytes() if coded else data
    code = base64.b64encode(data).decode()
    return (
        f'<figure><img alt="{escape(caption)}" src="data:image/jpeg;base64,{code}">'
        f"<figcaption>{escape(caption)}, at {picture.at:.1f} s</figcaption></figure>"
    )
