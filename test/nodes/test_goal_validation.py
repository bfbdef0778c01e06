"""Goals are refused by code and sentence before anything moves."""

from __future__ import annotations

import math

import pytest
from geometry_msgs.msg import PoseStamped
from hypothesis import given
from hypothesis import strategies as st
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.nodes.conversions import from_message, to_message
from tapping_cell.nodes.planner.goal_validation import Refused, read_goal, read_tolerance
from tapping_cell.se2 import Pose

NOW = 1000.0
SOMEWHERE = Pose(0.01, 0.02, 0.3)


def goal_message(pose: Pose = SOMEWHERE) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "table"
    message.pose = to_message(pose)
    return message


@given(
    x=st.floats(-1, 1),
    y=st.floats(-1, 1),
    theta=st.floats(-3.1, 3.1),
    flip=st.sampled_from([1, -1]),
)
def test_a_planar_goal_in_table_is_read_as_it_was_meant(
    x: float, y: float, theta: float, flip: int
) -> None:
    message = goal_message(Pose(x, y, theta))
    # A quaternion and its negative are the same rotation.
    q = message.pose.orientation
    q.z, q.w = flip * q.z, flip * q.w
    goal = read_goal(message, NOW)
    assert isinstance(goal, Pose)
    assert goal[:2] == pytest.approx((x, y))
    assert math.cos(goal.theta - theta) == pytest.approx(1.0)


def spoiled(**changes: float | str) -> PoseStamped:
    message = goal_message()
    for path, value in changes.items():
        owner, name = message, path
        for step in path.split("__")[:-1]:
            owner = getattr(owner, step)
        setattr(owner, name.split("__")[-1], value)
    return message


@pytest.mark.parametrize(
    ("message", "code", "word"),
    [
        (spoiled(header__frame_id="map"), ErrorCode.GOAL_WRONG_FRAME, "'map'"),
        (spoiled(header__frame_id=""), ErrorCode.GOAL_WRONG_FRAME, "''"),
        (spoiled(pose__position__x=math.nan), ErrorCode.GOAL_NOT_FINITE, "nan"),
        (spoiled(pose__position__z=math.inf), ErrorCode.GOAL_NOT_FINITE, "inf"),
        (spoiled(pose__orientation__w=math.nan), ErrorCode.GOAL_NOT_FINITE, "nan"),
        (spoiled(pose__orientation__w=0.0), ErrorCode.GOAL_BAD_ORIENTATION, "0.149"),
        (spoiled(pose__position__z=0.05), ErrorCode.GOAL_NOT_PLANAR, "50.00 mm"),
        (spoiled(header__stamp__sec=900), ErrorCode.GOAL_STALE, "100.0 s"),
        (spoiled(header__stamp__sec=1100), ErrorCode.GOAL_STALE, "-100.0 s"),
    ],
)
def test_a_bad_goal_is_refused_with_its_code_and_value(
    message: PoseStamped, code: int, word: str
) -> None:
    refused = read_goal(message, NOW)
    assert isinstance(refused, Refused)
    assert refused.code == code
    assert word in refused.sentence


def test_a_tilted_goal_is_refused() -> None:
    message = goal_message(Pose(0.0, 0.0, 0.0))
    message.pose.orientation.x = math.sin(0.1)
    message.pose.orientation.w = math.cos(0.1)
    refused = read_goal(message, NOW)
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_NOT_PLANAR
    assert "11.46 deg" in refused.sentence


@given(position=st.floats(), angle=st.floats())
def test_tolerances_are_the_cells_own_or_sound(position: float, angle: float) -> None:
    found = read_tolerance(position, angle, (0.001, 0.017))
    if isinstance(found, Refused):
        assert found.code == ErrorCode.GOAL_BAD_TOLERANCE
        return
    assert found[0] == (position or 0.001) and found[1] == (angle or 0.017)
    assert all(value >= 1e-4 for value in found)


@given(x=st.floats(-1, 1), y=st.floats(-1, 1), theta=st.floats(-3.1, 3.1))
def test_poses_survive_the_way_through_a_message(x: float, y: float, theta: float) -> None:
    assert from_message(to_message(Pose(x, y, theta))) == pytest.approx((x, y, theta))
