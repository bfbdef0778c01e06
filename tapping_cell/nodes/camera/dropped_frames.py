"""Which of the pictures that wait are looked at, where they come faster than they are answered."""

from __future__ import annotations

LONGEST_WAIT_S = 0.15
"""A picture that waited longer is passed over where a newer one waits, too: a machine that was busy
for so long is caught up with at once. Shorter jams are worked off picture by picture, so that a
track has no gaps."""
SHORTEST_WAIT_S = 0.005
_SHARE = 0.2
"""Weight of the newest in the means of the times between pictures and for one."""
_FULL = 0.9
"""Share of the time between pictures, from which on the time for one leaves none to catch up."""


class Backlog:
    """Compares how fast pictures come with how fast they are answered; all times in s."""

    def __init__(self) -> None:
        self.passed_over = 0
        self._arrived: float | None = None
        self._answered: float | None = None
        self._between: float | None = None
        self._each: float | None = None

    def arrived(self, when: float) -> None:
        """A picture is taken from the queue that came at ``when``."""
        if self._arrived is not None:
            self._between = _mean(self._between, when - self._arrived)
        self._arrived = when

    def answered(self, now: float) -> None:
        """The picture taken last has been dealt with."""
        last, arrived = self._answered, self._arrived
        # Only what waited and was taken up at once says how long a picture takes.
        if last is not None and arrived is not None and arrived < last:
            self._each = _mean(self._each, now - last)
        self._answered = now

    def stale(self, now: float) -> bool:
        """Whether a newer picture is better than the one taken last, if there is one."""
        assert self._arrived is not None
        waited = now - self._arrived
        return waited > LONGEST_WAIT_S or (waited > SHORTEST_WAIT_S and self.overrun)

    @property
    def overrun(self) -> bool:
        """Whether pictures come faster than they are answered."""
        if self._each is None or self._between is None:
            return False
        return self._each > _FULL * self._between

    @property
    def sentence(self) -> str:
        """What there is to say of it."""
        if not self.overrun:
            return ""
        assert self._each is not None and self._between is not None
        return (
            f"a picture takes {1e3 * self._each:.0f} ms but they come every "
            f"{1e3 * self._between:.0f} ms: only the newest is looked at; lower the camera's rate "
            "or relieve the machine"
        )


def _mean(known: float | None, newest: float) -> float:
    return newest if known is None else known + _SHARE * (newest - known)
