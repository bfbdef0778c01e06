"""Schedule the measurements: the tapped object in every frame, the other objects in turn."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

from tapping_cell.vision.markers.detection import MarkerError, ObjectMarker
from tapping_cell.vision.outline.shape import ObjectOutline

PERIOD = 0.2
"""Time (s) between measurements of a stationary object, so that computing time is left for the
moving object."""


def marker_ids(seen: Sequence[ObjectMarker | ObjectOutline]) -> frozenset[int]:
    """Return the ids of these objects' markers.

    Raises MarkerError if two objects have the same marker.
    """
    markers = [(one.dictionary, one.id) for one in seen if isinstance(one, ObjectMarker)]
    for count, (dictionary, number) in enumerate(markers):
        if (dictionary, number) in markers[:count]:
            raise MarkerError(
                f"two objects have marker {number} of {dictionary}; give each an id of its own"
            )
    return frozenset(number for _, number in markers)


class RoundRobin:
    """Selects which of several objects to measure in a frame."""

    def __init__(self, count: int) -> None:
        self._measured_at = [-math.inf] * count

    def due(self, stamp: float, always: Collection[int] = ()) -> list[int]:
        """Return the indices of the objects to measure in the frame with this stamp (s).

        These are the objects in ``always`` and, if :data:`PERIOD` has passed, the object whose last
        measurement is the oldest.
        """
        chosen = set(always)
        if self._measured_at:
            number = min(range(len(self._measured_at)), key=lambda each: self._measured_at[each])
            # Also measure if the stamp goes backwards, so that the tracker reports the reason.
            if not 0.0 <= stamp - self._measured_at[number] < PERIOD:
                chosen.add(number)
        for number in chosen:
            self._measured_at[number] = stamp
        return sorted(chosen)
