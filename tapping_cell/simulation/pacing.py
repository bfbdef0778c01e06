"""When the simulated camera takes its next picture, on a machine that may be too slow for it.

A real camera's pictures are evenly spaced whatever the computer does. So while the object slides
the world's time goes on by one period of the camera from picture to picture, and waits where the
machine is late: a slide is then played slower than it is, and its stamps, in the world's time, are
what they would be. A while after the slide the world's time catches up with the machine's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

STEADY_S = 0.25
"""How long after a slide the pictures stay evenly spaced: its end is still to be judged."""


@dataclass(slots=True)
class Pace:
    """``period`` of the camera in s; ``slow_motion``: slides are played so many times slower."""

    period: float
    slow_motion: float = 1.0
    _taken: float = field(default=-math.inf, init=False)
    _moved: float = field(default=-math.inf, init=False)
    _next: float = field(default=-math.inf, init=False)

    def next_picture(self, now: float, at_rest: bool) -> float | None:
        """The world's time of a picture at the machine's time ``now`` (s); None for no picture yet.

        ``at_rest``: whether the object neither moves nor is about to be hit. Never goes back.
        """
        if now < self._next:
            return None
        played, self._next = now, -math.inf
        if math.isfinite(self._taken) and (not at_rest or self._taken < self._moved + STEADY_S):
            played = max(self._taken, min(now, self._taken + self.period))
            # Half a period early at most: the caller's timer is not exact.
            self._next = now + self.period * (self.slow_motion - 0.5)
        if not at_rest:
            self._moved = played
        self._taken = played
        return played
