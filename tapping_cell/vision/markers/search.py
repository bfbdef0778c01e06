"""Find the known markers in a frame and verify their patterns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.markers.detection import Detection, Effort, find_markers
from tapping_cell.vision.markers.edges import MarkerEdges

_BITS_WRONG = 0.04
"""Maximum fraction of wrong modules in a pattern (dirt, glare): 4 of the 100 of an AprilTag
36h11."""


@dataclass(frozen=True, slots=True)
class Detections:
    """Result of a search of the whole image. ``single`` holds the corners (4, 2) of every marker
    detected once, by id. ``repeated`` are the ids detected at several places."""

    single: dict[int, Array]
    repeated: tuple[int, ...]

    def and_more(self, other: Detections) -> Detections:
        """Merge these detections with those of another search of the same image."""
        repeated = {*self.repeated, *other.repeated}
        repeated |= {
            i
            for i in self.single.keys() & other.single.keys()
            if _apart(self.single[i], other.single[i])
        }
        both = other.single | self.single
        return Detections({i: both[i] for i in both.keys() - repeated}, tuple(sorted(repeated)))


def detect(image: Image, dictionary: str, effort: Effort = Effort.QUICK) -> Detections:
    """Detect every marker of a dictionary in the image. Several detections of the same id at one
    place, such as nested squares, count as one."""
    by_id: dict[int, list[Detection]] = {}
    for found in find_markers(image, dictionary, effort=effort):
        others = by_id.setdefault(found.id, [])
        if all(_apart(found.corners, other.corners) for other in others):
            others.append(found)
    return Detections(
        {i: found[0].corners for i, found in by_id.items() if len(found) == 1},
        tuple(sorted(i for i, found in by_id.items() if len(found) > 1)),
    )


def efforts(first: bool, slow: bool) -> tuple[Effort, ...]:
    """Return the detection levels at which to search a frame, in order, until everything is found.

    The first frame may be the only one, so it is searched at all levels. Any other frame is
    searched once, at the level THOROUGH if ``slow``, otherwise at the level QUICK.
    """
    if first:
        return tuple(Effort)
    return (Effort.THOROUGH,) if slow else (Effort.QUICK,)


def _apart(first: Array, second: Array) -> bool:
    side = float(np.linalg.norm(first[1] - first[0]))
    gap = np.linalg.norm(first.mean(axis=0) - second.mean(axis=0))
    return float(gap) > 0.5 * side


def near(image: Image, dictionary: str, marker_id: int, quad: Array) -> Array | None:
    """Search for a marker around a quad (4, 2), at distances of up to the quad's diagonal. Return
    the corners of the marker, or None if it is not found exactly once."""
    reach = 1.0 * float(np.linalg.norm(quad[2] - quad[0]))
    low = np.floor(quad.min(axis=0) - reach).astype(int)
    high = np.ceil(quad.max(axis=0) + reach).astype(int)
    region = (int(low[0]), int(low[1]), int(high[0]), int(high[1]))
    found = [d for d in find_markers(image, dictionary, region) if d.id == marker_id]
    if not found or any(_apart(found[0].corners, other.corners) for other in found[1:]):
        return None
    return found[0].corners


def patterns_agree(
    image: Image, edges: MarkerEdges, patterns: list[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """Return for each marker whether the modules between its corners agree with its pattern."""
    agree = np.zeros(len(patterns), dtype=bool)
    height, width = image.shape
    corners = edges.corners
    with np.errstate(invalid="ignore"):
        inside = (corners >= 0).all(axis=(1, 2))
        inside &= (corners < [width - 1, height - 1]).all(axis=(1, 2))
    whole = np.flatnonzero(edges.good & inside)
    sizes = np.array([len(pattern) for pattern in patterns], dtype=np.intp)
    for modules in np.unique(sizes[whole]):
        rows = whole[sizes[whole] == modules]
        index = np.rint(_within(corners[rows], *_centres(int(modules)))).astype(np.intp)
        grey = image[index[..., 1], index[..., 0]]
        middle = 0.5 * (edges.black[rows] + edges.white[rows])
        wrong = (grey > middle[:, None]) != np.stack([patterns[row].ravel() for row in rows])
        agree[rows] = wrong.mean(axis=1) <= _BITS_WRONG
    return agree


@lru_cache(maxsize=8)
def _centres(modules: int) -> tuple[Array, Array]:
    """Return the positions of the modules' centres to the right (N,) and down (N,), row by row, as
    fractions of the side of the marker."""
    centres = (np.arange(modules) + 0.5) / modules
    u, v = np.meshgrid(centres, centres)
    return u.ravel(), v.ravel()


def _within(corners: Array, u: Array, v: Array) -> Array:
    """Points (M, N, 2) at the relative positions u (right) and v (down), (N,), in squares whose
    perspective images have the corners ``corners`` (M, 4, 2).

    The mapping from a square to a quadrilateral is that of Heckbert 1989, "Fundamentals of texture
    mapping".
    """
    # Row 0 of the pattern lies between corners 0 and 1.
    p0, p1, p2, p3 = corners.transpose(1, 0, 2)
    total = p0 - p1 + p2 - p3
    d1, d2 = p1 - p2, p3 - p2
    determinant = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    g = ((total[:, 0] * d2[:, 1] - total[:, 1] * d2[:, 0]) / determinant)[:, None]
    h = ((d1[:, 0] * total[:, 1] - d1[:, 1] * total[:, 0]) / determinant)[:, None]
    along = p1 - p0 + g * p1
    down = p3 - p0 + h * p3
    scale = g * u + h * v + 1.0
    points = along[:, None] * u[:, None] + down[:, None] * v[:, None] + p0[:, None]
    return np.asarray(points / scale[..., None], dtype=float)
