"""Stamps, joint states and the tip's pose that are made from a read-back of the arm."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from logic_parts import at

from tapping_cell.configuration.cell import Ros2ControlSection, load_cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.arm_jobs import Reading
from tapping_cell.logic.arm_readings import ArmReadings
from tapping_cell.logic.clock import to_nanoseconds

CELL = load_cell()
JOINTS = Joints(0.3, -0.8, 0.0, 0.2)


def reading(stamp: float, homed: bool = True) -> Reading:
    return Reading(homed, JOINTS, False, stamp)


def readings() -> ArmReadings:
    made = ArmReadings()
    made.configure(CELL)
    return made


@given(taken=st.floats(0.0, 100.0), age=st.floats(-1.0, 10.0))
def test_a_reading_is_stamped_with_the_time_at_which_it_was_requested(taken, age):
    """A stamp never lies in the future."""
    made = readings()
    made.take_in(reading(taken - age), at(taken))
    assert to_nanoseconds(made.stamp) == pytest.approx(at(taken - max(age, 0.0)).ros, abs=2000)
    assert made.age(at(taken + 0.5)) == pytest.approx(age + 0.5)


def test_an_arm_that_is_not_homed_has_no_stamp_and_no_joints() -> None:
    made = readings()
    assert made.age(at(1.0)) == math.inf
    made.take_in(reading(1.0, homed=False), at(1.0))
    assert to_nanoseconds(made.stamp) == 0 and made.of_homed_arm is None
    assert made.new_joints() is None


def test_the_joints_of_a_reading_are_published_once() -> None:
    made = readings()
    for time in (1.0, 2.0):
        made.take_in(reading(time), at(time))
        joints = made.new_joints()
        assert joints is not None and made.new_joints() is None
        assert list(joints.position) == list(JOINTS)
        assert to_nanoseconds(joints.header.stamp) == at(time).ros


def test_an_arm_with_a_ros_driver_of_its_own_publishes_its_joints_itself() -> None:
    made = ArmReadings()
    arm = replace(CELL.arm, ros2_control=Ros2ControlSection("/scara_controller", Joints._fields))
    made.configure(replace(CELL, file=replace(CELL.file, arm=arm)))
    made.take_in(reading(1.0), at(1.0))
    assert made.of_homed_arm is not None and made.new_joints() is None


def test_the_pose_of_the_tip_is_computed_once_for_each_reading() -> None:
    made = readings()
    first, second = reading(1.0), replace(reading(2.0), joints=JOINTS._replace(shoulder=0.4))
    pose = made.tip_pose(first)
    assert made.tip_pose(first) is pose
    assert made.tip_pose(second).position.x != pose.position.x
