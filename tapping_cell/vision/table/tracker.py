"""Estimate the camera's pose over the table from the averaged reference markers.

While nothing moves, each marker's corners are averaged over the frames and the pose is fitted to
the averages. Every frame is compared with the averages, marker by marker. If at least half of the
markers deviate from their averages in several successive frames, the camera or the table was moved.
The averages are then restarted and the move is reported. The residuals that remain after averaging
are due to lens and printing rather than noise. These residuals determine the systematic error of a
pose measured on this table.
"""

from __future__ import annotations

import enum

import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, CameraModel, CameraPose, View, at_height
from tapping_cell.vision.markers.detection import ReferenceMap
from tapping_cell.vision.markers.edges import MarkerEdges
from tapping_cell.vision.table.fit import (
    TableFit,
    TableSettings,
    consensus,
    fit_table,
    initial_pose,
    reference_rays,
    side_noise,
    whitening,
)
from tapping_cell.vision.table.systematic_error import (
    SystematicError,
    block_diagonal,
    condition,
    lens_shifts,
)

_SIDE_BIAS = 0.0007
"""Standard deviation, in pixels, of the error of an averaged side that depends on the position of
the side within a pixel (measured: 0.0005)."""
_STEP = 0.08
"""Limit in pixels for the case that only two reference markers are used. If the bloom changes by
more than this limit, or the error of the fit increases by more than twice this limit, a marker has
moved, not the camera."""
_EDGE_BIAS = 0.0002
"""Systematic error common to all averaged edges, in pixels (measured: below 0.0002)."""


class TableState(enum.Enum):
    """State of the table according to the reference markers of a frame."""

    UNKNOWN = "unknown"
    STEADY = "steady"
    UNSEEN = "unseen"
    SUSPECT = "suspect"
    MOVED = "moved"
    TOO_FAR = "too far"
    CONTRADICTED = "contradicted"


