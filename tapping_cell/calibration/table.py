"""Calibration of the reference markers' poses from images by a calibrated camera.

Bundle adjustment (Triggs et al., Vision Algorithms 1999) fits the poses of the camera and the
planar poses of the markers to the measured directions of all corners. The markers lie in one plane,
and their printed size determines the scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.table_frame import rigid, with_poses
from tapping_cell.se2 import Array, compose, inverse, transform_points
from tapping_cell.vision.camera import CameraModel, CameraPose, Image
from tapping_cell.vision.markers.detection import (
    UNIT_CORNERS,
    Effort,
    ReferenceMap,
    ReferenceMarker,
    find_markers,
    marker_pattern,
    visible_instead,
)
from tapping_cell.vision.markers.edges import MarkerEdges, refine, straight_corners
from tapping_cell.vision.table.fit import candidate_poses

_LENS_NOISE = 0.03
"""Standard deviation, in pixels, of a corner's position error due to residual lens distortion."""
_STRAY_RATIO, _STRAY_PIXELS = 5.0, 0.6
"""A marker in an image is an outlier if its error exceeds both this multiple of the median error
and this number of pixels."""
_STEPS = 60


@dataclass(frozen=True, slots=True, eq=False)
class MarkerView:
    """The markers of one image: ``ids`` (M,), directions ``rays`` (M, 4, 2) of their corners in
    normalised coordinates, and the standard deviations ``noise`` (M,) of these directions.
    """

    name: str
    ids: NDArray[np.intp]
    rays: Array
    noise: Array


@dataclass(frozen=True, slots=True)
class Outlier:
    """A rejected marker of an image, with its residual in pixels."""

    image: str
    marker: int
    error: float


@dataclass(frozen=True, slots=True, eq=False)
class TableCalibration:
    """The calibrated map ``references`` and its quality.

    ``deviations`` (M, 3) are the standard deviations of the markers' x, y (m) and theta (rad)
    relative to the common frame of all markers. ``rms`` is the root mean square corner error in
    pixels, ``seen`` (M,) the number of images in which each marker is used, and ``poses`` are the
    camera poses by image.
    """

    references: ReferenceMap
    deviations: Array
    rms: float
    seen: NDArray[np.intp]
    poses: tuple[CameraPose, ...]
    outliers: tuple[Outlier, ...]
    warnings: tuple[str, ...]


def observe_markers(
    image: Image,
    name: str,
    camera: CameraModel,
    dictionary: str,
    known: Sequence[int] | None = None,
) -> MarkerView | str:
    """Detect the markers of an image: those with an id in ``known``, or all if ``known`` is None.

    Return the reason as a string if this fails.
    """
    problem = camera.check_image(image)
    if problem:
        return problem
    found = find_markers(image, dictionary, effort=Effort.THOROUGH)
    ids = [d.id for d in found]
    twice = {i for i in ids if ids.count(i) > 1}
    kept = [d for d in found if d.id not in twice and (known is None or d.id in known)]
    if not kept:
        others = sorted(set(ids) - twice)
        reason = "none of the wanted ids" if others else f"no marker of {dictionary}"
        instead = visible_instead(image, dictionary, others)
        return f"{reason} is visible" + (f", but {instead}" if instead else "")
    quads = np.array([d.corners for d in kept])
    edges = refine(image, quads, marker_pattern(dictionary, kept[0].id).shape[0])
    good = edges.good
    if not good.any():
        return "no marker is completely visible"
    rays = straight_corners(camera.rays(edges.points), edges.weights)
    noise = np.hypot(_noise(edges), _LENS_NOISE) / camera.fx
    numbers = np.array([d.id for d in kept], dtype=np.intp)
    return MarkerView(name, numbers[good], rays[good], noise[good])


def _noise(edges: MarkerEdges) -> Array:
    """Compute the standard deviation (M,) of a corner in pixels.

    At the end of a line fitted to n points, the variance is 4 / n times the variance of one point.
    No points are measured near the ends of a side, so a corner lies a tenth of the side's length
    beyond the last point. This increases the factor to 5.3 / n. The factor is even larger because
    the sides are not perpendicular in the image. The factor used, 8 / n, was measured on rendered
    markers.
    """
    number = np.maximum(edges.weights.sum(axis=2).mean(axis=1), 4.0)
    return np.asarray(np.sqrt(8.0 / number) * np.maximum(edges.spread, 0.01))


