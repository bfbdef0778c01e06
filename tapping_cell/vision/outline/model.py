"""Predict the pixels around an outline, and their derivatives with respect to the pose.

A pixel near the rim shows the top, the side wall below it, or the surroundings. The fractions of
these three follow from the pixel's distances to the outline of the top and to the silhouette of the
whole body, with a Gaussian blur. The pixels are arranged in rows, one for each sector of the rim,
so that the levels of all sectors are solved for in one operation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.outline.pixels import Pixels
from tapping_cell.vision.outline.shape import Dot, ObjectOutline

LEVELS = 4  # top, wall, surroundings, and the slope of the illumination across the rim
GLOBALS = 7  # x, y, theta, size, blur, motion blur, size of the dot
SIZE, BLUR, SMEAR, DOT_SIZE = 3, 4, 5, 6


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """The rim's pixels, (S, K), with one row for each sector.

    ``top`` and ``floor`` (2, S, K) are their projections to the plane of the top and to the table,
    in m. ``pixels`` are flat indices in the image. ``counts`` (S,) are the numbers of pixels in
    each sector. Shorter rows are padded with duplicates, for which ``real`` is False.
    """

    top: Array
    floor: Array
    pixels: NDArray[np.intp]
    real: NDArray[np.bool_]
    counts: NDArray[np.intp]

    @classmethod
    def of(cls, rim: Pixels, sectors: NDArray[np.intp]) -> Band:
        """Arrange the rim's pixels by the indices (N,) of their sectors."""
        order = np.argsort(sectors, kind="stable")
        counts = np.bincount(sectors)
        place = np.arange(counts.max())
        real = place < counts[:, None]
        index = order[np.minimum((np.cumsum(counts) - counts)[:, None] + place, len(order) - 1)]
        return cls(rim.top.T[:, index], rim.floor.T[:, index], rim.pixels[index], real, counts)

    def grey(self, image: Image) -> Array:
        """Grey values of these pixels in an image, (S, K)."""
        return image.reshape(-1)[self.pixels].astype(float)


@dataclass(frozen=True, slots=True)
class Shape:
    """The unknowns of the fit.

    ``pose`` is (3,) and ``blur`` a sigma in pixels. ``size`` and ``dot_size`` are relative to the
    sizes of top and dot in the object's file. ``smear`` is the variance of the motion blur divided
    by the square of ``step`` (2,), which is the motion from frame to frame in pixels. ``pixel`` is
    the size of a pixel in m at the top.
    """

    pose: Array
    blur: float
    size: float
    smear: float
    dot_size: float
    step: Array
    pixel: float


def rim_model(
    outline: ObjectOutline, shape: Shape, band: Band, levels: Array | None, width: float
) -> Array:
    """Return the derivatives (LEVELS + GLOBALS + 1, S, K) of the grey values.

    They are taken with respect to the levels of the pixel's sector, to the parameters common to all
    sectors (``GLOBALS``), and to a displacement of the rim outwards by a pixel. ``levels`` (S,
    LEVELS) are None if unknown; ``width`` is the half width of the band in pixels.
    """
    cos, sin = math.cos(shape.pose[2]), math.sin(shape.pose[2])
    x, y = _within(shape.pose, cos, sin, band.top)
    below_x, below_y = _within(shape.pose, cos, sin, band.floor)
    distance, nx, ny = outline.distance_at(x, y)
    near, near_nx, near_ny, near_x, near_y = distance, nx, ny, x, y
    for part in (0.5, 1.0):
        at_x, at_y = x + part * (below_x - x), y + part * (below_y - y)
        gap, gap_nx, gap_ny = outline.distance_at(at_x, at_y)
        nearer = gap < near
        near = np.where(nearer, gap, near)
        near_nx, near_ny = np.where(nearer, gap_nx, near_nx), np.where(nearer, gap_ny, near_ny)
        near_x, near_y = np.where(nearer, at_x, near_x), np.where(nearer, at_y, near_y)
    model = np.empty((LEVELS + GLOBALS + 1, *distance.shape))
    top, by_top = _edge(shape, cos, sin, x, y, distance, nx, ny)
    body, by_body = _edge(shape, cos, sin, near_x, near_y, near, near_nx, near_ny)
    model[0], model[1], model[2] = top, body - top, 1.0 - body
    np.clip(distance / shape.pixel, -width, width, out=model[3])
    if levels is None:
        model[LEVELS:] = 0.0
        return model
    outer = (levels[:, 0] - levels[:, 1])[:, None]
    inner = (levels[:, 1] - levels[:, 2])[:, None]
    np.multiply(by_top, outer, out=model[LEVELS:])
    by_body *= inner
    model[LEVELS:] += by_body
    return model


