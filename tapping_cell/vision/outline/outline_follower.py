"""Tracks an object without a marker by its outline, or reports why it was not found."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from tapping_cell.se2 import transform_points, wrap_angle
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.markers.detection import ReferenceMap
from tapping_cell.vision.object_follower import Failure, Frame, ObjectFollower, Search
from tapping_cell.vision.observation import Problem
from tapping_cell.vision.outline.fit import (
    USUAL_BLUR,
    Linearisation,
    OutlineFit,
    fit_again,
    fit_outline,
)
from tapping_cell.vision.outline.search import (
    Refused,
    accept,
    find_outlines,
    fit_closely,
    stands_out,
)
from tapping_cell.vision.outline.shape import ObjectOutline
from tapping_cell.vision.rest_detection import RestSettings

_LONGEST_WINDOW = 18
"""Maximum number of frames used to prove that the object is at rest. More frames are needed than
for a marker, because an outline is measured less accurately."""
_RIM_BIAS = 7e-6
"""Standard deviation (m) of the error common to all frames, measured on rendered scenes. Its causes
are the position of the edge within a pixel, uneven light across the rim, and the side wall.
Chamfers, dirt and errors in the object file are not included."""


class OutlineFollower(ObjectFollower):
    """Follows the outline of one object on a table with the reference markers ``table``."""

    def __init__(self, outline: ObjectOutline, table: ReferenceMap, rest: RestSettings) -> None:
        reach = math.sqrt(outline.area / math.pi)
        patient = replace(rest, longest=max(rest.longest, _LONGEST_WINDOW))
        super().__init__(outline.height, outline.height_tolerance, reach, patient)
        self._shape = outline
        self._references = table.corners()
        self._blur = USUAL_BLUR
        self._search = True
        self._followed = False
        self._last_fit: tuple[View, Linearisation] | None = None

    def outline(self, pose: Array) -> Array:
        """Return points (N, 2) on the rim."""
        return np.asarray(transform_points(pose, self._shape.points()))

    def searched(self, search: Search) -> None:
        """Search the whole next frame for the outline."""
        self.wants_search = False
        self._search = True

    def measure(self, frame: Frame) -> tuple[Array, Array] | Failure:
        """Measure the outline at its predicted position, or search for it in the whole frame."""
        followed = self._follow(frame)
        lost = followed is None and self._followed
        if self._search or lost:
            self._search = False
            answer = self._everywhere(frame.image, frame.working, followed)
        else:
            answer = followed or self.failure or self._unseen()
        self._followed = isinstance(answer, OutlineFit)
        if isinstance(answer, OutlineFit):
            self.failure = None
            self._blur = float(np.clip(answer.blur, 0.4, 2.0))
            return np.append(answer.pose[:2], wrap_angle(answer.pose[2])), answer.covariance
        self.stop(frame.stamp)
        self.wants_search = True
        if answer[0] is Problem.DUPLICATE_OBJECT:
            self.forget()
        return answer

    def extra_uncertainty(self, frame: Frame) -> tuple[Array, str]:
        """Return the uncertainty common to all frames, due to the positions of edges within pixels
        and to uneven light across the rim."""
        return rim_uncertainty(self._shape), ""

    def _follow(self, frame: Frame) -> OutlineFit | None:
        """Measure the outline at its predicted pose, or a few pixels away."""
        expected = self.expected(frame.stamp)
        if expected is None:
            return None
        image, view, outline = frame.image, frame.working, self._shape
        again = self._again(image, view, expected)
        if again is not None:
            return again
        if not stands_out(image, view, outline, expected):
            return None
        step = self.step(frame.stamp)
        fit = fit_outline(image, view, outline, expected, blur=self._blur, step=step)
        if fit is not None and isinstance(accept(fit, outline), OutlineFit):
            self._last_fit = view, fit.linearisation
            return fit
        if not self._followed:
            return None
        near = fit_closely(image, view, outline, expected, self._blur)
        return near if isinstance(near, OutlineFit) else None

    def _again(self, image: Image, view: View, expected: Array) -> OutlineFit | None:
        """Measure the outline at its pose in the last frame; None if it does not fit there."""
        if self._last_fit is None or self._last_fit[0] is not view:
            return None
        fit = fit_again(image, self._last_fit[1], expected)
        if fit is None or isinstance(accept(fit, self._shape), Refused):
            self._last_fit = None
            return None
        return fit

    def _everywhere(
        self, image: Image, view: View, followed: OutlineFit | None
    ) -> OutlineFit | Failure:
        found, refused = find_outlines(image, view, self._shape, self._references, self._blur)
        if followed is not None:
            # A partly hidden outline may be found only at its predicted pose, not by the search.
            reach = 0.5 * self._shape.reach
            others = [f for f in found if math.hypot(*(f.pose - followed.pose)[:2]) > reach]
            found = [followed, *others]
        if len(found) > 1:
            places = " and ".join(
                f"({f.pose[0] * 1e3:.0f}, {f.pose[1] * 1e3:.0f}) mm" for f in found
            )
            self.failure = (
                Problem.DUPLICATE_OBJECT,
                f"the object's outline is seen more than once, at {places}; remove all but one",
            )
            return self.failure
        if found:
            return found[0]
        self.failure = None
        if refused:
            first = refused[0]
            self.failure = (first.problem, f"the object is not found: {first.sentence}")
        return self.failure or self._unseen()

    def _unseen(self) -> Failure:
        shade = "brighter" if self._shape.brighter else "darker"
        return (
            Problem.OBJECT_HIDDEN,
            f"the object's outline is not seen: no area {shade} than the table has the "
            "object's size, or too little of the object is visible",
        )


def rim_uncertainty(outline: ObjectOutline) -> Array:
    """Covariance (3, 3; m, m, rad) of the error that averaging over frames does not reduce."""
    arm = 0.7 * outline.reach
    if outline.dot is not None and outline.vertices is None:
        arm = math.hypot(*outline.dot.offset)
    return np.diag([_RIM_BIAS**2, _RIM_BIAS**2, (_RIM_BIAS / arm) ** 2])
