"""Common part of the dialects of controllers that answer in lines of text."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic

from tapping_cell.hardware.axis_units import TO_UNITS
from tapping_cell.hardware.dialect import Axes, LineCounters, StraightMove
from tapping_cell.hardware.text_line import Bad, Decoded, Frame
from tapping_cell.hardware.transport import Transport


class LineDialect(ABC, Generic[Frame]):
    """Reception of the frames of one controller. ``decode`` finds the frames in the received
    bytes."""

    def __init__(self, transport: Transport, decode: Callable[[bytes], Decoded[Frame]]) -> None:
        self.counters = LineCounters()
        self._transport = transport
        self._decode = decode
        self._buffer = b""
        self._frames: deque[Frame] = deque()

    @property
    def units(self) -> Sequence[float]:
        """Degrees and mm."""
        return TO_UNITS

    def start_moves(self, moves: Sequence[StraightMove], deadline: float) -> None:
        """Send one line per move."""
        for move in moves:
            self._start_move(move.target, move.feed, deadline)

    @abstractmethod
    def _start_move(self, target: Axes, feed: float, deadline: float) -> None:
        """Send one move."""

    @abstractmethod
    def _take(self, frame: Frame) -> None:
        """Queue a received frame in ``_frames``, or raise the fault that it reports."""

    def _pump(self, wait: float) -> bool:
        """Read for up to ``wait`` s and decode the data; return False if nothing was received."""
        data = self._transport.read(wait)
        self.counters.received.take(data)
        self._buffer += data
        while True:
            decoded = self._decode(self._buffer)
            self._buffer = decoded.rest
            if decoded.frame is None:
                return bool(data)
            self.counters.lines += 1
            if isinstance(decoded.frame, Bad):
                self.counters.bad_lines += 1
            else:
                self._take(decoded.frame)

    def _next(self, until: float) -> Frame | None:
        """Return the next frame; None if none is received by ``until``."""
        while not self._frames:
            left = until - self._transport.now()
            if left <= 0:
                return None
            self._pump(left)
        return self._frames.popleft()
