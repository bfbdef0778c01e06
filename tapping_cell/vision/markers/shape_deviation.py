"""Check that the object's marker appears as a square with the size and height that the files state.

A marker that is lifted, tilted or not of the stated size appears too large, too small or not
square. A single image does not show which of these three deviations is the cause. However, the
resulting error of the pose can be estimated from the deviation of the shape. If a
marker at the horizontal distance r from the camera is higher than assumed by a fraction s of the
camera's height, it appears larger by s and further away by s r. A marker tilted by an angle t
appears rotated by up to t r / (2 h), where h is the camera's height, and sheared or elongated by
the same amount.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tapping_cell import se2
from tapping_cell.vision.camera import Array, View
from tapping_cell.vision.markers.detection import ObjectMarker
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.markers.object_pose import NORMALS, PoseFit

_SIGN = np.array([1.0, -1.0, 1.0, -1.0])
_SHARE, _PIXELS, _SMEARED, _CONFIDENCE = 0.0006, 0.06, 0.3, 5.0
"""Limit below which stretch and strain are not significant.

The limit is the sum of four contributions. ``_SHARE`` is a constant relative error (of print and
lens). ``_PIXELS`` is an error of the side's length in pixels (position of edges within pixels,
nonlinear grey levels). ``_SMEARED`` * p / (1 - p) is the error, in pixels, due to blurred edges,
where p is ``MarkerEdges.pull``. ``_CONFIDENCE`` is a number of standard deviations of the
noise. In none of 140 images did the deviation exceed this limit. The markers' sides were 28 to 149
pixels long, and the images included the effects of gamma, Bayer patterns and blur.
"""


@dataclass(frozen=True, slots=True, eq=False)
class ShapeDeviation:
    """Difference between the measured and the configured square of a marker.

    ``stretch`` is the relative enlargement and ``strain`` the relative elongation or shear; values
    up to ``allowance`` are not significant. ``covariance`` (3, 3) is the uncertainty of the
    object's pose (m, m, rad) due to the significant part of the deviation.
    """

    stretch: float
    strain: float
    allowance: float
    covariance: Array

    @property
    def negligible(self) -> bool:
        """True if the marker agrees with its file within the measurement accuracy."""
        return max(abs(self.stretch), self.strain) <= self.allowance


def shape_deviation(
    view: View, edges: MarkerEdges, row: int, marker: ObjectMarker, fit: PoseFit, bloom: float
) -> ShapeDeviation:
    """Compute the deviation of marker ``row`` of ``edges`` from the marker's file. ``fit`` is the
    fitted pose of the marker.

    ``bloom`` is the mean displacement (pixels) of the reference markers' sides outwards. This
    displacement is subtracted, because an effect of camera and ink on all markers is not a
    difference of size.
    """
    pixel = float(view.pose.translation[2]) / view.camera.fx
    seen = view.on_plane(edges.points[row].reshape(-1, 2), marker.height).reshape(4, -1, 2)
    weights = edges.weights[row]
    total = np.maximum(weights.sum(axis=1), 1e-9)
    arm = se2.transform_points(se2.inverse(fit.pose), seen)
    out = (arm * NORMALS[:, None]).sum(axis=-1)
    along = NORMALS[:, None, 1] * arm[..., 0] - NORMALS[:, None, 0] * arm[..., 1]
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
    uncertainty = (
        (_CONFIDENCE * 2.0 * spread + _PIXELS + _SMEARED * pull / (1.0 - pull))
        * pixel
        / marker.size
    )
    allowance = _SHARE + uncertainty
    beyond = _beyond(stretch, allowance), _beyond(strain, allowance)
    return ShapeDeviation(stretch, strain, allowance, _covariance(view, marker, fit.pose, *beyond))


class ShapeWarnings:
    """Creates warnings about the shape. A warning is repeated with the same values until the shape
    changes noticeably."""

    def __init__(self, marker: ObjectMarker) -> None:
        self._marker = marker
        self._reported: tuple[float, float] | None = None

    def sentence(self, shape: ShapeDeviation, camera_height: float) -> str:
        """Warning about the shape, for a camera ``camera_height`` (m) above the table; empty if
        there is none."""
        worst = max(abs(shape.stretch), shape.strain) / shape.allowance
        if worst <= (1.0 if self._reported is None else 0.8):
            self._reported = None
            return ""
        reported = self._reported
        now = shape.stretch, shape.strain
        if reported is None or max(abs(a - b) for a, b in zip(now, reported, strict=True)) > 0.002:
            self._reported = reported = now
        lifted = (camera_height - self._marker.height) * reported[0] * 1e3
        amount = f" (by {lifted:.0f} mm if this is the only cause)" if lifted >= 1.0 else ""
        return (
            f"{self._described(*reported)}: the object may be lifted{amount} "
            "or tilted, or the marker's size or height in the object file may be wrong; the "
            "uncertainty of the pose includes this deviation"
        )

    def refusal(self, shape: ShapeDeviation, limit: float) -> str:
        """Error message for a shape whose deviation exceeds ``limit``."""
        self._reported = None
        return (
            f"{self._described(shape.stretch, shape.strain)} (limit {limit * 100:.0f} %): the "
            "object may be lifted or tilted, or the marker's size or height in the object file may "
            "be wrong"
        )

    def _described(self, stretch: float, strain: float) -> str:
        text = (
            f"the apparent size of the object's marker differs by {stretch * 100:+.1f} % from "
            f"{self._marker.size * 1e3:.1f} mm, its size in the object file"
        )
        if strain < 0.001:
            return text
        return f"{text}, and its shape deviates by {strain * 100:.1f} % from a square"


def _beyond(share: float, allowance: float) -> float:
    """Significant part of a deviation: zero up to the allowance, nearly the whole deviation if it
    is far above the allowance."""
    return math.sqrt(max(0.0, share**2 - allowance**2))


def _covariance(
    view: View, marker: ObjectMarker, pose: Array, stretch: float, strain: float
) -> Array:
    """Covariance (3, 3) of the object's pose for these errors of the marker's shape."""
    away = stretch * (pose[:2] - view.pose.position[:2])
    # An object with the tilt t touches the table at its rim, about one marker side from its centre.
    # The centre is therefore lifted by t times this side and appears displaced by r / h times this
    # lift. The displacement is twice the strain t r / (2 h) times the side (see the module's
    # docstring).
    lifted = 2.0 * strain * marker.size
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = np.outer(away, away) + lifted**2 * np.eye(2)
    covariance[2, 2] = strain**2
    offset = se2.transform_points(
        [0.0, 0.0, pose[2] - marker.offset[2]], np.array(marker.offset[:2])
    )
    jacobian = np.array([[1.0, 0.0, offset[1]], [0.0, 1.0, -offset[0]], [0.0, 0.0, 1.0]])
    return np.asarray(jacobian @ covariance @ jacobian.T)
