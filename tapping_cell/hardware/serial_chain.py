"""Forward and numerical inverse kinematics of a serial chain of revolute and prismatic joints.

Each joint moves about or along an axis of its own frame, whose pose in the frame of the previous
link is fixed, as in a URDF. The inverse starts at a seed, uses damped least squares, and keeps the
joints within their limits (Wampler 1986, *Manipulator inverse kinematic solutions based on vector
formulations and damped least-squares methods*). The solution keeps the seed's configuration of
elbow and wrist.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

ITERATIONS = 80
STUCK = 8
"""Number of consecutive iterations without improvement after which the search fails."""
POSITION_ERROR = 1e-6
"""Maximum position error of a solution, m; a hundredth of the arm's smallest default tolerance."""
ANGLE_ERROR = 1e-5
"""Maximum angle error of a solution, rad."""
LONGEST_STEP = 0.3
"""Maximum change of a joint in one iteration, rad or m."""
DAMPING = 1e-4


@dataclass(frozen=True, slots=True)
class ChainJoint:
    """One joint. ``origin`` is the pose of its frame at joint value zero, in the frame of the
    previous link."""

    name: str
    origin: tuple[tuple[float, ...], ...]
    """Homogeneous transform, 4 x 4, m."""
    axis: tuple[float, float, float]
    """Unit vector in the joint's frame."""
    prismatic: bool
    lower: float
    """Lower limit, rad or m."""
    upper: float
    max_speed: float
    """Maximum speed, rad/s or m/s."""


@dataclass(frozen=True, slots=True, eq=False)
class ChainSolution:
    """Result of :meth:`SerialChain.inverse`; ``reason`` is empty on success."""

    success: bool
    joints: Array
    reason: str


