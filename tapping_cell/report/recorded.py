"""Recorded messages of a run, in a bag or in memory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

NO_BAGS = (
    "the Python package rosbags is missing or damaged: call  pip install --force-reinstall rosbags"
)


@contextlib.contextmanager
def needing_rosbags() -> Iterator[None]:
    """Convert each exception of an import of rosbags to ModuleNotFoundError; a package that is
    damaged or does not suit its own requirements can raise any."""
    try:
        yield
    except Exception as error:
        raise ModuleNotFoundError(NO_BAGS, name="rosbags") from error


class BagError(ValueError):
    """Raised for a bag that cannot be read or written; the message gives reason and remedy."""


@dataclass(frozen=True, slots=True)
class Quality:
    """Quality of service of a topic's publisher."""

    depth: int = 10
    reliable: bool = True
    latched: bool = False


DEFAULT = Quality()
"""rclpy's default: reliable and volatile."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag. ``kind`` is its message type, such as ``geometry_msgs/msg/Pose``."""

    name: str
    kind: str


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a bag: its topic, time of reception (ns since 1970) and CDR bytes."""

    topic: Topic
    stamp: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Bag:
    """Contents of a bag. ``missing`` is a sentence about messages that were recorded but cannot be
    read; it is empty for a complete bag."""

    path: Path
    messages: tuple[Recorded, ...]
    missing: str
    decoder: Callable[[bytes, str], Any]
    """Decodes CDR bytes of a message type; raises ValueError if they do not match it."""

    @property
    def whole(self) -> bool:
        """Whether all recorded messages could be read."""
        return not self.missing

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Return the topics that have messages, sorted by name."""
        return tuple(sorted({m.topic for m in self.messages}, key=lambda topic: topic.name))

    def of(self, name: str) -> Iterator[tuple[int, Any]]:
        """Yield stamps and decoded messages of a topic in any namespace.

        A decoded message has the fields of its definition as attributes.
        """
        for message in self.messages:
            if message.topic.name == name or message.topic.name.endswith("/" + name.lstrip("/")):
                yield message.stamp, self.decode(message)

    def of_own_object(self) -> Iterator[Any]:
        """Yield the decoded states of the cell's own object, which version 0.1 recorded on a topic
        of their own, ``object_state``."""
        states = None
        for _, states in self.of("object_state"):
            yield states
        if states is None:
            for _, message in self.of("object_states"):
                yield from message.objects[:1]

    def decode(self, message: Recorded) -> Any:
        """Decode a message; the result has the fields of its definition as attributes.

        Raises:
            BagError: the bytes do not match the definition.
        """
        try:
            return self.decoder(message.data, message.topic.kind)
        except ValueError as error:
            topic = message.topic
            raise BagError(
                f"{self.path}: a message of {topic.name} is not a {topic.kind}: {error}"
            ) from error
