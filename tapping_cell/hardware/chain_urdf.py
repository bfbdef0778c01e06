"""Construction of a serial chain from an arm's URDF.

The URDF is read with the parser of the standard library: only joints, origins, axes and limits are
needed, and urdf_parser_py and yourdfpy would add lxml or trimesh without checking these values.
"""

from __future__ import annotations

import io
import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from tapping_cell.hardware.serial_chain import Array, ChainJoint, SerialChain, pose_matrix

MOVING = ("revolute", "continuous", "prismatic")
LARGEST_TEXT = 2_000_000
"""Maximum length of a URDF, in characters."""
LONGEST = 5.0
"""Maximum length in an arm, m: a larger value is probably in mm."""
LARGEST_TURN = 2.0 * math.tau + 0.01
"""Maximum limit of a revolute joint, rad: two turns. A larger value is probably in degrees."""
FASTEST_TURN, FASTEST_MOVE = 60.0, 10.0
"""Maximum speeds of joints: rad/s, and m/s. Larger values are probably in degrees/s and mm/s."""
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")


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
    differ, if a joint has no limits, or if a value is not a number or is in another unit.
    """
    robot = _robot(text)
    joint_elements = robot.findall("joint")
    for kind, names in (
        ("joint", [joint.get("name", "") for joint in joint_elements]),
        ("child link", [_link(joint, "child") for joint in joint_elements]),
    ):
        name, count = Counter(names).most_common(1)[0] if names else ("", 0)
        if count > 1:
            raise ValueError(f"the {kind} {name} appears {count} times; each must be unique")
    path = _path(joint_elements, base_link, tip_link)
    if path is None:
        known = sorted({entry.get("name", "") for entry in robot.findall("link")})
        hint = f"its links are {', '.join(known)}"
        if _path(joint_elements, tip_link, base_link):
            hint = "base_link and tip_link seem to be exchanged"
        raise ValueError(f"no joints lead from link {base_link} to {tip_link}; {hint}")
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
    _check_on_chain(joint_elements, joints, names, f"{base_link} to {tip_link}")
    if names != list(joints):
        raise ValueError(
            f"its joints from {base_link} to {tip_link} are {', '.join(names)}, but"
            f" arm.ros2_control.joints are {', '.join(joints)}: give them in this order"
        )
    return SerialChain(tuple(found), base, before @ tool)


def _path(
    joints: Sequence[ElementTree.Element], base_link: str, tip_link: str
) -> list[ElementTree.Element] | None:
    """Return the joints that lead from one link to another; None if there is no such path."""
    by_child = {_link(joint, "child"): joint for joint in joints}
    path: list[ElementTree.Element] = []
    link = tip_link
    while link != base_link:
        joint = by_child.get(link)
        if joint is None or len(path) > len(by_child):
            return None
        path.insert(0, joint)
        link = _link(joint, "parent")
    return path


def _check_on_chain(
    elements: Sequence[ElementTree.Element],
    joints: Sequence[str],
    names: Sequence[str],
    chain: str,
) -> None:
    """Raise ValueError for the first of ``joints`` that is not among ``names``, the chain's."""
    by_name = {element.get("name", ""): element for element in elements}
    for index, name in enumerate(joints):
        if name not in by_name:
            raise ValueError(
                f"it has no joint {name} (arm.ros2_control.joints); its joints are "
                f"{', '.join(by_name)}"
            )
        if name in names:
            continue
        cause = f"its joint {name} (arm.ros2_control.joints) is not on the way from {chain}"
        child = _link(by_name[name], "child")
        following = next((by_name[other] for other in joints[index + 1 :] if other in names), None)
        if following is None or child in (_link(element, "parent") for element in elements):
            raise ValueError(f"{cause}; leave it out, or correct base_link and tip_link")
        raise ValueError(
            f"{cause}: no joint has its child {child} as parent; correct the parent of "
            f"{following.get('name')}, which is {_link(following, 'parent')}"
        )


def _robot(text: str) -> ElementTree.Element:
    """Return the element ``robot`` of a URDF."""
    expand = "expand the xacro file with: xacro FILE > arm.urdf"
    if len(text) > LARGEST_TEXT:
        raise ValueError(f"it has {len(text) / 1e6:.0f} MB (limit {LARGEST_TEXT / 1e6:.0f} MB)")
    try:
        robot = ElementTree.fromstring(text)
        named: list[Any] = [
            entry for _, entry in ElementTree.iterparse(io.StringIO(text), ("start-ns",))
        ]
    except ElementTree.ParseError as error:
        # Without the declaration of its prefix, a xacro element is not XML.
        hint = f"; {expand}" if "unbound prefix" in str(error) and "xacro:" in text else ""
        raise ValueError(f"it is not XML: {error}{hint}") from error
    except ValueError as error:
        raise ValueError(f"it is not XML: {error}; save it as UTF-8 text") from error
    spaces = {uri for prefix, uri in named if prefix == "xacro" or "xacro" in uri}
    for element in robot.iter():
        name = element.get("name", "")
        if element.tag.startswith("{") and element.tag[1:].split("}")[0] in spaces:
            raise ValueError(f"it contains the xacro element {element.tag.split('}')[1]}; {expand}")
        for key, value in element.attrib.items():
            if re.search(r"\$[({]", value):
                raise ValueError(
                    f'{element.tag} {name}: {key}="{value}" is a xacro expression; {expand}'
                )
    if robot.tag != "robot":
        raise ValueError(f"it is not a URDF: its outermost element is {robot.tag}, not robot")
    return robot


