"""Whether the fitted model explains the taps, and how far off its predictions of new taps are.

Lack of fit: the taps of a run repeat one setting, so their spread is what a tap varies by itself.
Three things that this spread cannot explain are looked for by F tests (Draper and Smith, Applied
Regression Analysis, 1998, sections 2.1 and 6.1): means of the runs that differ from the model, and,
within the runs, deviations that go with the place of the contact on the object or with the
direction of travel on the table.

Prediction: a new tap deviates by the model's error at its setting, of which the runs are a sample,
and by the scatter of a tap: two variances of a one-way random effects model, with Satterthwaite's
degrees of freedom. So the interval widens by itself where the model is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tapping_cell.calibration.prediction import Launches

Array = NDArray[np.float64]

LEVEL = 0.95
_TELLING = 0.001
"""Probability below which a deviation is no chance; six tests are made of one fit."""
_LEAST_TRIALS = 8
_FLOOR = {"distance": 0.005, "rotation": 0.01}
"""Relative: what is smaller matters to no tap, however exactly it was measured."""
_LEAST_TURN = 0.2
"""rad/m: of taps that turn less over their distance the relative rotation says nothing."""
_CAUSES = {
    "setting": "from run to run, that is with the striker's speed and the incidence",
    "place": "with the place of the contact on the object: is its centre of mass or of friction "
    "off the middle?",
    "direction": "with the direction on the table: is it level, and without a grain?",
}


@dataclass(frozen=True, slots=True)
class Misfit:
    """A deviation that is no chance: of ``quantity`` (distance, rotation) with ``cause`` (setting,
    place, direction); ``probability`` of the F test, ``size`` one standard deviation, relative, and
    ``inflation``, the ratio of the variances."""

    quantity: str
    cause: str
    probability: float
    size: float
    inflation: float

    def sentence(self) -> str:
        """What to tell a person."""
        return (
            f"The model does not fit: the {self.quantity} deviates by {100 * self.size:.0f} % "
            f"{_CAUSES[self.cause]} (probability by chance {self.probability:.1g})."
        )


@dataclass(frozen=True, slots=True)
class ModelError:
    """How far a new tap is off its prediction, relative: ``scatter`` of a tap at one setting and
    ``error`` of the model from setting to setting, one standard deviation each; ``half_width`` of
    the interval that holds 95 % of new taps."""

    quantity: str
    scatter: float
    error: float
    half_width: float

    @property
    def total(self) -> float:
        """Both together, one standard deviation: what a planner should expect."""
        return math.hypot(self.scatter, self.error)


@dataclass(frozen=True, slots=True, eq=False)
class Taps:
    """Measured taps beside what the model says of them, arrays (n,).

    ``runs`` says which belong together; ``contact`` is the direction of the contact point in the
    object and ``direction`` that of travel in table, rad, NaN where not known.
    """

    measured: Launches
    predicted: Launches
    runs: Sequence[str]
    contact: Array
    direction: Array

    def deviations(self) -> dict[str, Array]:
        """Measured over predicted, minus 1; NaN where that says nothing."""
        measured, predicted = self.measured, self.predicted
        turned = np.abs(predicted.rotation) > _LEAST_TURN * predicted.distance
        rotation = np.where(turned, predicted.rotation, 1.0)
        return {
            "distance": measured.distance / predicted.distance - 1,
            "rotation": np.where(turned, measured.rotation / rotation - 1, math.nan),
        }


def lack_of_fit(taps: Taps) -> tuple[Misfit, ...]:
    """What the model does not explain, the least probable first."""
    found: list[Misfit | None] = []
    runs = np.array(taps.runs)
    sides = np.array(
        [f"{run} {turn > 0}" for run, turn in zip(runs, taps.predicted.rotation, strict=False)]
    )
    for quantity, off in taps.deviations().items():
        known = np.isfinite(off)
        if known.sum() < _LEAST_TRIALS or np.unique(runs[known]).size < 2:
            continue
        # A model of p parameters has taken p of the means of the runs for itself; two here.
        found.append(_by_setting(quantity, off[known], runs[known]))
        # What turns the object to one side adds to one turn and takes from the other.
        sign = np.sign(taps.predicted.rotation) if quantity == "rotation" else 1.0
        for cause, angle, orders in (
            ("place", taps.contact, (1,)),
            ("direction", taps.direction, (1, 2)),
        ):
            usable = known & np.isfinite(angle)
            columns = [f(k * angle[usable]) for k in orders for f in (np.cos, np.sin)]
            signed = (sign * off)[usable]
            found.append(_by_angle(quantity, cause, signed, sides[usable], np.array(columns).T))
    telling = [misfit for misfit in found if misfit is not None and misfit.probability < _TELLING]
    return tuple(sorted(telling, key=lambda misfit: misfit.probability))


def model_errors(taps: Taps) -> tuple[ModelError, ...]:
    """Of distance and rotation, where enough taps tell."""
    found = []
    runs = np.array(taps.runs)
    for quantity, off in taps.deviations().items():
        known = np.isfinite(off)
        number, groups = int(known.sum()), np.unique(runs[known]).size
        if number < _LEAST_TRIALS or groups < 2:
            continue
        within, between = _mean_squares(off[known], runs[known])
        within = max(within, _FLOOR[quantity] ** 2)
        size = number / groups
        error = max(between - within, 0.0) / size
        variance = within * (1 + 2 / number) + error * (1 + 1 / groups)
        # Satterthwaite: of the mean squares' weights in the sum.
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
    """Within groups, and of the groups' means about the model."""
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
    """Whether harmonics of an angle explain what the means of the groups leave."""
    means = np.stack([(groups == name).astype(float) for name in np.unique(groups)], axis=1)
    spare = off.size - means.shape[1] - (columns.shape[1] if columns.ndim == 2 else 0)
    if spare < _LEAST_TRIALS // 2:
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
