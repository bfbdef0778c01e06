"""Sub-pixel edges of square markers whose place is known to a few pixels.

Every pixel row (or column, whichever crosses the edge more steeply) that meets a side of the black
square gives one crossing: between the levels of black and white beside the edge, the grey values
sum to the area that is black, and so to the place of the edge. Nothing is interpolated, so nothing
is biased by where the edge lies between pixels, and any symmetric blur cancels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image

BINS = 8
"""Points that a side is condensed to: enough for the slight curve that a lens gives a straight
side."""

_LEAST_CONTRAST = 12.0
"""Grey levels between black and white below which a side is not trusted (six times usual noise)."""
_SOFT = 0.015
"""Change at the ends of a window, per pixel and contrast, from which the levels beside the edge are
not clean: the answer is then drawn towards the middle of the window, and the look repeated until
they meet."""
_MOST_LOOKS = 8
_LEAST_SHARE = 0.7
"""Share of a side's rows that must agree with a straight line."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerEdges:
    """Sides of M markers: side k runs from corner k to corner k + 1.

    ``points`` (M, 4, BINS, 2) in pixels, ``weights`` (M, 4, BINS) rows behind each, ``corners`` (M,
    4, 2) where the sides meet, in pixels, ``spread`` (M,) what one row adds to the standard
    deviation across the side, in pixels (divide by the root of the rows), ``black`` and ``white``
    (M,) grey levels, ``good`` (M,) all four sides are whole.
    """

    points: Array
    weights: Array
    corners: Array
    spread: Array
    black: Array
    white: Array
    good: NDArray[np.bool_]


def refine(image: Image, quads: Array, modules: int | NDArray[np.intp]) -> MarkerEdges:
    """Edges of markers near ``quads`` (M, 4, 2), corners in pixels good to about 3 pixels.

    ``modules`` (one for all, or (M,)) counts the black square's modules along a side: the search
    stays within one of them.
    """
    side = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).mean(axis=1)
    widths = np.clip(0.65 * side / modules, 2, 4).astype(int)
    if widths.min() == widths.max():
        return _refine(image, quads, int(widths[0]))
    kinds = np.unique(widths)
    order = np.concatenate([np.flatnonzero(widths == kind) for kind in kinds])
    whole = no_edges()
    for kind in kinds:
        part = _refine(image, quads[widths == kind], int(kind))
        whole = part if not len(whole.good) else join(whole, part)
    return take(whole, np.argsort(order))


def _refine(image: Image, quads: Array, half_width: int) -> MarkerEdges:
    """Looks at the edges with windows of one width until the windows lie on them."""
    found, soft = _edges(image, quads, half_width)
    for _ in range(_MOST_LOOKS):
        shift = np.abs(found.corners - quads).max(axis=(1, 2))
        redo = found.good & (shift > np.where(soft > _SOFT, 0.04, 0.6)) & (shift < 8.0)
        if not redo.any():
            break
        quads = np.where(redo[:, None, None], found.corners, quads)
        found, soft = _edges(image, quads, half_width)
    return found


