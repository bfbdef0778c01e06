"""Measuring markers whose place is roughly known: large ones by edges, small ones by their whole
pattern."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.edges import MarkerEdges, join, narrowest, refine, take
from tapping_cell.vision.search import patterns_agree
from tapping_cell.vision.small import as_edges, fit_pattern
from tapping_cell.vision.start import better_corners

_SMALL = 4.5
"""Pixels a module below which the whole pattern is fitted: there it is four times as accurate as
the edges, whose windows no longer end in plain black and white."""
_SMALL_EDGES = 2.5
"""Factor on the noise of edges of such a marker, where the pattern cannot be fitted."""


def measure(
    image: Image, quads: Array, patterns: list[NDArray[np.bool_]], searched: bool
) -> tuple[MarkerEdges, NDArray[np.bool_]]:
    """Markers near ``quads`` (M, 4, 2) and for each: is it measured, and surely this pattern?

    ``searched`` quads come from a search, whose corners may lie some pixels off and are then looked
    for again; others from a marker's last place.
    """
    modules = np.array([pattern.shape[0] for pattern in patterns])
    edges = refine(image, quads, modules)
    right = patterns_agree(image, edges, patterns)
    small = narrowest(quads) < _SMALL * modules
    if right.all() and not small.any():
        return edges, right
    order = np.arange(len(quads))
    edges = replace(edges, spread=np.where(small, _SMALL_EDGES, 1.0) * edges.spread)
    for row in np.flatnonzero(small | ~right):
        again = _again(image, quads[row], patterns[row], bool(small[row]), searched)
        if again is not None:
            order[row] = len(edges.good)
            edges = join(edges, again)
            right[row] = True
    return take(edges, order), right


def _again(
    image: Image, quad: Array, pattern: NDArray[np.bool_], small: bool, searched: bool
) -> MarkerEdges | None:
    """What a closer look at one marker says."""
    modules = pattern.shape[0]
    better = better_corners(image, quad, modules) if searched else quad
    if small:
        for start in (better, quad) if searched else (quad,):
            fit = fit_pattern(image, start, pattern)
            if fit is not None:
                return as_edges(fit)
    if not searched:
        return None
    edges = refine(image, better[None], modules)
    if not patterns_agree(image, edges, [pattern])[0]:
        return None
    return replace(edges, spread=_SMALL_EDGES * edges.spread) if small else edges
