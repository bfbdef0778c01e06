"""Calibration of the arm's base pose and joint offsets from measured poses of a marker on the tool,
or from touched points.

Points in the table plane are written as complex numbers. With the base position b, the base
rotation c = exp(i yaw) and a point m in the tool frame, the predicted position is

    p = b + c (L1 exp(i q1) + L2 exp(i (q1 + q2)) + m exp(i (q1 + q2 + q4)))

and the predicted angle is yaw + q1 + q2 + q4 plus the marker's angle on the tool. Here q2 is the
controller's value plus the offset of the elbow. No set of poses separates the shoulder's offset
from the base's yaw, and no set separates the tool joint's offset from the marker's angle on the
tool. Therefore neither of these two offsets is fitted.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import Column
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.se2 import Array, wrap_angle

Complex = NDArray[np.complex128]

MIN_POSES = 6
NAMES = ("base_x", "base_y", "base_yaw", "elbow_zero", "mount_x", "mount_y", "mount_angle")
LINKS = ("upper_arm", "forearm")
RECORD_COLUMNS = (
    Column("shoulder", "rad", -7.0, 7.0, least_largest=0.1),
    Column("elbow", "rad", -7.0, 7.0, least_largest=0.1),
    Column("tool", "rad", -20.0, 20.0),
    Column("x", "m", -3.0, 3.0, least_largest=0.01),
    Column("y", "m", -3.0, 3.0, least_largest=0.01),
    Column("theta", "rad", -20.0, 20.0, required=False),
)
"""Columns of the record file; each row is one pose."""
_COLUMNS = ("shoulder", "elbow", "tool", "x", "y")
_EXCHANGES = (("x", "y"), ("shoulder", "elbow"), ("elbow", "tool"), ("shoulder", "tool"))
"""Columns that are easily confused."""
_LOOSE = {"m": 0.005, "rad": np.radians(1.0)}
"""Maximum standard deviation of a fitted length (m) or angle (rad). If the poses determine a value
less accurately, it is not fitted, and the cell file's value is kept."""
_CORRELATED = 0.97
"""Correlation of two fitted values above which a note is made that the poses determine mainly a
combination of the two values."""
_OUTLIER = 4.5
"""Number of robust standard deviations above which a row is an outlier. These robust standard
deviations are at least ``_POSITION_FLOOR`` (m) and ``_ANGLE_FLOOR`` (rad)."""
_POSITION_FLOOR, _ANGLE_FLOOR = 2e-5, 2e-4
_WORST_SPREAD = 0.005
"""Standard deviation of the position residuals, in m, above which the calibration is refused,
because the rows do not fit this arm."""
_ALIKE = 0.01
"""Joint angles are rounded to multiples of this value, in rad, before different poses are
counted."""
_SUBSETS = 200
_IN_WORDS = {
    "base_x": "x of the base",
    "base_y": "y of the base",
    "base_yaw": "yaw of the base",
    "elbow_zero": "zero offset of the elbow",
    "mount_x": "forward offset of the marker or tip from the quill",
    "mount_y": "sideways offset of the marker or tip from the quill",
    "mount_angle": "angle of the marker on the tool",
    "upper_arm": "length of the upper arm",
    "forearm": "length of the forearm",
}


