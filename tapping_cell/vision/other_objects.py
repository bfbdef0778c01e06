"""Further objects on the table: looked at in turn, or in every frame while one is being moved."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from tapping_cell.vision.markers.detection import MarkerError, ObjectMarker
from tapping_cell.vision.outline.shape import ObjectOutline

PERIOD = 0.2
"""Time (s) between two looks at one object; it lies still, and the moved one needs the time."""


def marker_ids(seen: Sequence[ObjectMarker | ObjectOutline]) -> frozenset[int]:
    """The ids of these objects' markers.

    Raises MarkerError where two of them carry the same marker.
    """
    markers = [one for one in seen if isinstance(one, ObjectMarker)]
    for number, marker in enumerate(markers):
        for other in markers[:number]:
            if (marker.dictionary, marker.id) == (other.dictionary, other.id):
                raise MarkerError(
                    f"two objects have marker {marker.id} of {marker.dictionary}; give each an id "
                    "of its own"
                )
    return frozenset(marker.id for marker in markers)


class Turns:
    """Which of several objects that lie still are looked at in a frame: one in its turn."""

    def __init__(self, count: int) -> None:
        self._looked = [-math.inf] * count

    def due(self, stamp: float, always: Collection[int] = ()) -> list[int]:
        """Numbers of the objects to look at in the frame of this time (s): ``always`` those, and
        the one that was looked at longest ago, if that is long enough ago."""
        chosen = set(always)
        if self._looked:
            number = min(range(len(self._looked)), key=lambda each: self._looked[each])
            # A stamp that goes back is the tracker's to judge: it says so.
            if not 0.0 <= stamp - self._looked[number] < PERIOD:
                chosen.add(number)
        for number in chosen:
            self._looked[number] = stamp
        return sorted(chosen)
