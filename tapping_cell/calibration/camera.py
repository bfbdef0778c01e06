"""Calibration of the camera's intrinsics and distortion from photographs of a flat target.

The method is Zhang's (A flexible new technique for camera calibration, PAMI 22, 2000), as
implemented in OpenCV. In addition, unsuitable views are rejected with their name and the reason, a
set of views that does not determine the focal length is refused, and the lens model is chosen by
its predicted projection error over the whole image, also where no view shows the target (as in
mrcal, https://mrcal.secretsauce.net/uncertainty.html).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import compress
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.camera_views import (
    GRID,
    Rejected,
    coverage,
    screen,
    uncovered_regions,
)
from tapping_cell.calibration.target import Target, TargetView
from tapping_cell.se2 import Array
from tapping_cell.vision.camera import CameraError, CameraModel

MIN_VIEWS = 6
"""Minimum number of views for a calibration; about 20 are recommended."""
_MIN_TURN = np.radians(10.0)
"""Minimum angle between the target planes of those two views whose planes differ most."""
_WORST_FOCAL = 0.01
"""Maximum relative standard deviation of a focal length."""
_OUTLIER_RATIO, _OUTLIER_PIXELS = 3.0, 0.4
"""A view is an outlier if its error exceeds both this multiple of the median error and this number
of pixels."""
_CORNER_RATIO, _CORNER_PIXELS = 6.0, 0.4
_HIGH_RMS, _MAX_RMS = 0.5, 1.0
"""Root mean square reprojection error, in pixels, above which a warning is given, and above which
the calibration is refused: the lens model or the target does not describe the photographs."""
_WIDE = 0.5
"""A fisheye model that reduces the error of a refused calibration to this fraction explains it."""
_BETTER = 0.7
"""Fraction to which a more complex lens model must reduce the predicted projection error. Without
this limit, coefficients that the views hardly determine are chosen for a gain of 1 %."""
_HIGH_PREDICTED = 1.0
"""Predicted projection error, in pixels, above which a warning is given."""
_SUBSETS = 30


class CalibrationRefused(ValueError):
    """Raised if the data do not determine the result; the message says what to record instead."""


class Lens(NamedTuple):
    """A lens model: display name, ROS name, number of coefficients and OpenCV flags."""

    label: str
    model: str
    coefficients: int
    flags: int


LENSES = (
    Lens("plumb_bob, k1 k2 p1 p2", "plumb_bob", 5, cv2.CALIB_FIX_K3),
    Lens("plumb_bob, k1 k2 p1 p2 k3", "plumb_bob", 5, 0),
    Lens("rational_polynomial, k1 to k6 p1 p2", "rational_polynomial", 8, cv2.CALIB_RATIONAL_MODEL),
)
_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, slots=True, eq=False)
class UsedView:
    """A view used for the calibration.

    ``residuals`` (N, 2) are measured minus predicted corners in pixels, ``rms`` is the root mean
    square of their lengths, and ``tilt`` is the angle between target plane and image plane in rad.
    """

    view: TargetView
    residuals: Array
    rms: float
    tilt: float


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A calibrated camera and the quality of the calibration.

    ``rms`` is the root mean square reprojection error in pixels. ``deviations`` are the standard
    deviations of the parameters (in pixels; those of distortion coefficients have no unit).
    ``predicted`` contains the predicted projection error of each lens model in pixels, root mean
    square over the whole image. ``coverage`` (rows, columns) counts the views with corners in each
    part of the image, and ``projection`` (rows, columns) is the predicted error there, in pixels.
    ``warnings`` are for the user.
    """

    model: CameraModel
    rms: float
    deviations: dict[str, float]
    lens: str
    predicted: dict[str, float]
    views: tuple[UsedView, ...]
    rejected: tuple[Rejected, ...]
    coverage: NDArray[np.intp]
    projection: Array
    warnings: tuple[str, ...]

    @property
    def focal_deviation(self) -> float:
        """Relative standard deviation of fx or fy, whichever is larger."""
        d, m = self.deviations, self.model
        return max(d["fx"] / m.fx, d["fy"] / m.fy)


class _Fit(NamedTuple):
    """A camera fitted to views: image size, lens model, camera matrix, coefficients, and the
    target's rotation vector in each view."""

    size: tuple[int, int]
    lens: Lens
    matrix: Array
    coefficients: Array
    turns: list[Array]

    def model(self) -> CameraModel:
        """Return the camera; raise CalibrationRefused if its parameters are impossible."""
        m = self.matrix
        focal, centre = (float(m[0, 0]), float(m[1, 1])), (float(m[0, 2]), float(m[1, 2]))
        coefficients = tuple(self.coefficients.tolist())
        try:
            return CameraModel(*self.size, *focal, *centre, coefficients, self.lens.model)
        except CameraError as error:
            raise CalibrationRefused(
                f"the views do not determine the camera's parameters: {error}"
            ) from error


