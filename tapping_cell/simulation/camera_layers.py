"""Flat printed parts of the rendered scene: pre-filtered textures that are sampled per pixel.

A layer is drawn once at several texels per pixel, with exact coverage at its edges, and is then
blurred by the camera's point spread function. A sample at the centre of a pixel is therefore the
area average of the true pattern. Sampling a sharp pattern would shift its edges.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.vision.markers.detection import marker_pattern

Array32 = NDArray[np.float32]

PAPER = 0.90
INK = 0.06
"""Reflectances of white paper and of black toner, typical of laser prints."""


@dataclass(frozen=True, slots=True, eq=False)
class Layer:
    """A texture (rows, columns, 2) around the origin, with ``texel`` as the texel size in m.

    The two channels are reflectance multiplied by coverage, and coverage.
    """

    texture: Array32
    texel: float

    @property
    def half(self) -> float:
        """Half of the texture's side length, m."""
        return 0.5 * self.texel * self.texture.shape[0]

    def sample(self, u: Array32, v: Array32) -> tuple[Array32, Array32]:
        """Return both channels at points ``u``, ``v`` (m, v upwards) of the layer: reflectance
        multiplied by coverage, and coverage."""
        scale = np.float32(1.0 / self.texel)
        middle = np.float32(0.5 * self.texture.shape[0] - 0.5)
        found = cv2.remap(
            self.texture,
            u * scale + middle,
            middle - v * scale,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(0.0, 0.0, 0.0, 0.0),
        )
        return np.asarray(found[..., 0]), np.asarray(found[..., 1])


@lru_cache(maxsize=16)
def marker_layer(dictionary: str, marker_id: int, size: float, pixel: float, blur: float) -> Layer:
    """Return the layer of a marker of side ``size`` with a white margin of one module. ``size``,
    ``pixel`` and ``blur`` (sigma) are in m."""
    pattern = np.pad(marker_pattern(dictionary, marker_id), 1, constant_values=True)
    module = size / (pattern.shape[0] - 2)
    # About eight texels per pixel. The edges of the marker's modules coincide with texel edges, so
    # the coverage is exact.
    each = int(np.clip(np.ceil(8.0 * module / pixel), 4, 96))
    texel = module / each
    sheet = np.kron(np.where(pattern, PAPER, INK), np.ones((each, each)))
    margin = int(np.ceil(4.0 * blur / texel))
    coverage = np.pad(np.ones_like(sheet), margin)
    return _blurred(np.pad(sheet, margin), coverage, texel, blur)


def outline_layer(outline: ArrayLike, reflectance: float, pixel: float, blur: float) -> Layer:
    """Return a layer with uniform reflectance inside a convex outline, points (N, 2) in m around
    the origin."""
    points = np.ascontiguousarray(outline, dtype=float)
    return _outline_layer(points.tobytes(), reflectance, pixel, blur)


@lru_cache(maxsize=8)
def _outline_layer(outline: bytes, reflectance: float, pixel: float, blur: float) -> Layer:
    points = np.frombuffer(outline).reshape(-1, 2)
    reach = float(np.max(np.abs(points))) + 4.0 * blur
    texels = int(np.clip(np.ceil(16.0 * reach / pixel), 64, 1600))
    texel = 2.0 * reach / texels
    coverage = convex_coverage(points / texel + texels / 2.0, texels, texels)[::-1]
    return _blurred(coverage * reflectance, coverage, texel, blur)


def convex_coverage(
    points: ArrayLike, rows: int, columns: int, rows_each: int = 4
) -> NDArray[np.float64]:
    """Return the fraction of each cell of a (rows, columns) grid that a convex polygon covers.

    ``points`` (N, 2) are in units of cells, with the row index along y. The coverage is exact along
    x and uses ``rows_each`` samples along y.
    """
    p = np.asarray(points, dtype=float)
    p = np.roll(p, -int(p[:, 1].argmin()), axis=0)
    turn = int(p[:, 1].argmax())
    there, back = p[: turn + 1], np.concatenate([p[:1], p[: turn - 1 if turn else None : -1]])
    y = (np.arange(rows * rows_each) + 0.5) / rows_each
    ends = [np.interp(y, chain[:, 1], chain[:, 0]) for chain in (there, back)]
    within = (y >= p[0, 1]) & (y <= p[turn, 1])
    left = np.where(within, np.minimum(*ends), 0.0)
    right = np.where(within, np.maximum(*ends), 0.0)
    # In a sample row, the polygon covers the interval from its left end to its right end. Its
    # coverage is the area left of the right end minus the area left of the left end. The area to
    # the left of an end consists of all cells before the end and a part of the cell that contains
    # the end. For both ends, 1 is subtracted in every cell, and these terms cancel. `change`
    # contains the differences of the coverage between adjacent cells, so that a cumulative sum
    # yields the coverage.
    change = np.zeros((rows, columns + 2))
    row = np.arange(rows * rows_each) // rows_each
    for end, sign in ((right, 1.0), (left, -1.0)):
        place = np.clip(end, 0.0, columns)
        cell = np.minimum(place.astype(int), columns)
        part = place - cell
        np.add.at(change, (row, cell), sign * (part - 1.0))
        np.add.at(change, (row, cell + 1), -sign * part)
    covered = np.cumsum(change[:, :columns], axis=1) / rows_each
    return np.asarray(np.clip(covered, 0.0, 1.0), dtype=float)


def _blurred(
    reflected: NDArray[np.float64], coverage: NDArray[np.float64], texel: float, blur: float
) -> Layer:
    both = np.stack([reflected, coverage], axis=-1).astype(np.float32)
    sigma = blur / texel
    return Layer(
        np.asarray(cv2.GaussianBlur(both, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)), texel
    )
