"""Conversion of a received joint trajectory."""

from __future__ import annotations

import math

from tapping_cell.hardware.scara import Joints
from tapping_cell.messages import JointTrajectory


def trajectory_targets(message: JointTrajectory) -> list[tuple[Joints, float]]:
    """Return, for each point, the joint values and the time from the start of the trajectory, s.

    Raises:
        ValueError: the trajectory is invalid; the message says why.
    """
    names = list(Joints._fields)
    if sorted(message.joint_names) != sorted(names) or not message.points:
        raise ValueError(
            f"its joints are {list(message.joint_names)} with {len(message.points)} points; it"
            f" needs points for {names}"
        )
    order = [list(message.joint_names).index(name) for name in names]
    targets: list[tuple[Joints, float]] = []
    for number, point in enumerate(message.points, start=1):
        if len(point.positions) != len(names) or not all(map(math.isfinite, point.positions)):
            raise ValueError(
                f"point {number} has the positions {list(point.positions)}; it needs four finite"
                " numbers (rad, rad, m, rad)"
            )
        at = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        before = targets[-1][1] if targets else 0.0
        if at < 0 or (targets and at <= before):
            raise ValueError(
                f"point {number} is due at {at:g} s, but must be later than {before:g} s"
            )
        targets.append((Joints(*(point.positions[index] for index in order)), at))
    return targets
