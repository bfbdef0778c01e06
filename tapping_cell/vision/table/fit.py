"""Fit the camera's pose to a table's reference markers, excluding outliers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, islice

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.vision.camera import Array, CameraModel, CameraPose, at_height
from tapping_cell.vision.markers.edges import MarkerEdges, straight_corners

_BENT = 0.03
"""Typical displacement of a square's sides relative to each other due to lens errors, in pixels."""
_FAR = 4.0
"""Maximum error of an inlier, as a multiple of ``TableSettings.displaced``, if the pose is computed
from only two markers."""
_MAX_PAIRS = 66


@dataclass(frozen=True, slots=True)
class TableSettings:
    """Settings of the table tracker.

    At least ``least_references`` markers must be measured. At most ``memory`` frames are averaged.
    A marker more than ``suspect_shift`` pixels from its average counts as disturbed. A frame in
    which at least half of the markers are disturbed counts as suspect, and after ``confirm_frames``
    suspect frames the camera counts as moved. The table is refused if it has moved by more than
    ``largest_move`` in total (m, measured at the references). A marker that disagrees with the rest
    of the map by more than ``displaced`` pixels is excluded. The common difference between the
    apparent length of all sides and their length in the map may be up to ``bloom`` pixels or
    ``bloom_share`` of a side, whichever is more. A larger difference contradicts the map.
    """

    least_references: int = 2
    memory: int = 150
    suspect_shift: float = 0.25
    confirm_frames: int = 3
    largest_move: float = 0.05
    displaced: float = 1.5
    bloom: float = 2.0
    bloom_share: float = 0.04


@dataclass(frozen=True, slots=True, eq=False)
class TableFit:
    """Result of a table fit.

    Directions are undistorted image coordinates (x / z, y / z). ``pose`` is the camera's pose and
    ``covariance`` (6, 6) the covariance of the six parameters of ``CameraPose.moved``. ``used``
    (M,) marks the inlier markers, and ``residuals`` (U, 4, 2) are the residuals of their corners,
    as directions. ``jacobian`` (8 U, 6) is the derivative of the corners with respect to the pose,
    and ``gain`` (6, 8 U) the derivative of the fitted pose with respect to the corners. ``bloom``
    is the common outward displacement of all markers' sides, in units of directions. ``error`` is
    the largest error of a marker's corners (pixels, root mean square). ``unsquare`` is the standard
    deviation by which the sides deviate from squares in excess of the noise, in units of
    directions.
    """

    pose: CameraPose
    covariance: Array
    used: NDArray[np.bool_]
    residuals: Array
    jacobian: Array
    gain: Array
    bloom: float
    error: float
    unsquare: float


def initial_pose(camera: CameraModel, points: ArrayLike, corners: ArrayLike) -> CameraPose | None:
    """Compute the pose from table points (N, 2) in m and their pixels (N, 2); None if impossible.

    The best of the :func:`candidate_poses` after a refinement by least squares.
    """
    flat = at_height(np.asarray(points, dtype=float).reshape(-1, 2))
    rays = camera.rays(np.asarray(corners, dtype=float).reshape(-1, 2))
    best, least = None, np.inf
    for candidate in candidate_poses(flat, rays):
        for _ in range(4):
            jacobian, residual = _linearised(candidate, flat, rays)
            step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
            candidate = candidate.moved(step)
        _, residual = _linearised(candidate, flat, rays)
        error = float(residual @ residual)
        if candidate.position[2] > 0.0 and error < least:
            best, least = candidate, error
    return best


def candidate_poses(points: Array, rays: Array) -> list[CameraPose]:
    """Compute camera poses from points (N, 3) of a plane, in m, and their directions (N, 2).

    IPPE (Collins and Bartoli) gives both poses between which a distant plane is ambiguous, but it
    fails if the camera looks exactly along the normal. SQPnP (Terzakis and Lourakis) gives one
    pose, also then.
    """
    found = []
    for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):
        number, turns, shifts, _ = cv2.solvePnPGeneric(
            points, rays[:, None], np.eye(3), np.zeros(5), flags=method
        )
        for turn, shift in zip(turns[:number], shifts[:number], strict=True):
            rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=float)
            found.append(CameraPose(rotation, np.asarray(shift, dtype=float).ravel()))
    return found


def reference_rays(camera: CameraModel, edges: MarkerEdges) -> Array:
    """Return the markers' corners as undistorted directions, shape (M, 4, 2)."""
    return straight_corners(camera.rays(edges.points), edges.weights)


