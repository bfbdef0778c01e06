"""Speed of a simulated striker that is released with any energy."""

from __future__ import annotations

import math

from tapping_cell.hardware.energy import EnergyCurve


def striker_speed(curve: EnergyCurve, energy: float) -> float:
    """Return the speed, m/s, of a striker that is released with ``energy``, J.

    The energy may lie outside the curve's table: the carriage stops at whole motor steps, and it
    slides back if its motor loses the power. Beyond an end of the table the speed is proportional
    to the square root of the energy, as for an ideal drive.
    """
    nearest = min(max(energy, curve.table[0][0]), curve.table[-1][0])
    return curve.speed_for(nearest) * math.sqrt(max(energy, 0.0) / nearest)
