"""Annotated images: raw for screens and compressed for records, at two separate rates."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from tapping_cell.nodes.camera import images

QUALITY = 85
"""JPEG quality."""


class AnnotatedImages:
    """Publishers of ``camera/image_annotated`` and ``camera/image_annotated/compressed``."""

    def __init__(self, node: Node, rate: float, compressed_rate: float, width: int) -> None:
        """``rate``, ``compressed_rate``: maximum rates of the raw and of the compressed images, Hz.
        ``width``: maximum width of a compressed image, pixels."""
        self._raw = node.create_publisher(Image, images.ANNOTATED, images.PICTURES)
        self._compressed = node.create_publisher(
            CompressedImage, images.ANNOTATED_COMPRESSED, images.COMPRESSED_PICTURES
        )
        self._periods = {self._raw: 1.0 / rate, self._compressed: 1.0 / compressed_rate}
        self._published_at = dict.fromkeys(self._periods, -math.inf)
        self._width = width

    def is_due(self, now: float) -> bool:
        """Return whether an image that is annotated at ``now`` (monotonic, s) will be published."""
        return any(self._is_due(publisher, now) for publisher in self._periods)

    def publish(self, picture: NDArray[np.uint8], header: Header, now: float) -> None:
        """Publish a colour image (BGR, height x width x 3) as a raw image, a compressed image or
        both, depending on which is due."""
        if self._is_due(self._raw, now):
            raw = images.to_message(picture, "bgr8")
            raw.header = header
            self._raw.publish(raw)
            self._published_at[self._raw] = now
        if self._is_due(self._compressed, now):
            self._compressed.publish(images.compress_colour(picture, self._width, QUALITY, header))
            self._published_at[self._compressed] = now

    def _is_due(self, publisher: Publisher, now: float) -> bool:
        due = now - self._published_at[publisher] >= self._periods[publisher]
        return due and publisher.get_subscription_count() > 0
