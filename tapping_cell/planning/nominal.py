"""Number of taps that would be needed if taps had no errors; several methods rank states by it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import PlannerSettings


def nominal_taps(distance: ArrayLike, rotation: ArrayLike, settings: PlannerSettings) -> Array:
    """Return the number of taps that would be needed if taps had no errors: 0 in the box, 1 in the
    cone, 2 or more outside the cone.

    Far from the goal the number grows with the path length. This is the larger of two lengths: the
    distance, and the rotation divided by the cone's slope. A small share of this length is added,
    so that the nearer of two states with the same number of taps has the lower value.
    """
    r, theta = np.asarray(distance, dtype=float), np.abs(np.asarray(rotation, dtype=float))
    k, most = settings.cone_slope, settings.largest_distance
    box = settings.stopping
    path = np.maximum(r, theta / k)
    in_box = (r <= box.distance) & (theta <= box.rotation)
    in_cone = (r >= settings.smallest_distance) & (theta <= k * r)
    taps = np.where(in_cone, 1.0, 2.0) + np.maximum(path / most - 1.0, 0.0) + 0.2 * path / most
    return np.asarray(np.where(in_box, 0.0, taps))