class RowsDoNotFit(CalibrationRefused):
    """No arm fits the rows of the record."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmRecord:
    """Recorded poses of the arm.

    ``joints`` (N, 3) are the controller's shoulder, elbow and tool angles in rad. ``points`` (N, 2)
    are the measured marker positions or the touched points, in m. ``angles`` (N,) are the marker's
    angles in rad, None for touched points. ``rows`` (N,) are the row numbers in the file.
    """

    joints: Array
    points: Array
    angles: Array | None
    rows: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class ArmOutlier:
    """A rejected row with its residuals: ``distance`` in m, ``angle`` in rad (NaN if unknown)."""

    row: int
    distance: float
    angle: float

    def __str__(self) -> str:
        turn = "" if np.isnan(self.angle) else f" and {np.degrees(self.angle):.2f} deg"
        return (
            f"row {self.row} deviates by {self.distance * 1e3:.2f} mm{turn} from the arm fitted to "
            "the other rows"
        )


@dataclass(frozen=True, slots=True, eq=False)
class ArmCalibration:
    """Result of the arm's calibration.

    ``values`` maps the names in ``NAMES`` and ``LINKS`` to values in m and rad. ``deviations`` are
    the standard deviations of the fitted values; ``held`` names the values that were not fitted.
    ``residuals`` (N, 2) in m and ``turns`` (N,) in rad are the position and angle residuals of the
    rows used. ``wrist_deviation`` in m and ``heading_deviation`` in rad are the resulting standard
    deviations of the wrist position and of the forearm's heading (root mean square over the rows
    used).
    """

    values: dict[str, float]
    deviations: dict[str, float]
    held: tuple[str, ...]
    residuals: Array
    turns: Array | None
    outliers: tuple[ArmOutlier, ...]
    wrist_deviation: float
    heading_deviation: float
    notes: tuple[str, ...]

    @property
    def position_rms(self) -> float:
        """Root mean square distance between measured and predicted points, in m."""
        return float(np.sqrt((self.residuals**2).sum(axis=1).mean()))

    @property
    def angle_rms(self) -> float | None:
        """Root mean square of the angles' residuals, in rad."""
        return None if self.turns is None else float(np.sqrt((self.turns**2).mean()))


def calibrate_arm(
    record: ArmRecord, geometry: ScaraGeometry, links: bool = False
) -> ArmCalibration:
    """Fit the base pose, the elbow's offset, the mount and, if ``links``, the link lengths.

    Raises:
        CalibrationRefused: there are too few poses, they do not determine the base pose, or the
            rows do not fit. If the rows fit after two columns are exchanged, or after the sign
            of a column is changed, the message says so.
    """
    try:
        return _calibrate(record, geometry, links)
    except RowsDoNotFit as error:
        for changed, words in _slips(record):
            try:
                result = _calibrate(changed, geometry, links)
            except CalibrationRefused:
                continue
            raise CalibrationRefused(
                f"the rows fit only after {words} (then they deviate by "
                f"{1e3 * result.position_rms:.2f} mm); correct the record"
            ) from error
        raise


def _slips(record: ArmRecord) -> Iterator[tuple[ArmRecord, str]]:
    """Yield the record after each likely mistake is undone, and what was done."""
    table = np.hstack([record.joints, record.points])
    for names in _EXCHANGES:
        columns = [_COLUMNS.index(name) for name in names]
        changed = table.copy()
        changed[:, columns] = table[:, columns[::-1]]
        words = f"the columns {names[0]} and {names[1]} are exchanged"
        yield replace(record, joints=changed[:, :3], points=changed[:, 3:]), words
    for column, name in enumerate(_COLUMNS):
        changed = table.copy()
        changed[:, column] *= -1.0
        words = f"the sign of the column {name} is changed"
        yield replace(record, joints=changed[:, :3], points=changed[:, 3:]), words


def _calibrate(record: ArmRecord, geometry: ScaraGeometry, links: bool) -> ArmCalibration:
    different = len(np.unique(np.round(record.joints / _ALIKE), axis=0))
    if different < MIN_POSES:
        raise CalibrationRefused(
            f"{different} different poses are too few: at least {MIN_POSES} are needed; 20 "
            "are recommended"
        )
    start, used = _begin(record, geometry)
    names = [*NAMES[:6], *(("mount_angle",) if record.angles is not None else ())]
    names += list(LINKS) if links else []
    held: list[str] = []
    sigma = np.array([1e-4, 1.7e-3])
    while True:
        free = [name for name in names if name not in held]
        fit = _robust(record, start, free, used, sigma)
        used, sigma = fit.used, fit.sigma
        loose = {name: std / _LOOSE[_unit(name)] for name, std in fit.deviations().items()}
        worst = max(loose, key=lambda name: loose[name])
        if loose[worst] <= 1.0 and np.isfinite(loose[worst]):
            break
        worst = _to_hold(free, loose)
        if worst.startswith("base"):
            raise CalibrationRefused(
                f"the poses do not determine the {_IN_WORDS[worst]}: spread them over the "
                "table, with the elbow bent by different angles"
            )
        held.append(worst)
        start = {**fit.values, worst: start[worst]}
    return _result(record, fit, held)


