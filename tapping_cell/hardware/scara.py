"""Kinematics of a four-axis SCARA arm: shoulder, elbow, quill, tool rotation.

Frame ``arm_base``: origin on the shoulder axis in the plane of the table, x along the upper arm at
shoulder angle zero, z up. The joint order is always shoulder in rad, elbow in rad, quill in m
(positive up), tool in rad. The position of the wrist (the quill axis) is

    w = L1 (cos q1, sin q1) + L2 (cos(q1 + q2), sin(q1 + q2)).

The tool's heading is h = q1 + q2 + q4. The tip is at w + R(h) (tip_forward, tip_side), and its line
of travel points along h + tip_yaw. All joint values are those of the controller. The true value q
is the controller's value plus ``joint_offset``, which a calibration determines. The inverse is the
two-circle construction of the planar two-link arm (Craig, *Introduction to Robotics*, section 4.4,
algebraic solution).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

LIMIT_SLACK = 1e-9
"""Excess over a joint limit that is ignored as a rounding error, in rad or m."""


class Joints(NamedTuple):
    """Joint values: shoulder rad, elbow rad, quill m (positive up), tool rad."""

    shoulder: float
    elbow: float
    quill: float
    tool: float


REVOLUTE = [0, 1, 3]
"""Indices of the revolute joints in ``Joints``."""


class TipPose(NamedTuple):
    """Pose of the striker's tip in ``arm_base``: x, y, z in m; yaw of the line of travel in rad."""

    x: float
    y: float
    z: float
    yaw: float


class Branch(Enum):
    """Elbow side: the sign of the elbow angle."""

    POSITIVE = 1
    NEGATIVE = -1


class ReachCode(IntEnum):
    """Reason why a tip pose cannot be reached; 0 if it can."""

    REACHED = 0
    NOT_FINITE = 1
    TOO_FAR = 2
    TOO_NEAR = 3
    SINGULAR = 4
    SHOULDER_LIMIT = 5
    ELBOW_LIMIT = 6
    QUILL_LIMIT = 7
    TOOL_LIMIT = 8


JOINT_LIMITS = (
    ReachCode.SHOULDER_LIMIT,
    ReachCode.ELBOW_LIMIT,
    ReachCode.QUILL_LIMIT,
    ReachCode.TOOL_LIMIT,
)
"""Code for each joint, in joint order."""


@dataclass(frozen=True, slots=True)
class IKSolution:
    """Result of :meth:`ScaraGeometry.inverse`.

    ``residual``: on success the distance in m between the requested tip and ``forward(joints)``;
    otherwise the excess over the limit named in ``code``, in the unit of that limit (m or rad).
    ``reason``: empty on success; otherwise a sentence with the value, the limit and what to do.
    """

    success: bool
    joints: Joints | None
    branch: Branch
    residual: float
    code: ReachCode
    reason: str


class ManySolutions(NamedTuple):
    """Result of :meth:`ScaraGeometry.inverse_many`: arrays over the requested poses."""

    joints: Array
    """Shape (..., 4); NaN if the arm cannot reach the pose."""
    code: NDArray[np.int64]
    """Shape (...): :class:`ReachCode`."""
    excess: Array
    """Shape (...): excess over the limit, in m or rad; 0 if the pose is reachable."""


def _wrap(angle: Array) -> Array:
    return np.asarray((angle + math.pi) % (2 * math.pi) - math.pi)


def _into_range(angle: Array, low: float, high: float, near: Array) -> tuple[Array, Array]:
    """Add full turns to ``angle`` so that it lies inside [low, high] and as near to ``near`` as
    possible. Return the new angle and its excess over the range (0 inside)."""
    turns = _wrap(angle)[..., None] + 2 * math.pi * np.arange(-2, 3)
    excess = np.maximum(np.maximum(low - turns, turns - high), 0.0)
    excess = np.where(excess <= LIMIT_SLACK, 0.0, excess)
    # Prefer the angle with the smallest excess; among angles inside the range, the one nearest to
    # `near`.
    order = np.where(excess > 0, 1e3 + excess, np.abs(turns - near[..., None]) * 1e-3)
    best = np.argmin(order, axis=-1)[..., None]
    return (
        np.take_along_axis(turns, best, axis=-1)[..., 0],
        np.take_along_axis(excess, best, axis=-1)[..., 0],
    )