class TableTracker:
    """Tracks the camera's pose over the table."""

    def __init__(
        self, camera: CameraModel, references: ReferenceMap, settings: TableSettings | None = None
    ) -> None:
        self.camera = camera
        self.settings = settings or TableSettings()
        self.points = references.corners()
        self._deviation = references.deviation
        self.ids = np.array([marker.id for marker in references.markers])
        self.pose: CameraPose | None = None
        self.covariance: Array = np.zeros((6, 6))
        self.used: tuple[int, ...] = ()
        self.displaced: tuple[int, ...] = ()
        self.measured = 0
        """Number of reference markers that were measured in the last frame."""
        self.error = 0.0
        self.bloom = 0.0
        self.side = 0.0
        """Mean length of the reference markers' sides in the image, in pixels."""
        self.side_error = 0.0
        self.apart = False
        self._before: tuple[float, float] | None = None
        self.move = 0.0
        self.field_number = 0
        self._first: CameraPose | None = None
        self._suspects = 0
        self._restart()

    def _restart(self) -> None:
        """Clear the averaged image positions of the markers."""
        count = len(self.ids)
        self._seen = np.zeros(count)
        self._rays = np.zeros((count, 4, 2))
        self._noise = np.zeros(count)
        self._disturbed_frames = np.zeros(count, dtype=int)
        self._moved_markers = np.zeros(count, dtype=bool)
        self._field: SystematicError | None = None
        self._field_frames = 0.0

    def update(self, edges: MarkerEdges, rows: NDArray[np.intp]) -> TableState:
        """Process the reference markers of one frame.

        ``rows`` (M,) are the rows of the markers in the map. All ``edges`` must be good.
        """
        s = self.settings
        self.measured = len(rows)
        if len(rows) < s.least_references:
            return TableState.UNKNOWN if self.pose is None else TableState.UNSEEN
        rays = reference_rays(self.camera, edges)
        disturbed = self._disturbed(rays, rows)
        known = (self._seen[rows] > 0) & ~self._moved_markers[rows]
        apart = int((disturbed & known).sum())
        # On a table with three or more markers, a single disturbed marker does not indicate a
        # motion of the camera: this marker was moved or is partly occluded.
        moving = apart >= min(2, len(self.ids) - 1) and 2 * apart >= known.sum() > 0
        if self.pose is not None and (moving or self._too_many_moved(rows, disturbed)):
            self._suspects += 1
            if self._suspects < s.confirm_frames:
                return TableState.SUSPECT
            if not self.apart:
                self._before = self.bloom, self.error
            self._restart()
            disturbed = np.zeros(len(rows), dtype=bool)
        moved = self._suspects >= s.confirm_frames
        self._suspects = 0
        self._average(rays, side_noise(edges, self.camera.fx), rows, disturbed)
        before = self.pose
        if not self._fit(edges, rows):
            return TableState.UNKNOWN if self.pose is None else TableState.SUSPECT
        assert self.pose is not None
        if self._contradicted(edges):
            return TableState.CONTRADICTED
        if moved and before is not None:
            self.move = self._shift(before, self.pose)
        self._first = self._first or self.pose
        if self._shift(self._first, self.pose) > s.largest_move:
            return TableState.TOO_FAR
        return TableState.MOVED if moved else TableState.STEADY

    @property
    def camera_height(self) -> float:
        """Height of the camera above the table in m; 0 while unknown."""
        return 0.0 if self.pose is None else float(self.pose.position[2])

    def add(self, edges: MarkerEdges, rows: NDArray[np.intp]) -> TableState:
        """Add markers of the first frame that were measured at positions predicted from the other
        markers."""
        rays, noise = reference_rays(self.camera, edges), side_noise(edges, self.camera.fx)
        self._average(rays, noise, rows, np.zeros(len(rows), dtype=bool))
        if not self._fit(edges, rows) or self._contradicted(edges):
            return TableState.CONTRADICTED
        self._first = self.pose
        return TableState.STEADY

    def _disturbed(self, rays: Array, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which of these markers are away from their average positions."""
        shift = np.linalg.norm((rays - self._rays[rows]).mean(axis=1), axis=1) * self.camera.fx
        return np.asarray((self._seen[rows] > 0) & (shift > self.settings.suspect_shift))

    def _too_many_moved(self, rows: NDArray[np.intp], disturbed: NDArray[np.bool_]) -> bool:
        """Return whether so many markers deviate from their averages that they cannot have been
        moved individually.

        Deviations are collected over several frames, because each frame measures only a few of the
        markers.
        """
        apart = self._moved_markers.copy()
        apart[rows] |= disturbed & (self._disturbed_frames[rows] >= self.settings.confirm_frames)
        return int(apart.sum()) > max(1, len(apart) // 4)

    def _average(
        self, rays: Array, noise: Array, rows: NDArray[np.intp], disturbed: NDArray[np.bool_]
    ) -> None:
        self._disturbed_frames[rows] = np.where(disturbed, self._disturbed_frames[rows] + 1, 0)
        # A marker that remains away from its average for more than ``confirm_frames`` frames was
        # moved. Such a marker is ignored until it is back at its place.
        self._moved_markers[rows] = disturbed & (
            self._disturbed_frames[rows] > self.settings.confirm_frames
        )
        kept = rows[~disturbed]
        self._seen[kept] = np.minimum(self._seen[kept] + 1, self.settings.memory)
        share = 1.0 / self._seen[kept]
        self._rays[kept] += share[:, None, None] * (rays[~disturbed] - self._rays[kept])
        self._noise[kept] += share * (noise[~disturbed] - self._noise[kept])

    def _contradicted(self, edges: MarkerEdges) -> bool:
        """Return whether the markers differ so much from the map, in position or size, that neither
        markers nor map are reliable."""
        s = self.settings
        corners = edges.corners
        self.side = float(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).mean())
        limit = max(s.bloom, s.bloom_share * self.side)
        two = len(self.used) <= 2
        # With only two markers, the motion of one marker is difficult to distinguish from a motion
        # of the camera. The motion of one marker changes the apparent size of the markers or the
        # error of the fit; a motion of the camera changes neither.
        self.apart = False
        if two and self._before is not None:
            bloom, error = self._before
            self.apart = abs(self.bloom - bloom) > _STEP or self.error - error > 2.0 * _STEP
        few = self.apart or (two and self.error > s.displaced)
        return few or self.error > 3.0 * s.displaced or 2.0 * abs(self.bloom) > limit

    def _fit(self, edges: MarkerEdges, rows: NDArray[np.intp]) -> bool:
        """Fit pose, covariances and lists of markers to the averages; return False on failure."""
        have = np.flatnonzero((self._seen > 0) & ~self._moved_markers)
        start = self.pose or initial_pose(self.camera, self.points[rows], edges.corners)
        if start is None or len(have) < self.settings.least_references:
            return False
        noise = np.hypot(self._noise[have] / np.sqrt(self._seen[have]), _SIDE_BIAS / self.camera.fx)
        points, rays, focal = self.points[have], self._rays[have], self.camera.fx
        fit = fit_table(start, points, rays, noise, self.settings, focal)
        if fit is not None and fit.error > self.settings.displaced and len(have) >= 3:
            # Least squares could not identify the outlier, because a gross outlier makes all
            # residuals large.
            agreed = consensus(self.camera, points, rays, self.settings)
            if agreed is not None:
                pose, used = agreed
                fit = fit_table(pose, points, rays, noise, self.settings, focal, used)
        unsquare = 0.0 if fit is None else fit.unsquare
        if fit is not None and unsquare > 0.0:
            noise = np.hypot(noise, unsquare)
            fit = fit_table(fit.pose, points, rays, noise, self.settings, focal, fit.used)
        if fit is None:
            return False
        before = self.used
        self.pose, self.covariance = fit.pose, fit.covariance
        self.error, self.bloom = fit.error, fit.bloom * self.camera.fx
        self.side_error = unsquare * self.camera.fx
        self.used = tuple(int(i) for i in self.ids[have[fit.used]])
        wrong = self._moved_markers.copy()
        wrong[have[~fit.used]] = True
        self.displaced = tuple(int(i) for i in self.ids[wrong])
        frames = float(self._seen.sum())
        if self._field is None or frames >= 1.25 * self._field_frames or self.used != before:
            self._field_frames = frames
            self._field = self._condition(fit, points, rays, noise)
            self.field_number += 1
        return True

    def _shift(self, before: CameraPose, after: CameraPose) -> float:
        """Maximum displacement, in m, of the references' corners in the camera's frame."""
        flat = at_height(self.points)
        return float(np.linalg.norm(after.apply(flat) - before.apply(flat), axis=-1).max())

    def _condition(
        self, fit: TableFit, points: Array, rays: Array, noise: Array
    ) -> SystematicError:
        """Model the systematic error over the table from the residuals of the markers."""
        view = View(self.camera, fit.pose)
        seen, shifts = lens_shifts(view, points[fit.used], 0.0)
        count = int(fit.used.sum())
        # For each corner, compute the derivative of the position on the table with respect to the
        # direction of the ray. This derivative differs between corners if the view is oblique.
        ahead = seen.reshape(-1, 1, 2) + 1e-6 * np.eye(2)
        lengths = (view.rays_on_plane(ahead) - points[fit.used].reshape(-1, 1, 2)) / 1e-6
        block = block_diagonal(lengths.transpose(0, 2, 1))
        white = whitening(rays[fit.used], noise[fit.used])
        noises = np.asarray(np.linalg.inv(white.transpose(0, 2, 1) @ white), dtype=float)
        still = block_diagonal(noises)
        return condition(
            points[fit.used],
            (block @ fit.residuals.reshape(-1)).reshape(-1, 4, 2),
            block @ still @ block.T,
            block @ shifts.reshape(8 * count, -1),
            block @ fit.jacobian,
            fit.gain @ np.linalg.inv(block),
            stated=bool(self.camera.deviations),
        )

    def judge(self, points: Array, height: float) -> tuple[Array, Array]:
        """Systematic error of a pose (x, y, theta) measured at ``height`` from ``points`` (N, 2).

        Returns the expected error (3,) and the covariance (3, 3) of the remaining error due to the
        camera's pose, the lens and the printing. The noise of the object's marker is not included.
        """
        assert self.pose is not None and self._field is not None
        view = View(self.camera, self.pose)
        response = -pose_jacobian(view, points, height)
        rays, shifts = lens_shifts(view, points, height)
        shifted = view.rays_on_plane(np.moveaxis(rays[..., None] + shifts, -1, 0), height)
        lens = pose_changes(points, shifted - points).T
        error, covariance = self._field.at(response, lens)
        pixel = float(self.pose.translation[2]) / self.camera.fx
        floor = (_EDGE_BIAS * pixel) ** 2
        covariance = covariance + np.diag([floor, floor, 0.0])
        return error, covariance + self._stretched(points.mean(axis=0))

    def _stretched(self, place: Array) -> Array:
        """Covariance (3, 3) of a pose at ``place`` (2,) due to the errors of a measured map.

        If the same camera measured the map, the effects of the lens and of the markers' printed
        size are the same in the map and in this measurement, so the residuals do not show the
        errors of the map. These errors are modelled as a common stretch, shear and rotation about
        the markers' centre.
        """
        middles = self.points.mean(axis=1)
        arm = place - middles.mean(axis=0)
        square = float(((middles - middles.mean(axis=0)) ** 2).sum(axis=1).mean())
        reach = float(arm @ arm)
        turned = 0.5 * np.array([-arm[1], arm[0]])
        spread = np.array(
            [[reach, 0.0, turned[0]], [0.0, reach, turned[1]], [turned[0], turned[1], 0.5]]
        )
        return np.asarray(spread * self._deviation**2 / square)


def pose_changes(points: Array, shifts: Array) -> Array:
    """Return the change (..., 3) of a pose (x, y, theta) that is fitted to points (N, 2), if these
    points are displaced by ``shifts`` (..., N, 2)."""
    arm = points - points.mean(axis=0)
    turn = (arm[:, 0] * shifts[..., 1] - arm[:, 1] * shifts[..., 0]).sum(axis=-1)
    return np.concatenate([shifts.mean(axis=-2), (turn / (arm**2).sum())[..., None]], axis=-1)


def pose_jacobian(view: View, points: Array, height: float) -> Array:
    """Jacobian (3, 6) of a measured pose (x, y, theta) with respect to the camera's pose.

    The pose is measured from ``points`` (N, 2) at ``height``. The Jacobian is computed by finite
    differences with steps of 1e-6 in rotation (rad) and translation (m).
    """
    seen = view.pose.apply(at_height(points, height))
    rays = seen[:, :2] / seen[:, 2:]
    shifts = []
    for step in 1e-6 * np.eye(6):
        ahead, back = (
            View(view.camera, view.pose.moved(sign * step)).rays_on_plane(rays, height)
            for sign in (1.0, -1.0)
        )
        shifts.append((ahead - back) / 2e-6)
    return pose_changes(points, np.stack(shifts)).T
