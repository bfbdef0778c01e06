"""The moves of a tap: the order of raising, travelling and lowering; durations; limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hardware_faults import expect_fault
from hypothesis import assume, given
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.motion import (
    MotionSettings,
    check_limits,
    move_duration,
    path_duration,
    speed_for,
    strike_durations,
    strike_path,
    withdraw_path,
)
from tapping_cell.hardware.scara import Joints, ScaraGeometry, TipPose
from tapping_cell.simulation.joint_motion import trapezoid

GEOMETRY = ScaraGeometry()
SETTINGS = MotionSettings()

joint_values = st.tuples(
    *(st.floats(low, high) for low, high in zip(GEOMETRY.lower, GEOMETRY.upper, strict=True))
).map(lambda values: Joints(*values))


@given(joint_values, st.floats(0.2, 0.7), st.floats(-0.4, 0.4), st.floats(-3.1, 3.1))
def test_no_waypoint_sweeps_low(start: Joints, x: float, y: float, yaw: float) -> None:
    tip = TipPose(x, y, 0.01, yaw)
    assume(GEOMETRY.inverse(tip, near=start).success)
    path = strike_path(GEOMETRY, start, tip, SETTINGS)
    here = start
    for waypoint in path:
        sideways = any(
            abs(a - b) > 1e-12
            for a, b in zip(
                (here.shoulder, here.elbow, here.tool),
                (waypoint.joints.shoulder, waypoint.joints.elbow, waypoint.joints.tool),
                strict=True,
            )
        )
        if sideways:
            # Horizontal motion is allowed only above travel height. The path is straight in
            # joint space, so checking both ends is enough.
            for end in (here, waypoint.joints):
                assert GEOMETRY.forward(end).z >= SETTINGS.travel_height - 1e-12
        check_limits(GEOMETRY, waypoint.joints)
        here = waypoint.joints
    assert np.allclose(GEOMETRY.forward(here)[:3], tip[:3], atol=1e-9)


@given(joint_values, st.floats(0.2, 0.7), st.floats(-0.4, 0.4), st.floats(-3.1, 3.1))
def test_the_elbow_never_flips_where_its_side_reaches(start, x, y, yaw):
    tip = TipPose(x, y, 0.01, yaw)
    side = GEOMETRY.branch_of(start)
    assume(GEOMETRY.inverse(tip, side, near=start).success)
    for waypoint in strike_path(GEOMETRY, start, tip, SETTINGS):
        assert GEOMETRY.branch_of(waypoint.joints) is side


def test_withdrawing_backs_off_along_the_travel_then_raises_then_parks() -> None:
    tip = TipPose(0.45, 0.1, 0.01, 0.5)
    at_strike = GEOMETRY.inverse(tip).joints
    assert at_strike is not None
    path = withdraw_path(GEOMETRY, at_strike, SETTINGS)
    assert [w.phase for w in path] == ["raise", "travel"]
    assert path[0].via is not None
    behind = GEOMETRY.forward(path[0].via)
    assert behind.z == pytest.approx(tip.z)
    assert path[0].joints == path[0].via._replace(quill=path[0].joints.quill)
    along = (tip.x - behind.x) * math.cos(tip.yaw) + (tip.y - behind.y) * math.sin(tip.yaw)
    across = (tip.y - behind.y) * math.cos(tip.yaw) - (tip.x - behind.x) * math.sin(tip.yaw)
    assert along == pytest.approx(SETTINGS.back_off)
    assert across == pytest.approx(0, abs=1e-12)
    assert path[-1].joints == pytest.approx(SETTINGS.park)


def test_the_quill_moves_with_the_other_joints_down_to_the_travel_height() -> None:
    """A tap from a high park pose: quill motion above the travel height takes no additional
    time."""
    tip = TipPose(0.45, 0.1, 0.006, 0.5)
    settings = MotionSettings(park=(1.2, 1.2, -0.020, 0.0))
    path = strike_path(GEOMETRY, settings.park, tip, settings)
    travel, lower = path
    clear = settings.travel_height - GEOMETRY.tip_height
    assert travel.joints.quill == pytest.approx(clear)
    level = travel.joints._replace(quill=settings.park[2])
    assert path_duration(GEOMETRY, settings.park, path[:1]) == pytest.approx(
        move_duration(GEOMETRY, settings.park, level, settings.travel_speed)
    )
    back = withdraw_path(GEOMETRY, lower.joints, settings)
    assert back[0].joints.quill == pytest.approx(clear)
    assert back[-1].joints == pytest.approx(settings.park)


def test_no_withdrawal_is_needed_from_the_park_pose() -> None:
    assert withdraw_path(GEOMETRY, SETTINGS.park, SETTINGS) == ()


def test_out_of_reach_is_refused_with_a_message() -> None:
    with expect_fault(FaultReason.UNREACHABLE, "beyond the reach of 800.0 mm"):
        strike_path(GEOMETRY, SETTINGS.park, TipPose(1.2, 0, 0.01, 0), SETTINGS)


@given(joint_values, joint_values, st.floats(0.05, 1.0))
def test_the_duration_is_that_of_the_slowest_joint(start, goal, speed):
    """Compare the move with the emulator's trapezoidal speed profile for each joint alone. The move
    must take at least as long as the slowest joint, and at most twice as long."""
    duration = move_duration(GEOMETRY, start, goal, speed)
    single = 0.0
    for axis in range(4):
        length = abs(goal[axis] - start[axis])
        if length > 0:
            profile = trapezoid(
                0.0, length, GEOMETRY.max_speed[axis] * speed, GEOMETRY.max_acceleration[axis]
            )
            single = max(single, profile.end)
    assert duration >= single - 1e-9
    assert duration <= 2 * single + 1e-9


@given(joint_values, joint_values, st.floats(0.001, 20.0))
def test_a_move_takes_the_time_that_was_asked_for(start, goal, duration):
    fastest = move_duration(GEOMETRY, start, goal, 1.0)
    speed = speed_for(GEOMETRY, start, goal, duration)
    took = move_duration(GEOMETRY, start, goal, speed)
    assert 0.0 < speed <= 1.0
    if start != goal:
        assert took == pytest.approx(max(fastest, duration), rel=1e-6)


def test_path_duration_adds_the_moves() -> None:
    path = strike_path(GEOMETRY, SETTINGS.park, TipPose(0.45, 0.1, 0.01, 0.5), SETTINGS)
    path += withdraw_path(GEOMETRY, path[-1].joints, SETTINGS)
    here, total = Joints(*SETTINGS.park), 0.0
    for waypoint in path:
        for place, speed in (
            (waypoint.via, waypoint.via_speed or waypoint.speed),
            (waypoint.joints, waypoint.speed),
        ):
            if place is not None:
                total += move_duration(GEOMETRY, here, place, speed)
                here = place
    assert len(path) == 4 and path_duration(GEOMETRY, SETTINGS.park, path) == pytest.approx(total)


@given(joint_values, st.floats(0.2, 0.7), st.floats(-0.4, 0.4), st.floats(-3.1, 3.1))
def test_durations_of_many_strike_paths_match_each_single_path(start, x, y, yaw):
    tips = np.array([[x, y, 0.01, yaw], [x, -y, 0.01, -yaw], [2.0, 0.0, 0.01, 0.0]])
    many = strike_durations(GEOMETRY, start, tips, SETTINGS)
    assert math.isinf(many[2])
    for tip, seconds in zip(tips[:2], many, strict=False):
        if GEOMETRY.inverse(tip, near=start).success:
            path = strike_path(GEOMETRY, start, TipPose(*tip.tolist()), SETTINGS)
            assert seconds == pytest.approx(path_duration(GEOMETRY, start, path), abs=1e-9)
        else:
            assert math.isinf(seconds)


@pytest.mark.parametrize(
    ("joints", "words"),
    [
        ((5.0, 0, 0, 0), "shoulder at 286.48 deg"),
        ((0, 0, 0.1, 0), "quill at 100.00 mm"),
        ((math.nan, 0, 0, 0), "not four finite"),
    ],
)
def test_limits_are_reported_with_a_message(joints: tuple[float, ...], words: str) -> None:
    with expect_fault(FaultReason.OUT_OF_RANGE, words):
        check_limits(GEOMETRY, joints)


def test_settings_are_checked() -> None:
    with pytest.raises(ValueError, match="travel_speed"):
        MotionSettings(travel_speed=0.0)
    with pytest.raises(HardwareFault, match="lower travel_height"):
        strike_path(
            GEOMETRY,
            SETTINGS.park,
            TipPose(0.45, 0.1, 0.01, 0.5),
            MotionSettings(travel_height=0.5),
        )