def _edges(image: Image, quads: Array, half_width: int) -> tuple[MarkerEdges, Array]:
    """One look; and how much of the contrast (M,) still changes at the ends of the windows."""
    count = quads.shape[0]
    start = quads.reshape(-1, 2)
    end = np.roll(quads, -1, axis=1).reshape(-1, 2)
    middle = np.repeat(quads.mean(axis=1), 4, axis=0)
    steep = np.abs(end[:, 1] - start[:, 1]) > np.abs(end[:, 0] - start[:, 0])
    along = steep.astype(int)  # coordinate that counts the rows: y of a steep side, else x
    each = np.arange(start.shape[0])
    p0, q0 = start[each, along], start[each, 1 - along]
    p1, q1 = end[each, along], end[each, 1 - along]
    slope = (q1 - q0) / np.where(p1 == p0, 1.0, p1 - p0)
    trim = 0.5 * half_width + 2.5
    low, high = np.minimum(p0, p1) + trim, np.maximum(p0, p1) - trim
    rows = max(2, int(np.ceil((high - low).max())) + 1)
    p = np.ceil(low)[:, None] + np.arange(rows)
    inside = p <= high[:, None]
    centre = np.rint(q0[:, None] + slope[:, None] * (p - p0[:, None]))
    window = np.arange(-half_width, half_width + 1)
    outward = np.sign(0.5 * (q0 + q1) - middle[each, 1 - along]).astype(np.intp)
    height, width = image.shape
    limit_p = np.where(steep, height, width)[:, None]
    limit_q = np.where(steep, width, height)[:, None]
    inside &= (p >= 0) & (p < limit_p)
    inside &= (centre >= half_width) & (centre < limit_q - half_width)
    step_p = np.where(steep, width, 1)[:, None]
    step_q = np.where(steep, 1, width)[:, None]
    first = np.where(inside, p * step_p + centre * step_q, half_width * (width + 1)).astype(np.intp)
    index = first[:, :, None] + (outward[:, None] * step_q * window)[:, None, :]
    grey = image.reshape(-1).take(index).astype(np.float32)
    mask = inside.astype(float)
    black, white = _levels(grey, p, mask)
    contrast = white - black
    usable = mask * (contrast > _LEAST_CONTRAST)
    total = len(window) * white - grey.sum(axis=2, dtype=float)
    share = total / np.where(contrast == 0, 1.0, contrast)
    q = centre + outward[:, None] * (share - half_width - 0.5)
    usable *= np.abs(share - half_width - 0.5) < half_width - 0.5
    offset, slope, residual = _line(p, q, usable)
    half = p.shape[1] // 2
    scale = np.partition(np.abs(residual) * usable, half, axis=1)[:, half] * 1.5
    kept = usable * (np.abs(residual) < np.maximum(0.3, 4.0 * scale)[:, None])
    offset, slope, residual = _line(p, q, kept)
    steepness = np.sqrt(1.0 + slope**2)
    number = kept.sum(axis=1)
    squares = (kept * residual**2).sum(axis=1) / np.maximum(number - 2.0, 1.0)
    good = (number >= _LEAST_SHARE * np.maximum(mask.sum(axis=1), 4.0)) & (
        number >= _LEAST_SHARE * (high - low)
    )
    points, weights = _condense(p, q, kept, low, high, steep)
    # q = offset + slope p, written as normal . (x, y) = value
    normal = np.where(
        steep[:, None],
        np.stack([np.ones_like(slope), -slope], 1),
        np.stack([-slope, np.ones_like(slope)], 1),
    )
    corners = _meet(normal.reshape(count, 4, 2), offset.reshape(count, 4))
    squares *= _level_noise(2 * half_width + 1)
    spread = np.sqrt((squares / steepness**2).reshape(count, 4).mean(axis=1))
    total = np.maximum(mask.sum(axis=1), 1.0)
    edges = MarkerEdges(
        points=points.reshape(count, 4, BINS, 2),
        weights=weights.reshape(count, 4, BINS),
        corners=corners,
        spread=spread,
        black=((black * mask).sum(axis=1) / total).reshape(count, 4).mean(axis=1),
        white=((white * mask).sum(axis=1) / total).reshape(count, 4).mean(axis=1),
        good=good.reshape(count, 4).all(axis=1)
        & (spread < 0.6)
        & np.isfinite(corners).all(axis=(1, 2)),
    )
    ends = 0.5 * (grey[..., 1] - grey[..., 0] + grey[..., -1] - grey[..., -2])
    change = (ends * usable).sum(axis=1) / np.maximum((contrast * usable).sum(axis=1), 1e-9)
    return edges, change.reshape(count, 4).max(axis=1)


def _levels(grey: NDArray[np.float32], p: Array, mask: Array) -> tuple[Array, Array]:
    """Black and white beside every row: straight lines along the side through the outermost
    pixels."""
    sides = []
    end = _outermost(grey.shape[2])
    for columns in (grey[..., :end], grey[..., -end:]):
        level = columns[..., 0].astype(float)
        if end == 2:
            level = 0.5 * (level + columns[..., 1])
        offset, slope, _ = _line(p, level, mask)
        sides.append(offset[:, None] + slope[:, None] * p)
    return sides[0], sides[1]


def _outermost(window: int) -> int:
    """How many pixels at either end of a window give the levels: of a narrow one the second already
    belongs to the edge."""
    return 1 if window <= 5 else 2


