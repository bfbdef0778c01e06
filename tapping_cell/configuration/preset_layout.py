"""Preset layouts of the objects of a cell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tapping_cell.configuration.assembly import make_strike_space
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import FreeSpace
from tapping_cell.planning.arrangement import middle_of, preset_goals
from tapping_cell.se2 import Pose


def preset_layout(
    cells: Mapping[str, Cell], preset: str, poses: Mapping[str, Pose], free: FreeSpace | None = None
) -> dict[str, Pose]:
    """Return the goals of a preset for the objects at ``poses``; see ``preset_goals``.

    ``cells``: see ``cells_of``. ``free``: map of the places at which one of the objects can be
    tapped. The layout is placed at the centre of the bounding box of these places. If ``free`` is
    None, the map is computed for the first of the cells.

    Raises:
        PlanningError: unknown preset, or fewer than two objects.
    """
    if free is None:
        free = FreeSpace(make_strike_space(next(iter(cells.values()))))
    outlines = [np.asarray(cells[name].outline()) for name in poses]
    radius = max((float(np.max(np.hypot(*one.T))) for one in outlines), default=0.0)
    return preset_goals(preset, poses, radius, middle_of(free))
