"""Invalid goals are refused with an error code and a message before anything moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.logic.frames import FrameError, TableOnly
from tapping_cell.logic.goal_validation import Refused, read_goal, read_tolerance
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.messages import ErrorCode, Point, PoseStamped, Quaternion, Time
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.planning import PlannerSettings
from tapping_cell.se2 import Pose

Numbers = tuple[float, ...]
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
def test_a_planar_goal_in_the_table_frame_is_read_unchanged(x, y, theta, flip):
    message = goal_message(Pose(x, y, theta))
    # A quaternion and its negative describe the same rotation.
    q = message.pose.orientation
    q.z, q.w = flip * q.z, flip * q.w
    goal = read_goal(message, NOW, TableOnly())
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
        (spoiled(header__stamp__sec=900), ErrorCode.GOAL_STALE, "100.0 s in the past"),
        (spoiled(header__stamp__sec=1100), ErrorCode.GOAL_STALE, "100.0 s in the future"),
    ],
)
def test_an_invalid_goal_is_refused_with_its_code_and_value(message, code, word):
    refused = read_goal(message, NOW, TableOnly())
    assert isinstance(refused, Refused)
    assert refused.code == code
    assert word in refused.sentence


def test_a_tilted_goal_is_refused() -> None:
    message = goal_message(Pose(0.0, 0.0, 0.0))
    message.pose.orientation.x = math.sin(0.1)
    message.pose.orientation.w = math.cos(0.1)
    refused = read_goal(message, NOW, TableOnly())
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_NOT_PLANAR
    assert "11.46 deg" in refused.sentence


def point(values: Sequence[float]) -> Point:
    return Point(**dict(zip("xyz", map(float, values), strict=True)))


def quaternion(values: Sequence[float]) -> Quaternion:
    return Quaternion(**dict(zip("xyzw", values, strict=True)))


class OneFrame:
    """Frame lookup that only knows the pose of the frame ``fixture``."""

    def __init__(self, place: Numbers, turn: Numbers) -> None:
        self.pose = PoseMessage(position=point(place), orientation=quaternion(turn))

    def in_table(self, frame: str, stamp: Time) -> PoseMessage:
        if frame != "fixture":
            raise FrameError(f"'{frame}' is not known; known are table, fixture")
        return self.pose


def matrix(q: Numbers) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion by the textbook formula."""
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


quaternions = (
    st.tuples(*[st.floats(-1, 1)] * 4)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: tuple(v / math.hypot(*q) for v in q))
)


@given(
    place=st.tuples(*[st.floats(-2, 2)] * 3),
    turn=quaternions,
    wanted=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3.1, 3.1)),
)
def test_a_goal_in_another_frame_gives_the_same_table_pose(place, turn, wanted):
    # Express the goal in another frame, which may have any pose, such as the frame of a camera.
    rotation, planar = matrix(turn), matrix(tuple(vars_of(to_message(Pose(*wanted)))))
    local = rotation.T @ (np.array([wanted[0], wanted[1], 0.0]) - place)
    own = rotation.T @ planar
    message = PoseStamped(
        pose=PoseMessage(position=point(local), orientation=quaternion(quaternion_of(own)))
    )
    message.header.frame_id = "fixture"
    goal = read_goal(message, NOW, OneFrame(place, turn))
    assert isinstance(goal, Pose), goal
    assert goal[:2] == pytest.approx(wanted[:2], abs=1e-9)
    assert math.remainder(goal.theta - wanted[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-6)


def vars_of(pose: PoseMessage) -> Numbers:
    q = pose.orientation
    return q.x, q.y, q.z, q.w


def quaternion_of(rotation: np.ndarray) -> Numbers:
    """Return the unit quaternion of a rotation as the eigenvector of Bar-Itzhack's matrix."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
            [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
            [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], np.trace(r)],
        ]
    )
    values, vectors = np.linalg.eigh(k / 3)
    return tuple(float(v) for v in vectors[:, np.argmax(values)])


def test_a_goal_that_is_not_flat_on_the_table_in_its_frame_is_refused() -> None:
    message = goal_message()
    message.header.frame_id = "fixture"
    leaning = (math.sin(0.1), 0.0, 0.0, math.cos(0.1))
    refused = read_goal(message, NOW, OneFrame((0.0, 0.0, 0.0), leaning))
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_NOT_PLANAR
    lifted = read_goal(message, NOW, OneFrame((0.0, 0.0, 0.02), (0.0, 0.0, 0.0, 1.0)))
    assert isinstance(lifted, Refused) and "20.00 mm in 'table'" in lifted.sentence


class NoLookup:
    """Frame lookup that must not be used."""

    def in_table(self, frame: str, stamp: Time) -> PoseMessage:
        raise AssertionError("the frame was looked up")


@pytest.mark.parametrize("frame", ["table", "fixture"])
@given(sec=st.integers(-(2**31), -1), nanosec=st.integers(0, 10**9 - 1))
def test_a_negative_stamp_is_refused_before_the_frame_is_looked_up(frame, sec, nanosec):
    message = spoiled(header__frame_id=frame)
    message.header.stamp = Time(sec=sec, nanosec=nanosec)
    refused = read_goal(message, NOW, NoLookup())
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_STALE
    assert "negative" in refused.sentence


def test_an_unknown_frame_is_refused_with_the_list_of_known_frames() -> None:
    message = goal_message()
    message.header.frame_id = "fixtrue"
    refused = read_goal(message, NOW, OneFrame((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_WRONG_FRAME
    assert "'fixtrue'" in refused.sentence and "table, fixture" in refused.sentence


@given(position=st.floats(), angle=st.floats())
def test_tolerances_are_the_defaults_of_the_cell_or_valid_values(position, angle):
    found = read_tolerance(position, angle, (0.001, 0.017))
    if isinstance(found, Refused):
        assert found.code == ErrorCode.GOAL_BAD_TOLERANCE
        return
    assert found[0] == (position or 0.001) and found[1] == (angle or 0.017)
    assert all(value >= 5e-5 for value in found)
    PlannerSettings(tolerance_position=found[0], tolerance_angle=found[1])


@pytest.mark.parametrize(
    ("position", "angle", "words"),
    [
        (0.2, 0.0, ("position tolerance is 200 mm", "at most 100 mm")),
        (0.0, math.pi, ("angle tolerance is 180 deg", "at most 85.9 deg")),
        (1e-5, 0.0, ("position tolerance is 0.01 mm", "0.05 mm")),
    ],
)
def test_a_tolerance_out_of_range_is_refused_with_its_limits(position, angle, words):
    refused = read_tolerance(position, angle, (0.001, 0.017))
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_BAD_TOLERANCE
    assert all(word in refused.sentence for word in words)


@given(x=st.floats(-1, 1), y=st.floats(-1, 1), theta=st.floats(-3.1, 3.1))
def test_poses_survive_conversion_to_a_message_and_back(x: float, y: float, theta: float) -> None:
    assert from_message(to_message(Pose(x, y, theta))) == pytest.approx((x, y, theta))
