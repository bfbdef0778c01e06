"""Forward and inverse kinematics agree, and every refused pose is truly out of reach."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware.scara import Branch, Joints, ReachCode, ScaraGeometry, TipPose

lengths = st.floats(0.1, 0.6)
offsets = st.floats(-0.1, 0.1)
angles = st.floats(-math.pi, math.pi)


@st.composite
def geometries(draw: st.DrawFn) -> ScaraGeometry:
    return ScaraGeometry(
        upper_arm=draw(lengths),
        forearm=draw(lengths),
        tip_forward=draw(offsets),
        tip_side=draw(offsets),
        tip_yaw=draw(angles),
        lower=(-draw(st.floats(0.5, 3.1)), -draw(st.floats(0.5, 3.0)), -0.15, -3.5),
        upper=(draw(st.floats(0.5, 3.1)), draw(st.floats(0.5, 3.0)), 0.0, 3.5),
        joint_offset=(
            draw(st.floats(-0.1, 0.1)),
            draw(st.floats(-0.03, 0.03)),
            draw(st.floats(-0.005, 0.005)),
            draw(st.floats(-0.2, 0.2)),
        ),
    )


@st.composite
def joints_inside(draw: st.DrawFn, geometry: ScaraGeometry) -> Joints:
    values = [
        draw(st.floats(low, high)) for low, high in zip(geometry.lower, geometry.upper, strict=True)
    ]
    margin = geometry.singularity_margin
    if abs(values[1] + geometry.joint_offset[1]) < margin:
        values[1] = math.copysign(margin * 1.01, values[1]) - geometry.joint_offset[1]
    return Joints(*values)


def independent_tip(geometry: ScaraGeometry, joints: Joints) -> complex:
    """Return the tip from a chain of complex numbers, independently of the module's formulas."""
    joints = Joints(*(a + b for a, b in zip(joints, geometry.joint_offset, strict=True)))
    first = geometry.upper_arm * np.exp(1j * joints.shoulder)
    second = geometry.forearm * np.exp(1j * joints.elbow) * np.exp(1j * joints.shoulder)
    tool = complex(geometry.tip_forward, geometry.tip_side) * np.exp(
        1j * (joints.shoulder + joints.elbow + joints.tool)
    )
    return complex(first + second + tool)


@given(st.data())
def test_forward_kinematics_match_the_chain_of_links(data: st.DataObject) -> None:
    geometry = data.draw(geometries())
    joints = data.draw(joints_inside(geometry))
    tip = geometry.forward(joints)
    assert complex(tip.x, tip.y) == pytest.approx(independent_tip(geometry, joints), abs=1e-12)
    assert tip.z == pytest.approx(geometry.tip_height + joints.quill + geometry.joint_offset[2])


@given(st.data())
def test_inverse_kinematics_invert_forward_kinematics_on_the_same_branch(data):
    geometry = data.draw(geometries())
    joints = data.draw(joints_inside(geometry))
    tip = geometry.forward(joints)
    solution = geometry.inverse(tip, geometry.branch_of(joints), near=joints)
    assert solution.success, solution.reason
    assert solution.joints is not None
    back = geometry.forward(solution.joints)
    assert np.allclose(back[:3], tip[:3], atol=1e-9)
    assert abs(math.remainder(back.yaw - tip.yaw, 2 * math.pi)) < 1e-9
    assert solution.residual < 1e-9
    assert solution.joints.elbow == pytest.approx(joints.elbow, abs=1e-6)


