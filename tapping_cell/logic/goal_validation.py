"""Validation of the message of a goal. ``planning/goal.py`` checks whether its pose is possible."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.logic.clock import to_nanoseconds, to_seconds
from tapping_cell.logic.frames import TABLE, FrameError, Frames
from tapping_cell.logic.poses import compose, from_message, is_finite, quaternion_norm, tilt
from tapping_cell.messages import ErrorCode, PoseStamped
from tapping_cell.planning import RefusalReason
from tapping_cell.planning.settings import LARGEST_ANGLE_TOLERANCE, LARGEST_POSITION_TOLERANCE
from tapping_cell.se2 import Pose

LARGEST_TILT = math.radians(0.5)
LARGEST_HEIGHT = 0.001
NORM_SLACK = 0.01
OLDEST_S = 60.0
FARTHEST_AHEAD_S = 5.0
MIN_TOLERANCE = 5e-5
"""Minimum tolerance of position (m) and angle (rad) for any object."""

REFUSALS = {
    RefusalReason.GOAL_NOT_FINITE: ErrorCode.GOAL_NOT_FINITE,
    RefusalReason.GOAL_OFF_TABLE: ErrorCode.GOAL_OFF_TABLE,
    RefusalReason.GOAL_IN_KEEP_OUT: ErrorCode.GOAL_IN_KEEP_OUT,
    RefusalReason.GOAL_OUT_OF_REACH: ErrorCode.GOAL_OUT_OF_REACH,
    RefusalReason.NO_PATH_TO_GOAL: ErrorCode.NO_TAP_FOUND,
    RefusalReason.OBJECT_POSE_NOT_FINITE: ErrorCode.OBJECT_NOT_SEEN,
    RefusalReason.OBJECT_OFF_TABLE: ErrorCode.OBJECT_OFF_TABLE,
    RefusalReason.NO_STRIKE: ErrorCode.NO_TAP_FOUND,
    RefusalReason.PROBE_NEEDED: ErrorCode.PROBE_NEEDED,
    RefusalReason.NO_CONTACT: ErrorCode.NO_CONTACT_FOUND,
    RefusalReason.GOAL_OUTSIDE_WORKING_AREA: ErrorCode.GOAL_OUTSIDE_WORKING_AREA,
    RefusalReason.CAMERA_TOO_COARSE: ErrorCode.OBJECT_NOT_SEEN,
    RefusalReason.TOO_MANY_TAPS: ErrorCode.TAP_LIMIT_REACHED,
    RefusalReason.TAP_LEAVES_TABLE: ErrorCode.TAP_LEAVES_TABLE,
    RefusalReason.TAP_LEAVES_VIEW: ErrorCode.TAP_LEAVES_VIEW,
    RefusalReason.GOALS_OVERLAP: ErrorCode.GOALS_OVERLAP,
    RefusalReason.NO_ARRANGEMENT: ErrorCode.NO_ARRANGEMENT,
    RefusalReason.TAP_WITHOUT_ROTATION: ErrorCode.TAP_WITHOUT_ROTATION,
}
"""Error code of each refusal reason of the planning package."""


@dataclass(frozen=True, slots=True)
class Refused:
    """Refusal of a goal, with an error code and a message."""

    code: int
    sentence: str


def read_goal(message: PoseStamped, now: float, frames: Frames) -> Pose | Refused:
    """Return the planar goal of a message in ``table``, or why it is refused.

    ``now`` is ROS time in s; ``frames`` returns the pose of the message's frame in ``table``.
    """
    if not is_finite(message.pose):
        return Refused(
            ErrorCode.GOAL_NOT_FINITE,
            f"the goal {_numbers(message)} contains a number that is not finite; send a valid pose",
        )
    norm = quaternion_norm(message.pose)
    if abs(norm - 1) > NORM_SLACK:
        return Refused(
            ErrorCode.GOAL_BAD_ORIENTATION,
            f"the goal's quaternion has length {norm:.3f}, but must have length 1 within "
            f"{NORM_SLACK:g}; for an angle a about z send z = sin(a/2), w = cos(a/2)",
        )
    stamp = to_seconds(message.header.stamp)
    if to_nanoseconds(message.header.stamp) < 0:
        return Refused(
            ErrorCode.GOAL_STALE,
            f"the goal's stamp is negative ({stamp:g} s); send the goal again with a current stamp"
            " or with stamp 0",
        )
    frame, pose = message.header.frame_id, message.pose
    if frame != TABLE:
        try:
            pose = compose(frames.in_table(frame, message.header.stamp), pose)
        except FrameError as error:
            return Refused(ErrorCode.GOAL_WRONG_FRAME, str(error))
    tilted = tilt(pose)
    height = pose.position.z
    if tilted > LARGEST_TILT or abs(height) > LARGEST_HEIGHT:
        return Refused(
            ErrorCode.GOAL_NOT_PLANAR,
            f"the goal is tilted by {math.degrees(tilted):.2f} deg and lifted by "
            f"{1000 * height:.2f} mm in '{TABLE}'; at most {math.degrees(LARGEST_TILT):.1f} deg "
            f"and {1000 * LARGEST_HEIGHT:.0f} mm are accepted, because taps keep the object flat on"
            " the table",
        )
    age = now - stamp
    if stamp > 0 and not -FARTHEST_AHEAD_S <= age <= OLDEST_S:
        return Refused(
            ErrorCode.GOAL_STALE,
            f"the goal's stamp is {abs(age):.1f} s in the {'past' if age > 0 else 'future'}; it "
            f"may be at most {OLDEST_S:.0f} s in the past and {FARTHEST_AHEAD_S:.0f} s in the "
            "future; send the goal again with a current stamp or with stamp 0",
        )
    return from_message(pose)


def read_tolerance(
    position: float, angle: float, default: tuple[float, float]
) -> tuple[float, float] | Refused:
    """Return the tolerance of an action goal in m and rad; 0 means the cell's default."""
    for name, value, largest, scale, unit in (
        ("position", position, LARGEST_POSITION_TOLERANCE, 1e3, "mm"),
        ("angle", angle, LARGEST_ANGLE_TOLERANCE, math.degrees(1.0), "deg"),
    ):
        if value != 0 and not MIN_TOLERANCE <= value <= largest:  # also refuses NaN
            return Refused(
                ErrorCode.GOAL_BAD_TOLERANCE,
                f"the {name} tolerance is {scale * value:.3g} {unit}; it must be at least "
                f"{scale * MIN_TOLERANCE:.3g} {unit} and at most {scale * largest:.3g} {unit}, "
                "or 0 for the cell's tolerance",
            )
    return position or default[0], angle or default[1]


def _numbers(message: PoseStamped) -> str:
    p, q = message.pose.position, message.pose.orientation
    return f"({p.x}, {p.y}, {p.z}; {q.x}, {q.y}, {q.z}, {q.w})"