class SerialChain:
    """Chain of joints between a base and the striker.

    ``base``: pose of the chain's first frame in ``arm_base``. ``tool``: pose of the striker's frame
    (x along its line of travel, z up) in the chain's last link. Both are 4 x 4.
    """

    def __init__(self, joints: tuple[ChainJoint, ...], base: ArrayLike, tool: ArrayLike) -> None:
        if not joints:
            raise ValueError("a chain needs at least one joint")
        for joint in joints:
            if not joint.lower < joint.upper:
                raise ValueError(
                    f"limits of joint {joint.name}: lower {joint.lower:g} is not below upper"
                    f" {joint.upper:g}"
                )
        self.joints = joints
        self.base: Array = np.asarray(base, dtype=np.float64)
        self.tool: Array = np.asarray(tool, dtype=np.float64)
        self.lower: Array = np.array([joint.lower for joint in joints])
        self.upper: Array = np.array([joint.upper for joint in joints])
        self.max_speed: Array = np.array([joint.max_speed for joint in joints])
        self._prismatic: NDArray[np.bool_] = np.array([joint.prismatic for joint in joints])
        # The transform of a revolute joint is fixed + sin(q) * sine + (1 - cos(q)) * cosine
        # (Rodrigues); that of a prismatic joint is fixed + q * sine.
        self._terms = [_terms(joint) for joint in joints]
        self._axes = [np.array([*joint.axis, 0.0]) for joint in joints]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints, starting at the base."""
        return tuple(joint.name for joint in self.joints)

    def forward(self, joints: ArrayLike) -> Array:
        """Return the striker's pose in ``arm_base``, 4 x 4; limits are not checked."""
        return self._frames(joints)[2]

    def inverse(self, target: ArrayLike, seed: ArrayLike) -> ChainSolution:
        """Return joints that bring the striker to ``target`` (4 x 4), searching from ``seed``.

        If no solution is found, the result contains the joints that come nearest to the target.
        """
        goal = np.asarray(target, dtype=np.float64)
        q = np.clip(np.asarray(seed, dtype=np.float64), self.lower, self.upper)
        best, least, since = q, math.inf, 0
        for _ in range(ITERATIONS):
            axes, places, tip = self._frames(q)
            error = np.concatenate([goal[:3, 3] - tip[:3, 3], _turn(tip[:3, :3], goal[:3, :3])])
            size = float(np.linalg.norm(error))
            since = 0 if size < 0.99 * least else since + 1
            if size < least:
                best, least = q, size
            met = (
                np.linalg.norm(error[:3]) < POSITION_ERROR
                and np.linalg.norm(error[3:]) < ANGLE_ERROR
            )
            if met:
                return ChainSolution(True, q, "")
            if since > STUCK:
                break
            jacobian = self._jacobian(axes, places, tip[:3, 3])
            square = jacobian.T @ jacobian + DAMPING**2 * np.eye(len(q))
            step = np.linalg.solve(square, jacobian.T @ error)
            longest = float(np.max(np.abs(step)))
            if longest > LONGEST_STEP:
                step *= LONGEST_STEP / longest
            moved = np.clip(q + step, self.lower, self.upper)
            if np.array_equal(moved, q):
                break
            q = moved
        return ChainSolution(False, best, self._sentence(goal, best))

    def _frames(self, joints: ArrayLike) -> tuple[Array, Array, Array]:
        """Return the joints' axes and origins (N, 3) and the striker's pose, in ``arm_base``."""
        pose = self.base
        axes, places = np.empty((len(self.joints), 3)), np.empty((len(self.joints), 3))
        values = np.asarray(joints, dtype=np.float64).tolist()
        for index, ((fixed, sine, cosine), value) in enumerate(
            zip(self._terms, values, strict=True)
        ):
            if self._prismatic[index]:
                pose = pose @ (fixed + value * sine)
            else:
                pose = pose @ (fixed + math.sin(value) * sine + (1 - math.cos(value)) * cosine)
            # A rotation about the axis moves neither the axis nor the frame's origin on it, so both
            # can be computed after the rotation.
            axes[index] = (pose @ self._axes[index])[:3]
            places[index] = pose[:3, 3]
        return axes, places, pose @ self.tool

    def _jacobian(self, axes: Array, places: Array, tip: Array) -> Array:
        """Return the (6, N) Jacobian: the striker's translation (3 rows) and rotation (3 rows) per
        joint."""
        linear = np.where(self._prismatic[:, None], axes, np.cross(axes, tip - places))
        angular = np.where(self._prismatic[:, None], 0.0, axes)
        return np.asarray(np.concatenate([linear, angular], axis=1).T)

    def _sentence(self, goal: Array, nearest: Array) -> str:
        x, y, z = goal[:3, 3]
        where = f"x {x * 1e3:.0f} mm, y {y * 1e3:.0f} mm, z {z * 1e3:.0f} mm from arm_base"
        stopped = [
            joint.name
            for joint, value in zip(self.joints, nearest, strict=True)
            if value <= joint.lower or value >= joint.upper
        ]
        if stopped:
            return f"{where}: these joints would exceed their limits: {', '.join(stopped)}"
        left = float(np.linalg.norm(goal[:3, 3] - self.forward(nearest)[:3, 3]))
        return (
            f"{where}: in the nearest pose found, the striker is {left * 1e3:.0f} mm away from it"
        )


def pose_matrix(pose: ArrayLike) -> Array:
    """Return the 4 x 4 matrix of x, y, z in m and roll, pitch, yaw in rad (fixed axes)."""
    x, y, z, roll, pitch, yaw = np.asarray(pose, dtype=np.float64)
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _terms(joint: ChainJoint) -> tuple[Array, Array, Array]:
    """Return the terms (fixed, sine, cosine) of a joint's transform, 4 x 4 each."""
    origin = np.asarray(joint.origin, dtype=np.float64)
    x, y, z = joint.axis
    first: Array = np.zeros((4, 4))
    second: Array = np.zeros((4, 4))
    if joint.prismatic:
        first[:3, 3] = joint.axis
    else:
        first[:3, :3] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        second = first @ first
    return origin, origin @ first, origin @ second


def _turn(from_: Array, to: Array) -> Array:
    """Return the rotation vector from one orientation to another, in the base frame, rad."""
    turn = to @ from_.T
    vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine, cosine = float(np.linalg.norm(vector)) / 2, (float(np.trace(turn)) - 1) / 2
    angle = math.atan2(sine, cosine)
    if sine > 1e-9:
        return np.asarray(vector * (angle / (2 * sine)))
    if cosine > 0:
        return np.zeros(3)
    # Rotation by pi: the axis is the largest column of turn + identity.
    axis = (turn + np.eye(3))[:, int(np.argmax(np.diag(turn)))]
    return np.asarray(math.pi * axis / np.linalg.norm(axis))
