"""Generation of the arm's URDF from its kinematic dimensions, for viewers and planners.

Shapes and masses are those of plain aluminium bars, because the cell file contains neither. The
effort limits are the joint loads at the arm's maximum accelerations, with these masses and the arm
stretched out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

from tapping_cell.hardware.link_frames import LINKS, link_frames
from tapping_cell.hardware.scara import Joints, ScaraGeometry

LINK_RADIUS = 0.02
"""Radius of the bars that represent the links, m."""
DENSITY = 2700.0
"""Density of aluminium, kg/m^3."""
GRAVITY = 9.81
"""Gravitational acceleration, m/s^2."""


@dataclass(frozen=True, slots=True)
class _Bar:
    """A solid cylinder that starts at the link's origin, along z or x."""

    length: float
    """Length, m."""
    upright: bool
    """True if the bar is along z; otherwise it is along x."""

    @property
    def mass(self) -> float:
        """Mass, kg."""
        return DENSITY * math.pi * LINK_RADIUS**2 * self.length

    @property
    def along(self) -> float:
        """Moment of inertia about the bar's own axis, kg m^2."""
        return self.mass * LINK_RADIUS**2 / 2

    @property
    def across(self) -> float:
        """Moment of inertia about a perpendicular axis through the centre, kg m^2."""
        return self.mass * (3 * LINK_RADIUS**2 + self.length**2) / 12

    @property
    def centre(self) -> tuple[float, float, float]:
        """Centre of mass in the link's frame, m."""
        return (0.0, 0.0, self.length / 2) if self.upright else (self.length / 2, 0.0, 0.0)

    def about_z(self, distance: float) -> float:
        """Return the moment of inertia about a vertical axis that is ``distance`` m behind the
        origin, kg m^2."""
        own = self.along if self.upright else self.across
        return own + self.mass * (self.centre[0] + distance) ** 2


def urdf(geometry: ScaraGeometry, name: str = "scara_arm") -> str:
    """Return the URDF text: links from ``arm_base`` to ``striker``, joints named as in ``Joints``.

    ``arm_base`` has no inertia, because it is fixed and KDL allows none at the root.
    """
    robot = ElementTree.Element("robot", name=name)
    bars = _bars(geometry)
    for link in LINKS:
        element = ElementTree.SubElement(robot, "link", name=link)
        if link in bars:
            _shape(element, bars[link], inertia=link != LINKS[0])
    efforts = _efforts(geometry, bars)
    frames = link_frames(geometry, Joints(0.0, 0.0, 0.0, 0.0))
    names = (*Joints._fields, "striker_mount")
    for index, (joint, frame) in enumerate(zip(names, frames, strict=True)):
        kind = {"quill": "prismatic", "striker_mount": "fixed"}.get(joint, "revolute")
        element = add_joint(robot, joint, kind, frame.parent, frame.link)
        add_origin(element, (frame.x, frame.y, frame.z), (0, 0, frame.yaw))
        if kind == "fixed":
            continue
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        ElementTree.SubElement(
            element,
            "limit",
            lower=repr(geometry.lower[index]),
            upper=repr(geometry.upper[index]),
            velocity=repr(geometry.max_speed[index]),
            effort=repr(round(efforts[index], 6)),
        )
    return urdf_text(robot)


def _bars(geometry: ScaraGeometry) -> dict[str, _Bar]:
    """Return the cylinder of each link by name. The link ``striker`` is a point and has none."""
    return {
        "arm_base": _Bar(max(geometry.tip_height, LINK_RADIUS), upright=True),
        "upper_arm": _Bar(geometry.upper_arm, upright=False),
        "forearm": _Bar(geometry.forearm, upright=False),
        "quill_rod": _Bar(max(geometry.tip_height, LINK_RADIUS), upright=True),
        "tool": _Bar(max(geometry.tip_forward, LINK_RADIUS), upright=False),
    }


def _efforts(geometry: ScaraGeometry, bars: dict[str, _Bar]) -> tuple[float, float, float, float]:
    """Return torques (N m) and the quill's force (N) at maximum acceleration with the arm stretched
    out."""
    rod, tool = bars["quill_rod"], bars["tool"]
    reach = geometry.forearm
    elbow = bars["forearm"].about_z(0.0) + rod.about_z(reach) + tool.about_z(reach)
    reach += geometry.upper_arm
    shoulder = bars["upper_arm"].about_z(0.0) + bars["forearm"].about_z(geometry.upper_arm)
    shoulder += rod.about_z(reach) + tool.about_z(reach)
    acceleration = Joints(*geometry.max_acceleration)
    return (
        shoulder * acceleration.shoulder,
        elbow * acceleration.elbow,
        (rod.mass + tool.mass) * (acceleration.quill + GRAVITY),
        tool.about_z(0.0) * acceleration.tool,
    )


def _shape(link: ElementTree.Element, bar: _Bar, inertia: bool) -> None:
    turn = (0, 0, 0) if bar.upright else (0, math.pi / 2, 0)
    for part in ("visual", "collision", "inertial")[: 3 if inertia else 2]:
        element = ElementTree.SubElement(link, part)
        add_origin(element, bar.centre, turn)
        if part == "inertial":
            ElementTree.SubElement(element, "mass", value=repr(bar.mass))
            across, along = repr(bar.across), repr(bar.along)
            values = {
                "ixx": across,
                "iyy": across,
                "izz": along,
                "ixy": "0",
                "ixz": "0",
                "iyz": "0",
            }
            ElementTree.SubElement(element, "inertia", values)
        else:
            shape = ElementTree.SubElement(element, "geometry")
            ElementTree.SubElement(
                shape, "cylinder", radius=repr(LINK_RADIUS), length=repr(bar.length)
            )


def add_joint(
    robot: ElementTree.Element, name: str, kind: str, parent: str, child: str
) -> ElementTree.Element:
    """Add a joint of this type between two links to a robot; return its element."""
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    return joint


def add_origin(element: ElementTree.Element, place: Sequence[float], turn: Sequence[float]) -> None:
    """Add an origin: x, y, z in m; roll, pitch, yaw in rad."""
    xyz, rpy = (" ".join(repr(float(value)) for value in values) for values in (place, turn))
    ElementTree.SubElement(element, "origin", xyz=xyz, rpy=rpy)


def urdf_text(robot: ElementTree.Element) -> str:
    """Return the indented text of a robot."""
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode", xml_declaration=True) + "\n"
