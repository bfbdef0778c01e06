"""Check whether a prescribed tap is feasible, before any node is started."""

from __future__ import annotations

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import (
    FreeSpace,
    Gains,
    PrescribedSession,
    Prescription,
    Refusal,
    cautious,
)


class TapFeasibility:
    """Clearance for taps around the middle of a cell's table."""

    def __init__(self, cell: Cell) -> None:
        space = assembly.make_strike_space(cell)
        self._limits = space.settings
        self._space = assembly.make_strike_space(cell, cautious(space))
        self._free = FreeSpace(space)
        self._view = cell.references.corners().reshape(-1, 2)

    def problem(self, striker_speed: float, incidence: float) -> str:
        """Return why a tap with this striker speed (m/s) and incidence (rad) is infeasible with the
        object in the middle of the table; empty if it is feasible."""
        limits = self._limits
        if not limits.slowest <= striker_speed <= limits.fastest:
            return (
                f"the tapper's range is {1000 * limits.slowest:.0f} to "
                f"{1000 * limits.fastest:.0f} mm/s; give a speed in this range"
            )
        tap = Prescription(striker_speed, incidence)
        decision = PrescribedSession(tap, self._space, self._free, Gains.start()).decide(
            (0.0, 0.0, 0.0), in_view=self._view
        )
        return decision.sentence if isinstance(decision, Refusal) else ""
