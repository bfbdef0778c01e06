"""A six-axis arm instead of the SCARA: its kinematics, and the driver of its joints.

The independent reference is the forward kinematics of the shipped arm, written link by link with
SciPy's rotations. The lengths in this reference come from the drawing, not from the URDF.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from event_clock import EventClock
from hardware_faults import expect_fault
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from trajectory_controller import ControllerSettings, TrajectoryController
from virtual_trajectory_link import VirtualTrajectoryLink

from tapping_cell.configuration.arm_assembly import joint_accelerations, make_arm_driver
from tapping_cell.configuration.cell import ArmSection, load_cell
from tapping_cell.hardware.arm_settings import HomingStrategy
from tapping_cell.hardware.chain_link import upright
from tapping_cell.hardware.chain_urdf import chain_from_urdf
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.motion import strike_path, withdraw_path
from tapping_cell.hardware.scara import Joints, TipPose
from tapping_cell.hardware.serial_chain import SerialChain

CELL = load_cell(Path(__file__).parents[3] / "examples" / "six_axis_cell" / "cell.yaml")
_CHAIN = CELL.arm.chain()
assert _CHAIN is not None
CHAIN = _CHAIN
GEOMETRY = CELL.arm.geometry()
MOTION = CELL.arm.motion()
NAMES = CHAIN.names
ELBOW_UP = (1.75, 0.86, 0.14, 0.0, 0.58, -0.64)


def reference(joints: NDArray[np.float64] | tuple[float, ...]) -> NDArray[np.float64]:
    """Return the striker's pose in ``arm_base``. The lengths in m are from the drawing: column
    0.40, arms 0.48 and 0.50, wrist 0.08."""
    q1, q2, q3, q4, q5, q6 = joints
    turn, place = Rotation.from_euler("z", q1), np.array([0.0, 0.0, 0.40])
    turn *= Rotation.from_euler("y", q2)
    place = place + turn.apply([0.0, 0.0, 0.48])
    turn *= Rotation.from_euler("y", q3)
    place = place + turn.apply([0.20, 0.0, 0.03])
    turn *= Rotation.from_euler("x", q4)
    place = place + turn.apply([0.30, 0.0, 0.0])
    turn *= Rotation.from_euler("y", q5)
    turn *= Rotation.from_euler("x", q6)
    place = place + turn.apply([0.07 + 0.01 + 0.10, 0.0, 0.06])
    pose = np.eye(4)
    pose[:3, :3] = (turn * Rotation.from_euler("y", -1.5707963)).as_matrix()
    pose[:3, 3] = place
    return pose


JOINT_VALUES = st.tuples(*(st.floats(j.lower, j.upper) for j in CHAIN.joints))


@given(JOINT_VALUES)
def test_forward_kinematics_agree_with_the_drawing(joints: tuple[float, ...]) -> None:
    np.testing.assert_allclose(CHAIN.forward(joints), reference(joints), atol=1e-9)


@given(JOINT_VALUES, st.lists(st.floats(-0.15, 0.15), min_size=6, max_size=6))
def test_inverse_kinematics_reach_nearby_reachable_poses(joints, away):
    inside = 0.9 * np.array(joints)
    if abs(inside[4]) < 0.1:
        inside[4] = 0.1  # a straight wrist is singular
    elbow_angle = inside[2] + math.atan2(0.03, 0.5)
    if abs(math.cos(elbow_angle)) < 0.1:
        inside[2] += 0.2  # a stretched or folded elbow is singular, too
    target = reference(inside)
    solution = CHAIN.inverse(target, inside + np.array(away))
    if solution.success:
        np.testing.assert_allclose(reference(solution.joints), target, atol=2e-5)
        assert np.all(solution.joints >= CHAIN.lower) and np.all(solution.joints <= CHAIN.upper)
    else:
        assert solution.reason


@given(st.floats(-0.25, 0.25), st.floats(-0.15, 0.15), st.floats(-1.5, 1.5))
def test_every_table_position_is_solved_from_the_park_pose(x: float, y: float, yaw: float) -> None:
    target = upright(np.array([0.47 + y, x, 0.006, yaw]))
    solution = CHAIN.inverse(target, (0.0, 0.5, 0.5, 0.0, 0.57, 0.0))
    assert solution.success, solution.reason
    np.testing.assert_allclose(reference(solution.joints), target, atol=2e-5)


def test_an_unreachable_pose_is_reported_with_its_cause() -> None:
    far = CHAIN.inverse(upright(np.array([2.0, 0.0, 0.1, 0.0])), ELBOW_UP)
    assert not far.success and "x 2000 mm" in far.reason


class Cell(EventClock):
    """An emulated controller of six joints and the driver, in virtual time."""

    def __init__(
        self, start: tuple[float, ...], by_action: bool = False, arm: ArmSection = CELL.arm
    ) -> None:
        super().__init__(100.0)
        self.controller = TrajectoryController(ControllerSettings(NAMES), start, self.time)
        self.link = VirtualTrajectoryLink(
            self.controller,
            joint_accelerations(CELL.arm),
            lambda: self.time,
            self.sleep,
            by_action=by_action,
        )
        self.driver = make_arm_driver(arm, self.link)

    def tip(self, time: float | None = None) -> NDArray[np.float64]:
        """Return the striker's true pose from the reference kinematics."""
        joints, _ = self.controller.state(self.time if time is None else time)
        return reference(joints)

    def park(self) -> Joints:
        self.driver.connect()
        here = self.driver.home(HomingStrategy.NONE)
        self.driver.follow(withdraw_path(GEOMETRY, here, MOTION))
        return self.driver.read_joints()