def calibrate_camera(
    views: Sequence[TargetView],
    target: Target,
    size: tuple[int, int],
    lens_model: str | None = None,
    unseen: Sequence[Rejected] = (),
) -> CameraCalibration:
    """Calibrate the camera that took these views in images of ``size`` (width, height).

    ``lens_model`` is ``plumb_bob`` or ``rational_polynomial``; if it is None, the model is chosen
    by its predicted projection error. ``unseen`` are photographs without a detected target; the
    result lists them as rejected.

    Raises:
        CalibrationRefused: too few views remain, they do not determine the focal length, or no lens
            model describes them.
    """
    kept, screened = screen(views, size)
    rejected = [*unseen, *screened]
    _check_number(kept, rejected)
    _check_perspective(kept, target)
    fitter = _Fitter(target, size, [lens for lens in LENSES if lens_model in (None, lens.model)])
    choice, members, errors = fitter.consistent(kept)
    usual = float(np.median(errors[members])) if members.any() else np.nan
    rejected += [
        Rejected(
            view.name,
            f"outlier: its reprojection error is {error:.2f} pixels, and the median of the "
            f"other views is {usual:.2f}; is this another target, is the target bent, or are "
            "its corners swapped?",
        )
        for view, error, member in zip(kept, errors, members, strict=True)
        if not member
    ]
    chosen = list(compress(kept, members))
    _check_number(chosen, rejected)
    chosen = fitter.without_stray_corners(chosen, choice.lens)
    return _result(fitter, chosen, rejected, choice)


def _check_number(views: Sequence[TargetView], rejected: Sequence[Rejected]) -> None:
    if len(views) >= MIN_VIEWS:
        return
    out = "; ".join(f"{entry.name}: {entry.reason}" for entry in rejected[:4])
    raise CalibrationRefused(
        f"{len(views)} usable views are too few: at least {MIN_VIEWS} are needed; 20 are "
        "recommended. Take more photographs with the target tilted by 20 to 40 degrees in "
        "different directions and in every part of the image"
        + (f" (left out: {out}{'; ...' if len(rejected) > 4 else ''})" if out else "")
    )


def _check_perspective(views: Sequence[TargetView], target: Target) -> None:
    """Raise CalibrationRefused if nearly all views show the target without tilt."""
    depths = []
    for view in views:
        points = target.points[view.ids]
        homography, _ = cv2.findHomography(points, view.pixels)
        if homography is None:
            continue
        # Relative difference of the distances to the far end and the near end of the target.
        scale = points @ homography[2, :2] + homography[2, 2]
        depths.append(float(scale.max() / scale.min()) - 1.0 if scale.min() > 0 else 1.0)
    if not depths or np.quantile(depths, 0.75) < 0.03:
        raise CalibrationRefused(
            "the target faces the camera in nearly all views (one end is at most "
            f"{100 * max(depths, default=0.0):.1f} % nearer than the other); such views "
            "cannot separate the focal length from the distance. Tilt the target by 20 to 40 "
            "degrees, to a different side each time"
        )


class _Choice(NamedTuple):
    """The chosen lens model, and the predicted projection error of every model in pixels, by
    label."""

    lens: Lens
    predicted: dict[str, float]


