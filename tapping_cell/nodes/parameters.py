"""Declare node parameters from a frozen dataclass, whose fields have units and ranges.

The YAML files use the same field declarations (``configuration.schema``), so each range is defined
once and is checked, with a readable error message, at start and at ``ros2 param set``.
"""

from __future__ import annotations

import dataclasses
import math
import typing
from collections.abc import Collection
from dataclasses import MISSING
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from tapping_cell.configuration.schema import ConfigurationError, Limits, build

Parameters = TypeVar("Parameters")

QOS_OVERRIDES = "qos_overrides."
FOREIGN_PREFIXES = ("use_sim_time", QOS_OVERRIDES, "start_type_description_service")
"""Prefixes of the parameters that belong to rclpy itself."""


def declare(node: Node, kind: type[Parameters], changeable: tuple[str, ...] = ()) -> None:
    """Declare every field of a parameter class on the node, with description, unit and range.

    The node must be created with ``automatically_declare_parameters_from_overrides``, because only
    then are unknown parameter names detected. Parameters that are not in ``changeable`` are
    read-only while the node runs.

    Raises:
        ConfigurationError: an override names no parameter of this node, or has the wrong type.
    """
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    hints = typing.get_type_hints(kind)
    names = {entry.name for entry in fields}
    given = {name: node.get_parameter(name).value for name in node.get_parameters_by_prefix("")}
    for name in given:
        if name in names:
            node.undeclare_parameter(name)
        elif not name.startswith(FOREIGN_PREFIXES):
            raise ConfigurationError(
                f"{node.get_name()}: unknown parameter '{name}'; this node's parameters are "
                + ", ".join(sorted(names))
            )
    for entry in fields:
        if entry.default is MISSING:
            raise TypeError(f"{kind.__name__}.{entry.name} needs a default")
        descriptor = _descriptor(entry.metadata["limits"], hints[entry.name])
        descriptor.read_only = entry.name not in changeable
        try:
            node.declare_parameter(entry.name, entry.default, descriptor)
        except Exception as error:
            limits: Limits = entry.metadata["limits"]
            wanted = _type_name(hints[entry.name])
            if limits.range_text():
                wanted = f"{limits.range_text()} ({wanted})"
            value = given.get(entry.name, entry.default)
            raise ConfigurationError(
                f"{node.get_name()}: parameter '{entry.name}' is {value!r}, but must be {wanted}: "
                f"{limits.description}"
            ) from error


def check_qualities(node: Node, known: Collection[str], fixed: Collection[str]) -> None:
    """Check the parameters for the quality of service. ``known``: full names of those that the
    node's topics have; ``fixed``: full names of the topics that no parameter changes. Call it when
    the node has created its publishers and subscriptions. A topic that the node has not opened is
    only logged, because a file may set parameters of several nodes, or the node may open it later.

    Raises:
        ConfigurationError: the message contains the names that exist.
    """
    policies = {name.rpartition(".")[2] for name in known}
    for rest in node.get_parameters_by_prefix(QOS_OVERRIDES.removesuffix(".")):
        name = f"{QOS_OVERRIDES}{rest}"
        if name in known:
            continue
        sentence = (
            f"{node.get_name()}: unknown parameter '{name}'; the quality of service of commands"
            " and stops is fixed, and that of other topics is set by: " + ", ".join(sorted(known))
        )
        topic, _, end = rest.partition(".")
        if topic in fixed or end.rpartition(".")[2] not in policies:
            raise ConfigurationError(sentence)
        node.get_logger().warning(sentence)


def read(node: Node, kind: type[Parameters]) -> Parameters:
    """Return the node's current parameters after checking them.

    Raises:
        ConfigurationError: the message names node, parameter, value and range.
    """
    fields = dataclasses.fields(kind)  # type: ignore[arg-type]
    document = {entry.name: node.get_parameter(entry.name).value for entry in fields}
    return build(kind, document, source=f"parameters of {node.get_name()}")


def _type_name(hint: Any) -> str:
    return {float: "a double", int: "an integer", bool: "true or false", str: "a text"}[hint]


def _descriptor(limits: Limits, hint: Any) -> ParameterDescriptor:
    unit = f" [{limits.unit}]" if limits.unit else ""
    descriptor = ParameterDescriptor(
        description=limits.description + unit,
        additional_constraints=limits.range_text() if limits.choices else "",
    )
    bounded = math.isfinite(limits.minimum) and math.isfinite(limits.maximum)
    if hint is float and bounded:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=limits.minimum, to_value=limits.maximum)
        ]
    if hint is int and bounded:
        descriptor.integer_range = [
            IntegerRange(from_value=int(limits.minimum), to_value=int(limits.maximum), step=1)
        ]
    return descriptor
