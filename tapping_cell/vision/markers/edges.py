"""Sub-pixel edges of square markers whose position is known to a few pixels.

The position of a side of the black square is measured in every pixel row that crosses it, or in
every pixel column if columns cross the side more steeply. The sum of the grey values, relative to
the black and white levels beside the edge, gives the black area and thus the position of the edge.
Because nothing is interpolated, the result has no bias that depends on the position of the edge
within a pixel, and the effect of any symmetric blur cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image

BINS = 8
"""Number of points per side, enough for the slight curve due to lens distortion."""

_MIN_CONTRAST = 12.0
"""Minimum difference of the white and black grey levels at a side (six times the usual noise)."""
_SOFT = 0.02
"""Maximum slope of the grey level at the ends of the window across an edge, per pixel and relative
to the contrast. Above this slope, the blur of the edge reaches the ends, and the levels measured
there are wrong. The result is then biased towards the middle of the window, so the measurement is
repeated until the window is centred on the result."""
_USUAL = 0.68
"""Half width of a window in modules, at most 4 pixels. The ends of a narrower window would lie in
the blur of the edge. The ends of a wider window would, on small markers, lie in the blur of the
modules behind the black border."""
_WIDE, _WIDEST = 0.75, 8
"""Half width of the window for blurred edges (motion, defocus): ``_WIDE`` modules, but at most
``_WIDEST`` pixels. A wider window would reach the modules next to the black border."""
_OBLIQUE = 0.8
"""Ratio of the distance between opposite sides to the mean length of the sides. Below this ratio
(an oblique view), the distance instead of the length determines the width of the window."""
_ROWS_ALIKE = 3
"""Maximum lag, in rows, at which the correlation of the errors is estimated."""
_MAX_OBSERVATIONS = 8
_MAX_PULL = 0.9
_MIN_SHARE = 0.7
"""Minimum fraction of a side's rows that must agree with a straight line."""


class MarkerEdges(NamedTuple):
    """Sides of M markers: side k runs from corner k to corner k + 1.

    ``points`` (M, 4, BINS, 2) are in pixels, ``weights`` (M, 4, BINS) are the numbers of rows that
    they average, and ``corners`` (M, 4, 2) are the intersections of the sides, in pixels.
    ``spread`` (M,) is the standard deviation of the edge position measured in one row,
    perpendicular to the side, in pixels. For the whole side, divide this value by the square root
    of the number of rows. ``black`` and ``white`` (M,) are grey levels. ``good`` (M,) marks markers
    with four complete sides whose blur is not excessive.

    ``pull`` (M,) states, for the worst side of each marker, how far the measured side moves if its
    window moves by one pixel. It is 0 for an ideal edge. If it is 1, the measurement contains no
    information. The pull is above 0 if blur or objects reach the ends of the window, where the grey
    levels of black and white are measured.
    """

    points: Array
    weights: Array
    corners: Array
    spread: Array
    black: Array
    white: Array
    pull: Array
    good: NDArray[np.bool_]


def refine(image: Image, quads: Array, modules: int | NDArray[np.intp]) -> MarkerEdges:
    """Measure the edges of markers near ``quads`` (M, 4, 2), whose corners must be accurate to
    about 3 pixels.

    ``modules`` (one for all, or (M,)) is the number of modules along a side of the black square.
    The search range is at most one module.
    """
    side = narrowest(quads) / modules
    usual = np.clip(_USUAL * side, 2, 4).astype(int)
    found = _at_widths(image, quads, usual)
    wide = np.clip(_WIDE * side, 2, _WIDEST).astype(int)
    softest = (2 * usual - 1) * _SOFT
    redo = np.flatnonzero(found.good & (found.pull > softest) & (wide > usual))
    if not redo.size:
        return _accepted(found)
    again = _at_widths(image, found.corners[redo], wide[redo])
    better = again.good & (again.pull < found.pull[redo])
    order = np.arange(len(quads))
    order[redo[better]] = len(quads) + np.flatnonzero(better)
    return _accepted(take(join([found, again]), order))


def narrowest(quads: Array) -> Array:
    """Return the length (M,) of the sides of markers or, in an oblique view, the distance between
    opposite sides, in pixels."""
    along = quads[:, [1, 2, 3, 0]] - quads
    side = np.sqrt((along**2).sum(axis=2))
    (ax, ay), (bx, by) = (quads[:, 2] - quads[:, 0]).T, (quads[:, 3] - quads[:, 1]).T
    usual = side.mean(axis=1)
    apart = 0.5 * np.abs(ax * by - ay * bx) / np.maximum(side.max(axis=1), 1e-9)
    return np.asarray(np.where(apart < _OBLIQUE * usual, apart, usual))


