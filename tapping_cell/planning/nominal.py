"""How many taps a plan without errors needs: the common yardstick for states far from the goal."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import PlannerSettings


def nominal_taps(distance: ArrayLike, rotation: ArrayLike, settings: PlannerSettings) -> Array:
    """Taps without errors from what remains: 0 in the box, 1 in the cone, 2 and more outside.

    Far from the goal the path's length rules: the distance itself, or the rotation over the cone's
    slope. A small share of both is added so that among equal counts the nearer state is smaller.
    """
    r, theta = np.asarray(distance, dtype=float), np.abs(np.asarray(rotation, dtype=float))
    k, most = settings.cone_slope, settings.largest_distance
    box = settings.stopping
    path = np.maximum(r, theta / k)
    in_box = (r <= box.distance) & (theta <= box.rotation)
    in_cone = (r >= settings.smallest_distance) & (theta <= k * r)
    taps = np.where(in_cone, 1.0, 2.0) + np.maximum(path / most - 1.0, 0.0) + 0.2 * path / most
    return np.asarray(np.where(in_box, 0.0, taps))
