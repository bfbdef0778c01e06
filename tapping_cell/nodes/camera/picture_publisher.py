"""Camera topics with the names of image_transport: raw images, compressed images, calibration."""

from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from tapping_cell.nodes.camera import images


class PicturePublisher:
    """Publish images, and additionally compressed images while these have a subscriber."""

    def __init__(self, node: Node, quality: int) -> None:
        """``quality``: JPEG quality, 1 to 100."""
        self._quality = quality
        self._raw = node.create_publisher(Image, images.RAW, images.PICTURES)
        self._compressed = node.create_publisher(
            CompressedImage, images.COMPRESSED, images.COMPRESSED_PICTURES
        )
        self._info = node.create_publisher(CameraInfo, "camera/camera_info", images.PICTURES)

    def subscribers(self) -> int:
        """Number of subscribers to the images."""
        return self._raw.get_subscription_count() + self._compressed.get_subscription_count()

    def publish(self, picture: Image, info: CameraInfo) -> None:
        """Publish an image, and the calibration with the same stamp."""
        info.header.stamp = picture.header.stamp
        self._info.publish(info)
        self._raw.publish(picture)
        if self._compressed.get_subscription_count():
            self._compressed.publish(images.compress(picture, self._quality))
