"""Tracks an object without a marker by its outline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tapping_cell.se2 import transform_points, wrap_angle
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.markers.detection import ReferenceMap
from tapping_cell.vision.markers.search import Detections
from tapping_cell.vision.object_follower import Aim, Failure, Frame, ObjectFollower, Search
from tapping_cell.vision.observation import Problem
from tapping_cell.vision.outline.finder import OutlineFinder
from tapping_cell.vision.outline.fit import OutlineFit
from tapping_cell.vision.outline.shape import ObjectOutline
from tapping_cell.vision.rest_detection import RestSettings

_LONGEST_WINDOW = 18
"""Maximum number of frames used to prove that the object is at rest. More are needed than for a
marker, because an outline is measured less accurately."""


class OutlineFollower(ObjectFollower):
    """Follows the outline of one object on a table with the reference markers ``table``."""

    def __init__(self, outline: ObjectOutline, table: ReferenceMap, rest: RestSettings) -> None:
        super().__init__(outline.height, replace(rest, longest=max(rest.longest, _LONGEST_WINDOW)))
        self._shape = outline
        self._finder = OutlineFinder(outline, table)
        self._shared = self._finder.shared()

    def outline(self, pose: Array) -> Array:
        """Return points (N, 2) on the rim."""
        return np.asarray(transform_points(pose, self._shape.points()))

    def detected(self, stamp: float) -> bool:
        """Return False, because a search of markers finds no outline."""
        return False

    def aim(self, stamp: float, view: View | None) -> Aim | None:
        """Return None, because the object has no marker."""
        return None

    def complete(self, detections: Mapping[str, Detections]) -> bool:
        """Return True, because the follower needs no markers."""
        return True

    def searched(self, image: Image, search: Search) -> None:
        """Search the whole next frame for the outline."""
        self.wants_search = False
        self._finder.search()

    def measure(self, frame: Frame) -> tuple[Array, Array] | Failure:
        """Measure the outline at its predicted position, or search for it in the whole frame."""
        expected, step = self.expected(frame.stamp), self.step(frame.stamp)
        answer = self._finder.measure(frame.image, frame.working, expected, step)
        if isinstance(answer, OutlineFit):
            pose = answer.pose.copy()
            pose[2] = wrap_angle(pose[2])
            return pose, answer.covariance
        self.stop(frame.stamp)
        self.wants_search = True
        if answer[0] is Problem.DUPLICATE_OBJECT:
            self.forget()
        return answer

    def extra_uncertainty(self, frame: Frame) -> tuple[Array, str]:
        """Return the uncertainty common to all frames, due to the positions of edges within pixels
        and to uneven light across the rim."""
        return self._shared, ""
