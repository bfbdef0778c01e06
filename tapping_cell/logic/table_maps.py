"""Maps of the possible taps among the obstacles that are on the table at present."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import FreeSpace, KeepOut, StrikeSpace, cautious


@dataclass(frozen=True, slots=True, eq=False)
class TableMap:
    """Possible taps among given obstacles: ``space`` for goals, ``experiments`` for single taps."""

    space: StrikeSpace
    experiments: StrikeSpace
    free: FreeSpace


class TableMaps:
    """Computes maps of a cell's table. The last ``KEPT`` maps are cached, because computing a map
    takes about 0.1 s per obstacle."""

    KEPT = 4

    def __init__(self, cell: Cell) -> None:
        self._space = assembly.make_strike_space(cell)
        self._experiments = assembly.make_strike_space(cell, cautious(self._space))
        self.empty = FreeSpace(self._space)
        """Map of the table without other objects."""
        self._made: dict[tuple[KeepOut, ...], TableMap] = {}

    def among(self, obstacles: Sequence[KeepOut]) -> TableMap:
        """Return the map of the table with these obstacles."""
        key = tuple(obstacles)
        if key not in self._made:
            if len(self._made) >= self.KEPT:
                del self._made[next(iter(self._made))]
            free = self.empty.among(obstacles)
            self._made[key] = TableMap(free.space, self._experiments.among(obstacles), free)
        return self._made[key]
