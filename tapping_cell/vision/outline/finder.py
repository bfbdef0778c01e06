"""Track the outline from frame to frame, or report why it was not found."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.markers.detection import ReferenceMap
from tapping_cell.vision.observation import Problem
from tapping_cell.vision.outline.fit import USUAL_BLUR, Linearisation, OutlineFit, fit_again
from tapping_cell.vision.outline.search import (
    NO_DOT,
    OTHER_SIZE,
    TWO_DOTS,
    Refused,
    accept,
    find_outlines,
    fit_closely,
    fit_surely,
    stands_out,
)
from tapping_cell.vision.outline.shape import ObjectOutline

Failure = tuple[Problem, str]

RIM_BIAS = 7e-6
"""Standard deviation (m) of the error common to all frames, measured on rendered scenes. Its causes
are the position of the edge within a pixel, uneven light across the rim, and the side wall.
Chamfers, dirt and errors in the object file are not included."""
_PROBLEMS = {
    OTHER_SIZE: Problem.MISSHAPEN_OBJECT,
    NO_DOT: Problem.DOT_HIDDEN,
    TWO_DOTS: Problem.DOT_HIDDEN,
}


class OutlineFinder:
    """Finds one outline in every frame; remembers the blur of the camera."""

    def __init__(self, outline: ObjectOutline, table: ReferenceMap) -> None:
        self.outline = outline
        self._known = table.corners()
        self._blur = USUAL_BLUR
        self._search = True
        self._followed = False
        self._refused: Failure | None = None
        self._last_fit: tuple[View, Linearisation] | None = None

    def search(self) -> None:
        """Search the whole next frame."""
        self._search = True

    def shared(self) -> Array:
        """Covariance (3, 3; m, m, rad) of the error that averaging over frames does not reduce."""
        dot = self.outline.dot
        arm = 0.7 * self.outline.reach
        if dot is not None and self.outline.vertices is None:
            arm = math.hypot(*dot.offset)
        return np.diag([RIM_BIAS**2, RIM_BIAS**2, (RIM_BIAS / arm) ** 2])

    def measure(
        self, image: Image, view: View, expected: Array | None, step: Array
    ) -> OutlineFit | Failure:
        """Find the outline in this frame. Return the fit, or why the outline was not found.

        ``expected`` (3,) is the predicted pose of the outline; None if unknown. ``step`` (2,) is
        its motion from frame to frame in m.
        """
        followed = None if expected is None else self._follow(image, view, expected, step)
        lost = followed is None and self._followed
        if self._search or lost:
            self._search = False
            answer = self._everywhere(image, view, followed)
        else:
            answer = followed or self._refused or self._unseen()
        self._followed = isinstance(answer, OutlineFit)
        if isinstance(answer, OutlineFit):
            self._refused = None
            self._blur = float(np.clip(answer.blur, 0.4, 2.0))
        return answer

    def _follow(self, image: Image, view: View, expected: Array, step: Array) -> OutlineFit | None:
        """Measure the outline at its predicted pose, or a few pixels away."""
        again = self._again(image, view, expected)
        if again is not None:
            return again
        if not stands_out(image, view, self.outline, expected):
            return None
        fit = fit_surely(image, view, self.outline, expected, blur=self._blur, step=step)
        if fit is not None and isinstance(accept(fit, self.outline), OutlineFit):
            self._last_fit = view, fit.linearisation
            return fit
        if not self._followed:
            return None
        near = fit_closely(image, view, self.outline, expected, self._blur)
        return near if isinstance(near, OutlineFit) else None

    def _again(self, image: Image, view: View, expected: Array) -> OutlineFit | None:
        """Measure the outline at its pose in the last frame; None if it does not fit there."""
        if self._last_fit is None or self._last_fit[0] is not view:
            return None
        fit = fit_again(image, self._last_fit[1], expected)
        if fit is None or isinstance(accept(fit, self.outline), Refused):
            self._last_fit = None
            return None
        return fit

    def _everywhere(
        self, image: Image, view: View, followed: OutlineFit | None
    ) -> OutlineFit | Failure:
        found, refused = find_outlines(image, view, self.outline, self._known, self._blur)
        if followed is not None:
            # A partly hidden outline may be found only at its predicted pose, not by the search.
            reach = 0.5 * self.outline.reach
            others = [f for f in found if math.hypot(*(f.pose - followed.pose)[:2]) > reach]
            found = [followed, *others]
        if len(found) > 1:
            places = " and ".join(
                f"({f.pose[0] * 1e3:.0f}, {f.pose[1] * 1e3:.0f}) mm" for f in found
            )
            self._refused = (
                Problem.DUPLICATE_OBJECT,
                f"the object's outline is seen more than once, at {places}; remove all but one",
            )
            return self._refused
        if found:
            return found[0]
        self._refused = None
        if refused:
            first = refused[0]
            problem = _PROBLEMS.get(first.reason, Problem.WRONG_OBJECT)
            self._refused = (problem, f"the object is not found: {first.sentence}")
        return self._refused or self._unseen()

    def _unseen(self) -> Failure:
        shade = "brighter" if self.outline.brighter else "darker"
        return (
            Problem.OBJECT_HIDDEN,
            f"the object's outline is not seen: no area {shade} than the table has the "
            "object's size, or too little of the object is visible",
        )