def side_noise(edges: MarkerEdges, focal: float) -> Array:
    """Standard deviation (M,) of a side's position, measured perpendicular to the side, in units of
    directions."""
    number = np.maximum(edges.weights.sum(axis=2).mean(axis=1), 4.0)
    return np.asarray(np.maximum(edges.spread, 0.01) / np.sqrt(number) / focal)


def whitening(rays: Array, noise: Array) -> Array:
    """Matrices (M, 8, 8) that whiten the errors of corners (M, 4, 2): they become independent, with
    variance 1.

    The corners are the intersections of four lines, each fitted to a separate side. The positions
    of the lines (standard deviation ``noise`` (M,)) and their rotations are independent. A rotation
    by one standard deviation displaces the ends of a side by the square root of 3 times ``noise``.
    """
    side = np.roll(rays, -1, axis=1) - rays
    side /= np.linalg.norm(side, axis=2, keepdims=True)
    normal = np.stack([side[..., 1], -side[..., 0]], axis=-1) / noise[:, None, None]
    matrices = np.zeros((len(rays), 8, 4, 2))
    for k in range(4):
        begin, end = k, (k + 1) % 4
        matrices[:, 2 * k, [begin, end]] = 0.5 * normal[:, k, None]
        matrices[:, 2 * k + 1, begin] = -0.5 / np.sqrt(3.0) * normal[:, k]
        matrices[:, 2 * k + 1, end] = 0.5 / np.sqrt(3.0) * normal[:, k]
    return matrices.reshape(-1, 8, 8)


def fit_table(
    pose: CameraPose,
    points: Array,
    rays: Array,
    noise: Array,
    settings: TableSettings,
    focal: float,
    used: NDArray[np.bool_] | None = None,
) -> TableFit | None:
    """Fit the pose near ``pose`` that aligns table points (M, 4, 2) with the directions (M, 4, 2).

    ``noise`` (M,) is :func:`side_noise`, ``focal`` the number of pixels per unit of direction. Ink
    bleeding, nonlinear grey levels and stray light displace the sides of all markers outwards or
    inwards by the same unknown amount. This amount is fitted together with the pose. The fit begins
    with the markers in ``used`` (M,), or with all markers. As long as a marker disagrees with the
    rest by more than ``settings.displaced`` pixels, one marker is excluded and the fit is repeated.
    Returns None if fewer than ``settings.least_references`` remain.
    """
    count = points.shape[0]
    flat = at_height(points).reshape(-1, 3)
    used = np.ones(count, dtype=bool) if used is None else used.copy()
    covariance: Array = np.zeros((6, 6))
    white = whitening(rays, noise)
    outwards = np.zeros((count, 8))
    outwards[:, ::2] = 1.0 / noise[:, None]
    while used.sum() >= settings.least_references:
        blooms: Array = outwards[used].ravel()
        blooms = np.asarray(blooms / np.linalg.norm(blooms))
        for _ in range(3):
            jacobian, residual = _linearised(pose, flat, rays.reshape(-1, 2))
            sharp = (white[used] @ jacobian.reshape(count, 8, 6)[used]).reshape(-1, 6)
            weighted: Array = sharp - np.outer(blooms, blooms @ sharp)
            error = (white[used] @ residual.reshape(count, 8, 1)[used]).reshape(-1)
            covariance = np.asarray(np.linalg.inv(weighted.T @ weighted), dtype=np.float64)
            step = covariance @ (weighted.T @ error)
            pose = pose.moved(step)
            if float(np.abs(step).max()) < 1e-7:
                break
        left = (residual - jacobian @ step).reshape(count, 8)
        kept = jacobian.reshape(count, 8, 6)[used]
        bloom = float(
            blooms @ (white[used] @ left[used, :, None]).ravel() / (blooms @ outwards[used].ravel())
        )
        left = left - bloom * np.linalg.solve(white, outwards[..., None])[..., 0]
        off = np.sqrt(2.0 * (left**2).mean(axis=1)) * focal
        worst = float(off[used].max())
        # An outlier can be identified only among three or more markers.
        if used.sum() >= 3 and worst > settings.displaced:
            wrong = _wrong_one(white[used], left[used], weighted.reshape(-1, 8, 6))
            if wrong is not None:
                used[np.flatnonzero(used)[wrong]] = False
                continue
        gain = (
            covariance
            @ (white[used].transpose(0, 2, 1) @ weighted.reshape(-1, 8, 6)).reshape(-1, 6).T
        )
        return TableFit(
            pose,
            np.asarray(covariance),
            used,
            left[used].reshape(-1, 4, 2),
            kept.reshape(-1, 6),
            gain,
            bloom,
            worst,
            _unsquare(white[used], left[used], rays[used], noise[used], _BENT / focal),
        )
    return None


