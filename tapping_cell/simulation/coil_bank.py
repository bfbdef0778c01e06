"""Coils at fixed mounts: the strikers of a board with several channels, and their switches.

The model follows the rules of ``firmware/tapper/strikers.c``, but advances from event to event. The
switch at a mount is closed while its striker is retracted. The caller sets the flight time of a
striker.
"""

from __future__ import annotations

from tapping_cell.simulation.spring_drive import Status

SETTLE_TIME = 0.003
"""Time for which a switch level must be constant to count (debounce), s."""
LEAVES_AFTER = 0.002
"""Time from a release until the striker has left its switch, s."""
LEAVE_LIMIT = 0.2
"""Time after a release by which the switch must be open, s."""
RETURN_LIMIT = 4.0
"""Time after a release by which the switch must be closed again, s."""


class CoilBank:
    """Strikers of ``count`` channels; ``now`` in s must not decrease between calls."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.flight = 0.3
        """Time from a release to the striker's return, s; to be set before the release."""
        self._energy = 0.0
        self._proven = False
        self._channel = 0
        self._released: float | None = None
        self._left = False
        self._returns = 0.0
        self._flying: tuple[int, float, float] | None = None
        """Channel of the last released striker, and the times at which it leaves its switch and
        returns to it. A restart of the board does not change the striker's flight, but the board no
        longer waits for the striker."""
        self._stays_out: set[int] = set()
        self._blocked: set[int] = set()
        self._stuck: set[int] = set()

    @property
    def status(self) -> Status:
        """Status of the last movement."""
        if self._released is not None:
            return Status.MOVING
        return Status.THERE if self._proven else Status.UNKNOWN

    def at_mounts(self, now: float) -> int:
        """Return the mask of channels whose switch is closed."""
        self.advance(now)
        return sum(1 << channel for channel in range(self.count) if self._closed(channel, now))

    def _closed(self, channel: int, now: float) -> bool:
        if channel in self._stuck:
            return True
        if channel in self._stays_out:
            return False
        if self._flying is None or channel != self._flying[0] or channel in self._blocked:
            return True
        _, leaves, returns = self._flying
        return not leaves + SETTLE_TIME <= now < returns + SETTLE_TIME

    # Firmware commands.

    def can_store(self, energy: float) -> bool:
        """Return whether the coils can produce this energy in J."""
        return energy >= 20e-6

    def charge(self, energy: float, now: float) -> None:
        """Set the energy of the next pulse, J."""
        self._energy = energy

    def stored(self, now: float) -> float:
        """Return the energy of the next pulse, J."""
        return self._energy

    def home(self, now: float) -> None:
        """Check that every striker is at its mount."""
        if self._released is None:
            self._proven = self.at_mounts(now) == (1 << self.count) - 1

    def back(self, now: float) -> None:
        """Do nothing: springs return the strikers."""

    def halt(self, now: float) -> None:
        """Do nothing: no motor moves, and the coils are off."""

    def released(self, channel: int, now: float) -> None:
        """Release the striker of a channel: start its pulse."""
        self._channel, self._released, self._left = channel, now, False
        self._returns = now + self.flight
        self._flying = channel, now + LEAVES_AFTER, self._returns
        self._proven = False

    # Power and faults

    def start(self) -> None:
        """Simulate power-on of the board, after which no striker position is verified."""
        self._proven, self._released = False, None

    def block(self, channel: int, blocked: bool) -> None:
        """Set whether a striker is blocked, so that it stays at its mount when released."""
        (self._blocked.add if blocked else self._blocked.discard)(channel)

    def stick(self, channel: int, stuck: bool) -> None:
        """Set whether a switch is stuck closed."""
        (self._stuck.add if stuck else self._stuck.discard)(channel)
        self._lose_open_requests()

    def _lose_open_requests(self) -> None:
        """If no striker is in flight and a switch is open, mark the strikers' positions as
        unverified."""
        if self._released is None:
            self._proven &= all(self._closed(channel, 0.0) for channel in range(self.count))

    def keep_out(self, channel: int, out: bool) -> None:
        """Set whether a striker is held away from its mount and does not return to it."""
        (self._stays_out.add if out else self._stays_out.discard)(channel)
        self._lose_open_requests()

    # Time.

    def next_event(self) -> float | None:
        """Return the time of the next event of the flight."""
        if self._released is None:
            return None
        if not self._left:
            seen = self._released + LEAVES_AFTER + SETTLE_TIME
            stays = self._channel in self._blocked or self._channel in self._stuck
            return self._released + LEAVE_LIMIT if stays else seen
        limit = self._released + RETURN_LIMIT
        return limit if self._stays_out else min(self._returns + SETTLE_TIME, limit)

    def advance(self, now: float) -> None:
        """Advance the flight until ``now``."""
        while (due := self.next_event()) is not None and due <= now:
            assert self._released is not None
            if not self._left and due < self._released + LEAVE_LIMIT:
                self._left = True
                if self._stays_out - {self._channel}:
                    self._released = None
            else:
                self._proven = self._left and due < self._released + RETURN_LIMIT
                self._released = None
