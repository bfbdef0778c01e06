"""Layout of the printed sheets of a cell, to scale: targets, reference markers, object markers.

The origin of a page is its lower left corner, with x to the right and y up, in m.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.target import Target
from tapping_cell.se2 import Array
from tapping_cell.vision.markers.detection import ReferenceMap, ReferenceMarker, marker_pattern

PAPERS = {
    "a4": (0.297, 0.210),
    "a3": (0.420, 0.297),
    "a2": (0.594, 0.420),
    "a1": (0.841, 0.594),
    "a0": (1.189, 0.841),
    "letter": (0.2794, 0.2159),
    "tabloid": (0.4318, 0.2794),
}
"""Width and height in m of sheets in landscape orientation."""
_MARGIN = 0.010
"""Margin that printers cannot print on, in m."""
_FOOT = 0.014
"""Height of the line with ruler and text at the bottom, in m."""
RULER = 0.100
_QUIET = 0.125
"""Width of the white border as a fraction of a marker's side: one module of an 8-module marker."""


class SheetError(ValueError):
    """Raised for content that cannot be laid out on the paper; the message gives a remedy."""


@dataclass(frozen=True, slots=True)
class Label:
    """Text with its lower left corner at (x, y) and capitals of ``height``, all in m."""

    x: float
    y: float
    text: str
    height: float = 0.0025


@dataclass(frozen=True, slots=True)
class Page:
    """One page, in m: black ``shapes``, thin ``lines`` (x0, y0, x1, y1) and ``labels``.

    Each shape is a list of closed loops (N, 2) with the black area on their left.
    """

    width: float
    height: float
    shapes: tuple[tuple[Array, ...], ...]
    lines: tuple[tuple[float, float, float, float], ...]
    labels: tuple[Label, ...]


def paper_size(name: str) -> tuple[float, float]:
    """Return width and height in m of a paper such as ``a4``, or of ``900x600`` in mm.

    Raises:
        SheetError: the name is unknown, or a side is not between 100 and 5000 mm long.
    """
    if name.lower() in PAPERS:
        return PAPERS[name.lower()]
    found = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", name.lower())
    if not found:
        raise SheetError(
            f"paper {name!r} is unknown; use {', '.join(PAPERS)} or a size in mm such as 900x600"
        )
    width, height = float(found[1]) / 1e3, float(found[2]) / 1e3
    if not (0.1 <= width <= 5.0 and 0.1 <= height <= 5.0):
        raise SheetError(f"paper of {name} mm is outside 100 to 5000 mm per side")
    return width, height


def target_page(paper: tuple[float, float], target: Target) -> Page:
    """Lay out a ChArUco board or chessboard in the middle of a page.

    Raises:
        SheetError: the target does not fit.
    """
    width, height = target.columns * target.square, target.rows * target.square
    room = (paper[0] - 2 * _MARGIN, paper[1] - 2 * _MARGIN - _FOOT)
    if width > room[0] + 1e-9 or height > room[1] + 1e-9:
        raise SheetError(
            f"a {target.describe()} is {width * 1e3:g} x {height * 1e3:g} mm; the printable "
            f"area is {room[0] * 1e3:g} x {room[1] * 1e3:g} mm; use fewer or smaller squares"
        )
    left = 0.5 * (paper[0] - width)
    top = 0.5 * (paper[1] + _FOOT + height)
    shapes: list[tuple[Array, ...]] = []
    number = 0
    for row in range(target.rows):
        for column in range(target.columns):
            x, y = left + column * target.square, top - (row + 1) * target.square
            if (row + column) % 2 == 0:
                shapes.append((_rectangle(x, y, target.square),))
            elif target.kind == "charuco":
                inset = 0.5 * (target.square - target.marker)
                loops = marker_loops(target.dictionary, number, target.marker)
                shapes.append(tuple(loop + np.array([x + inset, y + inset]) for loop in loops))
                number += 1
    return _page(paper, shapes, [], f"target: {target.describe()}")


def reference_map(
    paper: tuple[float, float], size: float, dictionary: str, first_id: int
) -> ReferenceMap:
    """Arrange eight markers of side ``size`` (m) along the edges of a sheet with the origin in its
    middle.

    Raises:
        SheetError: the markers do not fit.
    """
    inset = _MARGIN + 0.5 * size
    x = 0.5 * paper[0] - inset
    top, bottom = 0.5 * paper[1] - inset, -0.5 * paper[1] + inset + _FOOT
    apart = size * (1 + 4 * _QUIET)
    if x < apart or top - bottom < 2 * apart:
        largest = min((paper[0] - 2 * _MARGIN), (paper[1] - 2 * _MARGIN - _FOOT)) / (3 + 8 * _QUIET)
        raise SheetError(
            f"eight markers of {size * 1e3:g} mm do not fit on {paper[0] * 1e3:g} x"
            f" {paper[1] * 1e3:g} mm; the largest that fit have {largest * 1e3 // 1:g} mm"
        )
    middle = 0.5 * (top + bottom)
    places = [(-x, top), (0.0, top), (x, top), (-x, middle), (x, middle)]
    places += [(-x, bottom), (0.0, bottom), (x, bottom)]
    return ReferenceMap(
        dictionary,
        tuple(
            ReferenceMarker(first_id + number, size, round(a, 6), round(b, 6))
            for number, (a, b) in enumerate(places)
        ),
    )