def _level_noise(window: int) -> float:
    """Factor on the variance of a side's line, because the levels come from the same rows.

    An edge is the sum of the pixels of a window over the contrast: the pixels count -1 each, and
    the outermost, as the mean of the levels, half the window besides.
    """
    end = _outermost(window)
    outer = 0.5 * window / end - 1.0
    return (window - 2 * end + 2 * end * outer**2) / window


def _line(p: Array, q: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Least squares q = offset + slope p, a line for every first index; and the residuals."""
    total = np.maximum(weight.sum(axis=1), 1e-9)
    mean_p = (weight * p).sum(axis=1) / total
    mean_q = (weight * q).sum(axis=1) / total
    dp, dq = p - mean_p[:, None], q - mean_q[:, None]
    slope = (weight * dp * dq).sum(axis=1) / np.maximum((weight * dp * dp).sum(axis=1), 1e-9)
    return mean_q - slope * mean_p, slope, dq - slope[:, None] * dp


def _condense(
    p: Array, q: Array, weight: Array, low: Array, high: Array, steep: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Means of BINS stretches of every side, in (x, y), and how many rows are behind each."""
    sides = p.shape[0]
    share = (p - low[:, None]) / np.maximum(high - low, 1.0)[:, None]
    which = np.clip((share * BINS).astype(int), 0, BINS - 1) + BINS * np.arange(sides)[:, None]
    flat, size = which.ravel(), sides * BINS
    number = np.bincount(flat, weight.ravel(), size)
    divisor = np.maximum(number, 1.0)
    mean_p = (np.bincount(flat, (weight * p).ravel(), size) / divisor).reshape(sides, BINS)
    mean_q = (np.bincount(flat, (weight * q).ravel(), size) / divisor).reshape(sides, BINS)
    upright = steep[:, None]
    points = np.stack([np.where(upright, mean_q, mean_p), np.where(upright, mean_p, mean_q)], -1)
    return points, np.asarray(number, dtype=float).reshape(sides, BINS)


def _meet(normal: Array, value: Array) -> Array:
    """Corners (M, 4, 2): corner k is where side k - 1 and side k meet."""
    n0, n1 = np.roll(normal, 1, axis=1), normal
    v0, v1 = np.roll(value, 1, axis=1), value
    determinant = n0[..., 0] * n1[..., 1] - n0[..., 1] * n1[..., 0]
    determinant = np.where(np.abs(determinant) < 1e-9, np.nan, determinant)
    x = (v0 * n1[..., 1] - v1 * n0[..., 1]) / determinant
    y = (n0[..., 0] * v1 - n1[..., 0] * v0) / determinant
    return np.stack([x, y], axis=-1)


def straight_corners(points: Array, weights: Array) -> Array:
    """Corners (M, 4, 2) from points (M, 4, BINS, 2) of straight sides, e.g. in undistorted rays."""
    total = np.maximum(weights.sum(axis=2), 1e-9)[..., None]
    mean = (weights[..., None] * points).sum(axis=2) / total
    d = points - mean[:, :, None]
    sxx = (weights * d[..., 0] ** 2).sum(axis=2)
    syy = (weights * d[..., 1] ** 2).sum(axis=2)
    sxy = (weights * d[..., 0] * d[..., 1]).sum(axis=2)
    angle = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    return _meet(normal, (normal * mean).sum(axis=-1))


def take(edges: MarkerEdges, rows: NDArray[np.intp]) -> MarkerEdges:
    """Only these markers, in this order."""
    return MarkerEdges(
        edges.points[rows],
        edges.weights[rows],
        edges.corners[rows],
        edges.spread[rows],
        edges.black[rows],
        edges.white[rows],
        edges.good[rows],
    )


def join(first: MarkerEdges, second: MarkerEdges) -> MarkerEdges:
    """The markers of both."""
    return MarkerEdges(
        np.concatenate([first.points, second.points]),
        np.concatenate([first.weights, second.weights]),
        np.concatenate([first.corners, second.corners]),
        np.concatenate([first.spread, second.spread]),
        np.concatenate([first.black, second.black]),
        np.concatenate([first.white, second.white]),
        np.concatenate([first.good, second.good]),
    )


def no_edges() -> MarkerEdges:
    """No markers."""
    none = np.zeros(0)
    return MarkerEdges(
        np.zeros((0, 4, 1, 2)),
        np.zeros((0, 4, 1)),
        np.zeros((0, 4, 2)),
        none,
        none,
        none,
        none.astype(bool),
    )