@dataclass(frozen=True)
class _Fitter:
    """Fits of a camera with one of ``lenses`` to views of ``target`` in images of ``size``."""

    target: Target
    size: tuple[int, int]
    lenses: Sequence[Lens]

    def consistent(self, views: Sequence[TargetView]) -> tuple[_Choice, NDArray[np.bool_], Array]:
        """Find the views that agree with one camera: the lens model chosen for these views, their
        mask (V,), and the error (V,) in pixels of every view."""
        members: NDArray[np.bool_] = np.ones(len(views), dtype=bool)
        choice = _Choice(self.lenses[0], {})
        errors: Array = np.full(len(views), np.nan)
        for turn in range(5):
            chosen = list(compress(views, members))
            if len(chosen) < MIN_VIEWS:
                break
            try:
                choice = self.choose(chosen)
            except CalibrationRefused:
                if turn:
                    raise
                members = self.consensus(views)
                continue
            errors = self.errors(views, self.fit(chosen, choice.lens))
            limit = max(_OUTLIER_RATIO * float(np.median(errors[members])), _OUTLIER_PIXELS)
            again = errors <= limit
            if np.array_equal(again, members):
                break
            # Outliers may have distorted the first fit, so continue with a robust consensus set.
            members = again if turn else self.consensus(views)
        return choice, members, errors

    def consensus(self, views: Sequence[TargetView]) -> NDArray[np.bool_]:
        """Return a mask (V,) of the views that agree with each other.

        The method is the least median of squares over random subsets (Rousseeuw 1984), alternating
        between the simplest and the most complex lens model.
        """
        random = np.random.default_rng(0)
        count = max(5, len(views) // 4)
        best: Array = np.full(len(views), np.inf)
        for number in range(_SUBSETS):
            part = random.choice(len(views), count, replace=False)
            lens = self.lenses[-1] if number % 2 else self.lenses[0]
            with suppress(CalibrationRefused):
                fit = self.fit([views[index] for index in part], lens)
                best = min(best, self.errors(views, fit), key=np.median)
        limit = max(_OUTLIER_RATIO * float(np.median(best)), _OUTLIER_PIXELS)
        members = best <= limit
        return np.asarray(members if members.sum() >= MIN_VIEWS else np.ones_like(members))

    def choose(self, views: Sequence[TargetView]) -> _Choice:
        """Choose a lens model by its predicted projection error over the whole image.

        The predicted error combines the uncertainty of the coefficients with the part of the
        residuals that another model explains. A more complex model is chosen only if it reduces
        this error enough (``_BETTER``). Models that fold back inside the image are excluded.
        """
        found: dict[Lens, tuple[float, float]] = {}
        for lens in self.lenses:
            with suppress(CalibrationRefused, np.linalg.LinAlgError):
                fit = self.fit(views, lens)
                covariance, misfit = self.uncertainty(views, fit)
                found[lens] = misfit, float((_projection(fit, covariance) ** 2).mean())
        if not found:
            raise CalibrationRefused(
                "no lens model fits these views: add views with the target tilted by 20 to 40 "
                "degrees in different directions and in every part of the image, and check the "
                "number of squares given for the target"
            )
        least = min(misfit for misfit, _ in found.values())
        predicted = {
            lens: float(np.sqrt(misfit - least + variance))
            for lens, (misfit, variance) in found.items()
        }
        best = next(iter(predicted))
        for lens in predicted:
            if predicted[lens] < _BETTER * predicted[best]:
                best = lens
        return _Choice(best, {lens.label: error for lens, error in predicted.items()})

    def uncertainty(self, views: Sequence[TargetView], fit: _Fit) -> tuple[Array, float]:
        """Return the covariance (P, P) of fx, fy, cx, cy and the coefficients that are not fixed,
        and the mean squared residual of a corner in pixels^2.

        The residuals of one view are correlated, because the target is bent or misprinted and the
        lens model is not exact. Therefore the covariance for independent corners and that for
        independent views ("sandwich", White 1980) are added.
        """
        free = 4 + fit.lens.coefficients - (1 if fit.lens.flags & cv2.CALIB_FIX_K3 else 0)
        normal, scores, total, count = np.zeros((free, free)), [], 0.0, 0
        for view in views:
            points, turn, shift = self._placed(view, fit)
            seen, jacobian = cv2.projectPoints(points, turn, shift, fit.matrix, fit.coefficients)
            left = (view.pixels - seen.reshape(-1, 2)).ravel()
            derivatives: Array = np.asarray(jacobian, dtype=float)
            pose, _ = np.linalg.qr(derivatives[:, :6])
            own = derivatives[:, 6 : 6 + free]
            own = own - pose @ (pose.T @ own)
            normal += own.T @ own
            scores.append(own.T @ left)
            total += float(left @ left)
            count += len(left) - 6
        inverse = np.linalg.inv(normal)
        variance = total / max(count - free, 1)
        score = np.array(scores)
        score = (score - score.mean(axis=0)) * np.sqrt(len(score) / (len(score) - 1))
        ours = inverse @ (score.T @ score) @ inverse
        return inverse * variance + ours, 2.0 * variance

    def fit(self, views: Sequence[TargetView], lens: Lens) -> _Fit:
        """Fit a camera to all corners by least squares.

        Raises:
            CalibrationRefused: OpenCV finds no solution.
        """
        refusal = (
            "the views do not determine the camera's parameters: add views with the target tilted "
            "by 20 to 40 degrees in different directions"
        )
        points = [
            np.column_stack([self.target.points[view.ids], np.zeros(len(view.ids))])
            for view in views
        ]
        try:
            _, matrix, coefficients, turns, _ = cv2.calibrateCamera(
                [each.astype(np.float32) for each in points],
                [np.ascontiguousarray(view.pixels.astype(np.float32)[:, None]) for view in views],
                self.size,
                np.eye(3),
                np.zeros(8),  # OpenCV accepts eight coefficients for every model
                flags=lens.flags,
                criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9),
            )
        except cv2.error as error:
            raise CalibrationRefused(refusal) from error
        if not (np.isfinite(matrix).all() and np.isfinite(coefficients).all() and matrix[0, 0] > 0):
            raise CalibrationRefused(refusal)
        return _Fit(
            self.size,
            lens,
            np.asarray(matrix, dtype=float),
            np.ravel(coefficients).astype(float)[: lens.coefficients],
            [np.asarray(turn, dtype=float) for turn in turns],
        )

    def residuals(self, view: TargetView, fit: _Fit) -> Array:
        """Compute the residuals (N, 2) of a view's corners after fitting its pose to this
        camera."""
        points, turn, shift = self._placed(view, fit)
        seen, _ = cv2.projectPoints(points, turn, shift, fit.matrix, fit.coefficients)
        return np.asarray(view.pixels - seen.reshape(-1, 2), dtype=float)

    def _placed(self, view: TargetView, fit: _Fit) -> tuple[Array, Array, Array]:
        """Return the corners (N, 3) of a view in the target's frame, and the rotation vector and
        the position of the target in this view (NaN if there is no solution)."""
        points = np.column_stack([self.target.points[view.ids], np.zeros(len(view.ids))])
        camera = fit.matrix, fit.coefficients
        good, turn, shift = cv2.solvePnP(points, view.pixels, *camera, flags=cv2.SOLVEPNP_SQPNP)
        if not good:
            return points, np.full(3, np.nan), np.full(3, np.nan)
        turn, shift = cv2.solvePnPRefineLM(points, view.pixels, *camera, turn, shift)
        return points, np.asarray(turn, dtype=float), np.asarray(shift, dtype=float)

    def errors(self, views: Sequence[TargetView], fit: _Fit) -> Array:
        """Compute the root mean square corner error (V,) of each view."""
        return np.array([_rms(self.residuals(view, fit)) for view in views])

    def without_stray_corners(self, views: Sequence[TargetView], lens: Lens) -> list[TargetView]:
        """Return the views after removing the corners with large residuals."""
        for _ in range(3):
            fit = self.fit(views, lens)
            lengths = [np.linalg.norm(self.residuals(view, fit), axis=1) for view in views]
            spread = 0.85 * float(np.median(np.concatenate(lengths)))
            limit = max(_CORNER_RATIO * spread, _CORNER_PIXELS)
            if max(length.max() for length in lengths) <= limit:
                break
            views = [
                replace(view, ids=view.ids[length <= limit], pixels=view.pixels[length <= limit])
                if (length <= limit).sum() >= self.target.least_corners
                else view
                for view, length in zip(views, lengths, strict=True)
            ]
        return list(views)