def started_upright(chain: SerialChain = CHAIN) -> tuple[float, ...]:
    """Return joints for an upright striker, close to the park pose, as if a person had jogged the
    arm there."""
    tip = np.array(GEOMETRY.forward(CELL.arm.park)) + np.array([0.03, -0.02, 0.01, 0.1])
    solution = chain.inverse(upright(tip), ELBOW_UP)
    assert solution.success, solution.reason
    return tuple(solution.joints.tolist())


@pytest.mark.parametrize("by_action", [False, True], ids=["topic", "action"])
def test_taps_across_the_table_end_at_their_strike_poses(by_action: bool) -> None:
    cell = Cell(started_upright(), by_action)
    here = cell.park()
    assert here == pytest.approx(CELL.arm.park, abs=1e-3)
    draw = np.random.default_rng(5)
    for _ in range(2):
        x, y = draw.uniform(-0.20, 0.20), draw.uniform(-0.15, 0.15)
        yaw = draw.uniform(-math.pi, math.pi)
        strike = TipPose(0.47 + y, x, 0.006, yaw)
        began = cell.time
        path = strike_path(GEOMETRY, here, strike, MOTION)
        cell.driver.follow(path)
        pose = cell.tip()
        np.testing.assert_allclose(pose[:3, 3], strike[:3], atol=3e-4)
        assert math.cos(math.atan2(pose[1, 0], pose[0, 0]) - yaw) > 1 - 1e-5
        last = np.arange(cell.time - 0.5, cell.time, 0.05)
        lean = [math.acos(min(1.0, cell.tip(time)[2, 2])) for time in last]
        assert max(lean) < 0.01, "the striker leant on its way down"
        assert cell.time - began < 12.0
        here = cell.driver.read_joints()
        cell.driver.follow(withdraw_path(GEOMETRY, here, MOTION))
        here = cell.driver.read_joints()


def test_the_last_part_of_the_descent_is_straight() -> None:
    cell = Cell(started_upright())
    here = cell.park()
    strike = TipPose(0.50, 0.05, 0.006, 0.4)
    path = strike_path(GEOMETRY, here, strike, MOTION)
    cell.driver.follow(path[:-1])
    began = cell.time
    cell.driver.follow(path[-1:])
    places = np.array([cell.tip(t)[:3, 3] for t in np.arange(began, cell.time, 0.01)])
    assert np.ptp(places[:, 2]) > 0.04
    assert np.max(np.hypot(places[:, 0] - 0.50, places[:, 1] - 0.05)) < 5e-4
    assert np.all(np.diff(places[:, 2]) < 1e-5), "it rose on its way down"


def test_no_joint_is_driven_faster_than_its_urdf_allows() -> None:
    cell = Cell(started_upright())
    here = cell.park()
    for yaw in (2.5, -2.5, 0.0):
        cell.driver.follow(strike_path(GEOMETRY, here, TipPose(0.45, 0.1, 0.006, yaw), MOTION))
        here = cell.driver.read_joints()
        began = cell.time
        cell.driver.follow(withdraw_path(GEOMETRY, here, MOTION))
        here = cell.driver.read_joints()
        for time in np.arange(began, cell.time, 0.005):
            _, speeds = cell.controller.state(float(time))
            assert np.all(np.abs(speeds) <= 1.1 * CHAIN.max_speed)