def _accepted(edges: MarkerEdges) -> MarkerEdges:
    return edges._replace(good=edges.good & (edges.pull < _MAX_PULL))


def _at_widths(image: Image, quads: Array, widths: NDArray[np.intp]) -> MarkerEdges:
    """Measure edges with windows of these half widths (M,), in pixels."""
    if widths.min() == widths.max():
        return _refine(image, quads, int(widths[0]))
    order = np.argsort(widths, kind="stable")
    parts = [_refine(image, quads[widths == kind], int(kind)) for kind in np.unique(widths)]
    return take(join(parts), np.argsort(order))


def _refine(image: Image, quads: Array, half_width: int) -> MarkerEdges:
    """Measure the edges with windows of one width, until the windows are centred on the edges."""
    found = _sample_edges(image, quads, half_width)
    for _ in range(_MAX_OBSERVATIONS):
        shift = np.abs(found.corners - quads).max(axis=(1, 2))
        redo = found.good & (shift > np.where(found.soft > _SOFT, 0.04, 0.6)) & (shift < 8.0)
        if not redo.any():
            break
        quads = np.where(redo[:, None, None], found.corners, quads)
        found = _sample_edges(image, quads, half_width)
    return _edges(found)


@dataclass(frozen=True, slots=True, eq=False)
class _EdgeSamples:
    """One measurement of all 4 M sides of M markers.

    ``p`` (4 M, R) are the coordinates of the rows along a side, and ``q`` the positions at which
    the edge crosses these rows. ``kept`` (1 or 0) marks the inliers of the line q = offset + slope
    p, and ``residual`` is the distance from this line. ``black`` and ``white`` are the grey levels
    on both sides of the edge in each row, ``mask`` (1 or 0) marks the rows that exist, and
    ``corners`` (M, 4, 2) are the intersections of the lines. ``outward`` is 1 if q increases
    outwards, otherwise -1.
    """

    half_width: int
    steep: NDArray[np.bool_]
    outward: Array
    low: Array
    high: Array
    p: Array
    q: Array
    kept: Array
    slope: Array
    residual: Array
    black: Array
    white: Array
    mask: Array
    corners: Array
    soft: Array
    good: NDArray[np.bool_]