def _projection(fit: _Fit, covariance: Array) -> Array:
    """Predicted standard deviation (rows, columns), in pixels, of the projection in each part of
    the image (``GRID``) for a covariance (P, P) of the camera's parameters.

    A rotation of the camera compensates a part of the error and is not counted.
    """
    rows, columns = GRID
    width, height = fit.size
    u, v = np.meshgrid(np.linspace(0.0, width - 1, columns), np.linspace(0.0, height - 1, rows))
    rays = fit.model().rays(np.stack([u, v], axis=-1).reshape(-1, 2))
    points = np.column_stack([rays, np.ones(len(rays))])
    zero = np.zeros(3)
    _, jacobian = cv2.projectPoints(points, zero, zero, fit.matrix, fit.coefficients)
    derivatives: Array = np.asarray(jacobian, dtype=float)
    turns, _ = np.linalg.qr(derivatives[:, :3])
    own = derivatives[:, 6 : 6 + len(covariance)]
    own = own - turns @ (turns.T @ own)
    variance = np.einsum("ni,ij,nj->n", own, covariance, own)
    # Rounding may make the variance of an undetermined lens negative.
    variance = np.maximum(variance.reshape(rows, columns, 2).sum(axis=-1), 0.0)
    return np.asarray(np.sqrt(variance))


def _check_rms(fitter: _Fitter, views: Sequence[TargetView], rms: float) -> None:
    """Raise CalibrationRefused if the reprojection error is too large."""
    if rms <= _MAX_RMS:
        return
    text = (
        f"corners are {rms:.2f} pixels (rms) from their reprojections (limit {_MAX_RMS:g}), so the "
        "file would be wrong"
    )
    if _fisheye_rms(fitter, views) < _WIDE * rms:
        raise CalibrationRefused(
            f"{text}: the lens is a wide-angle (fisheye) lens, which the cell does not support; "
            "use a lens with a field of view of less than about 100 degrees"
        )
    raise CalibrationRefused(
        f"{text}: check that the target is flat and stiff, that its sizes and number of squares "
        "were given correctly, and that focus and zoom were locked"
    )