def reference_page(paper: tuple[float, float], references: ReferenceMap) -> Page:
    """Lay out the reference markers on a page, with the table's origin and axes in its middle.

    Raises:
        SheetError: the markers with their white borders do not fit.
    """
    _refuse_too_small(paper, references)
    middle = np.array(paper) / 2
    shapes, labels = [], []
    for marker in references.markers:
        centre = middle + np.array([marker.x, marker.y])
        shapes.append(_turned_marker(references.dictionary, marker, centre))
        text = f"{marker.id}  x {marker.x * 1e3:g}  y {marker.y * 1e3:g}"
        half = _half_extent(marker)
        left, clear = float(centre[0]) - half, half + _QUIET * marker.size
        labels.append(
            Label(left, float(centre[1]) + clear, text, 0.0015)
            if marker.y < 0.3 * paper[1] - 0.02
            else Label(left, float(centre[1]) - clear - 0.002, text, 0.0015)
        )
    arm = 0.02
    lines = [
        (middle[0] - 0.005, middle[1], middle[0] + arm, middle[1]),
        (middle[0], middle[1] - 0.005, middle[0], middle[1] + arm),
    ]
    labels += [
        Label(middle[0] + arm + 0.002, middle[1] - 0.001, "x"),
        Label(middle[0] - 0.001, middle[1] + arm + 0.002, "y"),
    ]
    sizes = {marker.size for marker in references.markers}
    side = ", ".join(f"{size * 1e3:g}" for size in sorted(sizes))
    text = (
        f"reference markers {references.dictionary}, side {side} mm; the cross marks the "
        "origin of the frame table; lengths in mm"
    )
    return _page(paper, shapes, lines, text, labels)


def _half_extent(marker: ReferenceMarker) -> float:
    """Return half the side of a marker's axis-aligned bounding square, in m."""
    return 0.5 * marker.size * (abs(math.cos(marker.theta)) + abs(math.sin(marker.theta)))


def _turned_marker(dictionary: str, marker: ReferenceMarker, centre: Array) -> tuple[Array, ...]:
    """Return the outlines of a marker at ``centre`` on the page, rotated by its angle."""
    cosine, sine = math.cos(marker.theta), math.sin(marker.theta)
    turn = np.array([[cosine, sine], [-sine, cosine]])
    loops = marker_loops(dictionary, marker.id, marker.size)
    return tuple((loop - 0.5 * marker.size) @ turn + centre for loop in loops)


def _refuse_too_small(paper: tuple[float, float], references: ReferenceMap) -> None:
    """Raise SheetError if a marker would extend beyond the page or into its bottom line."""
    white = max(_MARGIN, _QUIET * max(marker.size for marker in references.markers))
    across = max(abs(marker.x) + _half_extent(marker) for marker in references.markers)
    above = max(marker.y + _half_extent(marker) for marker in references.markers)
    below = max(_half_extent(marker) - marker.y for marker in references.markers)
    width, height = 2 * (across + white), 2 * (max(above, below + _FOOT) + white)
    if width > paper[0] + 1e-9 or height > paper[1] + 1e-9:
        fitting = [name for name, (w, h) in PAPERS.items() if w >= width and h >= height]
        hint = f" such as {fitting[0]}" if fitting else ""
        raise SheetError(
            f"the reference markers need a paper of {width * 1e3:.0f} x {height * 1e3:.0f} "
            f"mm, but this paper is {paper[0] * 1e3:g} x {paper[1] * 1e3:g} mm: use a larger "
            f"paper{hint}, or print the markers one by one (--what cut)"
        )


def object_page(
    paper: tuple[float, float], ids: Sequence[int], size: float, dictionary: str
) -> Page:
    """Lay out object markers in rows. Each marker, with its white border, is in a square that is to
    be cut out.

    Raises:
        SheetError: the markers do not fit, or their size is not above 0.
    """
    texts = [
        f"{dictionary} id {number}, {size * 1e3:g} mm; this edge is its bottom" for number in ids
    ]
    return _cut_page(paper, ids, size, dictionary, texts, f"object markers {dictionary}")