def calibrate_table(
    views: Sequence[MarkerView],
    sizes: Mapping[int, float],
    dictionary: str,
    focal: float,
) -> TableCalibration:
    """Calibrate the map of the markers in their common frame.

    The frame's origin is the mean marker position, and its x axis the mean marker direction.
    ``sizes`` are in m by id; ``focal`` is the focal length in pixels.

    Raises:
        CalibrationRefused: there are too few markers or images, or no image connects two parts of
        the map.
    """
    views = [view for view in views if len(view.ids) >= 2]
    if len(views) < 2:
        raise CalibrationRefused(
            f"{len(views)} images show two markers or more; at least 2 such images are needed, and "
            "6 from different sides are recommended"
        )
    starts = [_square_up(view, sizes) for view in views]
    ids, markers, poses = _join(views, starts)
    problem = _Problem(views, ids, sizes)
    outliers: list[Outlier] = []
    while True:
        poses, markers = problem.solve(poses, markers)
        errors = problem.errors(poses, markers) * focal
        rms = float(np.sqrt((errors[problem.used] ** 2).mean()))
        limit = max(_STRAY_RATIO * float(np.median(errors[problem.used])), _STRAY_PIXELS)
        worst = int(np.argmax(np.where(problem.used, errors, -1.0)))
        if errors[worst] <= limit:
            break
        which, row = problem.owner[worst]
        outliers.append(Outlier(views[which].name, int(ids[row]), float(errors[worst])))
        problem.used[worst] = False
        if problem.counts()[row] == 0:
            return _without(views, int(ids[row]), float(errors[worst]), sizes, dictionary, focal)
    frame = _middle(markers)
    covariance = problem.covariance(poses, markers)
    markers = compose(inverse(frame), markers)
    turned = np.kron(np.eye(len(ids)), _turn(-frame[2]))
    deviations = np.sqrt(np.diag(turned @ covariance @ turned.T)).reshape(-1, 3)
    unplaced = tuple(ReferenceMarker(int(i), sizes[int(i)], 0.0, 0.0) for i in ids)
    references = with_poses(ReferenceMap(dictionary, unplaced), markers, 1.0)
    seen = problem.counts()
    return TableCalibration(
        references=references,
        deviations=deviations,
        rms=rms,
        seen=seen,
        poses=tuple(poses),
        outliers=tuple(outliers),
        warnings=tuple(_warnings(ids, seen, len(views), outliers)),
    )


def _without(
    views: Sequence[MarkerView],
    marker: int,
    error: float,
    sizes: Mapping[int, float],
    dictionary: str,
    focal: float,
) -> TableCalibration:
    """Repeat the calibration without one marker, because it is an outlier in every image."""
    kept = [
        replace(v, ids=v.ids[own], rays=v.rays[own], noise=v.noise[own])
        for v, own in ((v, v.ids != marker) for v in views)
    ]
    result = calibrate_table(kept, sizes, dictionary, focal)
    sentence = (
        f"marker {marker} is left out, because it is inconsistent with the other markers in every "
        f"image (residual in the last image checked: {error:.1f} pixels); either it does not lie "
        "flat on the table, or its size differs from the given size, or it was moved"
    )
    return replace(result, warnings=(sentence, *result.warnings))


def _middle(markers: Array) -> Array:
    """Compute the common frame of all markers: their mean position and mean direction."""
    angles = markers[:, 2] - markers[0, 2]
    mean = markers[0, 2] + np.angle(np.exp(1j * angles).sum())
    return np.array([*markers[:, :2].mean(axis=0), mean])


def _turn(angle: float) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _square_up(view: MarkerView, sizes: Mapping[int, float]) -> tuple[CameraPose, Array]:
    """Estimate from one image the camera's pose over the plane and the markers' poses (M, 3) on it.

    Each marker gives candidate planes. The plane on which the projections of all markers are
    closest to squares of their size is chosen and then refined by the same criterion.
    """
    side = np.array([sizes[int(i)] for i in view.ids])
    candidates: list[CameraPose] = []
    for row, size in enumerate(side):
        square = np.column_stack([UNIT_CORNERS * size, np.zeros(4)])
        candidates += candidate_poses(square, view.rays[row])
    best = min(candidates, key=lambda pose: float((_squareness(pose, view, side)[0] ** 2).sum()))
    # Refine the plane's tilt and distance; the frame's position in the plane has no effect.
    free = np.eye(6)[[0, 1, 5]]
    for _ in range(20):
        residual, _ = _squareness(best, view, side)
        columns = [
            (_squareness(best.moved(1e-6 * way), view, side)[0] - residual) / 1e-6 for way in free
        ]
        step = -np.linalg.lstsq(np.stack(columns, axis=1), residual, rcond=None)[0]
        best = best.moved(step @ free)
        if float(np.abs(step).max()) < 1e-9:
            break
    return best, _squareness(best, view, side)[1]