def _wrong_one(white: Array, left: Array, jacobian: Array) -> int | None:
    """Return the index of the marker whose exclusion reduces the sum of the squared residuals the
    most; None if no exclusion halves this sum. ``left`` (M, 8) are the residuals.

    The returned marker need not be the marker with the largest residual, because a marker far from
    the other markers pulls the fit towards itself (its leverage; Cook and Weisberg 1982). ``white``
    is (M, 8, 8) and the whitened ``jacobian`` (M, 8, 6).
    """
    covariance = np.linalg.inv(np.einsum("mki,mkj->ij", jacobian, jacobian))
    error = (white @ left[..., None])[..., 0]
    free = 1.001 * np.eye(8) - jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    explained = (error * np.linalg.solve(free, error[..., None])[..., 0]).sum(axis=1)
    wrong = int(np.argmax(explained))
    return wrong if explained[wrong] > 0.5 * float((error**2).sum()) else None


def consensus(
    camera: CameraModel, points: Array, rays: Array, settings: TableSettings
) -> tuple[CameraPose, NDArray[np.bool_]] | None:
    """Compute a pose in the presence of gross outliers. Return it with a mask (M,) of the inliers.

    The camera's pose is computed from every pair of markers, up to ``_MAX_PAIRS`` pairs, and the
    pose with the most inliers is chosen (Fischler and Bolles 1981, but without random selection).
    Returns None if fewer than three markers, or not a majority of the markers, are inliers.
    """
    count = len(points)
    flat = at_height(points)
    pixels = camera.project(at_height(rays, 1.0))
    best, agreed = None, np.zeros(count, dtype=bool)
    for pair in islice(combinations(range(count), 2), _MAX_PAIRS):
        pose = initial_pose(camera, points[list(pair)], pixels[list(pair)])
        if pose is None:
            continue
        off = np.linalg.norm(camera.project(pose.apply(flat)) - pixels, axis=2).max(axis=1)
        near = off < _FAR * settings.displaced
        if near.sum() > agreed.sum():
            best, agreed = pose, near
    return None if best is None or agreed.sum() < max(3, count // 2 + 1) else (best, agreed)


def _unsquare(white: Array, left: Array, rays: Array, noise: Array, usual: float) -> float:
    """Return the standard deviation, in units of directions, by which the sides of M markers
    deviate from squares in excess of their ``noise`` (M,) and of the ``usual`` deviation.

    The position and rotation of each marker are not considered, because they depend on print and
    lens (:mod:`tapping_cell.vision.table.systematic_error`). The residuals ``left`` (M, 8) of a
    marker's corners have five other degrees of freedom. These contain noise, the small deformation
    of a square by a lens, and errors of the sides due to blur, objects nearby or a shadow. The
    result is 0 if it cannot be distinguished from noise (three standard deviations of chi square).
    """
    count = len(left)
    arm = rays - rays.mean(axis=1, keepdims=True)
    shifts = np.zeros((count, 4, 2, 3))
    shifts[..., 0, 0] = shifts[..., 1, 1] = 1.0
    shifts[..., 0, 2], shifts[..., 1, 2] = -arm[..., 1], arm[..., 0]
    along, _ = np.linalg.qr(white @ shifts.reshape(count, 8, 3))
    error = (white @ left[..., None])[..., 0]
    error = error - (along @ (along.transpose(0, 2, 1) @ error[..., None]))[..., 0]
    total = np.square(noise) + usual**2
    freedom = 5.0 * count - 1.0
    ratio = float((np.square(noise) / total * (error**2).sum(axis=1)).sum()) / freedom
    if ratio <= 1.0 + 3.0 * np.sqrt(2.0 / freedom):
        return 0.0
    return float(np.sqrt((ratio - 1.0) * total.mean()))


def _linearised(pose: CameraPose, points: Array, rays: Array) -> tuple[Array, Array]:
    """Return the Jacobian (2 N, 6) of the directions with respect to the pose, and the residuals
    (2 N,), measured minus predicted."""
    p = pose.apply(points)
    x, y, z = p[:, 0], p[:, 1], p[:, 2]
    u, v = x / z, y / z
    zero = np.zeros_like(z)
    by_u = np.stack([-u * v, 1.0 + u * u, -v, 1.0 / z, zero, -u / z], axis=-1)
    by_v = np.stack([-1.0 - v * v, u * v, u, zero, 1.0 / z, -v / z], axis=-1)
    jacobian = np.stack([by_u, by_v], axis=1).reshape(-1, 6)
    residual = (rays - np.stack([u, v], axis=-1)).reshape(-1)
    return jacobian, residual
