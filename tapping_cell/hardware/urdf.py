"""A URDF of the arm from the same dimensions that the kinematics use, for viewers and planners."""

from __future__ import annotations

from xml.etree import ElementTree

from tapping_cell.hardware.scara import Joints, ScaraGeometry

LINK_RADIUS = 0.02
"""Radius of the bars that stand for the links, m; for the eye alone."""


def urdf(geometry: ScaraGeometry, name: str = "scara_arm") -> str:
    """The arm as URDF text: links from ``arm_base`` to ``striker``, joints named as in ``Joints``.

    ``striker`` is the tip with x along its line of travel, as ``ScaraGeometry.forward`` gives it.
    """
    robot = ElementTree.Element("robot", name=name)
    chain = ("arm_base", "upper_arm", "forearm", "quill_rod", "tool")
    lengths = (0.0, geometry.upper_arm, geometry.forearm, 0.0, 0.0)
    for link, length in zip(chain, lengths, strict=True):
        _link(robot, link, length, geometry.tip_height)
    ElementTree.SubElement(robot, "link", name="striker")
    height = geometry.tip_height
    places = ((0, 0, height), (geometry.upper_arm, 0, 0), (geometry.forearm, 0, 0), (0, 0, 0))
    for index, joint in enumerate(Joints._fields):
        sliding = joint == "quill"
        element = ElementTree.SubElement(
            robot, "joint", name=joint, type="prismatic" if sliding else "revolute"
        )
        ElementTree.SubElement(element, "parent", link=chain[index])
        ElementTree.SubElement(element, "child", link=chain[index + 1])
        x, y, z = places[index]
        offset = geometry.joint_offset[index]
        lift, turn = (offset, 0.0) if sliding else (0.0, offset)
        ElementTree.SubElement(
            element, "origin", xyz=_numbers(x, y, z + lift), rpy=_numbers(0, 0, turn)
        )
        ElementTree.SubElement(element, "axis", xyz="0 0 1")
        ElementTree.SubElement(
            element,
            "limit",
            lower=repr(geometry.lower[index]),
            upper=repr(geometry.upper[index]),
            velocity=repr(geometry.max_speed[index]),
            effort="0",
        )
    tip = ElementTree.SubElement(robot, "joint", name="striker_mount", type="fixed")
    ElementTree.SubElement(tip, "parent", link="tool")
    ElementTree.SubElement(tip, "child", link="striker")
    ElementTree.SubElement(
        tip,
        "origin",
        xyz=_numbers(geometry.tip_forward, geometry.tip_side, 0),
        rpy=_numbers(0, 0, geometry.tip_yaw),
    )
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode", xml_declaration=True) + "\n"


def _link(robot: ElementTree.Element, name: str, length: float, height: float) -> None:
    link = ElementTree.SubElement(robot, "link", name=name)
    if name == "arm_base":
        _cylinder(link, height, (0, 0, height / 2), "0 0 0")
    elif length > 0:
        _cylinder(link, length, (length / 2, 0, 0), _numbers(0, 1.5707963267948966, 0))
    else:
        _cylinder(link, LINK_RADIUS, (0, 0, 0), "0 0 0")


def _cylinder(
    link: ElementTree.Element, length: float, place: tuple[float, float, float], turn: str
) -> None:
    visual = ElementTree.SubElement(link, "visual")
    ElementTree.SubElement(visual, "origin", xyz=_numbers(*place), rpy=turn)
    shape = ElementTree.SubElement(visual, "geometry")
    ElementTree.SubElement(shape, "cylinder", radius=repr(LINK_RADIUS), length=repr(length))


def _numbers(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
