"""Compute the object's pose from its marker's edges, in the plane of the marker's printed face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tapping_cell import se2
from tapping_cell.vision.camera import Array, View
from tapping_cell.vision.markers.detection import UNIT_CORNERS, ObjectMarker
from tapping_cell.vision.markers.edges import MarkerEdges


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """Pose (x, y, theta) of the *marker* in ``table``, its covariance (3, 3) from pixel noise, the
    covariance ``sides`` (3, 3) from errors of the sides that are common to all frames, and the
    apparent side of the marker (m)."""

    pose: Array
    covariance: Array
    sides: Array
    size: float


NORMALS = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
"""Outward normals (4, 2) of the sides of a marker; side k of the unit square is at distance 1/2."""
_CLEAN, _SMEARED = 0.03, 0.25
"""Noise level of ``MarkerEdges.pull``, and error of motion-blurred edges in pixels.

An edge with a pull p above the noise level has an additional standard deviation of ``_SMEARED`` * p
/ (1 - p). This relation was measured on rendered slides with motion blur of up to 14 pixels.
"""
_FREE, _USUAL_FREE = 4.0, 8.0
"""``_FREE``: degrees of freedom of the residuals when a square is fitted to four sides.
``_USUAL_FREE``: degrees of freedom of the prior for the usual size of these residuals."""

_SIDES_TURN = 0.33
"""Ratio of the angle error due to deviating sides to that of independent errors along the sides
(measured on photographs of boards): a side is mostly displaced as a whole, which does not rotate
the square."""
_NOISY_OBLONG = 9.0
"""Squared difference of length and width, in variances of its noise, that is taken for noise."""


def fit_marker(
    view: View, edges: MarkerEdges, row: int, marker: ObjectMarker, side_error: float = 0.0
) -> PoseFit | None:
    """Fit a square of known side, at the marker's height, to marker ``row`` of ``edges``.

    ``side_error`` is the standard deviation, in pixels, by which the sides of the reference markers
    deviate from squares in excess of their noise. Returns None if the edges are not valid.
    """
    if not edges.good[row]:
        return None
    pixels = np.concatenate([edges.points[row].reshape(-1, 2), edges.corners[row]])
    seen = view.on_plane(pixels, marker.height)
    points = seen[:-4].reshape(4, -1, 2)
    weights = edges.weights[row]
    pose = _square_pose(seen[-4:])
    size = marker.size
    # One step is sufficient: the corners are accurate to hundredths of a pixel, so the fit is
    # nearly linear.
    normal = se2.transform_points([0.0, 0.0, pose[2]], NORMALS)[:, None, :]
    arm = points - pose[:2]
    distance = (normal * arm).sum(axis=-1) - 0.5 * size
    rows = np.empty((*distance.shape, 4))
    rows[..., :2] = normal
    rows[..., 2] = normal[..., 1] * arm[..., 0] - normal[..., 0] * arm[..., 1]
    rows[..., 3] = 0.5
    rows = rows.reshape(-1, 4)
    # Size of a pixel across each side, on the plane; the sizes differ in an oblique view.
    across = np.linalg.norm(normal[:, 0] @ _metres(edges.corners[row], seen[-4:]), axis=1)
    pixel = float(across.max())
    weights = weights * np.square(pixel / across)[:, None]
    weighted = rows * weights.reshape(-1, 1)
    inverse = np.linalg.inv(weighted.T @ rows)
    step = inverse @ (weighted.T @ distance.reshape(-1))
    pose = pose + step[:3]
    size += step[3]
    if not np.all(np.isfinite(pose)):
        return None
    left = distance - (rows @ step).reshape(distance.shape)
    noise = max(float(edges.spread[row]), 0.01) * pixel
    total = np.maximum(weights.sum(axis=1), 1e-9)
    sides = (weights * left).sum(axis=1) / total
    # An object that lies along a side displaces this side, and the square by half of that.
    constant = side_error * pixel * float(np.sqrt(total.mean()))
    usual = float(np.hypot(noise, constant))
    oblong = float(sides[0] - sides[1] + sides[2] - sides[3]) ** 2
    displaced = 0.25 * max(oblong - _NOISY_OBLONG * usual**2 * float((1.0 / total).sum()), 0.0)
    misfit = _misfit(left, weights, usual)
    pull = min(max(float(edges.pull[row]) - _CLEAN, 0.0), 0.99)
    smeared = _SMEARED * pixel * pull / (1.0 - pull)
    covariance = inverse[:3, :3] * (misfit * noise) ** 2
    extra = smeared**2 + displaced
    covariance += np.diag([extra, extra, extra / marker.size**2])
    turned = np.array([1.0, 1.0, _SIDES_TURN])
    common = inverse[:3, :3] * (misfit * constant) ** 2 * np.outer(turned, turned)
    return PoseFit(pose, covariance, common, float(size))


def _metres(pixels: Array, seen: Array) -> Array:
    """Matrix (2, 2) that converts steps of one pixel to the right and down to steps on the plane
    (m), computed from four corners (4, 2) in the image and on the plane."""
    return np.asarray((seen[2:] - seen[:2]).T @ np.linalg.inv((pixels[2:] - pixels[:2]).T))


def _misfit(left: Array, weights: Array, noise: float) -> float:
    """Ratio, at least 1, by which the residuals of the four sides exceed their noise.

    Each of the four sides has a position and a rotation: eight degrees of freedom. A square
    determines four of them. The residuals in the other four degrees of freedom reveal glare,
    sharpening, compression and bent paper. As four values are a small sample, a prior for their
    usual value is included.
    """
    total = np.maximum(weights.sum(axis=1), 1e-9)
    place = (weights * left).sum(axis=1) / total
    along = np.linspace(-0.5, 0.5, left.shape[1]) * np.ones_like(left)
    along = along - (weights * along).sum(axis=1, keepdims=True) / total[:, None]
    spread = np.maximum((weights * along**2).sum(axis=1), 1e-9)
    turn = (weights * left * along).sum(axis=1) / spread
    chi = float((place**2 * total + turn**2 * spread).sum()) / noise**2
    return float(np.sqrt(max(1.0, (chi + _USUAL_FREE) / (_FREE + _USUAL_FREE))))


def pose_of_corners(view: View, corners: Array, marker: ObjectMarker) -> Array:
    """Pose (x, y, theta) of the marker from its corners (4, 2) in pixels; its size is not used."""
    return _square_pose(view.on_plane(corners, marker.height))


def _square_pose(seen: Array) -> Array:
    """Pose (x, y, theta) of a square with these corners (4, 2), in m."""
    middle = seen.mean(axis=0)
    arm = seen - middle
    cross = (UNIT_CORNERS[:, 0] * arm[:, 1] - UNIT_CORNERS[:, 1] * arm[:, 0]).sum()
    dot = (UNIT_CORNERS * arm).sum()
    return np.array([middle[0], middle[1], np.arctan2(cross, dot)])


def object_pose(marker_pose: Array, covariance: Array, marker: ObjectMarker) -> tuple[Array, Array]:
    """Compute pose and covariance of the object in ``table`` from those of its marker."""
    to_object = se2.inverse(marker.offset)
    pose = se2.compose(marker_pose, to_object)
    pose[2] = se2.wrap_angle(pose[2])
    shift = pose[:2] - marker_pose[:2]
    jacobian = np.array([[1.0, 0.0, -shift[1]], [0.0, 1.0, shift[0]], [0.0, 0.0, 1.0]])
    return pose, jacobian @ covariance @ jacobian.T


def marker_pose(pose: Array, marker: ObjectMarker) -> Array:
    """Compute the pose of the marker in ``table`` if the object is at ``pose``."""
    return se2.compose(pose, marker.offset)