def _fisheye_rms(fitter: _Fitter, views: Sequence[TargetView]) -> float:
    """Root mean square error, in pixels, of OpenCV's fisheye model; infinite if it does not fit."""
    flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
    points = [fitter.target.points[view.ids] for view in views]
    flat = [np.column_stack([each, np.zeros(len(each))])[:, None] for each in points]
    with suppress(cv2.error):
        return float(
            cv2.fisheye.calibrate(
                flat,
                [view.pixels[:, None] for view in views],
                fitter.size,
                np.eye(3),
                np.zeros(4),
                flags=flags,
            )[0]
        )
    return np.inf


def _rms(residuals: Array) -> float:
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def _result(
    fitter: _Fitter, views: Sequence[TargetView], rejected: Sequence[Rejected], choice: _Choice
) -> CameraCalibration:
    lens, fit = choice.lens, fitter.fit(views, choice.lens)
    residuals = [fitter.residuals(view, fit) for view in views]
    rms = _rms(np.concatenate(residuals))
    _check_rms(fitter, views, rms)
    model = fit.model()
    covariance, _ = fitter.uncertainty(views, fit)
    names = ("fx", "fy", "cx", "cy", *_NAMES)[: 4 + lens.coefficients]
    deviations = dict.fromkeys(names, 0.0)
    deviations |= dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=False))
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in fit.turns])
    turns = np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
    if turns.max() < _MIN_TURN:
        raise CalibrationRefused(
            "the target has nearly the same tilt in all views (they differ by at most "
            f"{np.degrees(turns.max()):.0f} degrees); such views do not determine the focal "
            "length. Tilt the target by 20 to 40 degrees, to a different side each time"
        )
    worst = max(deviations["fx"] / model.fx, deviations["fy"] / model.fy)
    if worst > _WORST_FOCAL:
        raise CalibrationRefused(
            f"with these views the focal length is uncertain by {100 * worst:.1f} % (one standard"
            f" deviation; at most {100 * _WORST_FOCAL:g} % is accepted): tilt the target more, fill"
            " the image with it, take more views"
        )
    used = []
    for view, left, normal in zip(views, residuals, normals, strict=True):
        tilt = float(np.arccos(min(1.0, abs(normal[2]))))
        used.append(UsedView(view, left, _rms(left), tilt))
    projection = _projection(fit, covariance)
    counts = coverage(views, fitter.size)
    return CameraCalibration(
        model=model,
        rms=rms,
        deviations=deviations,
        lens=lens.label,
        predicted=choice.predicted,
        views=tuple(used),
        rejected=tuple(rejected),
        coverage=counts,
        projection=projection,
        warnings=tuple(_warnings(used, counts, projection, worst, rms)),
    )


def _warnings(
    used: Sequence[UsedView],
    counts: NDArray[np.intp],
    projection: Array,
    worst: float,
    rms: float,
) -> list[str]:
    """Return warnings about the used views, the predicted projection error and the root mean square
    error, both in pixels."""
    warnings = []
    if rms > _HIGH_RMS:
        warnings.append(
            f"corners are {rms:.2f} pixels (rms) from their reprojections; a flat target in "
            "sharp photographs gives 0.1 to 0.3. Check that the target is flat and that its sizes "
            "were given correctly"
        )
    if projection.max() > _HIGH_PREDICTED:
        warnings.append(
            f"the predicted projection error is up to {projection.max():.1f} pixels at the border "
            f"of the image ({projection[counts > 0].max():.1f} where there are corners): take more "
            "views with the target at the border and in the corners"
        )
    uncovered = uncovered_regions(counts)
    if uncovered:
        warnings.append(
            f"no view shows the target in the {', '.join(uncovered)} of the image, where the lens "
            "model is only extrapolated; take views with the target there"
        )
    if len(used) < 12:
        warnings.append(f"only {len(used)} views: 20 would make the standard deviations reliable")
    if worst > 0.003:
        warnings.append(
            f"the focal length is uncertain by {100 * worst:.2f} %: tilt the target more and fill"
            " the image with it"
        )
    if np.max([entry.tilt for entry in used]) < np.radians(15.0):
        warnings.append(
            "no view is tilted by more than 15 degrees: tilt the target by 20 to 40 degrees"
        )
    return warnings
