"""Measure markers at roughly known positions: large ones by edges, small ones by pattern."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.markers.edges import MarkerEdges, join, narrowest, refine, take
from tapping_cell.vision.markers.initial_corners import better_corners
from tapping_cell.vision.markers.search import patterns_agree
from tapping_cell.vision.markers.small_markers import as_edges, fit_pattern

_SMALL = 4.5
"""Pixels per module below which the whole pattern is fitted. Below this size, the fit is four times
as accurate as the edges, because the windows across the edges no longer end in uniform black and
white."""
_SMALL_EDGES = 2.5
"""Factor by which the noise of the edges is increased if a marker is smaller than ``_SMALL`` and
its pattern cannot be fitted."""


def measure(
    image: Image, quads: Array, patterns: list[NDArray[np.bool_]], searched: bool
) -> tuple[MarkerEdges, NDArray[np.bool_]]:
    """Measure the edges of markers near ``quads`` (M, 4, 2). Return the edges, and for each marker
    whether it was measured and its pattern verified (M,).

    ``searched`` states whether the quads come from a search. The corners of such quads may be some
    pixels off and are corrected if necessary. All other quads are predicted from the last positions
    of the markers.
    """
    modules = np.array([pattern.shape[0] for pattern in patterns])
    small = narrowest(quads) < _SMALL * modules
    fits = {
        row: _by_pattern(image, quads[row], patterns[row], searched)
        for row in np.flatnonzero(small)
    }
    fitted = {row: edges for row, edges in fits.items() if edges is not None}
    right = np.zeros(len(quads), dtype=bool)
    right[list(fitted)] = True
    parts = list(fitted.values())
    # Measure the edges of all these markers together: the large ones, and small ones whose pattern
    # fit failed.
    rest = [*np.flatnonzero(~small), *(row for row in fits if row not in fitted)]
    if rest:
        edges, right[rest] = _by_edges(
            image, quads[rest], [patterns[row] for row in rest], searched
        )
        factor = np.where(small[rest], _SMALL_EDGES, 1.0)
        parts.append(edges._replace(spread=factor * edges.spread))
    return take(join(parts), np.argsort([*fitted, *rest])), right


def _by_pattern(
    image: Image, quad: Array, pattern: NDArray[np.bool_], searched: bool
) -> MarkerEdges | None:
    starts = (better_corners(image, quad, pattern.shape[0]), quad) if searched else (quad,)
    for start in starts:
        fit = fit_pattern(image, start, pattern)
        if fit is not None:
            return as_edges(fit)
    return None


def _by_edges(
    image: Image, quads: Array, patterns: list[NDArray[np.bool_]], searched: bool
) -> tuple[MarkerEdges, NDArray[np.bool_]]:
    modules = np.array([pattern.shape[0] for pattern in patterns])
    edges = refine(image, quads, modules)
    right = patterns_agree(image, edges, patterns)
    if not searched or right.all():
        return edges, right
    order, again = np.arange(len(quads)), np.flatnonzero(~right)
    better = np.stack([better_corners(image, quads[row], int(modules[row])) for row in again])
    second = refine(image, better, modules[again])
    agree = patterns_agree(image, second, [patterns[row] for row in again])
    order[again[agree]] = len(quads) + np.flatnonzero(agree)
    right[again] = agree
    return take(join([edges, second]), order), right
