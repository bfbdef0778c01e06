"""Coverage of the working area by fixed tappers: the places at which an object can be tapped
inward."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tapping_cell.planning.fixed_tappers import FixedStrikeSpace
from tapping_cell.planning.interface import Array
from tapping_cell.planning.strike import BoolArray

STEP = 0.004
"""Step of the grid over the working area, m."""

ANGLES = 12
"""Number of orientations tried for an object that is not round."""

INWARD = math.radians(80.0)
"""Largest angle between an inward tap and the direction to the middle."""

MIDDLE = 0.25
"""Points within this share of the working radius are near the middle. There, every direction counts
as inward, and no gap between neighbouring directions of taps may exceed ``WIDEST_GAP``.
"""

WIDEST_GAP = math.radians(170.0)
"""Largest allowed angle between neighbouring directions of taps near the middle, below 180
degrees."""


class Coverage(NamedTuple):
    """Coverage at points of the working area.

    points: (n, 2), m. reached: (n, tappers), whether the tapper can tap an object at the point in
    every orientation. dead: (n,), whether there is an orientation in which an object at the point
    cannot be tapped inward."""

    points: Array
    reached: BoolArray
    dead: BoolArray


def coverage(space: FixedStrikeSpace) -> Coverage:
    """Compute the coverage of the working area for the space's object."""
    area = space.area
    count = math.ceil(area.radius / STEP)
    steps = np.linspace(-area.radius, area.radius, 2 * count + 1)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= area.radius + 1e-12]
    points = grid + np.array([area.x, area.y])
    angles = np.arange(ANGLES) * (2.0 * math.pi / ANGLES)
    if space.is_round:
        angles = angles[:1]
    poses = np.concatenate(
        [
            np.broadcast_to(points[:, None, :], (len(points), angles.size, 2)),
            np.broadcast_to(angles[:, None], (len(points), angles.size, 1)),
        ],
        axis=-1,
    )
    lines = space.lines(poses)
    inward = np.arctan2(-grid[:, 1], -grid[:, 0])[:, None, None]
    off = np.abs((lines.heading - inward + math.pi) % (2.0 * math.pi) - math.pi)
    leads = np.any(lines.usable & (off <= INWARD), axis=-1)
    near = np.hypot(grid[:, 0], grid[:, 1]) <= MIDDLE * area.radius
    around = _widest_gap(lines.heading, lines.usable) <= WIDEST_GAP
    dead = ~np.all(np.where(near[:, None], around, leads), axis=-1)
    return Coverage(points, np.all(lines.usable, axis=1), dead)


def _widest_gap(heading: Array, usable: BoolArray) -> Array:
    """Return the widest angle between neighbouring usable directions, rad. Directions (...,
    tappers) give (...,)."""
    angle = np.where(usable, heading % (2.0 * math.pi), math.inf)
    ordered = np.sort(angle, axis=-1)
    some = np.isfinite(ordered)
    first = ordered[..., :1]
    following = np.concatenate([ordered[..., 1:], np.full_like(first, math.inf)], axis=-1)
    following = np.where(np.isfinite(following), following, first + 2.0 * math.pi)
    with np.errstate(invalid="ignore"):
        gap = np.where(some, following - ordered, 0.0)
    widest = np.max(gap, axis=-1)
    return np.asarray(np.where(np.any(usable, axis=-1), widest, 2.0 * math.pi))