def cut_page(paper: tuple[float, float], references: ReferenceMap) -> Page:
    """Lay out the reference markers in rows of squares to cut out, labelled with their poses.

    Raises:
        SheetError: the markers do not fit, or differ in size.
    """
    sizes = {marker.size for marker in references.markers}
    if len(sizes) != 1:
        listed = ", ".join(f"{size * 1e3:g}" for size in sorted(sizes))
        raise SheetError(
            f"the markers have {len(sizes)} sizes ({listed} mm); all must have the same size"
        )
    texts = [
        f"{m.id}: x {m.x * 1e3:g}  y {m.y * 1e3:g} mm, {math.degrees(m.theta):g} deg"
        for m in references.markers
    ]
    (size,) = sizes
    text = f"cut out, glue the centres at x, y in the frame table; {references.dictionary}"
    ids = [marker.id for marker in references.markers]
    return _cut_page(paper, ids, size, references.dictionary, texts, text)


def _cut_page(
    paper: tuple[float, float],
    ids: Sequence[int],
    size: float,
    dictionary: str,
    texts: Sequence[str],
    what: str,
) -> Page:
    """Lay out markers in rows of squares to cut out.

    Raises:
        SheetError: the markers do not fit, or their size is not above 0.
    """
    if not size > 0.0:
        raise SheetError(f"the side of a marker is {size * 1e3:g} mm, but must be above 0 mm")
    cell = size * (1 + 2.5 * _QUIET)
    pitch = cell + 0.008
    across = int((paper[0] - 2 * _MARGIN + 0.008) / pitch)
    down = int((paper[1] - 2 * _MARGIN - _FOOT) / pitch)
    if len(ids) > across * down:
        raise SheetError(
            f"{len(ids)} markers of {size * 1e3:g} mm do not fit on the paper; "
            f"only {across * down} do: print fewer or smaller markers"
        )
    shapes, lines, labels = [], [], []
    for number, (marker_id, text) in enumerate(zip(ids, texts, strict=True)):
        x = _MARGIN + (number % across) * pitch
        y = paper[1] - _MARGIN - (number // across) * pitch - cell
        inset = 0.5 * (cell - size)
        loops = marker_loops(dictionary, marker_id, size)
        shapes.append(tuple(loop + np.array([x + inset, y + inset]) for loop in loops))
        rim = [(x, y), (x + cell, y), (x + cell, y + cell), (x, y + cell), (x, y)]
        lines += [(*start, *end) for start, end in pairwise(rim)]
        labels.append(Label(x, y - 0.0035, text, 0.0015))
    return _page(paper, shapes, lines, what, labels)


def marker_loops(dictionary: str, marker_id: int, size: float) -> tuple[Array, ...]:
    """Return the outlines of a marker's black areas: loops (N, 2) in m, with black on their left.

    The origin is the lower left corner. Adjacent black modules share one outline, because
    separately drawn modules would show seams where they touch.
    """
    black = ~marker_pattern(dictionary, marker_id)[::-1]
    module = size / black.shape[0]
    return tuple(loop * module for loop in _outlines(black))


def _outlines(black: NDArray[np.bool_]) -> list[Array]:
    """Trace the loops around True cells; cell (row, column) has its corner at x=column, y=row."""
    edges: set[tuple[tuple[int, int], tuple[int, int]]] = set()
    for row, column in np.argwhere(black).tolist():
        corners = [(column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1)]
        for start, end in zip(corners, corners[1:] + corners[:1], strict=True):
            if (end, start) in edges:
                edges.remove((end, start))
            else:
                edges.add((start, end))
    ahead: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for start, end in sorted(edges):
        ahead.setdefault(start, []).append(end)
    loops = []
    while ahead:
        loop = [next(iter(ahead))]
        while True:
            ends = ahead[loop[-1]]
            following = ends.pop()
            if not ends:
                del ahead[loop[-1]]
            if following == loop[0]:
                break
            loop.append(following)
        loops.append(np.array(loop, dtype=float))
    return loops


def _rectangle(x: float, y: float, side: float) -> Array:
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


def _page(
    paper: tuple[float, float],
    shapes: Sequence[tuple[Array, ...]],
    lines: Sequence[tuple[float, float, float, float]],
    text: str,
    labels: Sequence[Label] = (),
) -> Page:
    """Create a page with the ruler and the text in its bottom line."""
    x, y = _MARGIN, _MARGIN
    ruler = [(x, y, x + RULER, y)]
    ruler += [
        (x + k * RULER / 10, y, x + k * RULER / 10, y + (0.004 if k % 5 == 0 else 0.0025))
        for k in range(11)
    ]
    foot = Label(
        x,
        y + 0.0055,
        "ruler 100 mm: print at 100 %, measure it, and give calibrate table the measured length",
        0.0018,
    )
    what = Label(x + RULER + 0.006, y, text, 0.0018)
    return Page(paper[0], paper[1], tuple(shapes), (*lines, *ruler), (*labels, foot, what))