@given(
    st.data(),
    st.floats(-1.3, 1.3),
    st.floats(-1.3, 1.3),
    st.floats(-0.05, 0.25),
    angles,
    st.sampled_from(Branch),
)
def test_refused_poses_are_out_of_reach_and_accepted_poses_within(data, x, y, z, yaw, branch):
    geometry = data.draw(geometries())
    tip = TipPose(x, y, z, yaw)
    solution = geometry.inverse(tip, branch)
    heading = yaw - geometry.tip_yaw
    wrist = complex(x, y) - complex(geometry.tip_forward, geometry.tip_side) * np.exp(1j * heading)
    reach = abs(wrist)
    if solution.success:
        assert solution.joints is not None
        assert geometry.limit_excess(solution.joints)[0] is ReachCode.REACHED
        assert np.allclose(geometry.forward(solution.joints)[:3], tip[:3], atol=1e-9)
        assert geometry.branch_of(solution.joints) is branch
        return
    assert solution.joints is None and solution.reason and solution.residual > 0
    code = solution.code
    off = geometry.joint_offset
    quill = z - geometry.tip_height - off[2]
    if code is ReachCode.TOO_FAR:
        assert reach > geometry.upper_arm + geometry.forearm
    elif code is ReachCode.TOO_NEAR:
        assert reach < abs(geometry.upper_arm - geometry.forearm)
    elif code is ReachCode.QUILL_LIMIT:
        assert not geometry.lower[2] <= quill <= geometry.upper[2]
    else:
        # Solve for the elbow by the law of cosines, and for the shoulder by the angles of the
        # triangle.
        cosine = (reach**2 - geometry.upper_arm**2 - geometry.forearm**2) / (
            2 * geometry.upper_arm * geometry.forearm
        )
        elbow = branch.value * math.acos(max(-1.0, min(1.0, cosine)))
        if code is ReachCode.SINGULAR:
            assert abs(elbow) < geometry.singularity_margin or (
                abs(elbow) > math.pi - geometry.singularity_margin
            )
        elif code is ReachCode.ELBOW_LIMIT:
            assert not geometry.lower[1] <= elbow - off[1] <= geometry.upper[1]
        elif code is ReachCode.SHOULDER_LIMIT:
            inner = math.acos(
                (reach**2 + geometry.upper_arm**2 - geometry.forearm**2)
                / (2 * reach * geometry.upper_arm)
            )
            shoulder = math.atan2(wrist.imag, wrist.real) - branch.value * inner - off[0]
            assert not any(
                geometry.lower[0] + 1e-6 <= shoulder + 2 * math.pi * k <= geometry.upper[0] - 1e-6
                for k in (-1, 0, 1)
            )
        else:
            assert code is ReachCode.TOOL_LIMIT
            pytest.fail("a tool that turns beyond a whole turn reaches every heading")


def test_a_tool_axis_of_less_than_one_turn_refuses_with_its_limit() -> None:
    geometry = ScaraGeometry(
        lower=(-2.3, -2.6, -0.148, -1.0), upper=(2.3, 2.6, 0.0, 1.0), tip_forward=0.0
    )
    inside = geometry.forward(Joints(0.2, 1.0, -0.1, 0.9))
    assert geometry.inverse(inside, Branch.POSITIVE).success
    outside = geometry.forward(Joints(0.2, 1.0, -0.1, 1.3))
    refused = geometry.inverse(outside, Branch.POSITIVE)
    assert refused.code is ReachCode.TOOL_LIMIT
    assert refused.residual == pytest.approx(0.3)
    assert "57.3 deg" in refused.reason


def test_both_elbows_reach_the_same_tip() -> None:
    geometry = ScaraGeometry()
    tip = TipPose(0.45, 0.1, 0.02, 0.7)
    for branch in Branch:
        solution = geometry.inverse(tip, branch)
        assert solution.joints is not None
        assert np.allclose(geometry.forward(solution.joints), tip, atol=1e-9)
    near = geometry.inverse(tip, near=(0.0, -1.0, 0.0, 0.0))
    assert near.branch is Branch.NEGATIVE


def test_joint_angles_near_the_current_ones_are_preferred() -> None:
    geometry = ScaraGeometry()
    for tool in (-3.4, 3.4):
        joints = Joints(0.1, 1.2, -0.1, tool)
        solution = geometry.inverse(geometry.forward(joints), Branch.POSITIVE, near=joints)
        assert solution.joints is not None and solution.joints.tool == pytest.approx(tool)


@given(st.integers(0, 2**32 - 1))
def test_the_vectorised_mask_matches_each_single_result(seed: int) -> None:
    geometry = ScaraGeometry()
    rng = np.random.default_rng(seed)
    poses = rng.uniform((-0.9, -0.9, -0.02, -4), (0.9, 0.9, 0.17, 4), (6, 5, 4))
    mask = geometry.reachable(poses)
    assert mask.shape == (6, 5)
    for index in np.ndindex(6, 5):
        assert mask[index] == geometry.inverse(poses[index]).success


def test_nan_values_are_refused() -> None:
    solution = ScaraGeometry().inverse((math.nan, 0.0, 0.0, 0.0))
    assert solution.code is ReachCode.NOT_FINITE and not solution.success
    assert not ScaraGeometry().reachable([[math.inf, 0, 0, 0]])[0]


@pytest.mark.parametrize(
    "wrong",
    [
        {"upper_arm": 0.0},
        {"lower": (3.0, -2.6, -0.1, -3.0)},
        {"max_speed": (0.0, 1.0, 1.0, 1.0)},
        {"singularity_margin": 2.0},
    ],
)
def test_impossible_arm_dimensions_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError):
        ScaraGeometry(**wrong)  # type: ignore[arg-type]