def _unit(name: str) -> str:
    return "rad" if name.endswith(("yaw", "zero", "angle")) else "m"


def _to_hold(free: Sequence[str], loose: dict[str, float]) -> str:
    """Choose, among the poorly determined values, the next value that is not fitted but taken from
    the cell file: the value that is most likely to be accurate in this file."""
    order = ("forearm", "upper_arm", "elbow_zero", "mount_x", "mount_y", "mount_angle")
    known = [name for name in order if name in free and not loose[name] <= 1.0]
    return known[0] if known else max(loose, key=lambda name: loose[name])


def wrist(joints: Array, values: dict[str, float]) -> Complex:
    """Compute the position (N,) of the quill axis in the arm's base frame for joints (N, 3)."""
    reach = joints[:, 0] + joints[:, 1] + values["elbow_zero"]
    return np.asarray(
        values["upper_arm"] * np.exp(1j * joints[:, 0]) + values["forearm"] * np.exp(1j * reach)
    )


def predicted(joints: Array, values: dict[str, float]) -> tuple[Complex, Array]:
    """Predict points (N,) and angles (N,) of the marker or tip on the tool, in ``table``."""
    heading = joints.sum(axis=1) + values["elbow_zero"]
    mount = complex(values["mount_x"], values["mount_y"]) * np.exp(1j * heading)
    turn = np.exp(1j * values["base_yaw"])
    base = complex(values["base_x"], values["base_y"])
    points = base + turn * (wrist(joints, values) + mount)
    return points, heading + values["base_yaw"] + values["mount_angle"]


def _begin(
    record: ArmRecord, geometry: ScaraGeometry
) -> tuple[dict[str, float], NDArray[np.bool_]]:
    """Compute initial values and the inliers, by linear least squares on random subsets of the
    rows.
    """
    elbow_zero = geometry.joint_offset[1]
    values = {name: 0.0 for name in NAMES} | {
        "elbow_zero": elbow_zero,
        "mount_x": geometry.tip_forward,
        "mount_y": geometry.tip_side,
        "upper_arm": geometry.upper_arm,
        "forearm": geometry.forearm,
    }
    reach = wrist(record.joints, values)
    heading = np.exp(1j * (record.joints.sum(axis=1) + elbow_zero))
    seen = record.points[:, 0] + 1j * record.points[:, 1]
    columns = np.stack([np.ones_like(reach), reach, heading], axis=1)
    singular = np.linalg.svd(columns, compute_uv=False)
    if singular[-1] < 1e-3 * singular[0]:
        # The tool has the same angle to the forearm in all rows, so the rows do not determine the
        # mount of the marker or tip. Keep the mount of the cell file.
        columns = columns[:, :2]
        columns[:, 1] += complex(geometry.tip_forward, geometry.tip_side) * heading
    random = np.random.default_rng(0)
    best, least = None, np.inf
    for _ in range(_SUBSETS):
        rows = random.choice(len(seen), columns.shape[1] + 1, replace=False)
        try:
            found = np.linalg.lstsq(columns[rows], seen[rows], rcond=1e-9)[0]
        except np.linalg.LinAlgError:
            continue
        # ``found[1]`` is a rotation and should have magnitude one; otherwise the subset is nearly
        # singular or contains outliers.
        misfit = abs(abs(found[1]) - 1.0)
        error = float(np.median(np.abs(columns @ found - seen))) * (1.0 + 10.0 * misfit)
        if error < least:
            best, least = found, error
    if best is None or abs(best[1]) < 1e-6:
        raise CalibrationRefused(
            "the poses do not determine the position of the base: spread the poses more"
        )
    errors = np.abs(columns @ best - seen)
    agree = errors <= max(6.0 * least, 0.01)
    found = np.linalg.lstsq(columns[agree], seen[agree], rcond=1e-9)[0]
    turn = found[1] / abs(found[1])
    values["base_yaw"] = float(np.angle(turn))
    values["base_x"], values["base_y"] = float(found[0].real), float(found[0].imag)
    if columns.shape[1] == 3:
        mount = found[2] / found[1]
        values["mount_x"], values["mount_y"] = float(mount.real), float(mount.imag)
    if record.angles is not None:
        apart = record.angles - record.joints.sum(axis=1) - elbow_zero - values["base_yaw"]
        towards = np.exp(1j * apart[agree])
        values["mount_angle"] = math.atan2(np.median(towards.imag), np.median(towards.real))
    return values, np.asarray(agree)