def _sample_edges(image: Image, quads: Array, half_width: int) -> _EdgeSamples:
    count = quads.shape[0]
    start = quads.reshape(-1, 2)
    end = quads[:, [1, 2, 3, 0]].reshape(-1, 2)
    step = np.abs(end - start)
    steep = step[:, 1] > step[:, 0]
    along = steep.astype(np.intp)  # coordinate along the side: y for a steep side, otherwise x
    each = np.arange(4 * count)
    p0, q0 = start[each, along], start[each, 1 - along]
    p1, q1 = end[each, along], end[each, 1 - along]
    slope = (q1 - q0) / np.where(p1 == p0, 1.0, p1 - p0)
    trim = 0.5 * half_width + 2.5
    low, high = np.minimum(p0, p1) + trim, np.maximum(p0, p1) - trim
    rows = max(2, int(np.ceil((high - low).max())) + 1)
    p = np.ceil(low)[:, None] + np.arange(rows)
    centre = np.rint(slope[:, None] * p + (q0 - slope * p0)[:, None])
    middle = quads.mean(axis=1).repeat(4, axis=0)
    outward = np.sign(0.5 * (q0 + q1) - middle[each, 1 - along])
    height, width = image.shape
    limit_p = np.where(steep, height, width)[:, None]
    limit_q = np.where(steep, width, height)[:, None] - half_width
    inside = (p <= high[:, None]) & (p >= 0) & (p < limit_p)
    inside &= (centre >= half_width) & (centre < limit_q)
    step_p = np.where(steep, width, 1)[:, None]
    step_q = np.where(steep, 1, width)
    first = np.where(inside, p * step_p + centre * step_q[:, None], half_width * (width + 1))
    window = (outward * step_q).astype(np.intp)[:, None] * np.arange(-half_width, half_width + 1)
    grey = image.reshape(-1).take(first.astype(np.intp)[:, :, None] + window[:, None, :])
    grey = grey.astype(np.float32)
    mask = inside.astype(float)
    # Grey levels are integers, so the sums are exact in single precision.
    sums = np.matmul(grey, _sums(half_width)).astype(float)
    black, white = _along(p, np.moveaxis(sums[..., 1:3], -1, 0), mask)
    contrast = white - black
    usable = mask * (contrast > _MIN_CONTRAST)
    total = (2 * half_width + 1) * white - sums[..., 0]
    share = total / np.where(contrast == 0.0, 1.0, contrast) - (half_width + 0.5)
    usable *= np.abs(share) < half_width - 0.5
    q = centre + outward[:, None] * share
    _, _, residual = _line(p, q, usable)
    off = np.abs(residual)
    half = rows // 2
    scale = np.partition(off * usable, half, axis=1)[:, half] * 1.5
    kept = usable * (off < np.maximum(0.3, 4.0 * scale)[:, None])
    offset, slope, residual = _line(p, q, kept)
    number = kept.sum(axis=1)
    good = (number >= _MIN_SHARE * np.maximum(mask.sum(axis=1), 4.0)) & (
        number >= _MIN_SHARE * (high - low)
    )
    corners = _corners(offset, slope, along)
    # Blur measure: the mean grey-level step between neighbouring pixels at the two ends of the
    # window, divided by the mean contrast. This measure is near 0 if the window contains the whole
    # edge.
    ends = np.abs(np.matmul(usable[:, None, :], sums[..., 3:])[:, 0])
    soft = ends.sum(axis=1) / np.maximum(2.0 * (contrast * usable).sum(axis=1), 1e-9)
    return _EdgeSamples(
        half_width,
        steep,
        outward,
        low,
        high,
        p,
        q,
        kept,
        slope,
        residual,
        black,
        white,
        mask,
        corners,
        soft.reshape(count, 4).max(axis=1),
        good.reshape(count, 4).all(axis=1) & np.isfinite(corners).all(axis=(1, 2)),
    )


@lru_cache(maxsize=16)
def _sums(half_width: int) -> NDArray[np.float32]:
    """Matrix (window, 5) that maps the pixels of a window to their sum, the grey levels at its
    inner and outer ends, and the slopes at these ends."""
    size = 2 * half_width + 1
    end = _outermost(size)
    matrix = np.zeros((size, 5), dtype=np.float32)
    matrix[:, 0] = 1.0
    matrix[:end, 1] = matrix[-end:, 2] = 1.0 / end
    matrix[:2, 3] = matrix[-2:, 4] = -1.0, 1.0
    return matrix


def _edges(samples: _EdgeSamples) -> MarkerEdges:
    """Convert a measurement to the edges of its markers."""
    count = len(samples.good)
    squares = (samples.kept * samples.residual**2).sum(axis=1)
    squares /= np.maximum(samples.kept.sum(axis=1) - 2.0, 1.0) * (1.0 + samples.slope**2)
    # Only the larger of the two factors is used. Their product would be wrong: _level_noise is
    # valid for independent pixels, but noise that is correlated between rows is also correlated
    # between the pixels of a window.
    squares *= max(_level_noise(2 * samples.half_width + 1), _together(samples))
    spread = np.sqrt(squares.reshape(count, 4).mean(axis=1))
    number = np.maximum(samples.mask.sum(axis=1), 1.0)
    black, white = (
        (level * samples.mask).sum(axis=1) / number for level in (samples.black, samples.white)
    )
    points, weights = _condense(
        samples.p, samples.q, samples.kept, samples.low, samples.high, samples.steep
    )
    return MarkerEdges(
        points=points.reshape(count, 4, BINS, 2),
        weights=weights.reshape(count, 4, BINS),
        corners=samples.corners,
        spread=spread,
        black=black.reshape(count, 4).mean(axis=1),
        white=white.reshape(count, 4).mean(axis=1),
        # If the levels are means of two pixels (see _outermost), the pull is 1 for a ramp over the
        # whole window: the slope of this ramp is 1 / (2 half_width - 1) per pixel.
        pull=samples.soft * (2 * samples.half_width - 1),
        good=samples.good & (spread < 0.6),
    )


