"""Analysis of which parameters the trials determine, and which further taps would determine more.

The Fisher information of the launches is the sum of their squared derivatives with respect to the
parameters, divided by the variance of a tap. The information is computed for all parameters,
including those that the fit keeps fixed. A parameter is not determined if, with all other
parameters free, its relative standard deviation is too large. Eigenvectors with small eigenvalues
are combinations of parameters that are not determined. The information of candidate experiments is
added to that of the trials, and the best candidate is recommended.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tapping_cell.calibration.impact_fit import NAMES, ImpactModel, Strikes, weighted_slopes
from tapping_cell.se2 import Array

GAIN = "striker_speed_gain"
_ALL = (*NAMES, GAIN)
_WORDS = {
    "restitution": "restitution",
    "contact_friction": "contact friction",
    "scale_b1": "scale of B1",
    "scale_b2": "scale of B2",
    "scale_b3": "scale of B3",
    GAIN: "ratio of measured to commanded striker speed",
}
_UNKNOWN = 0.5  # relative standard deviation above which a parameter is not determined
_SHARE = 0.3  # eigenvector components below this fraction of the largest one are ignored
_LARGE = 1e6
_TAPS = 10
_REBOUND_STD = 0.02  # relative standard deviation of a measured striker speed after the impact
_INCIDENCES = tuple(math.radians(angle) for angle in (0, 10, 20, 30, 40, 50, 60))


@dataclass(frozen=True, slots=True)
class Identifiability:
    """Result of the analysis.

    ``alone`` holds the relative standard deviation of each parameter if the other parameters are
    known, and ``together`` if all parameters are unknown. A value of inf means that the trials do
    not determine the parameter. ``sentences`` are the findings as text.
    """

    alone: Mapping[str, float]
    together: Mapping[str, float]
    sentences: tuple[str, ...]


def identifiability(
    model: ImpactModel,
    values: Mapping[str, float],
    scatter: Sequence[float],
    speed_known: float,
) -> Identifiability:
    """Analyse how well the trials determine all parameters of the impact.

    ``speed_known`` is the relative standard deviation of the factor common to all striker speeds;
    it is inf if only the commanded speeds are known.
    """
    information = _information(model, values, scatter, speed_known)
    alone, together = _deviations(information, values)
    sentences = [
        *_confounded(information, speed_known),
        *_advice(model, values, scatter, information),
    ]
    return Identifiability(
        dict(zip(_ALL, alone.tolist(), strict=True)),
        dict(zip(_ALL, together.tolist(), strict=True)),
        tuple(sentences),
    )


def _information(
    model: ImpactModel, values: Mapping[str, float], scatter: Sequence[float], speed_known: float
) -> Array:
    launch = model.launch(values)
    deviation = model.deviation_std(launch, scatter)
    slopes = weighted_slopes(model, values, NAMES, deviation)
    gain = np.zeros((len(launch), 3, 1))
    gain[:, 0, 0] = -launch[:, 0] / deviation[:, 0]
    every = np.concatenate([slopes, gain], axis=2)
    information = np.einsum("nkp,nkq->pq", every, every)
    if math.isfinite(speed_known):
        information[-1, -1] += speed_known**-2
    return np.asarray(information)


def _deviations(information: Array, values: Mapping[str, float]) -> tuple[Array, Array]:
    """Return two arrays of relative standard deviations (p,): with the other parameters known, and
    with all parameters free."""
    restitution = values["restitution"]
    to_relative = np.ones(len(information))
    to_relative[0] = (1 + restitution) / max(restitution, 1e-3)
    diagonal = np.diag(information)
    alone = to_relative * np.where(
        diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), math.inf
    )
    together = to_relative * np.sqrt(
        np.diag(np.linalg.inv(information + np.eye(len(diagonal)) / _LARGE))
    )
    return (
        np.where(alone > _UNKNOWN, math.inf, alone),
        np.where(together > _UNKNOWN, math.inf, together),
    )


def _confounded(information: Array, speed_known: float) -> list[str]:
    sentences = []
    values, vectors = np.linalg.eigh(information)
    for value, vector in zip(values, vectors.T, strict=True):
        if value > _UNKNOWN**-2:
            continue
        largest = float(np.max(np.abs(vector)))
        names = [
            _WORDS[name]
            for name, part in zip(_ALL, vector, strict=True)
            if abs(part) > _SHARE * largest
        ]
        if len(names) == 1:
            sentences.append(f"The trials do not determine the {names[0]}.")
        else:
            listed = ", ".join(names[:-1]) + " and " + names[-1]
            sentences.append(f"The trials determine only a combination of {listed}.")
    if not math.isfinite(speed_known):
        sentences.append(
            "The striker's speed was not measured; the restitution is correct only if the speed "
            "was exactly as commanded. Friction, torque factor, contact friction and predictions "
            "for the same tapper do not depend on this assumption."
        )
    return sentences


def _advice(
    model: ImpactModel, values: Mapping[str, float], scatter: Sequence[float], information: Array
) -> list[str]:
    """Recommend the most informative further taps for each parameter that is not determined."""
    sentences = []
    known = _deviations(information, values)[1]
    for index, name in enumerate(_ALL):
        if math.isfinite(float(known[index])):
            continue
        after, description = min(
            (float(_deviations(information + more, values)[1][index]), description)
            for description, more in _candidates(model, values, scatter)
        )
        if after < _UNKNOWN:
            sentences.append(
                f"{_TAPS} more taps {description} would reduce the uncertainty of the "
                f"{_WORDS[name]} to {100 * after:.0f} %."
            )
    return sentences


def _candidates(
    model: ImpactModel, values: Mapping[str, float], scatter: Sequence[float]
) -> list[tuple[str, Array]]:
    strikes = model.strikes
    speed = float(np.median(strikes.speed))
    found: list[tuple[str, Array]] = []
    for incidence in _INCIDENCES:
        other = model.with_strikes(_alike(strikes, speed, incidence))
        information = _information(other, values, scatter, math.inf)
        angle = f"at {speed:.2f} m/s and an incidence of {math.degrees(incidence):.0f} degrees"
        both = angle + " with the striker's speed measured before and after the impact"
        found += [(angle, information), (both, information + _rebound(other, values))]
    return found


def _alike(strikes: Strikes, speed: float, incidence: float) -> Strikes:
    """Create candidate taps with incidences of both signs, measured as accurately as the median
    trial."""
    usual = ("speed_std", "launch_speed", "launch_speed_std", "spin", "spin_std", "angle_std")
    side = np.where(np.arange(_TAPS) % 2 == 0, 1.0, -1.0)
    measured = np.isfinite(strikes.angle).any()
    return replace(
        strikes,
        speed=np.full(_TAPS, speed),
        incidence=side * incidence,
        contact=np.tile(np.median(strikes.contact, axis=0), (_TAPS, 1)),
        angle=np.full(_TAPS, 0.0 if measured else math.nan),
        **{name: np.full(_TAPS, np.nanmedian(getattr(strikes, name))) for name in usual},
    )


def _rebound(model: ImpactModel, values: Mapping[str, float]) -> Array:
    """Compute the Fisher information of striker speeds measured before and after the impact."""
    columns = []
    strikes = model.strikes
    for name in NAMES:
        ends = [model.rebound({**values, name: values[name] * factor}) for factor in (1.01, 0.99)]
        by_log = (ends[0] - ends[1]) / 0.02
        if name == "restitution":
            by_log *= (1 + values[name]) / max(values[name], 1e-3)
        columns.append(by_log)
    columns.append(model.rebound(values))
    slopes = np.stack(columns, axis=1) / (_REBOUND_STD * strikes.speed[:, None])
    information = slopes.T @ slopes
    information[-1, -1] += _TAPS / _REBOUND_STD**2
    return np.asarray(information)
