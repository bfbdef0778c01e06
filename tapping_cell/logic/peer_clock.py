"""How old what another node says is, where that node may run on another computer.

The age of a message is its delay beyond the smallest delay seen of that node lately. Own time is
the steady clock, so that a step of this computer's clock changes nothing; a stamp in the future
makes everything else look older, never younger. A delay that all messages of the window share
cannot be told from a difference of the clocks: ``skew`` bounds both.
"""

from __future__ import annotations

from collections import deque

from tapping_cell.logic.clock import Now, to_seconds
from tapping_cell.messages import Time

WINDOW_S = 10.0
SKEW_LIMIT_S = 0.5
"""Largest difference of two computers' clocks with which the cell works."""


class PeerClock:
    """The clock of one other node, estimated from the stamps of its messages."""

    def __init__(self) -> None:
        # (time of arrival, arrival minus stamp), the differences rising: a sliding minimum.
        self._delays: deque[tuple[float, float]] = deque()

    def hear(self, stamp: Time, now: Now) -> None:
        """Take in a message's stamp; a stamp of zero means that none was given."""
        if not (stamp.sec or stamp.nanosec):
            return
        delay = now.steady - to_seconds(stamp)
        while self._delays and self._delays[-1][1] >= delay:
            self._delays.pop()
        self._delays.append((now.steady, delay))
        while self._delays[0][0] < now.steady - WINDOW_S:
            self._delays.popleft()

    def to_steady(self, stamp: Time, now: Now) -> float:
        """A stamp of that node on the own steady clock; ``now`` for a stamp of zero."""
        if not (stamp.sec or stamp.nanosec) or not self._delays:
            return now.steady
        return to_seconds(stamp) + self._delays[0][1]

    def age(self, stamp: Time, now: Now) -> float:
        """Age of a message in s, at least 0 for one that was heard."""
        return now.steady - self.to_steady(stamp, now)

    def skew(self, now: Now) -> float:
        """Own clock minus that of the node, the least delay included, s; 0 while unknown."""
        if not self._delays:
            return 0.0
        return self._delays[0][1] - (now.steady - 1e-9 * now.ros)
