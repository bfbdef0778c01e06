"""Where the camera is over the table: from the reference markers, frame by frame, fused while steady.

The pose is corrected by small steps (rotation vector and translation in camera axes, see
``CameraPose.moved``); steps of frames are averaged with their information while they agree. When
several frames in a row disagree with the average, the camera or the table was moved: the average
starts anew and the move is reported. What the reference markers still disagree about after averaging
is no noise but lens and printing, and says how wrong a pose on this table may be.
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
from tapping_cell.vision.markers import ReferenceMap


@dataclass(frozen=True, slots=True)
class TableSettings:
    """``least_references`` markers must be seen; ``memory`` frames are averaged at most.

    A frame is suspect when it moves a reference by more than ``suspect_shift`` pixels and the shift is
    significant; after ``confirm_frames`` of them the camera counts as moved. ``largest_move`` (m, seen
    at the references) is how far that may be, all moves together, before the table is refused.
    """

    least_references: int = 2
    memory: int = 150
    suspect_shift: float = 0.25
    confirm_frames: int = 3
    largest_move: float = 0.05
    displaced: float = 1.5
    """Pixels that one reference may differ from the others before it is left out."""


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
    """A pose of the camera from one frame: the step from the start, its information (6, 6) and ``used``
    (M,) which references agree; ``residuals`` (M, 4, 2) of the corners as directions.
    """

    step: Array
    information: Array
    used: NDArray[np.bool_]
    residuals: Array


def initial_pose(camera: CameraModel, points: ArrayLike, corners: ArrayLike) -> CameraPose | None:
    """Pose from table points (N, 2) in m and their pixels (N, 2); None if it cannot be.

    Planar pose (Collins and Bartoli, IPPE, as OpenCV has it), then least squares.
    """
    p = np.asarray(points, dtype=float).reshape(-1, 2)
    flat = np.column_stack([p, np.zeros(len(p))])
    rays = camera.rays(np.asarray(corners, dtype=float).reshape(-1, 2))
    eye = np.eye(3)
    number, turns, shifts, _ = cv2.solvePnPGeneric(
        flat, rays[:, None], eye, None, flags=cv2.SOLVEPNP_IPPE
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


def fit_table(
    pose: CameraPose, points: Array, rays: Array, noise: Array, settings: TableSettings, focal: float
) -> TableFit | None:
    """Step from ``pose`` that brings table points (M, 4, 2) onto the directions (M, 4, 2).

    ``noise`` (M,) is the standard deviation of a corner as a direction. One reference after another
    is left out while it disagrees with the rest by more than ``settings.displaced`` pixels. None if
    fewer than ``settings.least_references`` remain.
    """
    count = points.shape[0]
    flat = np.concatenate([points, np.zeros((count, 4, 1))], axis=-1).reshape(-1, 3)
    jacobian, residual = _linearised(pose, flat, rays.reshape(-1, 2))
    jacobian, residual = jacobian.reshape(count, 8, 6), residual.reshape(count, 8)
    weight = 1.0 / noise**2
    used = np.ones(count, dtype=bool)
    while used.sum() >= settings.least_references:
        information = np.einsum("m,mri,mrj->ij", weight[used], jacobian[used], jacobian[used])
        vector = np.einsum("m,mri,mr->i", weight[used], jacobian[used], residual[used])
        step = np.linalg.solve(information, vector)
        left = (residual - jacobian @ step).reshape(count, 4, 2)
        error = np.sqrt((left**2).sum(axis=2).mean(axis=1)) * focal
        # Only with three or more can it be said which one is wrong.
        worst = int(np.argmax(np.where(used, error, -1.0)))
        others = used.copy()
        others[worst] = False
        if used.sum() >= 3 and error[worst] > max(
            settings.displaced, 3.0 * float(np.median(error[others]))
        ):
            used = others
            continue
        return TableFit(step, information, used, left)
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
        self.references = references
        self.settings = settings or TableSettings()
        self.points = references.corners()
        self.ids = np.array([marker.id for marker in references.markers])
        self.pose: CameraPose | None = None
        self.covariance = np.zeros((6, 6))
        self.systematic = np.zeros((3, 3))
        self.used: tuple[int, ...] = ()
        self.displaced: tuple[int, ...] = ()
        self.move = 0.0
        self._first: CameraPose | None = None
        self._suspects = 0
        self._restart()

    def _restart(self) -> None:
        self.frames = 0
        self._information = np.zeros((6, 6))
        self._seen = np.zeros(len(self.ids))
        self._residuals = np.zeros((len(self.ids), 4, 2))

    def update(self, edges: MarkerEdges, rows: NDArray[np.intp]) -> TableState:
        """Take one frame's references: ``rows`` (M,) of the map that ``edges`` (good ones) belong to."""
        s = self.settings
        if len(rows) < s.least_references:
            return TableState.UNSEEN if self.pose is not None else TableState.UNKNOWN
        rays = reference_rays(self.camera, edges)
        if self.pose is None:
            found = initial_pose(self.camera, self.points[rows], edges.corners)
            if found is None:
                return TableState.UNKNOWN
            self.pose = found
            for _ in range(2):
                fit = self._fit(rays, edges, rows)
                if fit is None:
                    self.pose = None
                    return TableState.UNKNOWN
                self.pose = self.pose.moved(fit.step)
            self._first = self._first or self.pose
        fit = self._fit(rays, edges, rows)
        if fit is None:
            return TableState.SUSPECT
        if self.frames and self._disagrees(fit):
            self._suspects += 1
            if self._suspects < s.confirm_frames:
                return TableState.SUSPECT
            return self._moved(fit, rows)
        self._suspects = 0
        self._take(fit, rows)
        if self._distance_from_first() > s.largest_move:
            return TableState.TOO_FAR
        return TableState.STEADY

    def _fit(self, rays: Array, edges: MarkerEdges, rows: NDArray[np.intp]) -> TableFit | None:
        assert self.pose is not None
        number = np.maximum(edges.weights.sum(axis=2).mean(axis=1), 4.0)
        # The end of a line through n points has 4 / n of the variance of one; the levels beside the
        # edge, estimated from the same rows, add about as much again (measured).
        noise = np.sqrt(8.0 / number) * np.maximum(edges.spread, 0.01) / self.camera.fx
        return fit_table(
            self.pose, self.points[rows], rays, noise, self.settings, self.camera.fx
        )

    def _disagrees(self, fit: TableFit) -> bool:
        """Is this frame's step from the average significant and large enough to matter?"""
        assert self.pose is not None
        shift = self._shift(self.pose, self.pose.moved(fit.step)) * self.camera.fx
        if shift < self.settings.suspect_shift * self.pose.translation[2]:
            return False
        spread = np.linalg.inv(fit.information) + self.covariance
        # 6 degrees of freedom: 50 is exceeded by chance once in 200 million frames.
        return float(fit.step @ np.linalg.solve(spread, fit.step)) > 50.0

    def _shift(self, before: CameraPose, after: CameraPose) -> float:
        """Largest distance, in m, that the references' corners move in the camera's frame."""
        flat = np.concatenate([self.points, np.zeros((*self.points.shape[:2], 1))], axis=-1)
        return float(np.linalg.norm(after.apply(flat) - before.apply(flat), axis=-1).max())

    def _distance_from_first(self) -> float:
        assert self.pose is not None and self._first is not None
        return self._shift(self._first, self.pose)

    def _moved(self, fit: TableFit, rows: NDArray[np.intp]) -> TableState:
        assert self.pose is not None
        before = self.pose
        self._restart()
        self._suspects = 0
        self._take(fit, rows)
        assert self.pose is not None
        self.move = self._shift(before, self.pose)
        if self._distance_from_first() > self.settings.largest_move:
            return TableState.TOO_FAR
        return TableState.MOVED

    def _take(self, fit: TableFit, rows: NDArray[np.intp]) -> None:
        assert self.pose is not None
        self.frames = min(self.frames + 1, self.settings.memory)
        if self.frames == self.settings.memory:
            self._information *= 1.0 - 1.0 / self.settings.memory
        self._information = self._information + fit.information
        self.pose = self.pose.moved(np.linalg.solve(self._information, fit.information @ fit.step))
        self.covariance = np.linalg.inv(self._information)
        kept = rows[fit.used]
        self.used = tuple(int(i) for i in self.ids[kept])
        self.displaced = tuple(int(i) for i in self.ids[rows[~fit.used]])
        self._seen[kept] = np.minimum(self._seen[kept] + 1, self.settings.memory)
        share = (1.0 / self._seen[kept])[:, None, None]
        self._residuals[kept] += share * (fit.residuals[fit.used] - self._residuals[kept])
        self.systematic = self._systematic()

    def _systematic(self) -> Array:
        """Covariance (3, 3) of a pose on the table by what the references disagree about.

        Each reference, measured as if it were the object, misses its place in the map; with eight of
        them and 6 unknowns of the camera the spread is inflated as Student's distribution asks.
        """
        assert self.pose is not None
        known = self._seen > 0
        number = int(known.sum())
        if number < 3:
            return np.zeros((3, 3))
        scale = float(self.pose.translation[2])
        left = self._residuals[known] * scale @ self.pose.rotation[:2, :2]
        shift = left.mean(axis=1)
        arm = self.points[known] - self.points[known].mean(axis=1, keepdims=True)
        moment = (arm[..., 0] * left[..., 1] - arm[..., 1] * left[..., 0]).sum(axis=1)
        turn = moment / (arm**2).sum(axis=(1, 2))
        freedom = max(2.0 * number - 5.0, 1.0)
        place = float((shift**2).sum()) / freedom
        angle = float((turn**2).sum()) / max(number - 1.0, 1.0)
        heavy_tails = freedom / max(freedom - 2.0, 1.0)
        return np.diag([place, place, angle]) * heavy_tails


def pose_jacobian(view: View, object_pose: ArrayLike, height: float) -> Array:
    """How a measured pose (x, y, theta) of the plane at ``height`` answers a step of the camera's pose.

    Shape (3, 6); by differences of 1e-6 in steps of rotation (rad) and translation (m).
    """
    arm = np.array([[0.0, 0.0], [0.02, 0.0]])
    seen = view.pose.apply(
        np.column_stack([transform_points(object_pose, arm), np.full(2, height)])
    )
    rays = seen[:, :2] / seen[:, 2:]
    columns = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ends = [
            View(view.camera, view.pose.moved(sign * step)).rays_on_plane(rays, height)
            for sign in (1.0, -1.0)
        ]
        change = (ends[0] - ends[1]) / 2e-6
        direction = transform_points(object_pose, arm[1]) - transform_points(object_pose, arm[0])
        turned = change[1] - change[0]
        angle = (direction[0] * turned[1] - direction[1] * turned[0]) / (direction @ direction)
        columns.append([change[0, 0], change[0, 1], angle])
    return np.array(columns).T

