"""Camera model, camera pose over the table, and intersection of rays with planes.

The model is a pinhole with lens distortion. Model and coefficients are those of OpenCV and of ROS's
``camera_info`` (``plumb_bob``: k1 k2 p1 p2 k3; ``rational_polynomial``: k1 k2 p1 p2 k3 k4 k5 k6
and, if present, thin prism and tilt). Pixel coordinates are measured from the centre of the top
left pixel, x to the right, y down. In the optical frame, z points forward (REP-103).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_LENGTHS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8, 12, 14)}
# The 60 fixed-point iterations reduce the error by 12 decimal digits if every iteration reduces it
# to 63 % of its value. With the radial coefficient k1 = -0.2, this holds for fields of view of up
# to about 95 degrees. Rays that have not converged after these iterations are computed by Newton's
# method.
_UNDISTORT_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-12)
_FOUND = 1e-6
"""Maximum reprojection error, in pixels, at which a ray counts as found."""
_NEWTON_STEPS = 40
_LARGEST = 30_000
"""Maximum width and maximum height of an image, in pixels. No camera exceeds them."""


class CameraError(ValueError):
    """A camera description or an image that cannot be used; the message gives the reason."""


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Image size in pixels, focal lengths and principal point in pixels, and lens distortion.

    ``deviations`` are the standard deviations of fx, fy, cx, cy, k1, k2, p1 and p2 if the
    calibration states them, otherwise empty. Comparisons of two models ignore them.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    distortion_model: str = "plumb_bob"
    deviations: tuple[float, ...] = field(default=(), compare=False)

    def __post_init__(self) -> None:
        """Raise CameraError, with the value, if the parameters do not describe a camera."""
        if self.distortion_model not in _LENGTHS:
            remedy = (
                "calibrate again with plumb_bob or rational_polynomial, the only supported models"
            )
            if self.distortion_model == "radtan":  # Kalibr's name
                remedy = "write plumb_bob, which is the same model"
            raise CameraError(f"distortion_model is {self.distortion_model!r}; {remedy}")
        lengths = _LENGTHS[self.distortion_model]
        if len(self.distortion) not in lengths:
            allowed = f"{', '.join(map(str, lengths[:-1]))} or {lengths[-1]}"
            fitting = [m for m, own in _LENGTHS.items() if len(self.distortion) in own]
            remedy = f"if the model is {fitting[0]}, name it so" if fitting else "calibrate again"
            raise CameraError(
                f"{self.distortion_model} takes {allowed} coefficients, but "
                f"{len(self.distortion)} are given; correct them, or {remedy}"
            )
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not np.all(np.isfinite(numbers)):
            raise CameraError(
                f"fx, fy, cx, cy and the distortion are {[float(n) for n in numbers]}, but must "
                "not contain an infinity or NaN; calibrate again"
            )
        if len(self.deviations) not in (0, 8) or not all(
            math.isfinite(value) and value >= 0.0 for value in self.deviations
        ):
            raise CameraError(
                f"the standard deviations of the camera are {self.deviations}; give eight numbers "
                "of at least 0 (fx, fy, cx, cy, k1, k2, p1, p2) or none"
            )
        if self.width < 16 or self.height < 16:
            raise CameraError(
                f"an image of {self.width} x {self.height} pixels is too small (at least 16 x 16 "
                "are needed)"
            )
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(
                f"focal lengths are {self.fx} and {self.fy} pixels; they must be above 0 "
                "(a camera_info full of zeros means an uncalibrated camera)"
            )
        if max(self.width, self.height) > _LARGEST:
            raise CameraError(
                f"an image of {self.width} x {self.height} pixels is too large (limit {_LARGEST})"
            )
        if max(self.fx, self.fy) > 100.0 * _LARGEST:
            raise CameraError(
                f"focal lengths are {self.fx:g} and {self.fy:g} pixels (limit {100 * _LARGEST})"
            )
        for name, place, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -size <= place <= 2 * size:
                raise CameraError(
                    f"the principal point's {name} is {place:g} pixels, but must lie in or near "
                    f"the image ({-size} to {2 * size}); the matrix fits an image of about "
                    f"{2 * self.cx + 1:.0f} x {2 * self.cy + 1:.0f} pixels: correct the image's "
                    "size, or calibrate the camera at this resolution"
                )
        if any(self.distortion):
            self._check_fold()

    @classmethod
    def from_camera_info(
        cls,
        width: int,
        height: int,
        distortion_model: str,
        d: Sequence[float],
        k: Sequence[float],
    ) -> CameraModel:
        """Create the model from the fields of ``sensor_msgs/CameraInfo`` (k row by row, 9 numbers).

        Raises CameraError for an unknown lens model, wrong counts or an uncalibrated camera.
        """
        if len(k) != 9:
            raise CameraError(f"the camera matrix has {len(k)} numbers instead of 9")
        for index, value in zip((1, 3, 6, 7, 8), (0.0, 0.0, 0.0, 0.0, 1.0), strict=True):
            if k[index] != value and any(k):
                if (k[2], k[5], k[8]) == (0.0, 0.0, 1.0):
                    raise CameraError(
                        "the camera matrix seems to be transposed, as in MATLAB; its rows must be "
                        f"[fx, 0, cx], [0, fy, cy], [0, 0, 1], here [{k[0]:g}, 0, {k[6]:g}, 0, "
                        f"{k[4]:g}, {k[7]:g}, 0, 0, 1]"
                    )
                raise CameraError(
                    f"number {index} (from 0) of the camera matrix is {k[index]:g}, but must be "
                    f"{value:g}: a matrix with skew or another scale is not supported; calibrate "
                    "again with the model plumb_bob or rational_polynomial"
                )
        return cls(
            int(width),
            int(height),
            float(k[0]),
            float(k[4]),
            float(k[2]),
            float(k[5]),
            tuple(float(value) for value in d),
            distortion_model or "plumb_bob",
        )

    @property
    def matrix(self) -> Array:
        """Camera matrix K, shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> Array:
        """Distortion coefficients in OpenCV's order, at least 5 of them."""
        padded = self.distortion + (0.0,) * max(0, 5 - len(self.distortion))
        return np.array(padded)

    def project(self, points: ArrayLike) -> Array:
        """Project points (..., 3) in the optical frame, in m, to pixels (..., 2)."""
        p = np.asarray(points, dtype=float)
        flat = np.ascontiguousarray(p.reshape(-1, 1, 3))
        if flat.size == 0:
            return np.zeros((*p.shape[:-1], 2))
        zero = np.zeros(3)
        pixels, _ = cv2.projectPoints(flat, zero, zero, self.matrix, self.coefficients)
        return np.asarray(pixels, dtype=float).reshape(*p.shape[:-1], 2)

    def rays(self, pixels: ArrayLike) -> Array:
        """Return the undistorted directions (x / z, y / z), shape (..., 2), of pixels (..., 2). The
        result is NaN for a pixel to which the lens model projects no direction."""
        p = np.asarray(pixels, dtype=float)
        flat = np.ascontiguousarray(p.reshape(-1, 2))
        if flat.size == 0:
            return np.zeros(p.shape)
        undone = cv2.undistortPointsIter(
            flat[:, None], self.matrix, self.coefficients, np.eye(3), np.eye(3), _UNDISTORT_CRITERIA
        )
        found = np.asarray(undone, dtype=float).reshape(-1, 2)
        missed = self._missed(found, flat)
        if missed.any():
            found[missed] = self._newton(flat[missed])
        return found.reshape(p.shape)

    def _missed(self, rays: Array, pixels: Array) -> NDArray[np.bool_]:
        """Return for each of the rays (N, 2) whether its projection differs from its pixel
        (N, 2)."""
        homogeneous = np.column_stack([rays, np.ones(len(rays))])
        with np.errstate(invalid="ignore", over="ignore"):
            error = np.abs(self.project(homogeneous) - pixels).max(axis=1)
        return np.asarray(~(error <= _FOUND))

    def _newton(self, pixels: Array) -> Array:
        """Solve for rays (N, 2) by Newton's method from the undistorted pixels; NaN if it fails.

        With barrel distortion, the image radius grows less than linearly with the slope of the ray.
        Every step therefore stops short of the solution, and the next step continues from there.
        Beyond a certain radius, the lens model folds back: the image radius decreases again. A ray
        that a step moves beyond this radius becomes NaN, because the iteration cannot return from
        there.
        """
        rays = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        zero = np.zeros(3)
        left = np.arange(len(rays))
        for _ in range(_NEWTON_STEPS):
            points = np.column_stack([rays[left], np.ones(len(left))])
            seen, slopes = cv2.projectPoints(points, zero, zero, self.matrix, self.coefficients)
            # Columns 3 and 4: derivatives with respect to the translation along x and y. They equal
            # the derivatives with respect to the point's x and y. The depth is 1, so the point's x
            # and y are the direction of the ray.
            matrix = np.asarray(slopes, dtype=float)[:, 3:5].reshape(-1, 2, 2)
            error = pixels[left] - seen.reshape(-1, 2)
            forward = np.linalg.det(matrix) > 0
            rays[left[~forward]] = np.nan
            left, error = left[forward], error[forward]
            rays[left] += np.linalg.solve(matrix[forward], error[..., None])[..., 0]
            left = left[np.abs(error).max(axis=1) > 1e-3 * _FOUND]
            if not len(left):
                break
        rays[self._missed(rays, pixels)] = np.nan
        return rays

    def _check_fold(self) -> None:
        """Raise CameraError if the lens model folds back inside the image, so that some pixels
        there have no direction or two directions.

        On the way from the centre to the rim of the image, the position in the image must advance
        with every step of the direction (positive Jacobian).
        """
        along = np.linspace(0.0, 1.0, 9)
        rim = np.concatenate([[(s, 0.0), (s, 1.0), (0.0, s), (1.0, s)] for s in along])
        rim *= [self.width - 1, self.height - 1]
        rays = self.rays(rim)
        # Two per cent beyond the rim: at the fold itself, the directions are already useless.
        way = np.linspace(0.0, 1.02, 52)[:, None, None] * rays
        flat = np.column_stack([way.reshape(-1, 2), np.ones(way.size // 2)])
        zero = np.zeros(3)
        _, slopes = cv2.projectPoints(flat, zero, zero, self.matrix, self.coefficients)
        with np.errstate(invalid="ignore"):
            turned = np.linalg.det(np.asarray(slopes, dtype=float)[:, 3:5].reshape(-1, 2, 2))
        lost = ~(turned.reshape(way.shape[:2]) > 0.0).all(axis=0)
        if lost.any():
            x, y = rim[lost][0]
            raise CameraError(
                f"the lens model with the coefficients {self.distortion} maps no viewing direction "
                f"to the pixel ({x:.0f}, {y:.0f}) or several, because it folds back inside the "
                "image; calibrate again with views of the target in the corners of the image, or "
                "with --model rational_polynomial"
            )

    def check_image(self, image: NDArray[np.generic]) -> str | None:
        """Return None if the image matches this camera (uint8, height x width), else the reason."""
        if image.ndim != 2 or image.dtype != np.uint8:
            return (
                f"the image has type {image.dtype} and shape {image.shape}; expected uint8, "
                f"one channel (mono8), {self.height} rows of {self.width}"
            )
        if image.shape != (self.height, self.width):
            turned = image.shape == (self.width, self.height)
            remedy = "turn it by 90 degrees" if turned else "change the image size"
            return (
                f"the image is {image.shape[1]} x {image.shape[0]} pixels but the calibration is "
                f"for {self.width} x {self.height}; calibrate again or {remedy}"
            )
        return None


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """X_CT, the pose of the table in the camera's frame: p_C = rotation p_T + translation, in m."""

    rotation: Array
    translation: Array

    @classmethod
    def above(
        cls,
        position: Sequence[float],
        aim: Sequence[float] = (0.0, 0.0),
        spin: float = 0.0,
    ) -> CameraPose:
        """Return the pose of a camera at ``position`` (x, y, z in m) aimed at a point of the table.

        ``aim`` is the point (x, y). With ``spin`` (rad) 0, the image's x axis is parallel to the
        table's x axis.
        """
        place = np.asarray(position, dtype=float)
        forward = np.array([aim[0], aim[1], 0.0]) - place
        forward /= np.linalg.norm(forward)
        heading = np.array([np.cos(spin), np.sin(spin), 0.0])
        right = heading - forward * (heading @ forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        return cls(rotation, -rotation @ place)

    @property
    def position(self) -> Array:
        """Position of the camera in the table's frame, shape (3,), in m."""
        return np.asarray(-self.rotation.T @ self.translation)

    def apply(self, points: ArrayLike) -> Array:
        """Transform points of the table, shape (..., 3), to the optical frame."""
        return np.asarray(np.asarray(points, dtype=float) @ self.rotation.T + self.translation)

    def plane(self, height: float) -> Array:
        """Matrix (3, 3) that maps (x, y, 1) of the plane at ``height`` (m) to the optical frame."""
        third = self.rotation[:, 2] * height + self.translation
        return np.column_stack([self.rotation[:, 0], self.rotation[:, 1], third])

    def moved(self, step: ArrayLike) -> CameraPose:
        """Return this pose after a small motion: rotation vector in rad and translation in m, in
        camera axes."""
        s = np.asarray(step, dtype=float)
        turn, _ = cv2.Rodrigues(s[:3])
        return CameraPose(turn @ self.rotation, turn @ self.translation + s[3:])


def at_height(points: Array, height: float = 0.0) -> Array:
    """Return points (..., 2) of the plane at ``height`` (m) as points (..., 3)."""
    return np.concatenate([points, np.full((*points.shape[:-1], 1), height)], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera and its pose over the table; converts between pixels and planes of the table."""

    camera: CameraModel
    pose: CameraPose

    def project(self, points: ArrayLike, height: float = 0.0) -> Array:
        """Project points (..., 2) of the plane at ``height`` (m), or points (..., 3), to pixels."""
        p = np.asarray(points, dtype=float)
        return self.camera.project(self.pose.apply(at_height(p, height) if p.shape[-1] == 2 else p))

    def on_plane(self, pixels: ArrayLike, height: float = 0.0) -> Array:
        """Return the points (..., 2), in m, at which the rays of pixels (..., 2) intersect the
        plane at ``height`` (m)."""
        return self.rays_on_plane(self.camera.rays(pixels), height)

    def rays_on_plane(self, rays: ArrayLike, height: float = 0.0) -> Array:
        """Return the points (..., 2), in m, at which rays with the directions (..., 2) intersect
        the plane at ``height`` (m)."""
        r = np.asarray(rays, dtype=float)
        inverse = np.linalg.inv(self.pose.plane(height))
        # Component by component: numpy multiplies large stacks of tiny matrices slowly.
        x, y = r[..., 0], r[..., 1]
        across, along, depth = (row[0] * x + row[1] * y + row[2] for row in inverse)
        points = np.empty(r.shape)
        np.divide(across, depth, out=points[..., 0])
        np.divide(along, depth, out=points[..., 1])
        return points
