"""Is the object's marker the square that the files say, lying where they say?

A marker that is lifted, tilted or of another size than its file says is seen as a square of another
size, or as none. Which of these it is cannot be told from one picture, but how wrong the pose may
be follows from how wrong the shape is. A point at the horizontal distance r from the camera that
lies higher than believed by the share s of the camera's height seems larger by s and further away
by s r. A plane tilted by a seems turned by up to the share a r / 2 of the camera's height by which
it also seems sheared or longer than wide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tapping_cell import se2
from tapping_cell.vision.camera import Array, View
from tapping_cell.vision.markers.detection import ObjectMarker
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.markers.object_pose import PoseFit

_NORMALS = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
_SIGN = np.array([1.0, -1.0, 1.0, -1.0])
_SHARE, _PIXELS, _SMEARED, _CONFIDENCE = 0.0006, 0.06, 0.3, 5.0
"""Stretch and strain that say nothing: a share (print, lens), pixels of the side (where edges lie
between pixels, grey levels that are no measure of the light), pixels for edges that follow their
window (``MarkerEdges.pull`` p) times p / (1 - p), standard deviations of the noise. Of 140 pictures
with sides of 28 to 149 pixels, gamma, Bayer patterns and blur among them, none had more."""


@dataclass(frozen=True, slots=True, eq=False)
class ShapeDeviation:
    """How a marker's square differs from the file's: by what share it seems larger (``stretch``),
    and longer than wide or sheared (``strain``); up to ``allowance`` that says nothing.
    ``covariance`` (3, 3) is what the rest may mean for the object's pose (m, m, rad).
    """

    stretch: float
    strain: float
    allowance: float
    covariance: Array

    @property
    def negligible(self) -> bool:
        """Whether it is the square of the file, as far as can be seen."""
        return max(abs(self.stretch), self.strain) <= self.allowance


def shape_deviation(
    view: View, edges: MarkerEdges, row: int, marker: ObjectMarker, fit: PoseFit, bloom: float
) -> ShapeDeviation:
    """How marker ``row`` of ``edges``, whose pose is ``fit``, differs from its file.

    ``bloom`` is how far the sides of the reference markers lie outside of where they should
    (pixels): what camera and ink do to all markers is not taken for a size.
    """
    pixel = float(view.pose.translation[2]) / view.camera.fx
    seen = view.on_plane(edges.points[row].reshape(-1, 2), marker.height).reshape(4, -1, 2)
    weights = edges.weights[row]
    total = np.maximum(weights.sum(axis=1), 1e-9)
    arm = se2.transform_points(se2.inverse(fit.pose), seen)
    out = (arm * _NORMALS[:, None]).sum(axis=-1)
    along = _NORMALS[:, None, 1] * arm[..., 0] - _NORMALS[:, None, 0] * arm[..., 1]
    along = along - ((weights * along).sum(axis=1) / total)[:, None]
    sides = (weights * out).sum(axis=1) / total
    turns = (weights * along * out).sum(axis=1) / np.maximum(
        (weights * along**2).sum(axis=1), 1e-12
    )
    stretch = fit.size / marker.size - 1.0 - 2.0 * bloom * pixel / marker.size
    oblong = float(_SIGN @ sides) / (2.0 * marker.size)
    strain = math.hypot(oblong, float(_SIGN @ turns) / 4.0)
    pull = min(float(edges.pull[row]), 0.9)
    spread = max(float(edges.spread[row]), 0.01) / math.sqrt(max(float(total.mean()), 1.0))
    doubt = (
        (_CONFIDENCE * 2.0 * spread + _PIXELS + _SMEARED * pull / (1.0 - pull))
        * pixel
        / marker.size
    )
    allowance = _SHARE + doubt
    return ShapeDeviation(
        stretch,
        strain,
        allowance,
        _covariance(
            view, marker, fit.pose, _beyond(stretch, allowance), _beyond(strain, allowance)
        ),
    )


class ShapeWarnings:
    """Says that the shape is not right, in the same words as long as it stays so."""

    def __init__(self, marker: ObjectMarker) -> None:
        self._marker = marker
        self._said: tuple[float, float] | None = None

    def sentence(self, shape: ShapeDeviation, camera_height: float) -> str:
        """What is wrong with the shape as seen from ``camera_height`` (m) over the table; empty for
        nothing."""
        worst = max(abs(shape.stretch), shape.strain) / shape.allowance
        if worst <= (1.0 if self._said is None else 0.8):
            self._said = None
            return ""
        said = self._said
        if said is None or max(abs(shape.stretch - said[0]), abs(shape.strain - said[1])) > 0.002:
            self._said = said = (shape.stretch, shape.strain)
        lifted = (camera_height - self._marker.height) * said[0] * 1e3
        return (
            f"{self._looks(*said)}: lifted (by {lifted:.0f} mm?), tilted, or not of the object "
            "file's size and height; the pose is uncertain accordingly"
        )

    def refusal(self, shape: ShapeDeviation, limit: float) -> str:
        """The same for a shape that is beyond ``limit``."""
        self._said = None
        return (
            f"{self._looks(shape.stretch, shape.strain)} (limit {limit * 100:.0f} %): "
            "lifted, tilted or not of the object file's size and height"
        )

    def _looks(self, stretch: float, strain: float) -> str:
        text = (
            f"the object's marker looks {stretch * 100:+.1f} % larger than its "
            f"{self._marker.size * 1e3:.1f} mm"
        )
        return text if strain < 0.001 else f"{text} and {strain * 100:.1f} % out of square"


def _beyond(share: float, allowance: float) -> float:
    """What of a share counts: nothing of what is allowed, all of what is far beyond."""
    return math.sqrt(max(0.0, share**2 - allowance**2))


def _covariance(
    view: View, marker: ObjectMarker, pose: Array, stretch: float, strain: float
) -> Array:
    """Covariance (3, 3) of the object's pose where the marker's shape is wrong by these shares."""
    away = stretch * (pose[:2] - view.pose.position[:2])
    # A tilted object stands on its rim, about a marker's side away from the middle.
    lifted = 2.0 * strain * marker.size
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = np.outer(away, away) + lifted**2 * np.eye(2)
    covariance[2, 2] = strain**2
    offset = se2.transform_points(
        [0.0, 0.0, pose[2] - marker.offset[2]], np.array(marker.offset[:2])
    )
    jacobian = np.array([[1.0, 0.0, offset[1]], [0.0, 1.0, -offset[0]], [0.0, 0.0, 1.0]])
    return np.asarray(jacobian @ covariance @ jacobian.T)
