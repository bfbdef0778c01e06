"""Conversion of planar poses and their covariances from and to messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tapping_cell.messages import Point, Quaternion
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.se2 import Pose
from tapping_cell.se2 import from_message as from_message
from tapping_cell.se2 import is_finite as is_finite

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_PLANAR = (0, 1, 5)
"""Rows and columns of x, y and the rotation about z in a 6 x 6 covariance."""


def to_message(pose: Pose, height: float = 0.0) -> PoseMessage:
    """Convert a planar pose at a height in m to a message."""
    return PoseMessage(
        position=Point(x=pose.x, y=pose.y, z=height),
        orientation=Quaternion(z=math.sin(pose.theta / 2), w=math.cos(pose.theta / 2)),
    )


def compose(frame: PoseMessage, pose: PoseMessage) -> PoseMessage:
    """Convert a pose from a frame to its parent; ``frame``: the frame's pose in the parent."""
    turn, own = _rotation(frame.orientation), _rotation(pose.orientation)
    p, origin = pose.position, frame.position
    x, y, z = turn.apply([p.x, p.y, p.z])
    qx, qy, qz, qw = (turn * own).as_quat()
    return PoseMessage(
        position=Point(x=origin.x + float(x), y=origin.y + float(y), z=origin.z + float(z)),
        orientation=Quaternion(x=float(qx), y=float(qy), z=float(qz), w=float(qw)),
    )


def _rotation(q: Quaternion) -> Rotation:
    # Imported only here, because the import takes 0.4 s and only poses in frames other than `table`
    # need it.
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat([q.x, q.y, q.z, q.w])


def quaternion_norm(message: PoseMessage) -> float:
    """Return the norm of the orientation quaternion; 1 for a rotation."""
    q = message.orientation
    return math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)


def tilt(message: PoseMessage) -> float:
    """Return the angle in rad between the z axes of the pose and of its frame; the quaternion must
    be normalised."""
    q = message.orientation
    return math.acos(max(-1.0, min(1.0, 1 - 2 * (q.x * q.x + q.y * q.y))))


def covariance_from_message(values: Sequence[float]) -> NDArray[np.float64]:
    """Return the 3 x 3 covariance of (x, y, theta) from the 36 numbers of a pose covariance."""
    full = np.asarray(values, dtype=float).reshape(6, 6)
    return full[np.ix_(_PLANAR, _PLANAR)]


def covariance_to_message(covariance: NDArray[np.float64]) -> list[float]:
    """Convert a 3 x 3 covariance of (x, y, theta) to the 36 numbers of a pose covariance."""
    full = [0.0] * 36
    for row, values in zip(_PLANAR, covariance.tolist(), strict=True):
        for column, value in zip(_PLANAR, values, strict=True):
            full[6 * row + column] = value
    return full