def dot_model(dot: Dot, shape: Shape, around: Pixels, levels: Array | None) -> Array:
    """Return the derivatives (4 + GLOBALS, N) of the grey values in and around the dot with respect
    to the levels of dot and top, to two slopes of the illumination, and to the parameters of the
    whole outline (``GLOBALS``)."""
    cos, sin = math.cos(shape.pose[2]), math.sin(shape.pose[2])
    x, y = _within(shape.pose, cos, sin, around.top.T)
    x, y = x - dot.offset[0], y - dot.offset[1]
    length = np.sqrt(x * x + y * y)
    nx, ny = x / np.maximum(length, 1e-9), y / np.maximum(length, 1e-9)
    distance = length - shape.dot_size * dot.radius
    at_x, at_y = x + dot.offset[0], y + dot.offset[1]
    alone = replace(shape, size=1.0)
    inside, columns = _edge(alone, cos, sin, at_x, at_y, distance, nx, ny)
    model = np.empty((4 + GLOBALS, len(length)))
    model[0], model[1] = inside, 1.0 - inside
    model[2], model[3] = x / dot.radius, y / dot.radius
    if levels is None:
        model[4:] = 0.0
        return model
    model[4:] = columns[:GLOBALS] * (levels[0] - levels[1])
    model[4 + SIZE] = 0.0
    # A displacement of the dot's rim outwards by the dot's radius doubles the size of the dot.
    model[4 + DOT_SIZE] = columns[-1] * ((levels[0] - levels[1]) * dot.radius / shape.pixel)
    return model


def _within(pose: Array, cos: float, sin: float, places: Array) -> tuple[Array, Array]:
    """Transform points (2, ...) of the table to the object's frame."""
    dx, dy = places[0] - pose[0], places[1] - pose[1]
    return cos * dx + sin * dy, cos * dy - sin * dx


def _edge(
    shape: Shape,
    cos: float,
    sin: float,
    x: Array,
    y: Array,
    distance: Array,
    nx: Array,
    ny: Array,
) -> tuple[Array, Array]:
    """Return the fraction of each blurred pixel that lies inside the outline scaled by
    ``shape.size``, and the derivatives of this fraction.

    The derivatives (GLOBALS + 1, ...) are taken with respect to the parameters of the whole outline
    (``GLOBALS``; 0 for the dot's size) and to a displacement of the edge outwards by a pixel.
    ``x``, ``y`` are the points, and ``distance`` their distance from the edge, with the gradient
    ``nx``, ``ny``.
    """
    pixel = shape.pixel
    table_nx, table_ny = cos * nx - sin * ny, sin * nx + cos * ny
    support = nx * x + ny * y - distance
    columns = np.empty((GLOBALS + 1, *distance.shape))
    away = (distance - (shape.size - 1.0) * support) / pixel
    along: Array | float = 0.0
    sigma: Array | float = shape.blur
    if shape.smear > 0.0 or np.any(shape.step):
        along = (table_nx * shape.step[0] + table_ny * shape.step[1]) ** 2
        sigma = np.sqrt(shape.blur**2 + shape.smear * along)
    scaled = away / sigma
    density = np.exp(-0.5 * scaled * scaled) / (math.sqrt(2.0 * math.pi) * sigma)
    per_metre = density / pixel
    columns[-1] = density
    columns[0], columns[1] = table_nx * per_metre, table_ny * per_metre
    columns[2] = (ny * x - nx * y) * per_metre
    columns[SIZE] = support * per_metre
    columns[BLUR] = 0.5 * density * away / sigma**2
    columns[SMEAR] = columns[BLUR] * along
    columns[DOT_SIZE] = 0.0
    return scipy.special.ndtr(-scaled), columns
