"""What every emulated serial device offers: bytes in, bytes out, time told from outside.

An emulator is a state machine without a thread and without a clock of its own. A pseudo-terminal
runs it in real time, a test in any time it likes.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol


class DeviceEmulator(Protocol):
    """A serial device in simulated time; ``now`` in s never goes back from call to call."""

    def receive(self, data: bytes, now: float) -> None:
        """Bytes arrive from the host."""

    def advance(self, now: float) -> None:
        """Let everything happen that is due by ``now``."""

    def take_output(self, now: float) -> bytes:
        """The bytes that have left the device by ``now``."""

    def next_event(self) -> float | None:
        """When the device will next do or send something by itself; None if never."""

    def power_cycle(self, now: float) -> None:
        """The board restarts, as on a loss of power or when opening the port resets it."""


class OutputQueue:
    """Bytes on their way out, each with the time at which it has left the device."""

    def __init__(self, latency: float, byte_time: float) -> None:
        self._latency = latency
        self._byte_time = byte_time
        self._queue: deque[tuple[float, bytes]] = deque()
        self._line_free = 0.0

    def put(self, data: bytes, now: float) -> None:
        """Send ``data``; it is out when the line has carried it."""
        start = max(now + self._latency, self._line_free)
        self._line_free = start + len(data) * self._byte_time
        self._queue.append((self._line_free, data))

    def take(self, now: float) -> bytes:
        """What is out by ``now``."""
        parts: list[bytes] = []
        while self._queue and self._queue[0][0] <= now:
            parts.append(self._queue.popleft()[1])
        return b"".join(parts)

    def next_time(self) -> float | None:
        """When the next bytes are out."""
        return self._queue[0][0] if self._queue else None

    def clear(self) -> None:
        """Forget what has not left yet."""
        self._queue.clear()
        self._line_free = 0.0
