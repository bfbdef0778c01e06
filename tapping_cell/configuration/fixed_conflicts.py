"""Detection of errors in a cell with fixed tappers; every finding states a remedy."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from tapping_cell.configuration.assembly import make_fixed_space
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning.coverage import coverage


def fixed_conflicts(cell: Cell) -> Iterator[str]:
    """Yield every error that would make a goal in the working area fail."""
    fixed, path = cell.fixed_tappers, cell.path
    height, top = fixed.strike_height, cell.object.height
    if height >= top:
        yield (
            f"{path}: key 'fixed_tappers.strike_height' is {1e3 * height:.1f} mm, but the object "
            f"is {1e3 * top:.1f} mm high: the strikers pass over the object; reduce "
            "this value"
        )
    sections = cell.tapper_sections
    for name, tapper in sections.items():
        if height < tapper.tip_radius:
            yield (
                f"{path}: key 'fixed_tappers.strike_height' is {1e3 * height:.1f} mm, below the "
                f"tip radius of '{name}' ({1e3 * tapper.tip_radius:.1f} mm): the tip scrapes the "
                "table; increase this value"
            )
    wired: dict[tuple[str, int], str] = {}
    for entry in fixed.tappers:
        place = sections[entry.name].port, entry.channel
        if place in wired:
            yield (
                f"{path}: the tappers '{wired[place]}' and '{entry.name}' are both channel "
                f"{entry.channel} of {place[0]}; assign a different channel to each"
            )
        wired.setdefault(place, entry.name)
    space = make_fixed_space(cell)
    x, y, radius = fixed.working_area
    needed = space.object_radius
    for entry in fixed.tappers:
        distance = math.hypot(entry.position[0] - x, entry.position[1] - y)
        limit = radius + needed + sections[entry.name].tip_radius
        if distance < limit:
            yield (
                f"{path}: the tip of '{entry.name}' at rest is {1e3 * distance:.1f} mm from the "
                f"middle of the working area; an object at the edge of the area would touch the "
                f"tip; increase the distance to at least {1e3 * limit:.1f} mm"
            )
    if radius + needed > float(space.workspace.edge_distance(np.array([x, y]))):
        yield (
            f"{path}: an object at the edge of 'fixed_tappers.working_area' would hang over the "
            "table's edge; make the area smaller or move it"
        )
    cover = coverage(space)
    if np.any(cover.dead):
        share = 100.0 * float(np.mean(cover.dead))
        place = 1e3 * cover.points[int(np.argmax(cover.dead))]
        yield (
            f"{path}: from {share:.1f} % of the working area no tap moves the object inward (for "
            f"example from ({place[0]:.0f} mm, {place[1]:.0f} mm)); add tappers, place "
            "their lines closer to the middle, lengthen their strokes, or make "
            "fixed_tappers.working_area smaller; check-config --drawing FILE draws these places"
        )
