"""Age of the messages of another node, which may run on another computer.

The delay of a message is its time of arrival minus its stamp. The age of a message is its delay
minus the smallest recent delay of the same node. Local time is the steady clock, so a step of this
computer's wall clock has no effect. A stamp in the future makes all other messages appear older,
never younger. A delay that all recent messages share cannot be distinguished from a difference of
the clocks; ``skew`` returns the sum of the two.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from tapping_cell.logic.clock import Now, to_seconds
from tapping_cell.messages import Time

WINDOW_S = 10.0
SKEW_LIMIT_S = 0.5
"""Maximum difference between the clocks of two computers at which the cell works."""


class PeerClock:
    """The clock of one other node, estimated from the stamps of its messages."""

    def __init__(self) -> None:
        # Pairs (arrival, arrival minus stamp) with increasing differences, for a sliding minimum.
        self._delays: deque[tuple[float, float]] = deque()

    def receive(self, stamp: Time, now: Now) -> None:
        """Process a message's stamp; a stamp of zero means that no stamp was given."""
        if not (stamp.sec or stamp.nanosec):
            return
        delay = now.steady - to_seconds(stamp)
        while self._delays and self._delays[-1][1] >= delay:
            self._delays.pop()
        self._delays.append((now.steady, delay))
        while self._delays[0][0] < now.steady - WINDOW_S:
            self._delays.popleft()

    def to_steady(self, stamp: Time, now: Now) -> float:
        """Convert a stamp of the node to this computer's steady clock; a stamp of zero gives
        ``now``."""
        if not (stamp.sec or stamp.nanosec) or not self._delays:
            return now.steady
        return to_seconds(stamp) + self._delays[0][1]

    def age(self, stamp: Time, now: Now) -> float:
        """Return the age of a message in s. The age is not negative if ``receive`` was called with
        the stamp when the message arrived."""
        return now.steady - self.to_steady(stamp, now)

    def skew(self, now: Now) -> float:
        """Return this computer's ROS time minus the ROS time of the node, s; 0 if unknown. The
        difference includes the minimum delay."""
        if not self._delays:
            return 0.0
        return self._delays[0][1] - (now.steady - 1e-9 * now.ros)


def skewed_clock(clocks: Mapping[str, PeerClock], now: Now) -> tuple[str, float] | None:
    """Return the name and the skew in s of the first clock whose skew exceeds ``SKEW_LIMIT_S``, or
    None."""
    for name, clock in clocks.items():
        skew = clock.skew(now)
        if abs(skew) > SKEW_LIMIT_S:
            return name, skew
    return None
