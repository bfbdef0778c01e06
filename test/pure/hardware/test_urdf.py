"""The URDF describes the arm: its kinematics place the striker where the driver's kinematics do."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tapping_cell.hardware.link_frames import LINKS, link_frames
from tapping_cell.hardware.scara import Joints, ScaraGeometry
from tapping_cell.hardware.urdf import urdf

GEOMETRY = ScaraGeometry(tip_side=0.013, tip_yaw=0.4)


def turned(angle: float) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return matrix


def shifted(place: list[float]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, 3] = place
    return matrix


JOINTS = st.tuples(
    *(st.floats(lo, hi) for lo, hi in zip(GEOMETRY.lower, GEOMETRY.upper, strict=True))
)


@given(JOINTS, st.tuples(*[st.floats(-0.02, 0.02)] * 4))
def test_the_frames_of_the_links_end_at_the_tip(values, offset):
    geometry = ScaraGeometry(tip_side=0.013, tip_yaw=0.4, joint_offset=offset)
    pose, parent = np.eye(4), LINKS[0]
    for frame in link_frames(geometry, Joints(*values)):
        assert frame.parent == parent
        pose = pose @ shifted([frame.x, frame.y, frame.z]) @ turned(frame.yaw)
        parent = frame.link
    assert parent == LINKS[-1] == "striker"
    tip = geometry.forward(values)
    assert np.allclose(pose[:3, 3], tip[:3], atol=1e-12)
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    assert abs(math.remainder(yaw - tip.yaw, 2 * math.pi)) < 1e-9


@given(
    st.tuples(*(st.floats(lo, hi) for lo, hi in zip(GEOMETRY.lower, GEOMETRY.upper, strict=True)))
)
def test_the_chain_ends_at_the_tip(values: tuple[float, ...]) -> None:
    robot = ElementTree.fromstring(urdf(GEOMETRY))
    by_parent = {joint.find("parent").get("link"): joint for joint in robot.iter("joint")}
    pose, link = np.eye(4), "arm_base"
    while link in by_parent:
        joint = by_parent[link]
        origin = joint.find("origin")
        pose = pose @ shifted([float(v) for v in origin.get("xyz").split()])
        pose = pose @ turned(float(origin.get("rpy").split()[2]))
        if joint.get("type") != "fixed":
            value = values[Joints._fields.index(joint.get("name"))]
            axis = [float(v) for v in joint.find("axis").get("xyz").split()]
            assert axis == [0, 0, 1]
            move = turned(value) if joint.get("type") == "revolute" else shifted([0, 0, value])
            pose = pose @ move
        link = joint.find("child").get("link")
    assert link == "striker"
    tip = GEOMETRY.forward(values)
    assert np.allclose(pose[:3, 3], tip[:3], atol=1e-12)
    yaw = math.atan2(pose[1, 0], pose[0, 0])
    assert abs(math.remainder(yaw - tip.yaw, 2 * math.pi)) < 1e-9


def test_joint_limits_match_the_geometry() -> None:
    robot = ElementTree.fromstring(urdf(GEOMETRY))
    limits = {
        joint.get("name"): joint.find("limit")
        for joint in robot.iter("joint")
        if joint.get("type") != "fixed"
    }
    assert list(limits) == list(Joints._fields)
    for index, limit in enumerate(limits.values()):
        assert float(limit.get("lower")) == GEOMETRY.lower[index]
        assert float(limit.get("upper")) == GEOMETRY.upper[index]
        assert float(limit.get("velocity")) == pytest.approx(GEOMETRY.max_speed[index])
        assert float(limit.get("effort")) > 0


def test_every_link_that_moves_has_a_solid_with_mass() -> None:
    robot = ElementTree.fromstring(urdf(GEOMETRY))
    links = {link.get("name"): link for link in robot.iter("link")}
    assert tuple(links) == LINKS
    for name in LINKS[1:-1]:
        solid = links[name].find("collision/geometry/cylinder")
        radius, length = float(solid.get("radius")), float(solid.get("length"))
        mass = float(links[name].find("inertial/mass").get("value"))
        assert 500 < mass / (math.pi * radius**2 * length) < 8000, "kg/m^3 of a machine"
        given = links[name].find("inertial/inertia").attrib
        xx, yy, zz = (float(given[key]) for key in ("ixx", "iyy", "izz"))
        # The moments of inertia of any solid satisfy the triangle inequality. These solids are
        # cylinders.
        assert min(xx + yy - zz, yy + zz - xx, zz + xx - yy) > 0
        assert zz == pytest.approx(mass * radius**2 / 2)
        assert xx == yy == pytest.approx(mass * (3 * radius**2 + length**2) / 12)
        places = [links[name].find(f"{part}/origin").attrib for part in ("collision", "inertial")]
        assert places[0] == places[1], "the mass is where the solid is"


def test_the_shoulder_turns_the_stretched_arm_with_its_effort() -> None:
    # Each body is approximated by 10 000 equal point masses along its length, and the quill rod by
    # one.
    geometry = ScaraGeometry()
    robot = ElementTree.fromstring(urdf(geometry))
    masses = {
        link.get("name"): float(link.find("inertial/mass").get("value"))
        for link in robot.iter("link")
        if link.find("inertial") is not None
    }
    wrist = geometry.upper_arm + geometry.forearm
    spans = {
        "upper_arm": (0.0, geometry.upper_arm),
        "forearm": (geometry.upper_arm, wrist),
        "quill_rod": (wrist, wrist),
        "tool": (wrist, wrist + geometry.tip_forward),
    }
    inertia = sum(
        mass * np.mean(np.linspace(*spans[name], 10_000) ** 2) for name, mass in masses.items()
    )
    effort = float(robot.find("joint[@name='shoulder']/limit").get("effort"))
    assert effort == pytest.approx(inertia * geometry.max_acceleration[0], rel=2e-3)


@pytest.mark.skipif(shutil.which("check_urdf") is None, reason="needs check_urdf (urdfdom)")
def test_check_urdf_accepts_the_urdf(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(GEOMETRY))
    ended = subprocess.run(["check_urdf", path], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
