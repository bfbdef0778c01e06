"""The URDF is the arm: read back by its own rules, it puts the striker where the kinematics do."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

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


def test_limits_are_those_of_the_geometry() -> None:
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
