"""Tracks an object that carries a marker."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from tapping_cell.se2 import transform_points
from tapping_cell.vision.camera import Array, View
from tapping_cell.vision.markers.detection import UNIT_CORNERS, ObjectMarker, marker_pattern
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.markers.measurement import measure
from tapping_cell.vision.markers.object_pose import fit_marker, marker_pose, object_pose
from tapping_cell.vision.markers.search import Detections, near
from tapping_cell.vision.markers.shape_deviation import (
    ShapeDeviation,
    ShapeWarnings,
    shape_deviation,
)
from tapping_cell.vision.object_follower import Aim, Failure, Frame, ObjectFollower, Search
from tapping_cell.vision.observation import Problem
from tapping_cell.vision.rest_detection import RestSettings


class MarkerFollower(ObjectFollower):
    """Follows the marker of one object.

    ``size_tolerance`` is the relative deviation allowed between the measured and the configured
    side. ``other_ids`` are other markers of the same dictionary that may be visible.
    """

    fixed = 0.25
    # Measured: averaging reduces the standard deviation of an edge from 0.005 pixel to 0.0025
    # pixel.

    def __init__(
        self,
        marker: ObjectMarker,
        rest: RestSettings,
        size_tolerance: float,
        other_ids: frozenset[int],
    ) -> None:
        super().__init__(marker.height, marker.height_tolerance, marker.size / math.sqrt(3.0), rest)
        self.marker = marker
        self.dictionary = marker.dictionary
        self._size_tolerance = size_tolerance
        self._other_ids = other_ids
        self._pattern = marker_pattern(marker.dictionary, marker.id)
        self._warnings = ShapeWarnings(marker)
        self._shape: ShapeDeviation | None = None
        self._sides: Array = np.zeros((3, 3))
        self._searched_at = -math.inf
        self._detected: Array | None = None

    def outline(self, pose: Array) -> Array:
        """Return the corners (4, 2) of the marker's square."""
        square = UNIT_CORNERS * self.marker.size
        return np.asarray(transform_points(marker_pose(pose, self.marker), square))

    def detected(self, stamp: float) -> bool:
        """Return whether the search of the frame with this stamp found the marker exactly once."""
        return self._searched_at == stamp and self._detected is not None

    def aim(self, stamp: float, view: View | None) -> Aim | None:
        """Return the marker at its detected position in this frame, or at its predicted
        position."""
        quad = self._detected if self._searched_at == stamp else self._where(stamp, view)
        return None if quad is None else (quad, self._pattern)

    def complete(self, detections: Mapping[str, Detections]) -> bool:
        """Return whether the marker was found at least once."""
        found = detections[self.marker.dictionary]
        return self.marker.id in found.single or self.marker.id in found.repeated

    def searched(self, search: Search) -> None:
        """Store the marker's position, or diagnose why it was not found."""
        found = search.detections[self.marker.dictionary]
        self._searched_at, self.wants_search = search.stamp, False
        self._detected = found.single.get(self.marker.id)
        if self.marker.id in found.repeated:
            self.forget()
            self.failure = (
                Problem.DUPLICATE_MARKER,
                f"marker {self.marker.id} of the object is seen more than once; cover the other "
                "copies",
            )
        elif self._detected is not None:
            self.failure = None
        elif search.slow:
            self.failure = self._explain(search, found)

    def measure(self, frame: Frame) -> tuple[Array, Array] | Failure:
        """Measure the marker at its detected or predicted position, or near that position."""
        searched = self._searched_at == frame.stamp
        if searched and self._detected is None and self.failure is not None:
            return self.failure
        edges = frame.aimed if frame.aimed is not None else self._nearby(frame)
        self.wants_search |= edges is None
        fit = (
            None
            if edges is None
            else fit_marker(frame.working, edges, 0, self.marker, frame.table.side_error)
        )
        if edges is None or fit is None:
            self.stop(frame.stamp)
            # The diagnosis of the last search remains valid until the next search.
            return self.failure or (
                Problem.OBJECT_HIDDEN,
                f"the object's marker {self.marker.id} is not seen, is partly covered, or is "
                "seen at too flat an angle (tilted?)",
            )
        shape = shape_deviation(frame.working, edges, 0, self.marker, fit, frame.table.bloom)
        limit = self._size_tolerance
        if max(abs(shape.stretch), shape.strain) > limit:
            self.stop(frame.stamp, object_pose(fit.pose, fit.covariance, self.marker)[0])
            self.track.clear()
            return Problem.MISSHAPEN_MARKER, self._warnings.refusal(shape, limit)
        self._shape, self.failure = shape, None
        self._sides = object_pose(fit.pose, fit.sides, self.marker)[1]
        return object_pose(fit.pose, fit.covariance, self.marker)

    def extra_uncertainty(self, frame: Frame) -> tuple[Array, str]:
        """Return the uncertainty of the pose due to the marker's sides and its shape, and a
        warning."""
        assert self._shape is not None
        sentence = self._warnings.sentence(self._shape, frame.table.camera_height)
        return self._shape.covariance + self._sides, sentence

    def _nearby(self, frame: Frame) -> MarkerEdges | None:
        """Search around the marker's predicted position and return its edges."""
        where = self._where(frame.stamp, frame.working)
        if where is None:
            return None
        quad = near(frame.image, self.marker.dictionary, self.marker.id, where)
        if quad is None:
            return None
        edges, right = measure(frame.image, quad[None], [self._pattern], True)
        return edges if right[0] else None

    def _where(self, stamp: float, view: View | None) -> Array | None:
        """Predict the marker's corners (4, 2) in the image."""
        expected = self.expected(stamp)
        if expected is None or view is None:
            return None
        return view.project(self.outline(expected), self.height)

    def _explain(self, search: Search, found: Detections) -> Failure | None:
        """Diagnose why the object's marker was not found."""
        expected = search.expected_ids.get(self.marker.dictionary, frozenset())
        mirrored = set(search.mirrored(self.marker.dictionary).single)
        if self.marker.id in mirrored:
            return (
                Problem.MIRRORED_MARKER,
                f"marker {self.marker.id} is seen mirrored; turn off mirroring or print "
                "the marker again",
            )
        if len(mirrored & expected) > 1:
            return (
                Problem.MIRRORED_MARKER,
                f"the markers {', '.join(map(str, sorted(mirrored & expected)))} are seen "
                "mirrored; turn off mirroring in the camera",
            )
        others = sorted(set(found.single) - expected - self._other_ids - {self.marker.id})
        if others:
            return (
                Problem.WRONG_MARKER,
                f"the object's marker {self.marker.id} is not seen, but unexpected markers are "
                f"seen ({', '.join(map(str, others))}); compare the marker's id with the object "
                "file",
            )
        return None
