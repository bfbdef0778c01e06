"""Deserialisation of messages that a node of another version of the cell may have published.

The middleware matches publishers and subscriptions only by the name of their message type, so the
definition of a received message may differ from the definition in this version.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.serialization import deserialize_message
from tapping_cell_msgs.msg import ErrorCode

UNREADABLE_S = 10.0
"""Time after an unreadable message during which :attr:`MessageReader.warning` describes it."""


class MessageReader:
    """Deserialises messages, and reports the first unreadable message of each topic."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self._report = report
        self._reported: set[str] = set()
        self._last = ""
        self._last_at = 0.0

    @property
    def warning(self) -> str:
        """The description of the last unreadable message; empty if there was none recently."""
        return self._last if time.monotonic() - self._last_at < UNREADABLE_S else ""

    def read(self, topic: str, kind: type, data: bytes) -> Any | None:
        """Return the message; None if the bytes do not match the definition of ``kind``."""
        try:
            return deserialize_message(data, kind)
        except (RuntimeError, MemoryError):
            self._last = (
                f"({ErrorCode.OTHER_VERSION}) a message of {len(data)} bytes on {topic} does not "
                f"match this version's definition of {kind.__name__} and is not recorded: run "
                "nodes of one version only, or give the other cell another ROS_DOMAIN_ID"
            )
            self._last_at = time.monotonic()
            if topic not in self._reported:
                self._reported.add(topic)
                self._report(self._last)
            return None
