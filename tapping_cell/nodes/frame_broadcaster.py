"""Publish frames on ``/tf`` and ``/tf_static`` if tf2_msgs is installed; otherwise do nothing."""

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
"""Queue depth of ``/tf``, as in tf2_ros."""


class FrameBroadcaster:
    """Publisher of the frames that one node is responsible for."""

    def __init__(self, node: Node, *, moving: bool = True) -> None:
        """``moving``: whether some of the frames move. If not, ``/tf`` gets no publisher."""
        self._node = node
        self._moving = self._fixed = None
        self._fixed_frames: dict[str, TransformStamped] = {}
        if TFMessage is not None:
            self._fixed = node.create_publisher(TFMessage, "/tf_static", LATCHED)
            if moving:
                self._moving = node.create_publisher(TFMessage, "/tf", DEPTH)

    @property
    def is_open(self) -> bool:
        """Return whether frames are published."""
        return self._fixed is not None

    def send(self, frames: Iterable[TransformStamped]) -> None:
        """Publish the transforms of moving frames, each valid at its stamp."""
        if self._moving is not None and self._node.context.ok():
            self._moving.publish(TFMessage(transforms=list(frames)))

    def send_fixed(self, frames: Iterable[TransformStamped]) -> None:
        """Publish the transforms of fixed frames, also for subscribers that join later."""
        # A late subscriber receives only the last latched message, so each message contains all
        # frames.
        self._fixed_frames.update({frame.child_frame_id: frame for frame in frames})
        if self._fixed is not None and self._node.context.ok():
            self._fixed.publish(TFMessage(transforms=list(self._fixed_frames.values())))


def transform(parent: str, child: str, pose: Pose, stamp: Time) -> TransformStamped:
    """Return the transform message for the pose of ``child`` in ``parent``."""
    made = TransformStamped(child_frame_id=child)
    made.header.frame_id, made.header.stamp = parent, stamp
    place = made.transform.translation
    place.x, place.y, place.z = pose.position.x, pose.position.y, pose.position.z
    made.transform.rotation = pose.orientation
    return made
