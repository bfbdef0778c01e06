"""Interface of the emulated serial devices: bytes in, bytes out, and time as an argument.

An emulator is a state machine without a thread or a clock. A pseudo-terminal runs the emulator in
real time, a test in virtual time.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol


class DeviceEmulator(Protocol):
    """A serial device in simulated time; ``now`` in s must not decrease between calls."""

    def receive(self, data: bytes, now: float) -> None:
        """Process bytes from the host."""

    def advance(self, now: float) -> None:
        """Process all events that are due by ``now``."""

    def take_output(self, now: float) -> bytes:
        """Return the bytes that were transmitted by ``now``."""

    def next_event(self) -> float | None:
        """Return the time of the next internal event or transmission; None if there is none."""

    def power_cycle(self, now: float) -> None:
        """Restart the board, as after a power loss or when opening the port resets it."""


def earliest(*times: float | None) -> float | None:
    """Return the earliest of several times, of which any may be None; None if all times are
    None."""
    # The simulator calls this 20 000 times per goal; min with a generator takes six times as long.
    first: float | None = None
    for time in times:
        if time is not None and (first is None or time < first):
            first = time
    return first


class TimedBytes:
    """Queue of bytes in transmission, each with the time when its transmission ends."""

    def __init__(self) -> None:
        self._queue: deque[tuple[float, bytes]] = deque()

    def take(self, now: float) -> bytes:
        """Return the bytes transmitted by ``now``, in order."""
        parts: list[bytes] = []
        while self._queue and self._queue[0][0] <= now:
            parts.append(self._queue.popleft()[1])
        return b"".join(parts)

    def next_time(self) -> float | None:
        """Return the time when the next bytes are transmitted; None if the queue is empty."""
        return self._queue[0][0] if self._queue else None


class OutputQueue(TimedBytes):
    """Output of a board, whose line transmits one byte after the other."""

    def __init__(self, latency: float, byte_time: float) -> None:
        super().__init__()
        self._latency = latency
        self._byte_time = byte_time
        self._line_free = 0.0

    def put(self, data: bytes, now: float) -> None:
        """Queue ``data``; it is available once the line has transmitted it."""
        start = max(now + self._latency, self._line_free)
        self._line_free = start + len(data) * self._byte_time
        self._queue.append((self._line_free, data))

    def clear(self) -> None:
        """Discard the bytes that are not transmitted yet."""
        self._queue.clear()
        self._line_free = 0.0
