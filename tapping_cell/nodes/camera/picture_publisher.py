"""The camera's topics as image_transport names them: raw, compressed and the calibration."""

from __future__ import annotations

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from tapping_cell.nodes.camera import images


class PicturePublisher:
    """Publishes pictures; compressed ones only while somebody subscribes to them."""

    def __init__(self, node: Node, quality: int) -> None:
        """``quality`` of the JPEG pictures, 1 to 100."""
        self._quality = quality
        self._raw = node.create_publisher(Image, images.RAW, images.PICTURES)
        self._compressed = node.create_publisher(
            CompressedImage, images.COMPRESSED, images.COMPRESSED_PICTURES
        )
        self._info = node.create_publisher(CameraInfo, "camera/camera_info", images.PICTURES)

    def listeners(self) -> int:
        """How many subscribe to pictures."""
        return self._raw.get_subscription_count() + self._compressed.get_subscription_count()

    def publish(self, picture: Image, info: CameraInfo) -> None:
        """Publish a picture and its calibration, which gets the picture's stamp."""
        info.header.stamp = picture.header.stamp
        self._info.publish(info)
        self._raw.publish(picture)
        if self._compressed.get_subscription_count():
            self._compressed.publish(images.compress(picture, self._quality))
