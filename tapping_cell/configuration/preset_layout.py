"""Preset layouts of the objects of a cell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tapping_cell.configuration.assembly import make_strike_space
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning import FreeSpace, PlanningError
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
        PlanningError: unknown preset, fewer than two objects, or the layout does not fit on the
            table.
    """
    if free is None:
        free = FreeSpace(make_strike_space(next(iter(cells.values()))))
    outlines = [np.asarray(cells[name].outline()) for name in poses]
    radius = max((float(np.max(np.hypot(*one.T))) for one in outlines), default=0.0)
    goals = preset_goals(preset, poses, radius, middle_of(free))
    for name, goal in goals.items():
        if free.space.workspace.edge_distance(goal[:2]) < radius:
            raise PlanningError(
                f"a {preset} of {len(poses)} objects does not fit on the table: '{name}' would be "
                f"at x {1000 * goal.x:.0f} mm, y {1000 * goal.y:.0f} mm; choose another preset or "
                "fewer objects"
            )
    return goals
