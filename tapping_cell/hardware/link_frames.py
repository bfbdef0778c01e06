"""Frames of the arm's links from its kinematics, for /tf and the URDF."""

from __future__ import annotations

from typing import NamedTuple

from tapping_cell.hardware.scara import Joints, ScaraGeometry

LINKS = ("arm_base", "upper_arm", "forearm", "quill_rod", "tool", "striker")
"""Links from the fixed base to the tip. ``striker`` is fixed to ``tool``; the four joints
(``Joints``) connect the other links."""


class LinkFrame(NamedTuple):
    """Pose of a link's frame in the frame of its parent: x, y, z in m, rotation about z in rad."""

    parent: str
    link: str
    x: float
    y: float
    z: float
    yaw: float


def link_frames(geometry: ScaraGeometry, joints: Joints) -> tuple[LinkFrame, ...]:
    """Return the frames of the five links after ``arm_base`` at joint values (rad, rad, m, rad).

    ``striker`` is the tip with x along its line of travel, as in ``ScaraGeometry.forward``.
    """
    true = Joints(*(q + offset for q, offset in zip(joints, geometry.joint_offset, strict=True)))
    poses = (
        (0.0, 0.0, geometry.tip_height, true.shoulder),
        (geometry.upper_arm, 0.0, 0.0, true.elbow),
        (geometry.forearm, 0.0, true.quill, 0.0),
        (0.0, 0.0, 0.0, true.tool),
        (geometry.tip_forward, geometry.tip_side, 0.0, geometry.tip_yaw),
    )
    return tuple(LinkFrame(LINKS[i], LINKS[i + 1], *pose) for i, pose in enumerate(poses))
