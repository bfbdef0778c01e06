"""Reception of topics by the recorder: reading, and the buffer before a goal."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.serialization import deserialize_message
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.nodes.recorder.recording import ReceivedMessage

SELDOM_NS = 1_000_000_000
"""Minimum interval between two buffered messages of a topic that is added with ``seldom``."""


class MessageBuffer:
    """Before a recording, the messages of the last seconds; during a recording, the messages that
    are not written yet. All methods may be called from any thread."""

    def __init__(self, lead: float) -> None:
        """``lead``: time (s) for which messages are kept while there is no recording."""
        self._lead_ns = 1e9 * lead
        self._lock = threading.Lock()
        self._lead: deque[ReceivedMessage] = deque()
        self._latched: dict[str, ReceivedMessage] = {}
        self._waiting: list[ReceivedMessage] = []
        self._begins: int | None = None
        """Time of the first message of the current bag; None if there is no recording."""

    def add(self, message: ReceivedMessage, *, latched: bool, seldom: bool) -> None:
        """Add a message. ``latched`` or ``seldom``: the last message of the topic is written at the
        start of each bag. ``seldom``: the message is dropped if the last message of its topic was
        added less than ``SELDOM_NS`` before."""
        with self._lock:
            last = self._latched.get(message.topic)
            if seldom and last is not None and message.stamp - last.stamp < SELDOM_NS:
                return
            if latched or seldom:
                self._latched[message.topic] = message
            if self._begins is not None:
                if message.stamp < self._begins - self._lead_ns:
                    self._begins = message.stamp  # the clock was set back
                if message.stamp >= self._begins:
                    self._waiting.append(message)
                return
            self._lead.append(message)
            # A stamp far in the future is from before the clock was set back.
            while abs(message.stamp - self._lead[0].stamp) > self._lead_ns:
                self._lead.popleft()

    def begin(self, now: int, notes_topic: str, notes: bytes) -> None:
        """Begin a recording at ``now`` (ns) with the messages of the last seconds. The bag starts
        with ``notes``, followed by the latched messages that are older than these seconds."""
        with self._lock:
            first = min((message.stamp for message in self._lead), default=now)
            topics = {message.topic for message in self._lead}
            self._waiting += [
                ReceivedMessage(notes_topic, first, notes),
                *(replace(m, stamp=first) for m in self._latched.values() if m.topic not in topics),
                *self._lead,
            ]
            self._lead.clear()
            self._begins = first

    def take(self, *, end: bool = False) -> list[ReceivedMessage]:
        """Remove and return the messages to write, in the order of their reception. ``end``: end
        the recording."""
        with self._lock:
            taken, self._waiting = self._waiting, []
            if end:
                self._begins = None
        return sorted(taken, key=lambda message: message.stamp)


UNREADABLE_S = 10.0
"""Time after an unreadable message during which :attr:`MessageReader.warning` describes it."""


class MessageReader:
    """Deserialises messages, and reports the first unreadable message of each topic.

    The middleware matches publishers and subscriptions only by the name of their message type. A
    node of another version of the cell may therefore publish messages with another definition.
    """

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
