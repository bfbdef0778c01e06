"""Values of recorded messages: times and planar poses."""

from __future__ import annotations

import math
from typing import Any

from tapping_cell.se2 import Pose


def seconds_of(stamp: Any) -> float:
    """Return a ROS time in s."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def pose_of(pose: Any) -> Pose:
    """Return the planar part of a ROS pose, in m and rad."""
    q = pose.orientation
    theta = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
    return Pose(float(pose.position.x), float(pose.position.y), theta)
