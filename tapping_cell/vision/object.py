"""The object's pose from the edges of its marker, in the plane of the marker's printed face."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tapping_cell import se2
from tapping_cell.vision.camera import Array, View
from tapping_cell.vision.edges import MarkerEdges
from tapping_cell.vision.markers import UNIT_CORNERS, ObjectMarker


@dataclass(frozen=True, slots=True, eq=False)
class PoseFit:
    """A pose (x, y, theta) of the *marker* in table, its covariance (3, 3) from pixel noise, and
    the side that the marker seems to have (m).
    """

    pose: Array
    covariance: Array
    size: float


# Least squares of points on four sides; the levels beside an edge come from the same rows as the
# edge and add noise that all points of a side share: measured factor on the variance.
_LEVEL_NOISE = 2.0


def fit_marker(view: View, edges: MarkerEdges, row: int, marker: ObjectMarker) -> PoseFit | None:
    """Marker ``row`` of ``edges`` as a square of known side in the plane at the marker's height.

    None if the edges are not good or make no square.
    """
    if not edges.good[row]:
        return None
    points = view.on_plane(edges.points[row], marker.height)
    weights = edges.weights[row]
    pose = pose_of_corners(view, edges.corners[row], marker)
    size = marker.size
    # Side k of the unit square lies at distance 1/2 along this normal.
    normals = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
    information = np.eye(4)
    for _ in range(3):
        normal = se2.transform_points([0.0, 0.0, pose[2]], normals)[:, None, :]
        arm = points - pose[:2]
        distance = (normal * arm).sum(axis=-1) - 0.5 * size
        turning = -normal[..., 1] * arm[..., 0] + normal[..., 0] * arm[..., 1]
        row_of = np.stack(
            [
                np.broadcast_to(normal[..., 0], distance.shape),
                np.broadcast_to(normal[..., 1], distance.shape),
                -turning,
                np.full(distance.shape, 0.5),
            ],
            axis=-1,
        )
        information = np.einsum("sb,sbi,sbj->ij", weights, row_of, row_of)
        step = np.linalg.solve(information, np.einsum("sb,sbi,sb->i", weights, row_of, distance))
        pose = pose + step[:3]
        size += step[3]
    if not np.all(np.isfinite(pose)):
        return None
    pixel = view.pose.translation[2] / view.camera.fx
    noise = max(float(edges.spread[row]), 0.01) * pixel
    covariance = np.linalg.inv(information)[:3, :3] * noise**2 * _LEVEL_NOISE
    return PoseFit(pose, covariance, float(size))


def pose_of_corners(view: View, corners: Array, marker: ObjectMarker) -> Array:
    """Pose (x, y, theta) of the marker from its corners (4, 2) in pixels; the size is not used."""
    seen = view.on_plane(corners, marker.height)
    middle = seen.mean(axis=0)
    arm = seen - middle
    cross = (UNIT_CORNERS[:, 0] * arm[:, 1] - UNIT_CORNERS[:, 1] * arm[:, 0]).sum()
    dot = (UNIT_CORNERS * arm).sum()
    return np.array([middle[0], middle[1], np.arctan2(cross, dot)])


def object_pose(marker_pose: Array, covariance: Array, marker: ObjectMarker) -> tuple[Array, Array]:
    """Pose and covariance of the object in table from those of its marker."""
    to_object = se2.inverse(marker.offset)
    pose = se2.compose(marker_pose, to_object)
    pose[2] = se2.wrap_angle(pose[2])
    shift = pose[:2] - marker_pose[:2]
    jacobian = np.array([[1.0, 0.0, -shift[1]], [0.0, 1.0, shift[0]], [0.0, 0.0, 1.0]])
    return pose, jacobian @ covariance @ jacobian.T


def marker_pose(pose: Array, marker: ObjectMarker) -> Array:
    """Pose of the marker in table when the object is at ``pose``."""
    return se2.compose(pose, marker.offset)
