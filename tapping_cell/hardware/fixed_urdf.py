"""Generation of the URDF of tappers at fixed mounts, for viewers.

The root is ``table``. Each tapper has a fixed link at its mount and a striker on a prismatic joint.
The joint has the tapper's name, and its travel is the stroke.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from tapping_cell.hardware.urdf import add_joint, add_origin, urdf_text
from tapping_cell.se2 import Pose

STRIKER_RADIUS = 0.004
"""Radius of the rods that represent the strikers, m."""
PULSE_ACCELERATION = 500.0
"""Acceleration of a striker by its coil, m/s^2; it determines the effort limit of the striker's
joint."""


@dataclass(frozen=True, slots=True)
class MountedTapper:
    """Dimensions of a tapper for the URDF; m, kg and m/s. ``mount``: pose of the resting tip in
    ``table``. ``body_start``: distance from the tip back to the body."""

    name: str
    mount: Pose
    height: float
    stroke: float
    body_start: float
    body_length: float
    body_radius: float
    mass: float
    fastest: float


def mounted_tappers_urdf(tappers: Sequence[MountedTapper], name: str = "positioning_cell") -> str:
    """Return the URDF text.

    Each tapper has the links ``NAME_mount`` and ``NAME_striker`` and the prismatic joint ``NAME``.
    The mounts have no inertia, because they are fixed to the table.
    """
    robot = ElementTree.Element("robot", name=name)
    ElementTree.SubElement(robot, "link", name="table")
    for tapper in tappers:
        mount, pose = f"{tapper.name}_mount", tapper.mount
        link = ElementTree.SubElement(robot, "link", name=mount)
        behind = -tapper.body_start - tapper.body_length / 2
        _rod(link, tapper.body_length, tapper.body_radius, behind)
        joint = add_joint(robot, mount, "fixed", "table", mount)
        add_origin(joint, (pose.x, pose.y, tapper.height), (0.0, 0.0, pose.theta))
        striker = f"{tapper.name}_striker"
        length = tapper.body_start + tapper.body_length
        link = ElementTree.SubElement(robot, "link", name=striker)
        _rod(link, length, STRIKER_RADIUS, -length / 2)
        _inertia(link, tapper.mass, length)
        joint = add_joint(robot, tapper.name, "prismatic", mount, striker)
        ElementTree.SubElement(joint, "axis", xyz="1 0 0")
        ElementTree.SubElement(
            joint,
            "limit",
            lower="0",
            upper=repr(tapper.stroke),
            velocity=repr(tapper.fastest),
            effort=repr(round(tapper.mass * PULSE_ACCELERATION, 6)),
        )
    return urdf_text(robot)


def _rod(link: ElementTree.Element, length: float, radius: float, centre: float) -> None:
    """Add a cylinder along x to a link. ``centre``: x of the cylinder's centre, m."""
    for use in ("visual", "collision"):
        element = ElementTree.SubElement(link, use)
        add_origin(element, (centre, 0.0, 0.0), (0.0, math.pi / 2, 0.0))
        shape = ElementTree.SubElement(element, "geometry")
        ElementTree.SubElement(shape, "cylinder", length=repr(length), radius=repr(radius))


def _inertia(link: ElementTree.Element, mass: float, length: float) -> None:
    """Add the inertia of a thin rod along x whose front end is the link's origin."""
    inertial = ElementTree.SubElement(link, "inertial")
    place = f"{-length / 2!r} 0.0 0.0"
    ElementTree.SubElement(inertial, "origin", xyz=place, rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(mass))
    along, across = mass * STRIKER_RADIUS**2 / 2, mass * length**2 / 12
    values = {"ixx": along, "iyy": across, "izz": across, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
    ElementTree.SubElement(inertial, "inertia", {key: repr(v) for key, v in values.items()})
