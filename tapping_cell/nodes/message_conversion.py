"""Convert between ROS messages and the dataclasses of ``tapping_cell.messages`` that mirror them.

Each field of a mirror is converted to the message's field of the same name, and back.
"""

from __future__ import annotations

import copy
import dataclasses
import importlib
import operator
import typing
from collections.abc import Callable
from functools import cache
from typing import Any, ClassVar, Protocol, TypeVar

from tapping_cell import messages

Convert = Callable[[Any], Any]


class Mirrored(Protocol):
    """Dataclass of ``tapping_cell.messages``."""

    ROS_TYPE: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]


Mirror = TypeVar("Mirror", bound=Mirrored)


@cache
def ros_class(name: str) -> Any:
    """Return the ROS class named by a mirror's ``ROS_TYPE``: ``package/msg/Name`` or
    ``package/srv/Name.Part``."""
    package, kind, title = name.split("/")
    return operator.attrgetter(title)(importlib.import_module(f"{package}.{kind}"))


def to_ros(message: Mirrored) -> Any:
    """Convert a dataclass of :mod:`tapping_cell.messages` to its ROS message."""
    # A copy is faster than the constructor, which would build nested messages that are replaced
    # below.
    made = copy.copy(_default(message.ROS_TYPE))
    for name in _names(type(message)):
        value = getattr(message, name)
        if isinstance(value, list):
            value = [to_ros(v) if hasattr(v, "ROS_TYPE") else v for v in value]
        elif hasattr(value, "ROS_TYPE"):
            value = to_ros(value)
        setattr(made, name, value)
    return made


@cache
def _names(kind: type[Mirrored]) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(kind))


@cache
def _default(name: str) -> Any:
    return ros_class(name)()


def from_ros(message: Any, kind: type[Mirror]) -> Mirror:
    """Convert a ROS message to its mirror."""
    given = {name: convert(getattr(message, name)) for name, convert in _plan(kind)}
    return kind(**given)


@cache
def _plan(kind: type[Mirrored]) -> tuple[tuple[str, Convert], ...]:
    """Return the name and the conversion of each field of a mirror."""
    hints = typing.get_type_hints(kind, vars(messages))
    return tuple((field.name, _reader(hints[field.name])) for field in dataclasses.fields(kind))


def _reader(hint: Any) -> Convert:
    if typing.get_origin(hint) is list:
        (inner,) = typing.get_args(hint)
        if hasattr(inner, "ROS_TYPE"):
            return lambda values: [from_ros(value, inner) for value in values]
        # rclpy returns numeric sequences as numpy arrays or as arrays of the standard library.
        return lambda values: (
            values.tolist() if hasattr(values, "tolist") else [inner(value) for value in values]
        )
    if hasattr(hint, "ROS_TYPE"):
        return lambda value: from_ros(value, hint)
    return lambda value: value
