"""Further objects on the table: looked at in turn, or in every frame while one is being moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tapping_cell.vision.camera import CameraModel, Image
from tapping_cell.vision.markers.detection import MarkerError, ObjectMarker, ReferenceMap
from tapping_cell.vision.observation import Observation
from tapping_cell.vision.outline.shape import ObjectOutline
from tapping_cell.vision.tracker import PoseTracker, TrackerSettings

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


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What a picture says about one of the objects; ``number`` counts them from 0."""

    number: int
    observation: Observation


class OtherObjects:
    """Looks at several objects, one a frame at most, each with a tracker of its own."""

    def __init__(
        self,
        camera: CameraModel,
        table: ReferenceMap,
        seen: Sequence[ObjectMarker | ObjectOutline],
        other_ids: frozenset[int] = frozenset(),
        settings: TrackerSettings | None = None,
    ) -> None:
        """``other_ids`` are markers of the same dictionary that may be there as well.

        Raises MarkerError where two objects carry the same marker.
        """
        ids = marker_ids(seen) | other_ids
        chosen = replace(settings or TrackerSettings(), other_ids=ids)
        self._trackers = [PoseTracker(camera, table, one, chosen) for one in seen]
        self._looked = [-PERIOD] * len(self._trackers)

    def update(self, image: Image, stamp: float) -> Sighting | None:
        """Judge one frame as :meth:`PoseTracker.update` does, for the object that was looked at
        longest ago; None where no object's turn is."""
        if not self._trackers:
            return None
        number = min(range(len(self._trackers)), key=lambda each: self._looked[each])
        # A stamp that goes back is the tracker's to judge: it says so.
        if 0.0 <= stamp - self._looked[number] < PERIOD:
            return None
        return self.follow(number, image, stamp)

    def follow(self, number: int, image: Image, stamp: float) -> Sighting:
        """Judge one frame for one of the objects, counted from 0."""
        self._looked[number] = stamp
        return Sighting(number, self._trackers[number].update(image, stamp))
