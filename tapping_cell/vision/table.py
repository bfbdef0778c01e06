"""Where the camera is over the table: from the reference markers, averaged while it is steady.

While nothing moves, each marker's corners are averaged over the frames and the pose is fitted to
the averages. Every frame is compared with the averages, marker by marker: when most of the markers
of several frames in a row lie elsewhere, the camera or the table was moved; the averages start anew
and the move is reported. What the markers still disagree about after averaging is no noise but lens
and printing, and says how wrong a pose measured on this table may be.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.se2 import transform_points
from tapping_cell.vision.camera import Array, CameraModel, CameraPose, View
from tapping_cell.vision.edges import MarkerEdges, straight_corners
from tapping_cell.vision.field import ErrorField, condition, lens_shifts
from tapping_cell.vision.markers import ReferenceMap

_SIDE_BIAS = 0.0007
"""Pixels that an averaged side may be off by where it lies between pixels (measured: 0.0005)."""
_EDGE_BIAS = 0.0002
"""Pixels that all averaged edges may be off by together (measured: below 0.0002)."""


@dataclass(frozen=True, slots=True)
class TableSettings:
    """``least_references`` markers must be seen; ``memory`` frames are averaged at most.

    A marker that lies more than ``suspect_shift`` pixels from its average was disturbed; when half
    of a frame's are, the frame is suspect, and after ``confirm_frames`` of them the camera counts
    as moved. ``largest_move`` (m, seen at the references, all moves together) is how far it may be
    before the table is refused. A marker that disagrees with the rest of the map by more than
    ``displaced`` pixels is left out.
    """

    least_references: int = 2
    memory: int = 150
    suspect_shift: float = 0.25
    confirm_frames: int = 3
    largest_move: float = 0.05
    displaced: float = 1.5


class TableState(enum.Enum):
    """What the reference markers of a frame say."""

    UNKNOWN = "unknown"
    STEADY = "steady"
    UNSEEN = "unseen"
    SUSPECT = "suspect"
    MOVED = "moved"
    TOO_FAR = "too far"


@dataclass(frozen=True, slots=True, eq=False)
class TableFit:
    """A pose of the camera, its covariance (6, 6) for steps of ``CameraPose.moved``, which markers
    agree (``used``, (M,)), what is left of the corners of these, as directions (U, 4, 2), how those
    answer a step of the pose (8 U, 6) and the step that the fit makes of them (6, 8 U).
    """

    pose: CameraPose
    covariance: Array
    used: NDArray[np.bool_]
    residuals: Array
    jacobian: Array
    gain: Array


def initial_pose(camera: CameraModel, points: ArrayLike, corners: ArrayLike) -> CameraPose | None:
    """Pose from table points (N, 2) in m and their pixels (N, 2); None if it cannot be.

    Planar pose (Collins and Bartoli, IPPE, as OpenCV has it), then least squares.
    """
    p = np.asarray(points, dtype=float).reshape(-1, 2)
    flat = np.column_stack([p, np.zeros(len(p))])
    rays = camera.rays(np.asarray(corners, dtype=float).reshape(-1, 2))
    eye = np.eye(3)
    number, turns, shifts, _ = cv2.solvePnPGeneric(
        flat, rays[:, None], eye, np.zeros(5), flags=cv2.SOLVEPNP_IPPE
    )
    best, least = None, np.inf
    for turn, shift in zip(turns[:number], shifts[:number], strict=True):
        rotation, _ = cv2.Rodrigues(turn)
        candidate = CameraPose(np.asarray(rotation, dtype=float), np.asarray(shift, float).ravel())
        for _ in range(4):
            jacobian, residual = _linearised(candidate, flat, rays)
            step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
            candidate = candidate.moved(step)
        _, residual = _linearised(candidate, flat, rays)
        error = float(residual @ residual)
        if candidate.position[2] > 0.0 and error < least:
            best, least = candidate, error
    return best


def reference_rays(camera: CameraModel, edges: MarkerEdges) -> Array:
    """Corners of the markers as undistorted directions, shape (M, 4, 2)."""
    return straight_corners(camera.rays(edges.points), edges.weights)


def side_noise(edges: MarkerEdges, focal: float) -> Array:
    """Standard deviation (M,) of the place of a side, across it, as a direction."""
    number = np.maximum(edges.weights.sum(axis=2).mean(axis=1), 4.0)
    return np.asarray(np.maximum(edges.spread, 0.01) / np.sqrt(number) / focal)


def whitening(rays: Array, noise: Array) -> Array:
    """Matrices (M, 8, 8) that take errors of corners (M, 4, 2) to eight independent ones of
    variance 1.

    The corners are where four lines meet, each fitted to a side of its own: independent are the
    places of the lines (``noise`` (M,)) and their turns, which at the ends of the side weigh root
    three times as much.
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
) -> TableFit | None:
    """The pose near ``pose`` that brings table points (M, 4, 2) onto the directions (M, 4, 2).

    ``noise`` (M,) is :func:`side_noise`, ``focal`` pixels a unit of direction. One marker after
    another is left out while it disagrees with the rest by more than ``settings.displaced`` pixels.
    None if fewer than ``settings.least_references`` remain.
    """
    count = points.shape[0]
    flat = np.concatenate([points, np.zeros((count, 4, 1))], axis=-1).reshape(-1, 3)
    used = np.ones(count, dtype=bool)
    covariance: Array = np.zeros((6, 6))
    white = whitening(rays, noise)
    while used.sum() >= settings.least_references:
        for _ in range(2):
            jacobian, residual = _linearised(pose, flat, rays.reshape(-1, 2))
            weighted = (white[used] @ jacobian.reshape(count, 8, 6)[used]).reshape(-1, 6)
            error = (white[used] @ residual.reshape(count, 8, 1)[used]).reshape(-1)
            covariance = np.linalg.inv(weighted.T @ weighted)
            step = covariance @ (weighted.T @ error)
            pose = pose.moved(step)
            if float(np.abs(step).max()) < 1e-7:
                break
        left = (residual - jacobian @ step).reshape(count, 4, 2)
        error = np.sqrt((left**2).sum(axis=2).mean(axis=1)) * focal
        # Only with three or more can it be said which one is wrong.
        worst = int(np.argmax(np.where(used, error, -1.0)))
        others = used.copy()
        others[worst] = False
        limit = max(settings.displaced, 3.0 * float(np.median(error[others])) if count > 1 else 0.0)
        if used.sum() >= 3 and error[worst] > limit:
            used = others
            continue
        kept = jacobian[np.repeat(used, 8)]
        weights = white[used]
        gain = (
            covariance @ (weights.transpose(0, 2, 1) @ weighted.reshape(-1, 8, 6)).reshape(-1, 6).T
        )
        return TableFit(pose, np.asarray(covariance), used, left[used], kept, gain)
    return None


