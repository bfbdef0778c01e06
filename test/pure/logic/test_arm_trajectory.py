"""A received joint trajectory is converted point by point, or refused."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.arm_trajectory import trajectory_targets
from tapping_cell.messages import Duration, JointTrajectory, JointTrajectoryPoint

FINITE = st.floats(-3.0, 3.0)


def trajectory(names, points) -> JointTrajectory:
    """``points``: positions, and the time in ns."""
    return JointTrajectory(
        joint_names=list(names),
        points=[
            JointTrajectoryPoint(
                positions=list(positions),
                time_from_start=Duration(sec=due // 10**9, nanosec=due % 10**9),
            )
            for positions, due in points
        ],
    )


@given(
    names=st.permutations(Joints._fields),
    positions=st.lists(st.tuples(FINITE, FINITE, FINITE, FINITE), min_size=1, max_size=4),
    first=st.integers(0, 5 * 10**9),
    step=st.integers(1, 5 * 10**9),
)
def test_joints_in_any_order_become_targets_at_their_times(names, positions, first, step):
    points = [(point, first + number * step) for number, point in enumerate(positions)]
    targets = trajectory_targets(trajectory(names, points))
    assert len(targets) == len(points)
    for (joints, due), (point, nanoseconds) in zip(targets, points, strict=True):
        assert joints._asdict() == dict(zip(names, point, strict=True))
        assert due == pytest.approx(1e-9 * nanoseconds, rel=1e-12)


HOME = (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("names", "points", "word"),
    [
        (Joints._fields, [], "0 points"),
        (Joints._fields[:3], [(HOME[:3], 0)], "its joints are"),
        ((*Joints._fields[:3], "wrist"), [(HOME, 0)], "its joints are"),
        (Joints._fields, [(HOME, 0), (HOME[:3], 1)], "point 2 has the positions"),
        (Joints._fields, [((0.0, math.nan, 0.0, 0.0), 0)], "finite"),
        (Joints._fields, [((0.0, 0.0, 0.0, math.inf), 0)], "finite"),
        (Joints._fields, [(HOME, -1)], "must be later than 0 s"),
        (Joints._fields, [(HOME, 10**9), (HOME, 10**9)], "must be later than 1 s"),
        (Joints._fields, [(HOME, 2 * 10**9), (HOME, 10**9)], "point 2 is due at 1 s"),
    ],
)
def test_an_invalid_trajectory_is_refused_with_its_cause(names, points, word):
    with pytest.raises(ValueError, match=word):
        trajectory_targets(trajectory(names, points))
