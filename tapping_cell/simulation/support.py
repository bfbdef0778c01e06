"""Support of the object: the distribution of its weight over its underside.

The underside is a set of points, each with a fraction of the weight. The fractions are corrected so
that the centre of pressure lies under the centre of mass, as for a body at rest. The correction is
linear in the position, as for a rigid body on an elastic foundation, and points that would have to
pull are removed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Disk, Polygon, Ring
from tapping_cell.se2 import unit_vectors
from tapping_cell.simulation.truth import SupportTruth

Array = NDArray[np.float64]

_RINGS, _SPOKES = 8, 32
"""Numbers of rings and spokes that sample a disk. With these 256 points, the computed slide differs
from the exact one by at most 0.5 %."""
_RIM_POINTS = 180
_GRID = 20
"""Number of sample points along the longer side of a polygon."""


def sample_support(body: Disk | Ring | Polygon, truth: SupportTruth) -> tuple[Array, Array]:
    """Return support points (n, 2) in the object's frame, m, and the grip (n,) at each point.

    The grip of a point is its fraction of the weight times the ratio of its friction to the mean
    friction, which ``truth.lean`` describes. The grips add up to 1.
    """
    points: Array
    shares: Array
    if truth.pressure == "three_points":
        angles = truth.feet_turn + np.arange(3) * (2 * math.pi / 3)
        points = truth.feet_radius * np.asarray(body.boundary(angles))
        shares = np.ones(3)
    elif truth.pressure == "rim":
        points, shares = _rim(body)
    elif truth.pressure == "pads":
        points = _grid_inside(body, truth.pads)
        random = np.random.default_rng(truth.pad_seed)
        shares = np.exp(truth.pad_scatter * random.standard_normal(len(points)))
    else:
        points, shares = _face(body)
        points = points - points.mean(axis=0)
    reach = float(np.max(np.hypot(points[:, 0], points[:, 1])))
    relative = points / reach
    shares = shares * (1 + truth.edge_weight * np.sum(relative**2, axis=1))
    points, shares = balanced(points, shares, np.asarray(truth.mass_offset))
    grip = np.maximum(shares * (1 + points / reach @ np.asarray(truth.lean)), 0.0)
    return points, grip / grip.sum()


def balanced(points: Array, shares: Array, centre: Array) -> tuple[Array, Array]:
    """Return the points that carry weight, and the fraction of the weight at each, corrected so
    that the centre of pressure is at ``centre`` (m).

    Raises: ValueError: the points do not surround the centre, so that the object would tip over.
    """
    scale = float(np.max(np.hypot(points[:, 0], points[:, 1])))
    for _ in range(len(points)):
        lever = (points - centre) / scale
        basis = np.column_stack([np.ones(len(points)), lever])
        moments = basis.T @ (shares[:, None] * basis)
        if len(points) < 3 or np.linalg.cond(moments) > 1e12:
            break
        carried = shares * (basis @ np.linalg.solve(moments, [1.0, 0.0, 0.0]))
        if np.all(carried >= 0):
            return points, carried / carried.sum()
        points, shares = points[carried > 0], shares[carried > 0]
    raise ValueError(
        f"the centre of mass at {1e3 * centre[0]:.1f}, {1e3 * centre[1]:.1f} mm is not over the "
        "support: the object would tip over; move support.mass_offset towards the middle"
    )


def _face(body: Disk | Ring | Polygon) -> tuple[Array, Array]:
    """Return points and their fractions of the weight for even pressure over the whole
    underside."""
    if isinstance(body, Ring):
        return _rim(body)
    if isinstance(body, Disk):
        radius = body.radius * np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS)
        # Each ring is rotated relative to the next one, so that the points do not form straight
        # rows.
        turn = np.arange(_RINGS) * (math.pi * (3 - math.sqrt(5)))
        angles = (np.arange(_SPOKES) + 0.5) * (2 * math.pi / _SPOKES) + turn[:, None]
        points: Array = (radius[:, None, None] * unit_vectors(angles)).reshape(-1, 2)
    else:
        points = _grid_inside(body, _GRID)
    return points, np.ones(len(points))


def _rim(body: Disk | Ring | Polygon) -> tuple[Array, Array]:
    """Return points along the outline, and for each point its fraction of the weight, which is
    proportional to the length of the outline that the point represents."""
    if isinstance(body, Polygon):
        lengths = body.edge_lengths
        points, shares = [], []
        following = np.roll(body.points, -1, axis=0)
        for start, end, length in zip(body.points, following, lengths, strict=True):
            count = max(4, round(_RIM_POINTS * length / lengths.sum()))
            along = (np.arange(count) + 0.5)[:, None] / count
            points.append(start + along * (end - start))
            shares.append(np.full(count, length / count))
        return np.concatenate(points), np.concatenate(shares)
    angles = (np.arange(_RIM_POINTS) + 0.5) * (2 * math.pi / _RIM_POINTS)
    return np.asarray(body.boundary(angles)), np.ones(_RIM_POINTS)


def _grid_inside(body: Disk | Ring | Polygon, per_side: int) -> Array:
    """Return the centres of a square grid's cells that lie inside the outline."""
    outline = (
        body.points
        if isinstance(body, Polygon)
        else np.asarray(body.boundary(np.linspace(0, 2 * math.pi, 96, endpoint=False)))
    )
    low, high = outline.min(axis=0), outline.max(axis=0)
    pitch = float(np.max(high - low)) / per_side
    axes = [np.arange(a + pitch / 2, b, pitch) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    edges = np.roll(outline, -1, axis=0) - outline
    offsets = grid[:, None, :] - outline[None, :, :]
    inside = np.all(edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0, axis=1)
    return np.asarray(grid[inside])
