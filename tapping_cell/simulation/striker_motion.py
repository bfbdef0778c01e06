"""Motion of a simulated striker that is released with any energy."""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.hardware.energy import EnergyCurve

RETURN_SPEED = 1.0
"""Speed at which the spring returns a striker, m/s."""


@dataclass(frozen=True, slots=True)
class Flight:
    """A released striker: time of the release in s, speed in m/s, and travel in m."""

    begun: float
    speed: float
    travel: float

    def extension(self, now: float) -> float:
        """Return the extension of the tip at ``now``, m."""
        out = self.speed * (now - self.begun)
        back = self.travel - RETURN_SPEED * (now - self.begun - self.travel / self.speed)
        return max(0.0, min(out, back))

    @property
    def duration(self) -> float:
        """Time from the release to the return, s."""
        return self.travel / self.speed + self.travel / RETURN_SPEED


def striker_speed(curve: EnergyCurve, energy: float) -> float:
    """Return the speed, m/s, of a striker that is released with ``energy``, J.

    The energy may lie outside the curve's table: the carriage stops at whole motor steps, and it
    slides back if its motor loses the power. Beyond an end of the table the speed is proportional
    to the square root of the energy, as for an ideal drive.
    """
    nearest = min(max(energy, curve.table[0][0]), curve.table[-1][0])
    return curve.speed_for(nearest) * math.sqrt(max(energy, 0.0) / nearest)
