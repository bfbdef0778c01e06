"""Striker speed as a function of the tapper's stored energy, from measured pairs.

An ideal spring or coil gives v = sqrt(2 E / m), so speed is proportional to the square root of the
energy. The curve is therefore interpolated linearly in sqrt(E), which is exact for the ideal drive.
The curve is monotonic because the pairs must be strictly increasing.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

# Energies and speeds of a lossless 100 g striker (E = m v^2 / 2) at the ends of the speed range.
IDEAL_TABLE = ((0.05 * 0.02**2, 0.02), (0.05 * 2.5**2, 2.5))


@dataclass(frozen=True, slots=True)
class EnergyCurve:
    """At least two pairs (energy in J, speed in m/s), both strictly increasing.

    Raises ValueError for an invalid table.
    """

    table: Sequence[tuple[float, float]] = IDEAL_TABLE

    def __post_init__(self) -> None:
        if len(self.table) < 2:
            raise ValueError(f"the energy table has {len(self.table)} rows; at least 2 are needed")
        before = (0.0, 0.0)
        for row, (energy, speed) in enumerate(self.table, start=1):
            if not (math.isfinite(energy) and math.isfinite(speed)):
                raise ValueError(f"row {row} of the energy table is not finite")
            if energy <= before[0] or speed <= before[1]:
                raise ValueError(
                    f"row {row} of the energy table ({energy:g} J, {speed:g} m/s) does not rise"
                    f" above ({before[0]:g} J, {before[1]:g} m/s): sort the rows by energy, and"
                    " measure again where the speed falls"
                )
            before = (energy, speed)

    @property
    def slowest(self) -> float:
        """Lowest speed of the table, m/s."""
        return self.table[0][1]

    @property
    def fastest(self) -> float:
        """Highest speed of the table, m/s."""
        return self.table[-1][1]

    def energy_for(self, speed: float) -> float:
        """Return the energy in J for a striker speed in m/s; ValueError outside the table."""
        if not self.slowest <= speed <= self.fastest:
            raise ValueError(
                f"striker speed {speed * 1e3:.1f} mm/s is outside the tapper's"
                f" {self.slowest * 1e3:.1f} to {self.fastest * 1e3:.1f} mm/s"
            )
        (e0, v0), (e1, v1) = self._around([v for _, v in self.table], speed)
        part = (speed - v0) / (v1 - v0)
        return (math.sqrt(e0) + part * (math.sqrt(e1) - math.sqrt(e0))) ** 2

    def speed_for(self, energy: float) -> float:
        """Return the striker speed in m/s for an energy in J; ValueError outside the table."""
        least, most = self.table[0][0], self.table[-1][0]
        if not least <= energy <= most:
            raise ValueError(
                f"energy {energy * 1e3:.4g} mJ is outside the tapper's {least * 1e3:.4g} to"
                f" {most * 1e3:.4g} mJ"
            )
        (e0, v0), (e1, v1) = self._around([e for e, _ in self.table], energy)
        part = (math.sqrt(energy) - math.sqrt(e0)) / (math.sqrt(e1) - math.sqrt(e0))
        return v0 + part * (v1 - v0)

    def _around(
        self, keys: Sequence[float], value: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        row = min(max(bisect_right(keys, value), 1), len(keys) - 1)
        return self.table[row - 1], self.table[row]
