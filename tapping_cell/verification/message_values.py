"""Between the cell's messages and the values that the simulator reckons with."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from typing import Any

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


def copy_of(value: Any) -> Any:
    """A copy of a message that shares nothing with it that could change."""
    if isinstance(value, list):
        return [copy_of(item) for item in value]
    if not is_dataclass(value):
        return value
    made = object.__new__(type(value))
    for field in fields(value):
        object.__setattr__(made, field.name, copy_of(getattr(value, field.name)))
    return made


def time_of(stamp: Time) -> int:
    """A stamp in ns."""
    return to_nanoseconds(stamp)


def time_message(nanoseconds: int) -> Time:
    """A time in ns as a stamp."""
    return to_stamp(nanoseconds)
