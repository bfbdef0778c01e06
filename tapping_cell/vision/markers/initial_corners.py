"""Correct detected marker corners that are too inaccurate for the measurement of edges.

A detector takes the corners from a polygon around dark pixels. In photographs, a corner may be some
pixels off if glare, a shadow or an adjacent marker touches the outline of the marker. The step from
black to white is located along lines across each side, and a straight line is fitted robustly to
the inliers (Huber 1981). The intersections of the sides are the corrected corners.
"""

from __future__ import annotations

import cv2
import numpy as np

from tapping_cell.vision.camera import Array, Image

_ACROSS = 25
"""Number of samples on each search line perpendicular to a side of the marker."""
_REACH, _FURTHEST = 0.9, 7.0
"""Search range to either side of the edge: ``_REACH`` modules, but at most ``_FURTHEST`` pixels."""
_ALONG = 24
_ROUNDS = 2


def better_corners(image: Image, quad: Array, modules: int) -> Array:
    """Corrected corners (4, 2) of the black square near ``quad`` (4, 2), in pixels.

    The corners of ``quad`` may be off by nearly one module. If no consistent edges are found,
    ``quad`` is returned unchanged.
    """
    corners = quad
    for _ in range(_ROUNDS):
        corners = _once(image, corners, modules)
    off = np.abs(corners - quad).max()
    side = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).min()
    return corners if np.isfinite(off) and off < max(3.0, 0.3 * side) else quad


def _once(image: Image, quad: Array, modules: int) -> Array:
    along = np.roll(quad, -1, axis=0) - quad
    length = np.linalg.norm(along, axis=1)
    if not length.min() > 1.0:
        return quad
    # In the image, y points down and the corners are clockwise, so the outward direction is to the
    # left of the direction along a side.
    outward = np.stack([along[:, 1], -along[:, 0]], axis=-1) / length[:, None]
    # In an oblique view, the modules are foreshortened in one direction. The search range
    # perpendicular to a side is therefore a multiple of the module's size in this direction, which
    # is computed from the distance to the opposite side.
    depth = np.abs((outward * (quad[[2, 3, 0, 1]] - quad)).sum(axis=1))
    reach = np.clip(_REACH * depth / modules, 1.5, _FURTHEST)
    share = np.asarray(np.linspace(0.1, 0.9, _ALONG), dtype=float)
    offsets = np.linspace(-2.0, 2.0, _ACROSS) * reach[:, None]
    middles = quad[:, None] + share[:, None] * along[:, None]
    places = middles[:, :, None] + offsets[:, None, :, None] * outward[:, None, None]
    flat = places.reshape(4 * _ALONG, _ACROSS, 2).astype(np.float32)
    grey = cv2.remap(
        image, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).reshape(4, _ALONG, _ACROSS)
    # The height of the step at a position is the sum of the samples just outside this position (an
    # eighth of all samples) minus the sum of the same number of samples just inside it.
    sums = np.pad(np.cumsum(grey.astype(float), axis=2), ((0, 0), (0, 0), (1, 0)))
    half, low, high = _ACROSS // 8, _ACROSS // 4, _ACROSS - _ACROSS // 4
    at = np.arange(low, high)
    steps = sums[..., at + half + 1] - sums[..., at + 1] - sums[..., at] + sums[..., at - half]
    best = low + steps.argmax(axis=2)
    ends = []
    for side in range(4):
        weight = np.maximum(steps[side].max(axis=1), 0.0)
        first, last = _robust_line(share, offsets[side][best[side]], weight)
        begin, end = quad[side], quad[side] + along[side]
        ends.append((begin + first * outward[side], end + last * outward[side]))
    return np.array([_meeting(ends[k - 1], ends[k]) for k in range(4)])


def _robust_line(share: Array, offset: Array, weight: Array) -> tuple[float, float]:
    """Fit a line robustly. Return its offsets at the beginning and at the end of the side."""
    columns = np.stack([1.0 - share, share], axis=-1)
    weights = weight / max(float(weight.max()), 1e-9)
    answer = np.full(2, np.median(offset))
    for _ in range(8):
        left = np.abs(offset - columns @ answer)
        scale = max(0.15, 1.4826 * float(np.median(left)))
        bounded = weights / (1.0 + (left / scale) ** 2) ** 2
        matrix = (columns.T * bounded) @ columns
        answer = np.linalg.solve(matrix + 1e-9 * np.eye(2), columns.T @ (bounded * offset))
    return float(answer[0]), float(answer[1])


def _meeting(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """Intersection of two lines, each given by two points."""
    (a, b), (c, d) = first, second
    u, v = b - a, d - c
    determinant = u[0] * v[1] - u[1] * v[0]
    if abs(determinant) < 1e-9:
        return np.full(2, np.nan)
    t = ((c - a)[0] * v[1] - (c - a)[1] * v[0]) / determinant
    return np.asarray(a + t * u)
