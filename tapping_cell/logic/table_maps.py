"""Which taps are possible where, with what stands on the table at present."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import FreeSpace, KeepOut, StrikeSpace, cautious


@dataclass(frozen=True, slots=True, eq=False)
class TableMap:
    """The possible taps among some obstacles: for goals, and for single taps (experiments)."""

    space: StrikeSpace
    experiments: StrikeSpace
    free: FreeSpace


class TableMaps:
    """Makes maps of a cell's table; the last ones are kept, because each takes about a second."""

    KEPT = 4

    def __init__(self, cell: Cell) -> None:
        self._space = assembly.make_strike_space(cell)
        self._experiments = assembly.make_strike_space(cell, cautious(self._space))
        self._made: dict[tuple[KeepOut, ...], TableMap] = {}

    def among(self, obstacles: Sequence[KeepOut]) -> TableMap:
        """The map with these obstacles on the table."""
        key = tuple(obstacles)
        if key not in self._made:
            if len(self._made) >= self.KEPT:
                del self._made[next(iter(self._made))]
            space = self._space.among(obstacles)
            self._made[key] = TableMap(space, self._experiments.among(obstacles), FreeSpace(space))
        return self._made[key]
