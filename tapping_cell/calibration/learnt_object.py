"""Fit of friction, torque factor and scatter of an object to the taps of ordinary goals.

A tap planned with the mechanics of an object file launches the object with a known velocity and
spin. The measured displacement then determines friction and torque factor. These two values are
fitted to all taps jointly by robust least squares. Restitution and contact friction are kept from
the file. The fitted friction compensates for errors of these two values. It may therefore differ
from the true friction, but it predicts the taps of this cell accurately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares
from scipy.stats import chi2, t

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.estimates import Estimate, floor_estimates, with_estimates
from tapping_cell.calibration.keep import fingerprints, now
from tapping_cell.calibration.scatter_floor import Parts, scatter_parts
from tapping_cell.configuration.objects import GRAVITY, ObjectFile
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.mechanics import Sliding
from tapping_cell.se2 import Array, wrap_angle

EQUIVALENT = (
    "friction and torque factor are equivalent values: with the restitution and contact friction "
    "of the object file, they predict the taps of this cell; their intervals do not contain the "
    "error of those two values"
)
FEWEST_TAPS = 5
_DISTANCE, _ROTATION, _SLOPE = 0.05, 0.15, 0.1
"""Standard deviations by which the residuals are divided. ``_DISTANCE`` and ``_ROTATION`` are
relative to distance and rotation. ``_SLOPE`` is the standard deviation of the rotation per
distance, in rad/m, for taps that hardly rotate the object."""
_OUTLIER = 5.0
"""Number of standard deviations above which a tap is an outlier, for example due to a collision or
a miss."""
_BOUNDS = (np.log([0.01, 0.05]), np.log([2.0, 20.0]))
_UNKNOWN = 0.5
"""Relative standard deviation at or above which the torque factor counts as not determined."""
_MIN_SCATTER = 0.002


@dataclass(frozen=True, slots=True)
class LearntObject:
    """Result of the fit: ``content`` is the file with new values; ``used`` and ``left_out`` count
    taps."""

    content: ObjectFile
    estimates: tuple[Estimate, ...]
    used: int
    left_out: int


def learn_object(content: ObjectFile, commanded: ArrayLike, measured: ArrayLike) -> LearntObject:
    """Fit an object to taps that were planned with the mechanics of ``content``.

    Args:
        content: object file with which the taps were planned.
        commanded, measured: displacements (n, 3) in the object frame before the tap, m and rad.

    Raises:
        RecordError: too few taps moved the object.
    """
    asked, moved = np.asarray(commanded, dtype=float), np.asarray(measured, dtype=float)
    usable = np.all(np.isfinite(asked) & np.isfinite(moved), axis=1)
    usable &= np.hypot(moved[:, 0], moved[:, 1]) > 0.1 * np.hypot(asked[:, 0], asked[:, 1])
    asked, moved = asked[usable], moved[usable]
    if len(asked) < FEWEST_TAPS:
        raise RecordError(
            f"{len(asked)} of {usable.size} taps moved the object; at least {FEWEST_TAPS} are "
            "needed; send more goals, some with --probe"
        )
    body = content.body()
    assumed = Sliding(body, content.friction, content.torque_factor, GRAVITY)
    twist = assumed.twist_for(asked)

    def predicted(logarithms: Array) -> Array:
        friction, factor = np.exp(logarithms).tolist()
        return Sliding(body, friction, factor, GRAVITY).displace(twist)

    def residuals(logarithms: Array, rows: NDArray[np.bool_]) -> Array:
        distance, rotation, _ = _errors(predicted(logarithms)[rows], moved[rows])
        return np.concatenate([distance / _DISTANCE, rotation / _ROTATION])

    start = np.clip(np.log([content.friction, content.torque_factor]), *_BOUNDS)
    ratio = np.hypot(moved[:, 0], moved[:, 1]) / np.hypot(asked[:, 0], asked[:, 1])
    start[0] = np.clip(start[0] - np.log(np.median(ratio)), *(bound[0] for bound in _BOUNDS))
    rows = np.ones(len(asked), dtype=bool)
    for _ in range(3):
        found = least_squares(
            residuals, start, bounds=_BOUNDS, loss="soft_l1", diff_step=1e-4, args=(rows,)
        )
        start = found.x
        errors = _errors(predicted(start), moved)
        scatter = [max(1.4826 * float(np.median(np.abs(e[rows]))), _MIN_SCATTER) for e in errors]
        off = np.max(
            [np.abs(error) / size for error, size in zip(errors, scatter, strict=True)], axis=0
        )
        rows = off < _OUTLIER
        if rows.sum() < FEWEST_TAPS:
            raise RecordError(
                f"only {int(rows.sum())} of {len(asked)} taps are consistent with one another; at "
                f"least {FEWEST_TAPS} are needed. Check that the object lies flat, and that arm "
                "and tapper are calibrated"
            )
    count = int(rows.sum())
    deviations = [float(np.std(error[rows], ddof=2)) for error in errors]
    place, angle = _parts(predicted(start)[rows], [error[rows] for error in errors])
    if place is not None and place.floor > 0.0:
        deviations[0], deviations[2] = place.shares
    if angle is not None and angle.floor > 0.0:
        deviations[1] = angle.shares[0]
    weights = np.repeat([deviations[0] / _DISTANCE, deviations[1] / _ROTATION], count)
    steps = 1e-4 * np.eye(2)
    slopes = np.stack(
        [(residuals(start + s, rows) - residuals(start - s, rows)) / 2e-4 for s in steps], axis=1
    )
    slopes /= np.maximum(weights, 1e-6)[:, None]
    spread = np.sqrt(np.diag(np.linalg.pinv(slopes.T @ slopes)))
    wide = float(t.ppf(0.975, count - 2))
    friction, factor = np.exp(start).tolist()
    known = bool(spread[1] < _UNKNOWN)
    estimates = (
        _about("friction", friction, float(spread[0]), wide, content.friction),
        _about(
            "torque_factor", factor, float(spread[1]), wide, content.torque_factor, fitted=known
        ),
        *(
            _scatter(name, deviation, count, getattr(content.scatter, name), unit)
            for name, deviation, unit in zip(
                ("distance", "rotation", "direction"), deviations, ("", "", "rad"), strict=True
            )
        ),
        *floor_estimates(place, angle, content),
        _smallest(content, predicted(start)[rows]),
    )
    # The floors of the old file do not apply to the new scatter.
    own = replace(content.scatter, position_floor=0.0, angle_floor=0.0)
    made = with_estimates(replace(content, scatter=own, calibration=None), estimates)
    return LearntObject(made, estimates, count, int(usable.size) - count)


def learning_record(learnt: LearntObject, inputs: Sequence[Path]) -> Provenance:
    """Create the record of the fit."""
    by_name = {entry.name: entry for entry in learnt.estimates}
    intervals = "; ".join(f"{e.name} {e.low:.4g} to {e.high:.4g}" for e in learnt.estimates)
    return Provenance(
        by="object learn",
        made=now(),
        inputs=fingerprints(inputs),
        observations=learnt.used,
        left_out=learnt.left_out,
        residual=by_name["scatter_distance"].value,
        residual_of="distances, relative",
        uncertainty=by_name["friction"].std / by_name["friction"].value,
        uncertainty_of="friction, relative",
        deviations={e.name: e.std for e in learnt.estimates if e.fitted and math.isfinite(e.std)},
        notes=(f"95 % intervals: {intervals}", EQUIVALENT),
    )


def _errors(predicted: Array, measured: Array) -> tuple[Array, Array, Array]:
    """Compute the relative errors of distance and rotation, and the errors of the direction in
    rad."""
    length = np.hypot(predicted[:, 0], predicted[:, 1])
    moved = np.hypot(measured[:, 0], measured[:, 1])
    distance = np.log(moved / length)
    turn = np.hypot(predicted[:, 2], _SLOPE / _ROTATION * length)
    rotation = (measured[:, 2] * length / moved - predicted[:, 2]) / turn
    cross = predicted[:, 0] * measured[:, 1] - predicted[:, 1] * measured[:, 0]
    direction = np.arctan2(cross, (predicted[:, :2] * measured[:, :2]).sum(axis=1))
    return distance, rotation, np.asarray(wrap_angle(direction))


def _parts(predicted: Array, errors: Sequence[Array]) -> tuple[Parts | None, Parts | None]:
    """Divide the scatter, of the position and of the angle, into a part proportional to the size of
    the tap and a constant floor."""
    length, turn = np.hypot(predicted[:, 0], predicted[:, 1]), predicted[:, 2]
    off = np.hypot(turn, _SLOPE / _ROTATION * length) * errors[1]
    return (
        scatter_parts([(np.expm1(errors[0]) * length, length), (errors[2] * length, length)]),
        scatter_parts([(off, np.abs(turn))]),
    )


def _about(
    name: str, value: float, spread: float, wide: float, old: float, *, fitted: bool = True
) -> Estimate:
    """Create the estimate of a value whose logarithm has the standard deviation ``spread``; the
    interval covers ``wide`` standard deviations to each side."""
    if not fitted:
        return Estimate(name, old, math.nan, math.nan, math.nan, old, fitted=False)
    low, high = value * math.exp(-wide * spread), value * math.exp(wide * spread)
    return Estimate(name, value, low, high, value * spread, old)


def _scatter(name: str, value: float, count: int, old: float, unit: str) -> Estimate:
    freedom = count - 2
    low = value * math.sqrt(freedom / float(chi2.ppf(0.975, freedom)))
    high = value * math.sqrt(freedom / float(chi2.ppf(0.025, freedom)))
    return Estimate(f"scatter_{name}", value, low, high, value / math.sqrt(2 * freedom), old, unit)


def _smallest(content: ObjectFile, predicted: Array) -> Estimate:
    """Return the smallest predicted displacement of the taps used, or the file's value if that is
    smaller."""
    seen = float(np.hypot(predicted[:, 0], predicted[:, 1]).min())
    value = min(max(seen, 1e-4), content.smallest_tap)
    return Estimate("smallest_tap", value, 0.0, value, 0.0, content.smallest_tap, "m")