def _together(samples: _EdgeSamples) -> float:
    """Factor (at least 1) by which correlated errors of nearby rows increase a line's variance.

    The errors are correlated in images that are smoothed, demosaiced or compressed, and also if
    grey levels without noise are rounded. The factor is estimated from the residuals of all sides.
    Fitting a line to n rows reduces the mean product of two residuals by 2 / n of their variance.
    The factor is corrected for this bias.
    """
    kept = samples.kept
    residual = kept * samples.residual
    number = kept.sum()
    square = float((residual**2).sum() / max(number, 1.0))
    if square == 0.0:
        return 1.0
    factor = 1.0
    for lag in range(1, min(_ROWS_ALIKE, kept.shape[1] - 1) + 1):
        pairs = float((kept[:, lag:] * kept[:, :-lag]).sum())
        product = float((residual[:, lag:] * residual[:, :-lag]).sum()) / max(pairs, 1.0)
        factor += 2.0 * (product / square + 2.0 * len(kept) / max(float(number), 1.0))
    return max(factor, 1.0)


def _along(p: Array, levels: Array, mask: Array) -> Array:
    """Fit straight lines along the sides to the levels (2, S, R). Return the value of these lines
    at every row."""
    offset, slope, _ = _line(p, levels, mask)
    return np.asarray(offset[..., None] + slope[..., None] * p)


def _outermost(window: int) -> int:
    """Number of pixels at each end of a window from which the black and white levels are
    determined. In a narrow window, the second pixel already belongs to the edge."""
    return 1 if window <= 7 else 2


def _level_noise(window: int) -> float:
    """Factor by which the variance of a side's line changes because the black and white levels are
    measured in the same rows.

    The edge position is the sum of a window's pixels divided by the contrast. Each pixel of the
    window has the weight -1 in the sum. A level is the mean of the outermost pixels at one end.
    These pixels have an additional total weight of half the window.
    """
    end = _outermost(window)
    outer = 0.5 * window / end - 1.0
    return (window - 2 * end + 2 * end * outer**2) / window


def _line(p: Array, q: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Fit q = offset + slope p by least squares along the last axis; return also the residuals."""
    weighted = weight * p
    total = np.maximum(weight.sum(axis=-1), 1e-9)
    mean_p = weighted.sum(axis=-1) / total
    mean_q = np.einsum("...i,...i->...", weight, q) / total
    squares = np.einsum("...i,...i->...", weighted, p) - total * mean_p**2
    products = np.einsum("...i,...i->...", weighted, q) - total * mean_p * mean_q
    slope = products / np.maximum(squares, 1e-6)
    offset = mean_q - slope * mean_p
    return offset, slope, q - (offset[..., None] + slope[..., None] * p)


def _condense(
    p: Array, q: Array, weight: Array, low: Array, high: Array, steep: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Divide every side into BINS sections. Return the mean position (x, y) of the edge in each
    section, and the number of its rows."""
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


def _corners(offset: Array, slope: Array, along: NDArray[np.intp]) -> Array:
    """Return the corners (M, 4, 2) at which the 4 M lines q = offset + slope p intersect. The
    coordinate p of a line is x if its ``along`` is 0, and y if it is 1."""
    each = np.arange(len(slope))
    normal = np.empty((len(slope), 2))
    normal[each, 1 - along] = 1.0
    normal[each, along] = -slope
    return _meet(normal.reshape(-1, 4, 2), offset.reshape(-1, 4))


def _meet(normal: Array, value: Array) -> Array:
    """Return the corners (M, 4, 2): corner k is the intersection of side k - 1 and side k. The
    points on a side are those whose product with ``normal`` (M, 4, 2) is ``value`` (M, 4)."""
    n0, n1 = normal[:, [3, 0, 1, 2]], normal
    v0, v1 = value[:, [3, 0, 1, 2]], value
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
    """Return the markers with the indices ``rows``, in this order."""
    return MarkerEdges._make(part[rows] for part in edges)


def join(sets: Sequence[MarkerEdges]) -> MarkerEdges:
    """Concatenate the markers of several sets."""
    return MarkerEdges._make(map(np.concatenate, zip(*sets, strict=True)))


def no_edges() -> MarkerEdges:
    """Create an empty set of markers."""
    sides, none = (0, 4, BINS), np.zeros(0)
    return MarkerEdges(
        np.zeros((*sides, 2)),
        np.zeros(sides),
        np.zeros((0, 4, 2)),
        spread=none,
        black=none,
        white=none,
        pull=none,
        good=none.astype(bool),
    )
