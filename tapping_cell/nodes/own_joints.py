"""Find the joint states of the cell's arm on a topic that other robots use too."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState


class OwnJoints:
    """Joints of one arm, recognised by their names in serialised joint states."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        # CDR, the serialisation of ROS, ends each text with a zero byte.
        self._marks = [name.encode() + b"\0" for name in self.names]

    def may_be_in(self, data: bytes) -> bool:
        """Return False if a serialised message does not name all joints. A longer name that ends
        with the name of a joint counts too. Much faster than deserialising the message."""
        return bool(self._marks) and all(mark in data for mark in self._marks)

    def positions(self, data: bytes) -> tuple[float, ...] | None:
        """Return the positions of the joints; None if the message does not have all of them."""
        if not self.may_be_in(data):
            return None
        message = deserialize_message(data, JointState)
        found = dict(zip(message.name, message.position, strict=False))
        if not all(name in found for name in self.names):
            return None
        return tuple(found[name] for name in self.names)
