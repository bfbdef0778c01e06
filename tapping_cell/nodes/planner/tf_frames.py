"""Lookup of the frames of the planner's goals on ``/tf``, if tf2_ros is installed."""

from __future__ import annotations

import yaml
from geometry_msgs.msg import TransformStamped
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.frames import TABLE, FrameError, Frames, TableOnly
from tapping_cell.messages import Point, Pose, Quaternion
from tapping_cell.messages import Time as Stamp

try:
    import tf2_ros
except ImportError:
    tf2_ros = None

KEPT_S = 60.0
"""Time for which transforms are kept. This time is also the maximum age of a goal's stamp."""
NEWEST_S = 0.5
"""If a goal's stamp is newer than the newest transform by at most this time (s), the newest
transform is used."""


class TfFrames:
    """Buffer of the transforms on ``/tf`` and ``/tf_static``."""

    def __init__(self, node: Node, prefix: str) -> None:
        self._table = prefix + TABLE
        self._buffer = tf2_ros.Buffer(cache_time=Duration(seconds=KEPT_S))
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def in_table(self, frame: str, stamp: Stamp) -> Pose:
        """See ``logic.frames.Frames``."""
        try:
            found = self._lookup(frame, Time(nanoseconds=to_nanoseconds(stamp)))
        except (tf2_ros.TransformException, ValueError) as error:
            # rclpy raises ValueError for a time that ROS cannot represent.
            raise FrameError(self._refusal(frame, error)) from error
        place, turn = found.transform.translation, found.transform.rotation
        return Pose(
            position=Point(x=place.x, y=place.y, z=place.z),
            orientation=Quaternion(x=turn.x, y=turn.y, z=turn.z, w=turn.w),
        )

    def _lookup(self, frame: str, at: Time) -> TransformStamped:
        try:
            return self._buffer.lookup_transform(self._table, frame, at)
        except tf2_ros.ExtrapolationException:
            newest = self._buffer.lookup_transform(self._table, frame, Time())
            behind = at.nanoseconds - Time.from_msg(newest.header.stamp).nanoseconds
            if not 0 <= behind <= 1e9 * NEWEST_S:
                raise
            return newest

    def _refusal(self, frame: str, error: Exception) -> str:
        known = self._known()
        if frame in known:
            return f"the pose of the goal's frame '{frame}' at the goal's stamp is unknown: {error}"
        return (
            f"the goal's frame_id is '{frame}', which is not connected to '{self._table}'; use one "
            f"of {', '.join((self._table, *known))}"
        )

    def _known(self) -> list[str]:
        """Return the frames that are connected to ``table``."""
        # This loader leaves every name a string, also a name that looks like a number.
        received = yaml.load(self._buffer.all_frames_as_yaml(), Loader=yaml.BaseLoader) or {}
        names = set(received) | {entry["parent"] for entry in received.values()}
        table = self._table
        return sorted(n for n in names - {table} if self._buffer.can_transform(table, n, Time()))


def open_frames(node: Node, prefix: str) -> Frames:
    """Return the source of the frames on ``/tf``, where the cell's frames have this prefix. If
    tf2_ros is not installed, return a source of ``table`` only."""
    return TableOnly() if tf2_ros is None else TfFrames(node, prefix)
