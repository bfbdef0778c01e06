"""Preset layouts: goals in a line, on a circle or in a grid, or objects swapped in pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.interface import Array
from tapping_cell.se2 import Pose, unit_vectors

PRESETS = ("line", "circle", "grid", "swap")

PRESET_GAP = 0.040
"""Gap between the bounding circles of neighbouring objects, m. The tool needs a gap of about this
size."""


def preset_goals(
    preset: str,
    poses: Mapping[str, Pose],
    radius: float,
    middle: tuple[float, float],
    gap: float = PRESET_GAP,
) -> dict[str, Pose]:
    """Return the goals of a preset layout for objects at ``poses``, by name.

    In a line, circle or grid about ``middle`` (x, y in m) all orientations are 0, and the objects
    are assigned to the places so that the sum of the distances is smallest. ``swap`` exchanges the
    poses of the first and second object, of the third and fourth, and so on. ``radius``: largest
    bounding radius of the objects, m; ``gap``: gap between neighbouring objects, m. Whether the
    goals can be reached is not checked here.

    Raises:
        PlanningError: unknown preset, or fewer than two objects.
    """
    if preset not in PRESETS:
        raise PlanningError(f"the preset is {preset!r}; it must be one of {', '.join(PRESETS)}")
    if len(poses) < 2:
        raise PlanningError(f"a preset needs at least two objects, not {len(poses)}")
    names = list(poses)
    if preset == "swap":
        return {
            name: poses[names[number ^ 1]]
            for number, name in enumerate(names)
            if number ^ 1 < len(names)
        }
    # Only this function needs scipy.optimize, which takes 0.1 s to import.
    from scipy.optimize import linear_sum_assignment

    places = preset_places(preset, len(names), 2.0 * radius + gap, middle)
    here = np.array([[pose.x, pose.y] for pose in poses.values()])
    distance = np.hypot(*(here[:, None, :] - places[None, :, :]).transpose(2, 0, 1))
    rows, columns = linear_sum_assignment(distance)
    return {
        names[row]: Pose(float(places[column, 0]), float(places[column, 1]), 0.0)
        for row, column in zip(rows, columns, strict=True)
    }


def preset_places(preset: str, count: int, pitch: float, middle: tuple[float, float]) -> Array:
    """Return the places (count, 2), m, of a line, circle or grid about ``middle``; neighbouring
    places are at least ``pitch`` apart."""
    number = np.arange(count)
    if preset == "circle":
        radius = 0.0 if count == 1 else 0.5 * pitch / math.sin(math.pi / count)
        angle = number * (2.0 * math.pi / count)
        offset = radius * unit_vectors(angle)
    else:
        columns = count if preset == "line" else math.ceil(math.sqrt(count))
        rows = math.ceil(count / columns)
        column, row = number % columns, number // columns
        offset = pitch * np.stack([column - (columns - 1) / 2, row - (rows - 1) / 2], axis=-1)
    return np.asarray(np.array(middle) + offset)


def middle_of(free: FreeSpace) -> tuple[float, float]:
    """Return the centre (x, y), m, of the bounding box of a free-space map's tappable cells."""
    tappable = free.centres[free.tappable]
    x, y = (tappable.min(axis=0) + tappable.max(axis=0)) / 2
    return float(x), float(y)