@dataclass(frozen=True, slots=True)
class ScaraGeometry:
    """Dimensions and limits of the arm, in SI units. The defaults are for the simulated cell.

    Raises ValueError for invalid lengths, limits or speeds.
    """

    upper_arm: float = 0.425
    """Distance from the shoulder axis to the elbow axis, m."""
    forearm: float = 0.375
    """Distance from the elbow axis to the quill axis, m."""
    tip_forward: float = 0.060
    """Offset of the tip from the quill axis along the tool's heading, m."""
    tip_side: float = 0.0
    """Offset of the tip from the quill axis to the left of the tool's heading, m."""
    tip_yaw: float = 0.0
    """Angle from the tool's heading to the line of travel, rad."""
    tip_height: float = 0.150
    """Height of the tip above the table with the quill at zero, m."""
    lower: tuple[float, float, float, float] = (-2.3, -2.6, -0.148, -3.5)
    """Lower joint limits: rad, rad, m, rad."""
    upper: tuple[float, float, float, float] = (2.3, 2.6, 0.0, 3.5)
    """Upper joint limits: rad, rad, m, rad."""
    max_speed: tuple[float, float, float, float] = (2.0, 2.5, 0.25, 6.0)
    """Maximum joint speeds: rad/s, rad/s, m/s, rad/s."""
    max_acceleration: tuple[float, float, float, float] = (8.0, 10.0, 2.0, 30.0)
    """Maximum joint accelerations: rad/s2, rad/s2, m/s2, rad/s2."""
    singularity_margin: float = 0.05
    """Minimum angle of the elbow from the straight and from the folded position, rad."""
    joint_offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """True joint values minus the controller's: rad, rad, m, rad."""

    def __post_init__(self) -> None:
        if not (self.upper_arm > 0 and self.forearm > 0):
            raise ValueError(
                f"links of {self.upper_arm:g} m and {self.forearm:g} m are invalid: both must "
                "be above 0"
            )
        for name, low, high in zip(Joints._fields, self.lower, self.upper, strict=True):
            if not low < high:
                swapped = all(a >= b for a, b in zip(self.lower, self.upper, strict=True))
                remedy = "exchange 'lower' and 'upper'" if swapped else "correct one of them"
                raise ValueError(
                    f"limits of joint {name}: lower {low:g} is not below upper {high:g}; {remedy}"
                )
        for label, values in (("speed", self.max_speed), ("acceleration", self.max_acceleration)):
            if not all(value > 0 for value in values):
                raise ValueError(f"every joint {label} must be above 0, got {values}")
        if not 0 <= self.singularity_margin < math.pi / 2:
            raise ValueError(
                f"singularity_margin {self.singularity_margin:g} rad must be in [0, pi/2)"
            )

    def forward(self, joints: Sequence[float] | Array) -> TipPose:
        """Return the tip pose in ``arm_base`` for one set of joints, with the yaw in [-pi, pi)."""
        offset = self.joint_offset
        shoulder, elbow, quill, tool = (
            float(joint) + off for joint, off in zip(joints, offset, strict=True)
        )
        reach = shoulder + elbow
        heading = reach + tool
        cos, sin = math.cos(heading), math.sin(heading)
        x = self.upper_arm * math.cos(shoulder) + self.forearm * math.cos(reach)
        y = self.upper_arm * math.sin(shoulder) + self.forearm * math.sin(reach)
        return TipPose(
            x + cos * self.tip_forward - sin * self.tip_side,
            y + sin * self.tip_forward + cos * self.tip_side,
            quill + self.tip_height,
            (heading + self.tip_yaw + math.pi) % (2.0 * math.pi) - math.pi,
        )

    def forward_many(self, joints: ArrayLike) -> Array:
        """Return tip poses (..., 4) = x, y, z in m, yaw in rad for joints (..., 4).

        Limits are not checked.
        """
        q = np.asarray(joints, dtype=float) + self.joint_offset
        reach = q[..., 0] + q[..., 1]
        heading = reach + q[..., 3]
        cos, sin = np.cos(heading), np.sin(heading)
        x = self.upper_arm * np.cos(q[..., 0]) + self.forearm * np.cos(reach)
        y = self.upper_arm * np.sin(q[..., 0]) + self.forearm * np.sin(reach)
        return np.stack(
            [
                x + cos * self.tip_forward - sin * self.tip_side,
                y + sin * self.tip_forward + cos * self.tip_side,
                q[..., 2] + self.tip_height,
                _wrap(heading + self.tip_yaw),
            ],
            axis=-1,
        )

    def branch_of(self, joints: ArrayLike) -> Branch:
        """Return the elbow side of these joints; a straight elbow counts as positive."""
        elbow = float(np.asarray(joints)[1]) + self.joint_offset[1]
        return Branch.NEGATIVE if elbow < 0 else Branch.POSITIVE

    def limit_excess(self, joints: ArrayLike) -> tuple[ReachCode, float]:
        """Return the first joint outside its limits and its excess (rad or m), or (REACHED, 0)."""
        q = np.asarray(joints, dtype=float)
        if q.shape != (4,) or not np.all(np.isfinite(q)):
            return ReachCode.NOT_FINITE, math.inf
        limits = zip(JOINT_LIMITS, q.tolist(), self.lower, self.upper, strict=True)
        for code, value, low, high in limits:
            excess = max(low - value, value - high)
            if excess > LIMIT_SLACK:
                return code, excess
        return ReachCode.REACHED, 0.0

    def inverse_many(
        self, poses: ArrayLike, branch: Branch, near: ArrayLike | None = None
    ) -> ManySolutions:
        """Return joints for tip poses (..., 4) = x, y, z, yaw in ``arm_base`` on one elbow side.

        ``near``: joints (..., 4). Full turns are added to the angles of shoulder and tool so that
        these lie within the limits and as near to ``near`` as possible. ``near`` None means zero
        for all joints.
        """
        p = np.asarray(poses, dtype=float)
        close = np.zeros(4) if near is None else np.asarray(near, dtype=float)
        finite = np.all(np.isfinite(p), axis=-1)
        safe = np.where(finite[..., None], p, 0.0)
        heading = safe[..., 3] - self.tip_yaw
        cos, sin = np.cos(heading), np.sin(heading)
        wx = safe[..., 0] - cos * self.tip_forward + sin * self.tip_side
        wy = safe[..., 1] - sin * self.tip_forward - cos * self.tip_side
        distance = np.hypot(wx, wy)
        product = self.upper_arm * self.forearm
        cosine = (distance**2 - self.upper_arm**2 - self.forearm**2) / (2 * product)
        elbow = branch.value * np.arccos(np.clip(cosine, -1.0, 1.0))
        shoulder = np.arctan2(wy, wx) - np.arctan2(
            self.forearm * np.sin(elbow), self.upper_arm + self.forearm * np.cos(elbow)
        )
        bend = np.abs(elbow)
        tool = heading - shoulder - elbow - self.joint_offset[3]
        shoulder, elbow = shoulder - self.joint_offset[0], elbow - self.joint_offset[1]
        shoulder, shoulder_excess = _into_range(
            shoulder, self.lower[0], self.upper[0], close[..., 0]
        )
        tool, tool_excess = _into_range(tool, self.lower[3], self.upper[3], close[..., 3])
        quill = safe[..., 2] - self.tip_height - self.joint_offset[2]
        margin = self.singularity_margin
        excesses = (
            (ReachCode.NOT_FINITE, np.where(finite, 0.0, math.inf)),
            (ReachCode.TOO_FAR, distance - (self.upper_arm + self.forearm)),
            (ReachCode.TOO_NEAR, abs(self.upper_arm - self.forearm) - distance),
            (ReachCode.SINGULAR, np.maximum(margin - bend, bend - (math.pi - margin))),
            (ReachCode.SHOULDER_LIMIT, shoulder_excess),
            (ReachCode.ELBOW_LIMIT, np.maximum(self.lower[1] - elbow, elbow - self.upper[1])),
            (ReachCode.QUILL_LIMIT, np.maximum(self.lower[2] - quill, quill - self.upper[2])),
            (ReachCode.TOOL_LIMIT, tool_excess),
        )
        code = np.zeros(distance.shape, dtype=np.int64)
        excess = np.zeros(distance.shape)
        for name, value in excesses:
            new = (code == 0) & (value > LIMIT_SLACK)
            code = np.where(new, int(name), code)
            excess = np.where(new, value, excess)
        joints = np.stack([shoulder, elbow, quill, tool], axis=-1)
        return ManySolutions(np.where((code == 0)[..., None], joints, math.nan), code, excess)

    def reachable(self, poses: ArrayLike, branch: Branch | None = None) -> NDArray[np.bool_]:
        """Return a mask (...) of the reachable tip poses (..., 4); ``branch`` None allows both
        sides."""
        branches = tuple(Branch) if branch is None else (branch,)
        masks = [self.inverse_many(poses, side).code == 0 for side in branches]
        return np.asarray(np.any(masks, axis=0), dtype=np.bool_)

    def inverse(
        self, tip: ArrayLike, branch: Branch | None = None, near: ArrayLike | None = None
    ) -> IKSolution:
        """Return joints for one tip pose (x, y, z, yaw) in ``arm_base``.

        ``branch`` None tries both elbow sides and prefers the side of ``near``; without ``near``,
        the side with the smaller absolute shoulder angle. Limits, reach and singularity margin are
        always checked.
        """
        if branch is not None:
            return self._inverse_on(tip, branch, near)
        solutions = [self._inverse_on(tip, side, near) for side in Branch]
        good = [solution for solution in solutions if solution.success]
        if not good:
            # The failure with the smallest excess is the most helpful one to report.
            return min(solutions, key=lambda solution: solution.residual)
        if near is not None:
            side = self.branch_of(near)
            good.sort(key=lambda solution: solution.branch is not side)
            return good[0]
        return min(
            good, key=lambda solution: abs(solution.joints.shoulder) if solution.joints else 0
        )

    def _inverse_on(self, tip: ArrayLike, branch: Branch, near: ArrayLike | None) -> IKSolution:
        pose = np.asarray(tip, dtype=float)
        if pose.shape != (4,):
            raise ValueError(f"a tip pose is (x, y, z, yaw), got shape {pose.shape}")
        many = self.inverse_many(pose, branch, near)
        code = ReachCode(int(many.code))
        if code is not ReachCode.REACHED:
            excess = float(many.excess)
            return IKSolution(False, None, branch, excess, code, self._sentence(pose, code, excess))
        joints = Joints(*many.joints.tolist())
        residual = float(np.linalg.norm(np.asarray(self.forward(joints))[:3] - pose[:3]))
        return IKSolution(True, joints, branch, residual, code, "")

    def _sentence(self, pose: Array, code: ReachCode, excess: float) -> str:
        where = (
            f"tip pose x {pose[0] * 1e3:.1f} mm, y {pose[1] * 1e3:.1f} mm,"
            f" z {pose[2] * 1e3:.1f} mm,"
            f" yaw {math.degrees(pose[3]) if math.isfinite(pose[3]) else pose[3]:.1f} deg"
        )
        if code is ReachCode.NOT_FINITE:
            return f"{where} is not a number: give four finite values"
        if code is ReachCode.TOO_FAR:
            limit = (self.upper_arm + self.forearm) * 1e3
            return (
                f"{where}: the wrist would be {excess * 1e3:.1f} mm beyond the reach of"
                f" {limit:.1f} mm; choose a pose nearer to the arm"
            )
        if code is ReachCode.TOO_NEAR:
            limit = abs(self.upper_arm - self.forearm) * 1e3
            return (
                f"{where}: the wrist would be {excess * 1e3:.1f} mm inside the minimum reach "
                f"of {limit:.1f} mm; choose a pose farther from the shoulder"
            )
        if code is ReachCode.SINGULAR:
            return (
                f"{where}: the elbow must stay {math.degrees(self.singularity_margin):.1f} deg"
                " away from straight and from folded, and would be too close by"
                f" {math.degrees(excess):.2f} deg; choose a pose away from the edge of the reach"
            )
        joint = JOINT_LIMITS.index(code)
        scale, unit = (1e3, "mm") if joint == 2 else (180 / math.pi, "deg")
        return (
            f"{where}: joint {Joints._fields[joint]} would be {excess * scale:.2f} {unit} outside"
            f" {self.lower[joint] * scale:.1f} to {self.upper[joint] * scale:.1f} {unit}; choose"
            " another pose or the other elbow side"
        )