def _squareness(pose: CameraPose, view: MarkerView, side: Array) -> tuple[Array, Array]:
    """Fit squares to the corners projected on the plane. Return the residuals (8 M,) relative to
    the sizes of the squares, and the poses (M, 3) of the squares."""
    matrix = np.linalg.inv(pose.plane(0.0))
    homogeneous = view.rays @ matrix[:, :2].T + matrix[:, 2]
    points = homogeneous[..., :2] / homogeneous[..., 2:]
    squares = UNIT_CORNERS * side[:, None, None]
    poses = np.array([rigid(squares[k], points[k]) for k in range(len(squares))])
    left = points - transform_points(poses[:, None], squares)
    return (left / side[:, None, None]).ravel(), poses


def _join(
    views: Sequence[MarkerView], starts: Sequence[tuple[CameraPose, Array]]
) -> tuple[NDArray[np.intp], Array, list[CameraPose]]:
    """Join the maps of the single images to an initial map; return the marker ids, the marker poses
    (M, 3) and the camera poses.

    Raises:
        CalibrationRefused: an image has no marker in common with the other images.
    """
    maps: list[dict[int, Array]] = [
        dict(zip(view.ids.tolist(), poses, strict=True))
        for view, (_, poses) in zip(views, starts, strict=True)
    ]
    first = int(np.argmax([len(each) for each in maps]))
    places = dict(maps[first])
    frames: dict[int, Array] = {first: np.zeros(3)}
    while len(frames) < len(views):
        waiting = [k for k in range(len(views)) if k not in frames]
        shared = {k: [i for i in maps[k] if i in places] for k in waiting}
        best = max(waiting, key=lambda k: len(shared[k]))
        if not shared[best]:
            names = ", ".join(views[k].name for k in waiting[:5])
            raise CalibrationRefused(
                f"{names}: no marker in common with the other images; take further images, each "
                "with markers from these and from the other images"
            )
        here, there = (np.array([m[i] for i in shared[best]]) for m in (maps[best], places))
        if len(here) == 1:
            frame = compose(there[0], inverse(here[0]))
        else:
            frame = rigid(here[:, :2], there[:, :2])
        frames[best] = frame
        for i, pose in maps[best].items():
            places.setdefault(i, compose(frame, pose))
    ids = np.array(sorted(places), dtype=np.intp)
    poses = []
    for k, (start, _) in enumerate(starts):
        # Transform from the table to this image's own plane, and from there to the camera.
        x, y, angle = inverse(frames[k]).tolist()
        shift = start.rotation @ np.array([x, y, 0.0]) + start.translation
        poses.append(CameraPose(start.rotation @ _turn(angle), shift))
    return ids, np.array([places[int(i)] for i in ids]), poses


