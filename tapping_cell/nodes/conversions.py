"""Conversion of planar poses, goals and times from and to ROS messages.

Imports nothing large, so that a client that only sends a goal starts fast.
"""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time as TimeMessage
from geometry_msgs.msg import Pose as PoseMessage
from tapping_cell_msgs.action import PositionObject
from tapping_cell_msgs.msg import ObjectGoal

from tapping_cell.se2 import Pose
from tapping_cell.se2 import from_message as from_message
from tapping_cell.se2 import is_finite as is_finite


def to_message(pose: Pose, height: float = 0.0) -> PoseMessage:
    """Convert a planar pose at a height in m to a ROS pose."""
    message = PoseMessage()
    message.position.x, message.position.y, message.position.z = pose.x, pose.y, height
    message.orientation.z = math.sin(pose.theta / 2)
    message.orientation.w = math.cos(pose.theta / 2)
    return message


def seconds(stamp: TimeMessage) -> float:
    """Convert a ROS stamp to seconds."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def position_goal(
    pose: Pose, tolerance: tuple[float, float], stamp: TimeMessage, name: str = ""
) -> PositionObject.Goal:
    """Return a goal in ``table`` of an object; without a name, it is the cell's own object. A
    tolerance (m, rad) of 0 selects the cell's default."""
    goal = PositionObject.Goal(
        object_id=name, position_tolerance=tolerance[0], angle_tolerance=tolerance[1]
    )
    goal.goal_pose.header.frame_id, goal.goal_pose.header.stamp = "table", stamp
    goal.goal_pose.pose = to_message(pose)
    return goal


def object_goal(name: str, pose: Pose, tolerance: tuple[float, float]) -> ObjectGoal:
    """Return the goal in ``table`` of one object of an arrangement. A tolerance (m, rad) of 0
    selects the cell's default."""
    goal = ObjectGoal(object_id=name, position_tolerance=tolerance[0], angle_tolerance=tolerance[1])
    goal.goal_pose.header.frame_id = "table"
    goal.goal_pose.pose = to_message(pose)
    return goal
