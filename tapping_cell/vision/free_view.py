"""Visibility of points on the table for a camera whose view is partly occluded by bars. The bars
model the links of the arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.vision.camera import Array


def view_clearance(
    camera: ArrayLike, start: ArrayLike, end: ArrayLike, radius: ArrayLike, points: ArrayLike
) -> Array:
    """Distance (N, M), in m, of M points from the nearest shadow of N sets of bars.

    A shadow is the area that a bar hides from the camera: the bar's central projection from the
    lens to the horizontal plane through the point. The distance is negative if the point itself is
    hidden. A disk around the point is fully visible if the distance is greater than the radius of
    the disk.

    Args:
        camera: position of the lens, (3,).
        start, end: ends of the bars' centre lines, (N, K, 3).
        radius: radii of the bars, (K,).
        points: (M, 3), below the camera.
    """
    lens = np.asarray(camera, dtype=float)
    wanted = np.asarray(points, dtype=float)
    first, second = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    height = wanted[:, 2]  # (M,)
    nearest = np.full((first.shape[0], len(wanted)), np.inf)
    for index, thickness in enumerate(np.asarray(radius, dtype=float)):
        a, scale_a = _projected(lens, first[:, index], height)
        b, scale_b = _projected(lens, second[:, index], height)
        wide = thickness * np.maximum(scale_a, scale_b)
        distance = _to_segment(wanted[None, :, :2], a, b) - wide
        nearest = np.minimum(nearest, distance)
    return nearest


def shadows(
    camera: ArrayLike, start: ArrayLike, end: ArrayLike, radius: ArrayLike
) -> tuple[Array, Array, Array]:
    """Return the areas of the table that K bars hide from the camera. Each area is itself a bar in
    the plane z = 0.

    Args:
        camera: position of the lens, (3,).
        start, end: ends of the bars' centre lines, (K, 3).
        radius: radii of the bars, (K,).

    Returns:
        The starts (K, 2) and the ends (K, 2) of the areas' centre lines, and the radii (K,), in m.
    """
    lens, ground = np.asarray(camera, dtype=float), np.zeros(1)
    a, scale_a = _projected(lens, np.asarray(start, dtype=float), ground)
    b, scale_b = _projected(lens, np.asarray(end, dtype=float), ground)
    wide = np.asarray(radius, dtype=float) * np.maximum(scale_a, scale_b)[:, 0]
    return a[:, 0], b[:, 0], wide


def _projected(lens: Array, places: Array, height: Array) -> tuple[Array, Array]:
    """Project places (N, 3) from the lens to the planes at the heights (M,).

    Returns points (N, M, 2) and magnification (N, M). A place that is less than 1 mm below the
    lens, or above it, is projected as if it were 1 mm below the lens.
    """
    below = np.maximum(lens[2] - places[:, None, 2], 1e-3)
    scale = (lens[2] - height[None, :]) / below
    return lens[:2] + (places[:, None, :2] - lens[:2]) * scale[..., None], scale


def _to_segment(points: Array, start: Array, end: Array) -> Array:
    way = end - start
    length = np.sum(way * way, axis=-1)
    share = np.sum((points - start) * way, axis=-1) / np.where(length > 0, length, 1.0)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * way
    return np.asarray(np.linalg.norm(points - nearest, axis=-1))
