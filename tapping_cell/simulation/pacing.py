"""Timing of the simulated camera's images on a machine that may be too slow to render them.

A real camera takes images at equal intervals, regardless of the computer's load. While the object
slides, the time of the simulated world (world time) therefore advances by one camera period per
image, even if rendering is late. The slide is then played in slow motion, but the images' stamps,
in world time, are correct. ``STEADY_S`` after the slide, the world time catches up with the
machine's time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

STEADY_S = 0.25
"""Time after a slide, s, for which the images remain evenly spaced, because the end of the slide is
still being evaluated."""


@dataclass(slots=True)
class Pace:
    """Pace of the images. ``period``: period of the camera in s; ``slow_motion``: factor by which
    slides are slowed down."""

    period: float
    slow_motion: float = 1.0
    _taken: float = field(default=-math.inf, init=False)
    _moved: float = field(default=-math.inf, init=False)
    _next: float = field(default=-math.inf, init=False)

    def next_picture(self, now: float, at_rest: bool) -> float | None:
        """Return the world time of an image at machine time ``now`` (s), or None if none is due.

        ``at_rest``: whether the object neither moves nor is about to be hit. The returned time
        never decreases.
        """
        if now < self._next:
            return None
        played, self._next = now, -math.inf
        if math.isfinite(self._taken) and (not at_rest or self._taken < self._moved + STEADY_S):
            played = max(self._taken, min(now, self._taken + self.period))
            # The next image may be up to half a period early, because the caller's timer is not
            # exact.
            self._next = now + self.period * (self.slow_motion - 0.5)
        if not at_rest:
            self._moved = played
        self._taken = played
        return played
