"""Random joint trajectories of another program."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.messages import JointTrajectory, JointTrajectoryPoint

DURATION_S = 3
"""Time from the start of a trajectory to its last point, s."""
LOWEST, HIGHEST = (-0.5, 0.5, -0.05, -1.0), (1.0, 1.8, 0.0, 1.0)
"""Range of the joints of a valid point: rad, rad, m, rad."""
MOST_POINTS = 3
NOT_A_NUMBER, OUTSIDE = "not a number", "outside its limits"
FALLING_TIMES, UNKNOWN_JOINT = "times that fall", "unknown joint"
WRONG = (NOT_A_NUMBER, OUTSIDE, FALLING_TIMES, UNKNOWN_JOINT)


def draw_trajectory(
    rng: np.random.Generator, names: tuple[str, ...], wrong: str = ""
) -> JointTrajectory:
    """Choose a trajectory with a few points and its joints in any order. ``names``: joints of the
    arm; ``wrong``: one of ``WRONG``, or empty for a valid trajectory."""
    order = [int(index) for index in rng.permutation(len(names))]
    number = int(rng.integers(1, MOST_POINTS + 1))
    if wrong == FALLING_TIMES:
        number = MOST_POINTS
    message = JointTrajectory(joint_names=[names[index] for index in order])
    for place in range(number):
        is_last = place == number - 1
        joints = [float(value) for value in rng.uniform(LOWEST, HIGHEST)]
        if is_last and wrong == NOT_A_NUMBER:
            joints[int(rng.integers(len(joints)))] = math.nan
        elif is_last and wrong == OUTSIDE:
            joints[int(rng.integers(2))] = 10.0
        point = JointTrajectoryPoint(positions=[joints[index] for index in order])
        at = DURATION_S * 10**9 * (place + 1) // number
        if is_last and wrong == FALLING_TIMES:
            at //= 2
        point.time_from_start.sec, point.time_from_start.nanosec = divmod(at, 10**9)
        message.points.append(point)
    if wrong == UNKNOWN_JOINT:
        message.joint_names[0] = "elbow_of_another_arm"
    return message
