"""Finding the markers that the cell knows in a frame, and being sure that it is they."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.edges import MarkerEdges
from tapping_cell.vision.markers import Detection, find_markers

_BITS_WRONG = 0.04
"""Share of a pattern's modules that may read wrong (dirt, glare): 4 of an AprilTag 36h11's 100."""


@dataclass(frozen=True, slots=True)
class Census:
    """A full search, by id: markers seen once, and those seen more than once."""

    single: dict[int, Array]
    repeated: tuple[int, ...]


def census(image: Image, dictionary: str, thorough: bool = False) -> Census:
    """Every marker of a dictionary in the whole image; nested doubles of one square count once."""
    by_id: dict[int, list[Detection]] = {}
    for found in find_markers(image, dictionary, thorough=thorough):
        others = by_id.setdefault(found.id, [])
        if all(_apart(found, other) for other in others):
            others.append(found)
    return Census(
        {i: found[0].corners for i, found in by_id.items() if len(found) == 1},
        tuple(sorted(i for i, found in by_id.items() if len(found) > 1)),
    )


def _apart(first: Detection, second: Detection) -> bool:
    side = float(np.linalg.norm(first.corners[1] - first.corners[0]))
    gap = np.linalg.norm(first.corners.mean(axis=0) - second.corners.mean(axis=0))
    return float(gap) > 0.5 * side


def near(image: Image, dictionary: str, marker_id: int, quad: Array) -> Array | None:
    """Corners of a marker searched within one marker's width around a quad (4, 2); None if not
    once."""
    reach = 1.0 * float(np.linalg.norm(quad[2] - quad[0]))
    low = np.floor(quad.min(axis=0) - reach).astype(int)
    high = np.ceil(quad.max(axis=0) + reach).astype(int)
    region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    found = [d for d in find_markers(image, dictionary, region) if d.id == marker_id]
    if not found or any(_apart(found[0], other) for other in found[1:]):
        return None
    return found[0].corners


def patterns_agree(
    image: Image, edges: MarkerEdges, patterns: list[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """For each marker: do the modules between its corners read as its pattern?"""
    agree = np.zeros(len(patterns), dtype=bool)
    height, width = image.shape
    for row, pattern in enumerate(patterns):
        corners = edges.corners[row]
        if not edges.good[row]:
            continue
        inside = (corners >= 0).all() and (corners < [width - 1, height - 1]).all()
        if not inside:
            continue
        modules = pattern.shape[0]
        centres = (np.arange(modules) + 0.5) / modules
        u, v = np.meshgrid(centres, centres)
        # The four corners' perspective; row 0 of the pattern lies along corners 0 and 1.
        pixels = _within(corners, u, v)
        index = np.rint(pixels).astype(np.intp)
        grey = image[index[..., 1], index[..., 0]]
        middle = 0.5 * (edges.black[row] + edges.white[row])
        agree[row] = float(((grey > middle) != pattern).mean()) <= _BITS_WRONG
    return agree


def _within(corners: Array, u: Array, v: Array) -> Array:
    """Points at shares u (right) and v (down) of a square seen in perspective as ``corners`` (4,
    2).

    Heckbert 1989, "Fundamentals of texture mapping", square to quadrilateral.
    """
    p0, p1, p2, p3 = corners
    total = p0 - p1 + p2 - p3
    d1, d2 = p1 - p2, p3 - p2
    determinant = d1[0] * d2[1] - d1[1] * d2[0]
    g = (total[0] * d2[1] - total[1] * d2[0]) / determinant
    h = (d1[0] * total[1] - d1[1] * total[0]) / determinant
    along = p1 - p0 + g * p1
    down = p3 - p0 + h * p3
    scale = g * u + h * v + 1.0
    return np.asarray(
        (along * u[..., None] + down * v[..., None] + p0) / scale[..., None], dtype=float
    )
