"""Between the cell's messages and the values that the simulator reckons with."""

from __future__ import annotations

import math

from tapping_cell.logic.clock import to_nanoseconds, to_stamp
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.messages import Time
from tapping_cell.se2 import Pose


def pose_of(message: PoseMessage) -> Pose:
    """The planar pose of a message."""
    q = message.orientation
    return Pose(message.position.x, message.position.y, 2.0 * math.atan2(q.z, q.w))


def pose_message(pose: Pose, height: float = 0.0) -> PoseMessage:
    """A message of a planar pose; ``height`` in m."""
    message = PoseMessage()
    message.position.x, message.position.y, message.position.z = pose.x, pose.y, height
    message.orientation.z = math.sin(pose.theta / 2)
    message.orientation.w = math.cos(pose.theta / 2)
    return message


def time_of(stamp: Time) -> int:
    """A stamp in ns."""
    return to_nanoseconds(stamp)


def time_message(nanoseconds: int) -> Time:
    """A time in ns as a stamp."""
    return to_stamp(nanoseconds)