def _linearised(pose: CameraPose, points: Array, rays: Array) -> tuple[Array, Array]:
    """Jacobian (2 N, 6) of the directions to a step of the pose, and measured minus predicted."""
    p = pose.apply(points)
    x, y, z = p[:, 0], p[:, 1], p[:, 2]
    u, v = x / z, y / z
    zero = np.zeros_like(z)
    by_u = np.stack([-u * v, 1.0 + u * u, -v, 1.0 / z, zero, -u / z], axis=-1)
    by_v = np.stack([-1.0 - v * v, u * v, u, zero, 1.0 / z, -v / z], axis=-1)
    jacobian = np.stack([by_u, by_v], axis=1).reshape(-1, 6)
    residual = (rays - np.stack([u, v], axis=-1)).reshape(-1)
    return jacobian, residual


class TableTracker:
    """Keeps the camera's pose over the table from frame to frame."""

    def __init__(
        self, camera: CameraModel, references: ReferenceMap, settings: TableSettings | None = None
    ) -> None:
        self.camera = camera
        self.settings = settings or TableSettings()
        self.points = references.corners()
        self.ids = np.array([marker.id for marker in references.markers])
        self.pose: CameraPose | None = None
        self.covariance: Array = np.zeros((6, 6))
        self.used: tuple[int, ...] = ()
        self.displaced: tuple[int, ...] = ()
        self.move = 0.0
        self.field_number = 0
        self._first: CameraPose | None = None
        self._suspects = 0
        self._restart()

    def _restart(self) -> None:
        """Forget where the markers were in the image."""
        count = len(self.ids)
        self._seen = np.zeros(count)
        self._rays = np.zeros((count, 4, 2))
        self._noise = np.zeros(count)
        self._strayed = np.zeros(count, dtype=int)
        self._field: ErrorField | None = None
        self._field_frames = 0.0

    def update(self, edges: MarkerEdges, rows: NDArray[np.intp]) -> TableState:
        """Take one frame's references: ``rows`` (M,) of the map that ``edges`` (good ones) belong
        to."""
        s = self.settings
        if len(rows) < s.least_references:
            return TableState.UNKNOWN if self.pose is None else TableState.UNSEEN
        rays = reference_rays(self.camera, edges)
        disturbed = self._disturbed(rays, rows)
        known = self._seen[rows] > 0
        if self.pose is not None and known.any() and 2 * disturbed.sum() >= known.sum():
            self._suspects += 1
            if self._suspects < s.confirm_frames:
                return TableState.SUSPECT
            self._restart()
            disturbed = np.zeros(len(rows), dtype=bool)
        moved = self._suspects >= s.confirm_frames
        self._suspects = 0
        self._average(rays, side_noise(edges, self.camera.fx), rows, disturbed)
        before = self.pose
        if not self._fit(edges, rows):
            return TableState.UNKNOWN if self.pose is None else TableState.SUSPECT
        assert self.pose is not None
        if moved and before is not None:
            self.move = self._shift(before, self.pose)
        self._first = self._first or self.pose
        if self._shift(self._first, self.pose) > s.largest_move:
            return TableState.TOO_FAR
        return TableState.MOVED if moved else TableState.STEADY

    def _disturbed(self, rays: Array, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which of these markers lie elsewhere than on average."""
        shift = np.linalg.norm((rays - self._rays[rows]).mean(axis=1), axis=1) * self.camera.fx
        return np.asarray((self._seen[rows] > 0) & (shift > self.settings.suspect_shift))

    def _average(
        self, rays: Array, noise: Array, rows: NDArray[np.intp], disturbed: NDArray[np.bool_]
    ) -> None:
        self._strayed[rows] = np.where(disturbed, self._strayed[rows] + 1, 0)
        # One marker alone that stays elsewhere was itself moved: its average starts anew.
        anew = self._strayed[rows] > self.settings.confirm_frames
        self._seen[rows[anew]] = 0
        take = ~disturbed | anew
        kept = rows[take]
        self._seen[kept] = np.minimum(self._seen[kept] + 1, self.settings.memory)
        share = 1.0 / self._seen[kept]
        self._rays[kept] += share[:, None, None] * (rays[take] - self._rays[kept])
        self._noise[kept] += share * (noise[take] - self._noise[kept])

    def _fit(self, edges: MarkerEdges, rows: NDArray[np.intp]) -> bool:
        """Pose, covariances and the lists of markers from the averages; False if there is none."""
        have = np.flatnonzero(self._seen)
        start = self.pose or initial_pose(self.camera, self.points[rows], edges.corners)
        if start is None or len(have) < self.settings.least_references:
            return False
        noise = np.hypot(self._noise[have] / np.sqrt(self._seen[have]), _SIDE_BIAS / self.camera.fx)
        fit = fit_table(
            start, self.points[have], self._rays[have], noise, self.settings, self.camera.fx
        )
        if fit is None:
            return False
        before = self.used
        self.pose, self.covariance = fit.pose, fit.covariance
        self.used = tuple(int(i) for i in self.ids[have[fit.used]])
        self.displaced = tuple(int(i) for i in self.ids[have[~fit.used]])
        frames = float(self._seen.sum())
        if self._field is None or frames >= 1.25 * self._field_frames or self.used != before:
            self._field_frames = frames
            self._field = self._condition(fit, self.points[have], self._rays[have], noise)
            self.field_number += 1
        return True

    def _shift(self, before: CameraPose, after: CameraPose) -> float:
        """Largest distance, in m, that the references' corners move in the camera's frame."""
        flat = np.concatenate([self.points, np.zeros((*self.points.shape[:2], 1))], axis=-1)
        return float(np.linalg.norm(after.apply(flat) - before.apply(flat), axis=-1).max())

    def _condition(self, fit: TableFit, points: Array, rays: Array, noise: Array) -> ErrorField:
        """The error of the lens over the table, from what the markers still disagree about."""
        scale = float(fit.pose.translation[2])
        # Directions to lengths on the table, which lies nearly square to the optical axis.
        to_table: Array = np.asarray(scale * fit.pose.rotation[:2, :2].T)
        count = int(fit.used.sum())
        block: Array = np.asarray(np.kron(np.eye(4 * count), to_table))
        _, shifts = lens_shifts(View(self.camera, fit.pose), points[fit.used], 0.0)
        still: Array = np.zeros((8 * count, 8 * count))
        white = whitening(rays[fit.used], noise[fit.used])
        for k in range(count):
            part = slice(8 * k, 8 * k + 8)
            still[part, part] = np.linalg.inv(white[k].T @ white[k])
        return condition(
            points[fit.used],
            fit.residuals @ to_table.T,
            block @ still @ block.T,
            block @ shifts.reshape(8 * count, -1),
            block @ fit.jacobian,
            fit.gain @ np.linalg.inv(block),
            stated=bool(self.camera.deviations),
        )

    def judge(self, pose: ArrayLike, height: float) -> tuple[Array, Array]:
        """Likely error (3,) of a pose (x, y, theta) measured at ``height``, and covariance (3, 3)
        of what remains of it: the camera's pose, lens, printing; not the noise of the object's
        marker.
        """
        assert self.pose is not None and self._field is not None
        place = np.asarray(pose, dtype=float)
        view = View(self.camera, self.pose)
        response = -pose_jacobian(view, place, height)
        points = transform_points(place, CROSS)
        rays, shifts = lens_shifts(view, points, height)
        shifted = view.rays_on_plane(np.moveaxis(rays[..., None] + shifts, -1, 0), height)
        lens = pose_changes(points, shifted - points).T
        error, covariance = self._field.at(response, lens)
        pixel = float(self.pose.translation[2]) / self.camera.fx
        floor = (_EDGE_BIAS * pixel) ** 2
        return error, covariance + np.diag([floor, floor, 0.0])


CROSS = 0.02 * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Points (4, 2) in m around an object's middle that stand for its marker where it is shifted,
turned and sheared: a fit to all sides of a square turns by the mean of what its sides turn."""


def pose_changes(points: Array, shifts: Array) -> Array:
    """Change (..., 3) of the pose (x, y, theta) fitted to points (N, 2) that shift by (..., N,
    2)."""
    arm = points - points.mean(axis=0)
    turn = (arm[:, 0] * shifts[..., 1] - arm[:, 1] * shifts[..., 0]).sum(axis=-1)
    return np.concatenate([shifts.mean(axis=-2), (turn / (arm**2).sum())[..., None]], axis=-1)


def pose_jacobian(view: View, object_pose: ArrayLike, height: float) -> Array:
    """How a measured pose (x, y, theta) of the plane at ``height`` answers a step of the camera's
    pose.

    Shape (3, 6); by differences of 1e-6 in steps of rotation (rad) and translation (m).
    """
    points = transform_points(object_pose, CROSS)
    seen = view.pose.apply(np.column_stack([points, np.full(len(points), height)]))
    rays = seen[:, :2] / seen[:, 2:]
    shifts = []
    for step in 1e-6 * np.eye(6):
        ahead, back = (
            View(view.camera, view.pose.moved(sign * step)).rays_on_plane(rays, height)
            for sign in (1.0, -1.0)
        )
        shifts.append((ahead - back) / 2e-6)
    return pose_changes(points, np.stack(shifts)).T