def test_a_tilted_striker_is_refused() -> None:
    leaning = list(started_upright())
    leaning[4] += 0.05
    cell = Cell(tuple(leaning))
    with expect_fault(FaultReason.POSITION_LOST) as caught:
        cell.driver.connect()
    assert "leans by" in caught.value.sentence and "panel" in caught.value.sentence


def test_an_unreachable_path_is_refused_before_anything_moves() -> None:
    own = CELL.arm.ros2_control
    assert own is not None and own.chain is not None
    # The arm is mounted so far back that it does not reach every pose that the SCARA of the cell
    # file reaches.
    back = replace(own.chain, mount=(-0.45, 0.0, 0.0, 0.0, 0.0, 0.0))
    arm = replace(CELL.arm, ros2_control=replace(own, chain=back))
    chain = arm.chain()
    assert chain is not None
    cell = Cell(started_upright(chain), arm=arm)
    cell.driver.connect()
    here = cell.driver.home(HomingStrategy.NONE)
    far = Joints(0.0, 0.16, -0.02, 0.0)
    with expect_fault(FaultReason.UNREACHABLE) as caught:
        cell.driver.move_to(far)
    assert "cannot bring the striker to" in caught.value.sentence
    assert cell.controller.taken == 0, "something was sent"
    cell.driver.move_to(here._replace(quill=here.quill - 0.01))


def test_a_stop_brakes_the_six_joints_and_requires_homing() -> None:
    cell = Cell(started_upright())
    here = cell.park()
    cell.after(0.3, cell.driver.stop)
    with expect_fault(FaultReason.STOPPED):
        cell.driver.follow(strike_path(GEOMETRY, here, TipPose(0.45, 0.1, 0.006, 0.0), MOTION))
    cell.sleep(1.0)
    assert not cell.controller.moving(cell.time)
    cell.driver.clear_fault()
    with pytest.raises(HardwareFault, match="not homed"):
        cell.driver.read_joints()
    cell.driver.home(HomingStrategy.NONE)


def test_a_push_is_detected_from_the_measured_joints() -> None:
    cell = Cell(started_upright())
    here = cell.park()
    cell.controller.push((0.02, 0.0, 0.0, 0.0, 0.0, 0.0), cell.time)
    cell.sleep(0.2)
    with expect_fault(FaultReason.POSITION_LOST):
        cell.driver.move_to(here._replace(shoulder=here.shoulder - 0.1))


URDF = (Path(__file__).parents[3] / "examples" / "six_axis_cell" / "six_axis_arm.urdf").read_text()


@pytest.mark.parametrize(
    ("text", "base", "tip", "names", "words"),
    [
        ("<robot", "base_link", "flange", NAMES, "not XML"),
        ("<robot xmlns:xacro='a'><xacro:arm/></robot>", "a", "b", NAMES, "xacro FILE"),
        (URDF, "base_link", "tool0", NAMES, "its links are base_link"),
        (URDF, "base_link", "flange", NAMES[:5], "in this order"),
        (URDF.replace('velocity="7.5"', ""), "base_link", "flange", NAMES, "velocity limit"),
        (URDF.replace('"revolute"', '"floating"', 1), "base_link", "flange", NAMES, "floating"),
    ],
)
def test_an_incompatible_urdf_is_refused_with_a_message(text, base, tip, names, words):
    with pytest.raises(ValueError, match=words):
        chain_from_urdf(text, base, tip, names, np.eye(4), np.eye(4))


def test_the_limits_of_a_continuous_joint_are_kept() -> None:
    def ends(lower: float, upper: float) -> tuple[float, float]:
        text = URDF.replace('"revolute"', '"continuous"', 1)
        text = text.replace('lower="-2.97" upper="2.97"', f'lower="{lower}" upper="{upper}"')
        joint = chain_from_urdf(text, "base_link", "flange", NAMES, np.eye(4), np.eye(4)).joints[0]
        return joint.lower, joint.upper

    assert ends(-2.97, 2.97) == (-2.97, 2.97)
    assert ends(0.0, 0.0) == ends(-1e16, 1e16) == (-math.tau, math.tau)