def _joint(joint: ElementTree.Element, origin: Array) -> ChainJoint:
    name, limit = joint.get("name", ""), joint.find("limit")
    prismatic, bounded = joint.get("type") == "prismatic", joint.get("type") != "continuous"
    if joint.find("mimic") is not None:
        raise ValueError(f"joint {name} mimics another joint, which is not supported")
    if limit is None or limit.get("velocity") is None:
        raise ValueError(f"joint {name} has no velocity limit; one is required")
    axis = np.array(_numbers(joint, "axis", "xyz", (1.0, 0.0, 0.0)))
    length = float(np.linalg.norm(axis))
    if length < 1e-6:
        raise ValueError(f"joint {name} has an axis of length 0")
    x, y, z = axis / length
    ends = (-math.tau, math.tau)
    lower, upper = _limit(joint, "lower"), _limit(joint, "upper")
    if not bounded and lower < upper:
        # The URDF's definition ignores them, but an arm whose cable cannot turn further needs them.
        ends = max(-math.tau, lower), min(math.tau, upper)
    if bounded:
        if limit.get("lower") is None and limit.get("upper") is None:
            raise ValueError(f"joint {name} has no lower and upper limit; both are required")
        ends = lower, upper
        for key, end in zip(("lower", "upper"), ends, strict=True):
            if prismatic:
                _check_size(joint, "limit", key, end, LONGEST, "m", "mm")
            else:
                _check_size(joint, "limit", key, end, LARGEST_TURN, "rad", "degrees")
    speed = _limit(joint, "velocity")
    if prismatic:
        _check_size(joint, "limit", "velocity", speed, FASTEST_MOVE, "m/s", "mm/s")
    else:
        _check_size(joint, "limit", "velocity", speed, FASTEST_TURN, "rad/s", "degrees/s")
    if speed <= 0.0:
        raise ValueError(f"joint {name}: the limit velocity is {speed:g}; it must be above 0")
    return ChainJoint(
        name,
        tuple(tuple(row) for row in origin.tolist()),
        (float(x), float(y), float(z)),
        prismatic,
        *ends,
        speed,
    )


def _origin(joint: ElementTree.Element) -> Array:
    zero = (0.0, 0.0, 0.0)
    place = _numbers(joint, "origin", "xyz", zero)
    turn = _numbers(joint, "origin", "rpy", zero)
    for value in place:
        _check_size(joint, "origin", "xyz", value, LONGEST, "m", "mm")
    for value in turn:
        _check_size(joint, "origin", "rpy", value, math.tau + 0.01, "rad", "degrees")
    return pose_matrix([*place, *turn])


def _check_size(
    joint: ElementTree.Element,
    element: str,
    key: str,
    value: float,
    most: float,
    unit: str,
    other: str,
) -> None:
    """Raise ValueError for a value of more than ``most`` in magnitude, which is probably in another
    unit."""
    if abs(value) > most:
        factor = 1e-3 if other.startswith("mm") else math.pi / 180.0
        raise ValueError(
            f"joint {joint.get('name')}: {value:g} in {element} {key} is more than {most:.4g} "
            f"{unit}; if it is in {other}, write {value * factor:.6g}"
        )


def _numbers(
    joint: ElementTree.Element, name: str, key: str, default: tuple[float, float, float]
) -> tuple[float, ...]:
    """Return the three numbers of an attribute of one of the joint's elements."""
    element = joint.find(name)
    text = None if element is None else element.get(key)
    if text is None:
        return default
    words = text.split()
    if len(words) != 3:
        raise ValueError(
            f'joint {joint.get("name")}: {name} {key}="{text}" must be three numbers with spaces '
            "between them"
        )
    return tuple(_number(joint, name, key, word) for word in words)


def _limit(joint: ElementTree.Element, key: str) -> float:
    """Return a number of the joint's limit; 0 if it is left out, as in the URDF's definition."""
    element = joint.find("limit")
    assert element is not None
    return _number(joint, "limit", key, element.get(key, "0").strip())


def _number(joint: ElementTree.Element, name: str, key: str, word: str) -> float:
    if not _NUMBER.fullmatch(word) or not math.isfinite(float(word)):
        hint = "; write a decimal point in place of the comma" if "," in word else ""
        raise ValueError(
            f"joint {joint.get('name')}: '{word}' in {name} {key} is not a finite number{hint}"
        )
    return float(word)


def _link(joint: ElementTree.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")