def _misses(record: ArmRecord, values: dict[str, float]) -> tuple[Array, Array | None]:
    """Compute residuals, measured minus predicted: points (N, 2) in m, angles (N,) in rad."""
    points, angles = predicted(record.joints, values)
    left = record.points - np.stack([points.real, points.imag], axis=1)
    if record.angles is None:
        return left, None
    return left, wrap_angle(record.angles - angles)


class _Fit(NamedTuple):
    """A fit of the values ``free``: all values, the covariance of the free ones, the noise
    ``sigma`` (m, rad) of a row, and the mask of the rows used."""

    free: Sequence[str]
    values: dict[str, float]
    covariance: Array
    sigma: Array
    used: NDArray[np.bool_]

    def deviations(self) -> dict[str, float]:
        """Return the standard deviations of the free values."""
        return dict(zip(self.free, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def _robust(
    record: ArmRecord,
    start: dict[str, float],
    free: Sequence[str],
    used: NDArray[np.bool_],
    sigma: Array,
) -> _Fit:
    """Fit the inliers by least squares, starting with the rows ``used``."""
    values = dict(start)
    for _ in range(12):
        values, _ = _least_squares(record, values, free, used, sigma)
        left, turns = _misses(record, values)
        distance = np.linalg.norm(left, axis=1)
        count = max(1.0, 1.0 - len(free) / max(1, (2 + (turns is not None)) * int(used.sum())))
        sigma = np.array(
            [
                max(np.median(distance[used]) / 1.1774 / count, _POSITION_FLOOR),
                1.0
                if turns is None
                else max(1.4826 * np.median(np.abs(turns[used])), _ANGLE_FLOOR),
            ]
        )
        again = distance <= _OUTLIER * sigma[0]
        if turns is not None:
            again &= np.abs(turns) <= _OUTLIER * sigma[1]
        needed = max(MIN_POSES, len(record.rows) // 2)
        if again.sum() < needed:
            raise RowsDoNotFit(
                f"only {int(again.sum())} of {len(record.rows)} rows are consistent with one arm; "
                f"at least {needed} are needed. Check that the joint values come from the "
                "controller in the right unit, and that the marker is the same in all rows"
            )
        if np.array_equal(again, used):
            break
        used = again
    if sigma[0] > _WORST_SPREAD:
        raise RowsDoNotFit(
            "no arm with these links fits the rows: half of them deviate by more than "
            f"{sigma[0] * 1.2e3:.0f} mm. Check that the columns are the controller's joint "
            "values in the right unit and order, that the link lengths in the cell file are "
            "those of the arm, and that neither arm, table nor camera was moved between the rows"
        )
    values, jacobian = _least_squares(record, values, free, used, sigma)
    left, turns = _misses(record, values)
    squares = float((left[used] ** 2).sum() / sigma[0] ** 2)
    number = 2 * int(used.sum())
    if turns is not None:
        squares += float((turns[used] ** 2).sum() / sigma[1] ** 2)
        number += int(used.sum())
    # Residuals below the assumed noise are due to chance, so they must not reduce the covariance.
    factor = max(1.0, squares / max(number - len(free), 1))
    return _Fit(free, values, factor * _inverse(jacobian.T @ jacobian), sigma, used)


def _inverse(information: Array) -> Array:
    """Invert an information matrix; directions without information get a very large variance."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, 1e-13)) @ vectors.T
    return np.asarray(inverse / np.outer(scale, scale))


def _least_squares(
    record: ArmRecord,
    start: dict[str, float],
    free: Sequence[str],
    used: NDArray[np.bool_],
    sigma: Array,
) -> tuple[dict[str, float], Array]:
    """Fit the rows ``used``; return the values and the Jacobian of the normalised residuals."""
    scale = np.array([1.0 if _unit(name) == "rad" else 0.1 for name in free])

    def residuals(unknown: Array) -> Array:
        values = {**start, **dict(zip(free, (unknown * scale).tolist(), strict=True))}
        left, turns = _misses(record, values)
        parts = [left[used].ravel() / sigma[0]]
        if turns is not None:
            parts.append(turns[used] / sigma[1])
        return np.concatenate(parts)

    begin = np.array([start[name] for name in free]) / scale
    found = least_squares(residuals, begin, method="lm", xtol=1e-12, ftol=1e-12)
    values = {**start, **dict(zip(free, (found.x * scale).tolist(), strict=True))}
    return values, np.asarray(found.jac / scale)


def _result(record: ArmRecord, fit: _Fit, held: Sequence[str]) -> ArmCalibration:
    used = fit.used
    left, turns = _misses(record, fit.values)
    distance = np.linalg.norm(left, axis=1)
    outliers = tuple(
        ArmOutlier(
            int(record.rows[k]), float(distance[k]), np.nan if turns is None else float(turns[k])
        )
        for k in np.flatnonzero(~used)
    )
    arm = [k for k, name in enumerate(fit.free) if not name.startswith("mount")]
    place = _by_differences(record.joints[used], fit.values, [fit.free[k] for k in arm])
    own = fit.covariance[np.ix_(arm, arm)]
    wrist_variance = np.einsum("nai,ij,naj->n", place[:, :2], own, place[:, :2])
    heading_variance = np.einsum("ni,ij,nj->n", place[:, 2], own, place[:, 2])
    return ArmCalibration(
        values=fit.values,
        deviations=fit.deviations(),
        held=tuple(held),
        residuals=left[used],
        turns=None if turns is None else turns[used],
        outliers=outliers,
        wrist_deviation=float(np.sqrt(wrist_variance.mean())),
        heading_deviation=float(np.sqrt(heading_variance.mean())),
        notes=tuple(_notes(record, fit, held)),
    )


def _by_differences(joints: Array, values: dict[str, float], names: Sequence[str]) -> Array:
    """Compute derivatives (N, 3, len(names)) of the wrist's x and y and the forearm's heading with
    respect to the values ``names``."""

    def place(values: dict[str, float]) -> Array:
        base = complex(values["base_x"], values["base_y"])
        at = base + np.exp(1j * values["base_yaw"]) * wrist(joints, values)
        turned = joints[:, 0] + joints[:, 1] + values["elbow_zero"] + values["base_yaw"]
        return np.stack([at.real, at.imag, turned], axis=1)

    step = 1e-6
    columns = [
        (place({**values, n: values[n] + step}) - place({**values, n: values[n] - step}))
        / (2 * step)
        for n in names
    ]
    return np.stack(columns, axis=2)


def _notes(record: ArmRecord, fit: _Fit, held: Sequence[str]) -> list[str]:
    """Describe the values that the record does not determine, and poses that would determine
    them."""
    warnings = [
        "the shoulder's zero offset and the base's yaw have the same effect; their sum is "
        "stored as the base's yaw"
    ]
    for name in held:
        warnings.append(
            f"the poses do not determine the {_IN_WORDS[name]}, which is kept as in the cell file; "
            + (
                "turn the tool relative to the forearm from pose to pose"
                if name.startswith("mount")
                else "bend the elbow by more different angles, to both sides if the arm can"
            )
        )
    spread = np.sqrt(np.diag(fit.covariance))
    correlation = np.tril(fit.covariance / np.outer(spread, spread), -1)
    for a, b in np.argwhere(np.abs(correlation) > _CORRELATED):
        warnings.append(
            f"the poses determine mainly a combination of {_IN_WORDS[fit.free[b]]} and "
            f"{_IN_WORDS[fit.free[a]]} (correlation {correlation[a, b]:+.3f}); their combined "
            "effect on the wrist is known better than each of the two values"
        )
    elbow = record.joints[fit.used, 1] + fit.values["elbow_zero"]
    if not (elbow.min() < -0.1 and elbow.max() > 0.1):
        warnings.append(
            "all poses bend the elbow to one side; poses on both sides separate the elbow's "
            "zero offset from the base pose better"
        )
    if fit.used.sum() < 15:
        warnings.append(
            f"the fit used only {fit.used.sum()} poses; 20 poses, spread over the whole table, are "
            "better"
        )
    return warnings