class _Problem:
    """Least squares problem of the camera and marker poses for the corners of all images."""

    def __init__(
        self, views: Sequence[MarkerView], ids: NDArray[np.intp], sizes: Mapping[int, float]
    ) -> None:
        self.owner = [
            (k, int(np.searchsorted(ids, i))) for k, view in enumerate(views) for i in view.ids
        ]
        self.image = np.array([k for k, _ in self.owner])
        self.marker = np.array([m for _, m in self.owner])
        self.rays = np.concatenate([view.rays for view in views])
        self.noise = np.concatenate([view.noise for view in views])
        self.squares = UNIT_CORNERS * np.array([sizes[int(i)] for i in ids])[:, None, None]
        self.used = np.ones(len(self.owner), dtype=bool)
        self.images, self.markers = len(views), len(ids)

    def counts(self) -> NDArray[np.intp]:
        """Count the images in which each marker is used."""
        return np.bincount(self.marker[self.used], minlength=self.markers)

    def _system(self, poses: Sequence[CameraPose], markers: Array) -> tuple[Array, Array, Array]:
        """Compute normalised residuals (O, 8) and their derivatives with respect to the camera pose
        (O, 8, 6) and the marker pose (O, 8, 3); O is the number of markers in all images."""
        rotation = np.array([pose.rotation for pose in poses])[self.image]
        shift = np.array([pose.translation for pose in poses])[self.image]
        places = markers[self.marker]
        square = self.squares[self.marker]
        points = transform_points(places[:, None], square)
        flat = np.concatenate([points, np.zeros((*points.shape[:2], 1))], axis=-1)
        p = np.einsum("oij,ocj->oci", rotation, flat) + shift[:, None]
        z = p[..., 2]
        u, v = p[..., 0] / z, p[..., 1] / z
        zero = np.zeros_like(z)
        by_point = _matrix([[1.0 / z, zero, -u / z], [zero, 1.0 / z, -v / z]])
        x, y = p[..., 0], p[..., 1]
        cross = _matrix([[zero, z, -y], [-z, zero, x], [y, -x, zero]])
        by_pose = np.concatenate([by_point @ cross, by_point], axis=-1)
        arm = points - places[:, None, :2]
        tangent = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)
        local = np.zeros((*points.shape[:2], 3, 3))
        local[..., 0, 0] = local[..., 1, 1] = 1.0
        local[..., :2, 2] = tangent
        by_marker = by_point @ (rotation[:, None] @ local)
        residual = (self.rays - np.stack([u, v], axis=-1)).reshape(-1, 8)
        scale = self.used / self.noise
        return (
            residual * scale[:, None],
            by_pose.reshape(-1, 8, 6) * scale[:, None, None],
            by_marker.reshape(-1, 8, 3) * scale[:, None, None],
        )

    def errors(self, poses: Sequence[CameraPose], markers: Array) -> Array:
        """Compute the root mean square corner error of each marker in each image, in normalised
        coordinates."""
        used, self.used = self.used, np.ones_like(self.used)
        residual, _, _ = self._system(poses, markers)
        self.used = used
        return np.asarray(np.sqrt((residual**2).sum(axis=1) / 4.0) * self.noise)

    def _normal(self, poses: Sequence[CameraPose], markers: Array) -> tuple[Array, Array, float]:
        residual, by_pose, by_marker = self._system(poses, markers)
        size = 6 * self.images + 3 * self.markers
        matrix, right = np.zeros((size, size)), np.zeros(size)
        for k in range(len(self.owner)):
            a = slice(6 * self.image[k], 6 * self.image[k] + 6)
            begin = 6 * self.images + 3 * self.marker[k]
            b = slice(begin, begin + 3)
            jp, jm, r = by_pose[k], by_marker[k], residual[k]
            matrix[a, a] += jp.T @ jp
            matrix[b, b] += jm.T @ jm
            matrix[a, b] += jp.T @ jm
            matrix[b, a] += jm.T @ jp
            right[a] += jp.T @ r
            right[b] += jm.T @ r
        return matrix, right, float((residual**2).sum())

    def solve(self, poses: Sequence[CameraPose], markers: Array) -> tuple[list[CameraPose], Array]:
        """Minimise by the Levenberg-Marquardt method. The common frame of the markers is not held
        fixed, but it hardly moves during the iterations."""
        poses, damping = list(poses), 1e-6
        matrix, right, cost = self._normal(poses, markers)
        for _ in range(_STEPS):
            step = np.linalg.solve(matrix + np.diag(damping * np.diag(matrix) + 1e-9), right)
            moved = [pose.moved(step[6 * k : 6 * k + 6]) for k, pose in enumerate(poses)]
            shifted = markers + step[6 * self.images :].reshape(-1, 3)
            again = self._normal(moved, shifted)
            if again[2] > cost * (1 + 1e-12):
                damping = max(10.0 * damping, 1e-6)
                if damping > 1e6:
                    break
                continue
            gain = cost - again[2]
            poses, markers, (matrix, right, cost) = moved, shifted, again
            damping *= 0.1
            if gain < 1e-9 * cost:
                break
        return poses, markers

    def covariance(self, poses: Sequence[CameraPose], markers: Array) -> Array:
        """Compute the markers' covariance (3 M, 3 M) relative to their common frame.

        The covariance is scaled up if the residuals exceed the assumed noise.
        """
        matrix, _, cost = self._normal(poses, markers)
        split = 6 * self.images
        reduced = matrix[split:, split:] - matrix[split:, :split] @ np.linalg.solve(
            matrix[:split, :split], matrix[:split, split:]
        )
        values, vectors = np.linalg.eigh(0.5 * (reduced + reduced.T))
        # The images do not determine three combinations of the marker parameters: the two
        # translations and the rotation of the whole table.
        inverse_values = np.concatenate([np.zeros(3), 1.0 / values[3:]])
        free = 8 * int(self.used.sum()) - len(matrix) + 3
        factor = max(1.0, cost / max(free, 1))
        return np.asarray(factor * (vectors * inverse_values) @ vectors.T)


def _matrix(rows: Sequence[Sequence[Array]]) -> Array:
    """Stack entries of the shape (...) into matrices (..., rows, columns)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _warnings(
    ids: NDArray[np.intp], seen: NDArray[np.intp], images: int, outliers: Sequence[Outlier]
) -> list[str]:
    warnings = []
    single_view = [str(i) for i, count in zip(ids, seen, strict=True) if count < 2]
    if single_view:
        warnings.append(
            f"markers {', '.join(single_view)} are seen in only one image: take more images"
        )
    if images < 6:
        warnings.append(
            f"number of images: {images}; take 6 or more from different sides, so that the lens "
            "errors average out"
        )
    for number in sorted({outlier.marker for outlier in outliers}):
        times = sum(outlier.marker == number for outlier in outliers)
        if 2 * times >= times + int(seen[np.searchsorted(ids, number)]):
            warnings.append(
                f"marker {number} is at inconsistent positions in {times} images: was it "
                "moved between them?"
            )
    return warnings
