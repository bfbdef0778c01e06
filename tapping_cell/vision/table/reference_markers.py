"""Select the reference markers to measure in a frame, and detect missed markers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.markers.detection import ReferenceMap, marker_pattern
from tapping_cell.vision.markers.edges import MarkerEdges, no_edges, take
from tapping_cell.vision.markers.measurement import measure
from tapping_cell.vision.markers.search import Detections
from tapping_cell.vision.object_follower import Aim

_MISSED = 3
"""Consecutive misses before a reference marker is reported as occluded."""

Rows = NDArray[np.intp]


class ReferenceMarkers:
    """Predicts the image positions of a map's markers and measures at most ``each`` of them in a
    frame, in turn."""

    def __init__(self, table: ReferenceMap, each: int) -> None:
        self.dictionary = table.dictionary
        self.ids = frozenset(marker.id for marker in table.markers)
        self.repeated: list[int] = []
        """Ids that the last search found more than once."""
        self._rows = {marker.id: row for row, marker in enumerate(table.markers)}
        self._patterns = [marker_pattern(table.dictionary, m.id) for m in table.markers]
        self._each = each
        self._group = 0
        self._quads: Array | None = None
        self._misses: dict[int, int] = {}

    @property
    def missed(self) -> list[int]:
        """Rows of the map whose markers were missed several times in succession."""
        return [row for row, misses in self._misses.items() if misses >= _MISSED]

    @property
    def suspect(self) -> bool:
        """True if a marker was missed, but not yet often enough to be reported as occluded."""
        return any(0 < misses < _MISSED for misses in self._misses.values())

    def place(self, quads: Array) -> None:
        """Set the image positions of all markers: (M, 4, 2), in the order of the map."""
        self._quads = quads

    def found(self, detections: Detections) -> dict[int, Array]:
        """Return the markers found by a search of the whole image: corners (4, 2) by row of the
        map."""
        quads = {self._rows[i]: q for i, q in detections.single.items() if i in self._rows}
        self.repeated = [i for i in detections.repeated if i in self._rows]
        if self._quads is not None:
            # In the next frames, the markers are measured near these image positions, even if the
            # table's pose predicts other positions.
            for row, quad in quads.items():
                self._quads[row] = quad
        return quads

    def next_group(self) -> dict[int, Array]:
        """Return the predicted corners (4, 2) of the markers to measure in this frame, by row of
        the map. Successive calls return successive groups of markers."""
        if self._quads is None:
            return {}
        count = len(self._quads)
        groups = max(1, math.ceil(count / self._each))
        self._group = (self._group + 1) % groups
        return {row: self._quads[row] for row in range(self._group, count, groups)}

    def measure(
        self,
        image: Image,
        quads: Mapping[int, Array],
        searched: bool,
        others: Sequence[Aim | None] = (),
    ) -> tuple[MarkerEdges, Rows, list[MarkerEdges | None]]:
        """Measure the markers near ``quads``, and the object markers in ``others``.

        Return the edges of the detected markers, their row indices in the marker map, and for each
        of the ``others`` its edges, or None if it was not found. ``searched`` states whether the
        quads come from a search; the corners of such quads may be some pixels off.
        """
        rows = np.array(list(quads), dtype=np.intp)
        aims = {number: aim for number, aim in enumerate(others) if aim is not None}
        corners = [*quads.values(), *(quad for quad, _ in aims.values())]
        patterns = [*(self._patterns[row] for row in quads), *(aim[1] for aim in aims.values())]
        theirs: list[MarkerEdges | None] = [None] * len(others)
        if not corners:
            return no_edges(), rows, theirs
        edges, right = measure(image, np.stack(corners), patterns, searched)
        kept = np.flatnonzero(right[: len(rows)])
        for row, number in enumerate(aims, start=len(rows)):
            if right[row]:
                theirs[number] = take(edges, np.array([row], dtype=np.intp))
        return take(edges, kept), rows[kept], theirs

    def count_missed(self, expected: Mapping[int, Array], met: Rows) -> None:
        """Count consecutive misses of each marker that was found before."""
        seen = set(met.tolist())
        self._misses |= dict.fromkeys(seen, 0)
        for row in expected.keys() - seen:
            if row in self._misses:
                self._misses[row] += 1
