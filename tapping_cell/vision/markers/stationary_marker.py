"""Measure the marker of a nearly stationary object from all its pixels.

Pixel noise differs from frame to frame and averages out. The errors due to the print, to
differences between pixels and to the positions of the edges within the pixels remain as long as the
object does not move. The fraction of the variance that remains is estimated by comparing the
unexplained residual of a frame with the change from one frame to the next.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import transform_points
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.markers.detection import UNIT_CORNERS, ObjectMarker
from tapping_cell.vision.markers.object_pose import PoseFit, object_pose
from tapping_cell.vision.markers.photometric import (
    Alignment,
    Linearisation,
    Template,
    align,
    align_again,
    make_template,
)

_USUAL_BLUR = 0.65
"""Initial blur (sigma in pixels): that of a well focused lens, including the averaging over a
pixel's area. The first alignment corrects it."""
_BLUR_STEP = 0.15
"""Relative change of the blur at which the template is computed again."""
_FIXED_EDGES = 0.25
"""Fraction of the edges' variance that does not average out. Measured: averaging reduces the
standard deviation from 0.005 pixel to 0.0025 pixel."""
_MIN_FIXED = 0.01
_DOWNWARDS = 0.95
"""Cosine of the angle between the optical axis and the table's normal, below which the edges are
used instead of all pixels. A template is blurred equally in all directions of the plane, but an
oblique image is not (measured on photographs)."""
_MEMORY = 30
"""Number of frames over which the noise is averaged."""


class RestingMarker:
    """Measures one marker in successive frames. ``fixed`` is the fraction of the variance of a
    frame's pose that averaging over more frames does not reduce."""

    def __init__(self, marker: ObjectMarker) -> None:
        self._marker = marker
        self._template: Template | None = None
        self._known: tuple[View, Linearisation] | None = None
        self._window: tuple[slice, slice] | None = None
        self._last: NDArray[np.float32] | None = None
        self._pairs = 0
        self._changing = 0.0
        self._unexplained = 0.0
        self.fixed = _FIXED_EDGES

    def measure(self, image: Image, view: View, fit: PoseFit) -> tuple[Array, Array]:
        """Measure the object's pose (3,) and covariance (3, 3). The result comes from the edges if
        the pattern does not explain the image."""
        aligned = None
        if self._known is not None and self._known[0] is view:
            aligned = align_again(image, self._known[1], self._marker, fit.pose)
        if aligned is None or not self._as_blurred(aligned):
            aligned = self._align(image, view, fit)
            self._known = None if aligned is None else (view, aligned.linearisation)
        if aligned is None:
            self.fixed = _FIXED_EDGES
            return object_pose(fit.pose, fit.covariance, self._marker)
        self._compare(image, view, aligned.pose, aligned.unexplained)
        return object_pose(aligned.pose, aligned.covariance, self._marker)

    def _align(self, image: Image, view: View, fit: PoseFit) -> Alignment | None:
        """Align the pattern, starting from the edges, with a template as blurred as the image."""
        if abs(float(view.pose.rotation[2, 2])) < _DOWNWARDS:
            return None
        pixel = float(view.pose.translation[2]) / view.camera.fx
        if self._template is None:
            self._template = make_template(self._marker, pixel, _USUAL_BLUR * pixel)
        aligned = align(image, view, self._template, self._marker, fit.pose)
        if aligned is not None and not self._as_blurred(aligned):
            self._template = make_template(self._marker, pixel, aligned.blur)
            aligned = align(image, view, self._template, self._marker, aligned.pose)
        return aligned

    def _as_blurred(self, aligned: Alignment) -> bool:
        assert self._template is not None
        return abs(aligned.blur / self._template.blur - 1.0) <= _BLUR_STEP

    def _compare(self, image: Image, view: View, pose: Array, unexplained: float) -> None:
        """Update the estimate of frame-to-frame change if the marker did not move."""
        square = transform_points(pose, UNIT_CORNERS * self._marker.size)
        seen = view.project(square, self._marker.height)
        low = np.maximum(np.rint(seen.min(axis=0)).astype(int), 0)
        high = np.rint(seen.max(axis=0)).astype(int)
        window = slice(low[1], high[1]), slice(low[0], high[0])
        now = image[window].astype(np.float32)
        if window == self._window and self._last is not None:
            share = 1.0 / min(self._pairs + 1, _MEMORY)
            self._pairs += 1
            self._changing += share * (0.5 * float(np.var(now - self._last)) - self._changing)
            self._unexplained += share * (unexplained**2 - self._unexplained)
            stays = 1.0 - self._changing / max(self._unexplained, 1e-9)
            self.fixed = min(max(stays, _MIN_FIXED), 1.0)
        else:
            self._pairs = 0
        self._window, self._last = window, now
