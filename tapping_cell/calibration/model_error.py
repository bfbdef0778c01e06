"""Lack-of-fit tests of the fitted model, and its prediction error for new taps.

Lack of fit: the taps of a run repeat one setting, so their spread is the scatter of a tap. F tests
(Draper and Smith, Applied Regression Analysis, 1998, sections 2.1 and 6.1) detect three effects
that this scatter cannot explain: run means that differ from the model and, within the runs,
deviations that depend on the contact point on the object or on the direction of travel.

Prediction: the error of a new tap has two sources, the scatter of a tap and the model's error at
the tap's setting. The runs are a sample of the settings, so the two variances are those of a
one-way random effects model, with Satterthwaite's degrees of freedom. If the model is wrong, the
second variance is large, and the interval that contains 95 % of new taps is wide.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tapping_cell.calibration.prediction import Launches
from tapping_cell.se2 import Array

LEVEL = 0.95
_SIGNIFICANT = 0.001
"""Significance level of one test; six tests are made for each fit."""
_MIN_TRIALS = 8
_FLOOR = {"distance": 0.005, "rotation": 0.01}
"""Relative standard deviations that are negligible in practice. The scatter is assumed to be at
least as large as these values, so that smaller model errors are not reported."""
_MIN_TURN = 0.2
"""Minimum rotation per distance, in rad/m, for which a relative rotation error is meaningful (equal
to 0.2 degrees in 17 mm)."""
_CAUSES = {
    "setting": "from run to run, that is, with the striker's speed and the incidence.",
    "place": "with the contact point on the object. Is the centre of mass or of friction off "
    "the object's middle?",
    "direction": "with the direction on the table. Is the table level, and is the table's "
    "friction the same in all directions?",
}


@dataclass(frozen=True, slots=True)
class Misfit:
    """A deviation of ``quantity`` (distance, rotation) that depends on ``cause`` (setting, place,
    direction). ``probability`` is the p-value of the F test, and ``size`` is the relative standard
    deviation due to the cause. ``inflation`` is the F statistic: the mean square due to the cause
    divided by the mean square of the scatter."""

    quantity: str
    cause: str
    probability: float
    size: float
    inflation: float

    def sentence(self) -> str:
        """Describe the deviation for the user."""
        return (
            f"The model does not fit (p-value {self.probability:.1g}): the relative error of the "
            f"predicted {self.quantity} varies by {100 * self.size:.0f} % (standard deviation) "
            f"{_CAUSES[self.cause]}"
        )


@dataclass(frozen=True, slots=True)
class ModelError:
    """Relative prediction error of a new tap. ``scatter`` is the standard deviation of taps at one
    setting, and ``error`` is the standard deviation of the model's error between settings.
    ``half_width`` is half the width of the interval that contains 95 % of new taps."""

    quantity: str
    scatter: float
    error: float
    half_width: float

    @property
    def total(self) -> float:
        """Combined standard deviation of scatter and model error, with which a planner should
        work."""
        return math.hypot(self.scatter, self.error)


@dataclass(frozen=True, slots=True, eq=False)
class Taps:
    """Measured taps with the model's predictions, arrays (n,).

    ``runs`` is the run of each tap. ``contact`` is the direction of the contact point in the object
    frame, and ``direction`` is the direction of travel in ``table``. Both are in rad, and NaN if
    unknown.
    """

    measured: Launches
    predicted: Launches
    runs: Sequence[str]
    contact: Array
    direction: Array

    def turned(self) -> NDArray[np.bool_]:
        """Return for which taps (n,) a relative deviation of the rotation is meaningful."""
        return np.abs(self.predicted.rotation) > _MIN_TURN * self.predicted.distance

    def deviations(self) -> dict[str, Array]:
        """Compute relative deviations from the predictions; NaN for small predicted rotations."""
        measured, predicted, turned = self.measured, self.predicted, self.turned()
        rotation = np.where(turned, predicted.rotation, 1.0)
        return {
            "distance": measured.distance / predicted.distance - 1,
            "rotation": np.where(turned, measured.rotation / rotation - 1, math.nan),
        }


def lack_of_fit(taps: Taps) -> tuple[Misfit, ...]:
    """Return the significant deviations from the model, in order of increasing p-value."""
    found: list[Misfit | None] = []
    runs = np.array(taps.runs)
    sides = np.array(
        [f"{run} {turn > 0}" for run, turn in zip(runs, taps.predicted.rotation, strict=False)]
    )
    for quantity, off in taps.deviations().items():
        known = np.isfinite(off)
        if known.sum() < _MIN_TRIALS or np.unique(runs[known]).size < 2:
            continue
        # Each fitted parameter removes one degree of freedom from the run means. The test ignores
        # this, so its p-value is slightly too large.
        found.append(_by_setting(quantity, off[known], runs[known]))
        # A disturbance that turns the object counterclockwise makes counterclockwise rotations
        # larger and clockwise rotations smaller. After multiplication by the sign of the rotation,
        # the relative deviations of both kinds of rotation have the same sign.
        sign = np.sign(taps.predicted.rotation) if quantity == "rotation" else 1.0
        for cause, angle, orders in (
            ("place", taps.contact, (1,)),
            ("direction", taps.direction, (1, 2)),
        ):
            usable = known & np.isfinite(angle)
            columns = [f(k * angle[usable]) for k in orders for f in (np.cos, np.sin)]
            signed = (sign * off)[usable]
            found.append(_by_angle(quantity, cause, signed, sides[usable], np.array(columns).T))
    significant = [
        misfit for misfit in found if misfit is not None and misfit.probability < _SIGNIFICANT
    ]
    return tuple(sorted(significant, key=lambda misfit: misfit.probability))


def model_errors(taps: Taps) -> tuple[ModelError, ...]:
    """Estimate the prediction errors of distance and rotation, if there are enough taps."""
    found = []
    runs = np.array(taps.runs)
    for quantity, off in taps.deviations().items():
        known = np.isfinite(off)
        number, groups = int(known.sum()), np.unique(runs[known]).size
        if number < _MIN_TRIALS or groups < 2:
            continue
        within, between = _mean_squares(off[known], runs[known])
        within = max(within, _FLOOR[quantity] ** 2)
        size = number / groups
        error = max(between - within, 0.0) / size
        variance = within * (1 + 2 / number) + error * (1 + 1 / groups)
        # Satterthwaite's approximation of the degrees of freedom of this sum of mean squares.
        parts = (error * (1 + 1 / groups)) ** 2 / max(groups - 1, 1)
        parts += (within * (1 + 2 / number)) ** 2 / (number - groups)
        freedom = variance**2 / parts if parts > 0 else number - groups
        quantile = float(stats.t.ppf((1 + LEVEL) / 2, freedom))
        found.append(
            ModelError(
                quantity, math.sqrt(within), math.sqrt(error), quantile * math.sqrt(variance)
            )
        )
    return tuple(found)


def _mean_squares(off: Array, groups: NDArray[np.str_]) -> tuple[float, float]:
    """Compute the mean square of the residuals about their group means and, weighted by the sizes
    of the groups, the mean square of the group means."""
    names = np.unique(groups)
    within = sum(float(np.sum((off[groups == n] - off[groups == n].mean()) ** 2)) for n in names)
    between = sum(float(np.sum(groups == n) * off[groups == n].mean() ** 2) for n in names)
    return within / (off.size - names.size), between / names.size


def _by_setting(quantity: str, off: Array, runs: NDArray[np.str_]) -> Misfit:
    names = np.unique(runs)
    within, between = _mean_squares(off, runs)
    within = max(within, _FLOOR[quantity] ** 2)
    ratio = between / within
    probability = float(stats.f.sf(ratio, names.size, off.size - names.size))
    size = math.sqrt(max(between - within, 0.0) * names.size / off.size)
    return Misfit(quantity, "setting", probability, size, ratio)


def _by_angle(
    quantity: str, cause: str, off: Array, groups: NDArray[np.str_], columns: Array
) -> Misfit | None:
    """Test whether harmonics of an angle explain the residuals about the group means."""
    means = np.stack([(groups == name).astype(float) for name in np.unique(groups)], axis=1)
    spare = off.size - means.shape[1] - (columns.shape[1] if columns.ndim == 2 else 0)
    if spare < _MIN_TRIALS // 2:
        return None
    alone = off - means @ np.linalg.lstsq(means, off, rcond=None)[0]
    both = np.concatenate([means, columns], axis=1)
    coefficients = np.linalg.lstsq(both, off, rcond=None)[0]
    rest = off - both @ coefficients
    count = columns.shape[1]
    noise = max(float(rest @ rest) / spare, _FLOOR[quantity] ** 2)
    ratio = (float(alone @ alone) - float(rest @ rest)) / count / noise
    explained = columns @ coefficients[means.shape[1] :]
    probability = float(stats.f.sf(ratio, count, spare))
    return Misfit(quantity, cause, probability, float(np.std(explained)), ratio)
