"""Expected number of taps that follow a tap in any direction.

The plan (a solution of ``value_iteration``) contains only taps along the line to the goal. If the
goal is at the distance r, the residual after a tap of length s at an angle phi to that line, in the
frame of the tap, is ::

    (r cos phi - s (1 + a), -r sin phi + s c)

with the relative error a of the distance and the error c of the direction. Each of the two errors
is represented by values of equal probability, its nodes. Each pair of nodes gives a length of the
residual. The weight of this length is divided between the two neighbouring points of the plan's
grid of distances by linear interpolation. The rotation is independent of this length, as in
``value_iteration``.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import ndtri

from tapping_cell.planning.interface import Array
from tapping_cell.planning.lookup import bracket
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.value_iteration import (
    FINE_STEPS,
    MIN_DEVIATION,
    MIN_SCATTER,
    Solution,
    folded_weights,
)

ALONG_NODES, ASIDE_NODES = 48, 12
"""Numbers of nodes that represent the errors of distance and direction."""


def expected_taps(
    solution: Solution,
    settings: PlannerSettings,
    distance: float,
    rotation: float,
    aside: Array,
    sizes: Array,
    turns: Array,
) -> Array:
    """Return the expected number of taps that follow a tap, (directions, sizes, turns); infinite
    outside the cone.

    Args:
        solution: plan that is followed after the tap.
        settings: settings of that plan.
        distance, rotation: residual before the tap, m and rad.
        aside: directions of the tap relative to the direction of the goal, rad.
        sizes: lengths of the tap, m, above 0.
        turns: rotations of the tap, rad.
    """
    box, camera = settings.stopping, settings.camera
    scatter = settings.scatter.at_least(MIN_SCATTER)
    camera_noise = 2.0 * camera.position**2
    floor = MIN_DEVIATION * box.distance
    along = np.sqrt(scatter.along(sizes) ** 2 + camera_noise + floor**2)
    across = np.sqrt(scatter.across(sizes) ** 2 + camera_noise)
    ahead = distance * np.cos(aside)[:, None] - sizes
    beside = np.broadcast_to(-distance * np.sin(aside)[:, None], ahead.shape)
    lengths = np.hypot(
        (ahead[..., None] + along[:, None] * normal_nodes(ALONG_NODES))[..., :, None],
        (beside[..., None] + across[:, None] * normal_nodes(ASIDE_NODES))[..., None, :],
    ).reshape(ahead.size, -1)
    whole, inside = _radial_weights(solution.distances, lengths, box.distance)

    sense = -1.0 if rotation < 0.0 else 1.0
    deviation = np.sqrt(
        scatter.turning(turns) ** 2 + 2.0 * camera.angle**2 + (MIN_DEVIATION * box.rotation) ** 2
    )
    after, after_in = folded_weights(solution.rotations, abs(rotation) - sense * turns, deviation)
    value, near = solution.value, slice(0, FINE_STEPS + 1)
    taps = whole @ value @ after.T - inside @ value[near, near] @ after_in.T
    taps = taps.reshape(aside.size, sizes.size, turns.size)
    most = settings.cone_slope * sizes * (1.0 + 1e-9)
    return np.where(np.abs(turns) > most[:, None], np.inf, taps)


def normal_nodes(count: int) -> Array:
    """Return the conditional means of N(0, 1) over ``count`` intervals of equal probability,
    (count,)."""
    edges = ndtri(np.arange(1, count) / count)
    density = np.exp(-0.5 * edges**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(-count * np.diff(density, prepend=0.0, append=0.0))


def _radial_weights(grid: Array, lengths: Array, box: float) -> tuple[Array, Array]:
    """Return the weights, (n, grid), for linear interpolation on a grid at lengths (n, nodes),
    averaged over the nodes. Also return the part of these weights that is due to lengths inside the
    box, (n, grid points up to the edge of the box)."""
    rows, nodes = lengths.shape
    index, share = bracket(grid, lengths)
    at = np.arange(rows)[:, None] * grid.size + index

    def spread(counted: Array) -> Array:
        low = np.bincount(at.ravel(), (counted * (1.0 - share)).ravel(), rows * grid.size)
        high = np.bincount(at.ravel() + 1, (counted * share).ravel(), rows * grid.size)
        return (low + high).reshape(rows, grid.size) / nodes

    inside = spread(np.asarray(lengths <= box, dtype=float))
    return spread(np.ones_like(share)), inside[:, : FINE_STEPS + 1]
