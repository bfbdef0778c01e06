"""Construction of a serial chain from an arm's URDF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from tapping_cell.hardware.serial_chain import Array, ChainJoint, SerialChain, pose_matrix

MOVING = ("revolute", "continuous", "prismatic")


def chain_from_urdf(
    text: str,
    base_link: str,
    tip_link: str,
    joints: Sequence[str],
    base: Array,
    tool: Array,
) -> SerialChain:
    """Return the chain from ``base_link`` to ``tip_link``, which must contain exactly ``joints``.

    ``base``, ``tool``: as for :class:`SerialChain`. Raises ValueError if the text is not a URDF (a
    xacro file must be expanded first), if the links are not connected, if the joints or their order
    differ, or if a joint has no limits.
    """
    try:
        robot = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"it is not XML: {error}") from error
    if robot.tag != "robot" or "{http://www.ros.org/wiki/xacro}" in text or "xacro:" in text:
        raise ValueError("it is not a URDF; expand a xacro file with: xacro FILE > arm.urdf")
    by_child = {_link(joint, "child"): joint for joint in robot.findall("joint")}
    path: list[ElementTree.Element] = []
    link = tip_link
    while link != base_link:
        joint = by_child.get(link)
        if joint is None or len(path) > len(by_child):
            known = sorted({entry.get("name", "") for entry in robot.findall("link")})
            raise ValueError(
                f"no joints lead from link {base_link} to {tip_link}; its links are"
                f" {', '.join(known)}"
            )
        path.insert(0, joint)
        link = _link(joint, "parent")
    found, before = [], np.eye(4)
    for joint in path:
        before = before @ _origin(joint)
        if joint.get("type") in MOVING:
            found.append(_joint(joint, before))
            before = np.eye(4)
        elif joint.get("type") != "fixed":
            raise ValueError(
                f"joint {joint.get('name')} is of type {joint.get('type')}, which is not supported"
            )
    names = [joint.name for joint in found]
    if names != list(joints):
        raise ValueError(
            f"its joints from {base_link} to {tip_link} are {', '.join(names)}, but"
            f" arm.ros2_control.joints are {', '.join(joints)}: give them in this order"
        )
    return SerialChain(tuple(found), base, before @ tool)


def _joint(joint: ElementTree.Element, origin: Array) -> ChainJoint:
    name, limit = joint.get("name", ""), joint.find("limit")
    if joint.find("mimic") is not None:
        raise ValueError(f"joint {name} mimics another joint, which is not supported")
    if limit is None or limit.get("velocity") is None:
        raise ValueError(f"joint {name} has no velocity limit; one is required")
    axis = np.array(_numbers(joint.find("axis"), "xyz", (1.0, 0.0, 0.0)))
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        raise ValueError(f"joint {name} has an axis of length 0")
    x, y, z = axis / length
    bounded = joint.get("type") != "continuous"
    return ChainJoint(
        name,
        tuple(tuple(row) for row in origin.tolist()),
        (float(x), float(y), float(z)),
        joint.get("type") == "prismatic",
        float(limit.get("lower", "0")) if bounded else -math.tau,
        float(limit.get("upper", "0")) if bounded else math.tau,
        float(limit.get("velocity", "0")),
    )


def _origin(joint: ElementTree.Element) -> Array:
    element = joint.find("origin")
    zero = (0.0, 0.0, 0.0)
    return pose_matrix([*_numbers(element, "xyz", zero), *_numbers(element, "rpy", zero)])


def _numbers(
    element: ElementTree.Element | None, key: str, default: tuple[float, float, float]
) -> tuple[float, ...]:
    text = None if element is None else element.get(key)
    if text is None:
        return default
    numbers = tuple(float(word) for word in text.split())
    if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
        raise ValueError(f'{key}="{text}" is not three finite numbers')
    return numbers


def _link(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")
