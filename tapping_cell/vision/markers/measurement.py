"""Measure the edges of markers at roughly known positions, and verify their patterns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.markers.edges import MarkerEdges, join, narrowest, refine, take
from tapping_cell.vision.markers.initial_corners import better_corners
from tapping_cell.vision.markers.search import patterns_agree

_SMALL, _SMALL_EDGES = 4.5, 2.5
"""Pixels per module below which the windows across the edges no longer end in uniform black and
white, and the factor by which the noise of such edges is increased."""


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
    edges, right = _measured(image, quads, patterns, modules, searched)
    small = narrowest(quads) < _SMALL * modules
    return edges._replace(spread=np.where(small, _SMALL_EDGES, 1.0) * edges.spread), right


def _measured(
    image: Image,
    quads: Array,
    patterns: list[NDArray[np.bool_]],
    modules: NDArray[np.intp],
    searched: bool,
) -> tuple[MarkerEdges, NDArray[np.bool_]]:
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
