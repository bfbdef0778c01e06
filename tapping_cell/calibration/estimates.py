"""Fitted values with their confidence intervals and the previous values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.bootstrap import spread
from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.impact_fit import NAMES, ImpactFit
from tapping_cell.calibration.model_error import ModelError, Taps
from tapping_cell.calibration.prediction import Launches
from tapping_cell.calibration.scatter_floor import Parts, scatter_parts
from tapping_cell.calibration.sliding_fit import SlideFit
from tapping_cell.configuration.objects import ObjectFile, ScatterSection
from tapping_cell.se2 import Array

_MIN_SCATTER_TRIALS = 8
_KEYS = ("friction", "torque_factor", "restitution", "contact_friction", "smallest_tap")
"""Keys of the object file whose names equal the names of their estimates."""
_UNKNOWN = 0.5  # relative standard deviation above which a value counts as not determined


@dataclass(frozen=True, slots=True)
class Estimate:
    """A fitted value with its 95 % interval, standard deviation and previous value.

    ``old`` is NaN if the object file had no value. If the data do not determine the value,
    ``fitted`` is False, and low, high and std are NaN.
    """

    name: str
    value: float
    low: float
    high: float
    std: float
    old: float
    unit: str = ""
    fitted: bool = True


def with_estimates(content: ObjectFile, estimates: Sequence[Estimate]) -> ObjectFile:
    """Return the object file with the fitted values, rounded to six digits; values that were not
    fitted are unchanged. The scatter is limited to the range of its keys."""
    found = {entry.name: float(f"{entry.value:.6g}") for entry in estimates if entry.fitted}
    scatter = {
        key.name: min(found[f"scatter_{key.name}"], key.metadata["limits"].maximum)
        for key in fields(ScatterSection)
        if f"scatter_{key.name}" in found
    }
    values: dict[str, Any] = {name: found[name] for name in _KEYS if name in found}
    return replace(content, scatter=replace(content.scatter, **scatter), **values)


def slide_estimates(
    slide: SlideFit, runs: Sequence[int], content: ObjectFile, seed: int
) -> list[Estimate]:
    """Estimate friction and torque factor; ``runs`` is the run of each trial.

    Raises:
        RecordError: the trials do not determine both values.
    """
    message = (
        "the trials do not determine friction and torque factor together: the object hardly "
        "turned. Tap with an incidence of at least 20 degrees"
    )
    try:
        width = spread(slide.score, slide.information, runs, seed)
    except ValueError as problem:
        raise RecordError(message) from problem
    # The bootstrap reports no uncertainty for slides without noise and rotation, although such
    # slides do not determine the torque factor. Therefore also check the Fisher information.
    expected = np.sqrt(np.diag(np.linalg.inv(slide.information.sum(axis=0))))
    if max(float(np.max(width.std[:2])), float(np.max(expected[:2]))) > _UNKNOWN:
        raise RecordError(message)
    values = (slide.friction, slide.torque_factor)
    old = (content.friction, content.torque_factor)
    return [
        Estimate(
            name,
            value,
            value * math.exp(width.low[k]),
            value * math.exp(width.high[k]),
            value * float(width.std[k]),
            old[k],
        )
        for k, (name, value) in enumerate(zip(("friction", "torque_factor"), values, strict=True))
    ]


def impact_estimates(
    impact: ImpactFit,
    runs: Sequence[int],
    content: ObjectFile,
    seed: int,
    inflation: float = 1.0,
) -> list[Estimate]:
    """Estimate all parameters of the impact, including those that were not fitted.

    ``inflation`` widens the intervals if the model does not fit.
    """
    known = (content.restitution, content.contact_friction, *content.impact_scale)
    old = dict(zip(NAMES, known, strict=True))
    try:
        width = spread(impact.score, impact.information, runs, seed + 1)
    except ValueError:
        width = None
    estimates = []
    for name, value in impact.values.items():
        kept = Estimate(name, value, *(math.nan,) * 3, old[name], fitted=False)
        if name not in impact.free or width is None:
            estimates.append(kept)
            continue
        k = impact.free.index(name)
        if inflation * float(width.std[k]) > _UNKNOWN:
            estimates.append(kept)
            continue
        shift = 1.0 if name == "restitution" else 0.0  # fitted as ln(1 + e)
        ends = [
            (value + shift) * math.exp(offset) - shift
            for offset in (inflation * float(width.low[k]), inflation * float(width.high[k]))
        ]
        if name == "restitution":
            ends = [min(max(end, 0.0), 1.0) for end in ends]
        std = inflation * (value + shift) * float(width.std[k])
        estimates.append(Estimate(name, value, ends[0], ends[1], std, old[name]))
    return estimates


def scatter_estimates(
    taps: Taps,
    impact: ImpactFit,
    runs: Sequence[int],
    content: ObjectFile,
    seed: int,
    errors: Sequence[ModelError],
) -> list[Estimate]:
    """Estimate the scatter of launches (speed, spin, direction) and displacements.

    The scatter of distance and rotation includes the model's prediction ``errors``, because a
    planner must expect both scatter and model error. If the scatter of small taps, relative to
    their size, is larger than that of large taps, the scatter is divided into a part proportional
    to the size and a constant floor.
    """
    expected = {entry.quantity: entry.total for entry in errors}
    place, angle = _parts(taps.measured, taps.predicted, impact, runs)
    between = {entry.quantity: entry.error for entry in errors}
    if place is not None and place.floor > 0.0:
        expected["distance"] = math.hypot(place.shares[0], between.get("distance", 0.0))
    if angle is not None and angle.floor > 0.0:
        expected["rotation"] = math.hypot(angle.shares[0], between.get("rotation", 0.0))
    direction = impact.scatter[2] if place is None or place.floor == 0.0 else place.shares[1]
    old, off = content.scatter, taps.deviations()
    spin = np.where(taps.turned(), impact.deviations[:, 1], math.nan)
    found = []
    for name, deviation, before, value in (
        ("speed", impact.deviations[:, 0], math.nan, impact.scatter[0]),
        ("spin", spin, math.nan, impact.scatter[1]),
        ("direction", impact.deviations[:, 2], old.direction, direction),
        ("distance", off["distance"], old.distance, expected.get("distance", math.nan)),
        ("rotation", off["rotation"], old.rotation, expected.get("rotation", math.nan)),
    ):
        known = np.isfinite(deviation)
        unit = "rad" if name == "direction" else ""
        if known.sum() < _MIN_SCATTER_TRIALS:
            continue
        total = math.sqrt(float(np.mean(deviation[known] ** 2)))
        if total == 0.0:
            continue
        value = total if math.isnan(value) else value
        square = (deviation[known] / total) ** 2
        width = spread(
            (1 - square)[:, None],
            np.full((int(known.sum()), 1, 1), 2.0),
            list(compress(runs, known)),
            seed + 2,
        )
        low, high = (value * math.exp(float(end[0])) for end in (width.low, width.high))
        std = value * float(width.std[0])
        found.append(Estimate(f"scatter_{name}", value, low, high, std, before, unit))
    return [*found, *floor_estimates(place, angle, content)]


def floor_estimates(
    place: Parts | None, angle: Parts | None, content: ObjectFile
) -> Iterator[Estimate]:
    """Yield estimates of those floors of the scatter that the taps determine.

    A floor that is not significant is given as 0, without an interval.
    """
    for name, parts, unit in (("position_floor", place, "m"), ("angle_floor", angle, "rad")):
        if parts is not None:
            factor = math.exp(1.96 * parts.floor_std / parts.floor) if parts.floor > 0.0 else 1.0
            yield Estimate(
                f"scatter_{name}",
                parts.floor,
                parts.floor / factor,
                parts.floor * factor,
                parts.floor_std,
                getattr(content.scatter, name),
                unit,
            )


def _parts(
    measured: Launches, tapped: Launches, impact: ImpactFit, runs: Sequence[int]
) -> tuple[Parts | None, Parts | None]:
    """Divide the scatter within runs, of the position and of the angle, into a part proportional to
    the size of the tap and a constant floor."""
    labels = np.asarray(runs)
    return (
        scatter_parts(
            [
                (_within(measured.distance - tapped.distance, labels), tapped.distance),
                (_within(impact.deviations[:, 2] * tapped.distance, labels), tapped.distance),
            ]
        ),
        scatter_parts(
            [(_within(measured.rotation - tapped.rotation, labels), np.abs(tapped.rotation))]
        ),
    )


def _within(off: Array, runs: NDArray[np.int_]) -> Array:
    """Return the deviation of each tap from the mean of its run; NaN if the run has only one tap.

    Subtracting the mean of n taps multiplies the variance by (n - 1) / n, so the deviations are
    scaled up accordingly.
    """
    made = np.full(off.size, math.nan)
    for run in np.unique(runs):
        own = (runs == run) & np.isfinite(off)
        count = int(own.sum())
        if count > 1:
            made[own] = (off[own] - off[own].mean()) * math.sqrt(count / (count - 1))
    return made
