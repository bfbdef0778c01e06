"""Frames on ``/tf`` and ``/tf_static``, where tf2_msgs is installed; without it nothing is sent."""

from __future__ import annotations

from collections.abc import Iterable

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, TransformStamped
from rclpy.node import Node

from tapping_cell.nodes.cell_node import LATCHED

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

DEPTH = 100
"""Of the queue on ``/tf``, as tf2_ros has it."""


class FrameBroadcaster:
    """The frames of which one node is the authority."""

    def __init__(self, node: Node, *, moving: bool = True) -> None:
        """``moving``: some of them move, so that ``/tf`` is opened, too."""
        self._node = node
        self._moving = self._fixed = None
        self._fixed_frames: dict[str, TransformStamped] = {}
        if TFMessage is not None:
            self._fixed = node.create_publisher(TFMessage, "/tf_static", LATCHED)
            if moving:
                self._moving = node.create_publisher(TFMessage, "/tf", DEPTH)

    @property
    def is_open(self) -> bool:
        """Whether anything is sent."""
        return self._fixed is not None

    def send(self, frames: Iterable[TransformStamped]) -> None:
        """Send where frames are at the time of their stamps."""
        if self._moving is not None and self._node.context.ok():
            self._moving.publish(TFMessage(transforms=list(frames)))

    def send_fixed(self, frames: Iterable[TransformStamped]) -> None:
        """Send where fixed frames are; listeners that join later hear it, too."""
        # A latched publisher resends its last message alone, so that each holds all frames.
        self._fixed_frames.update({frame.child_frame_id: frame for frame in frames})
        if self._fixed is not None and self._node.context.ok():
            self._fixed.publish(TFMessage(transforms=list(self._fixed_frames.values())))


def transform(parent: str, child: str, pose: Pose, stamp: Time) -> TransformStamped:
    """The message that says where a frame is: the pose of ``child`` in ``parent``."""
    made = TransformStamped(child_frame_id=child)
    made.header.frame_id, made.header.stamp = parent, stamp
    place = made.transform.translation
    place.x, place.y, place.z = pose.position.x, pose.position.y, pose.position.z
    made.transform.rotation = pose.orientation
    return made
