"""Calibration of the striker's speed against the stored energy, from the object's displacements.

The launch speed follows from the measured displacement (v0 = sqrt(2 mu g x) without rotation), and
the striker's speed from the impact's ratio of launch to striker speed. The fitted model is

    ln v = a + ln(E) / 2 + g(ln E),

which is the ideal drive (v ~ sqrt(E)) with a smooth deviation g. The deviation g is a Gaussian
process. Several amplitudes and length scales of g are tried, and their curves are weighted by the
marginal likelihood (Rasmussen and Williams, Gaussian Processes for Machine Learning, chapter 5).
The level a has no prior, whereas g differs from zero only as far as the data require.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.csv_table import Column
from tapping_cell.mechanics import Impact, Tap
from tapping_cell.se2 import Array

MIN_TAPS = 8
SHARES = (8, 4, 3, 3, 4, 8)
"""Distribution of 30 taps over six energies (equal steps in ln E). The two ends of the range get
more taps, because the curve at an end is determined only by the taps there."""
POINTS = 8
"""Number of points of the resulting curve."""
RECORD_COLUMNS = (
    Column("energy", "J", 1e-7, 100.0, least_largest=1e-5),
    Column("distance", "m", 0.0, 1.0, least_largest=0.002),
    Column("rotation", "rad", -20.0, 20.0, required=False),
    Column("incidence", "rad", -1.4, 1.4, required=False),
    Column("distance_std", "m", 1e-6, 0.01, required=False),
)
"""Columns of the record file; each row is one tap."""
USUAL_DEVIATION = 1e-4
"""Default standard deviation of a displacement, in m, measured by an overhead camera."""
_NO_MOTION = 0.0003
"""Displacement in m below which the object did not move (three times the camera's error)."""
_SHORT, _NEIGHBOURS = 0.003, 5
"""A tap that does not move the object counts as too weak if the median displacement of those
``_NEIGHBOURS`` taps that moved the object and have the most similar energies is below ``_SHORT`` m;
otherwise it counts as a miss."""
_RELIABLE = 0.9
"""Fraction of the taps of one energy that must move the object for the energy to be reliable."""
_OUTLIER = 4.5
_FLOOR = 0.01
"""Minimum relative scatter assumed for outlier detection."""
_AMPLITUDES = (0.08, 0.16, 0.32)
_NOISES = 32
"""Number of candidate values for the scatter of a tap."""
_STRETCHES = (0.7, 1.4)
"""Candidate length scales of the deviation g, as fractions of the range of ln E. ``_AMPLITUDES``
are the candidate standard deviations of g. Smaller amplitudes are not tried: losses and thresholds
make every drive deviate from the ideal drive, and an assumed deviation that is too small costs more
accuracy than it gains."""
_ALIKE = 0.02
"""Relative difference up to which energies count as the same energy level."""


@dataclass(frozen=True, slots=True, eq=False)
class TapRecord:
    """Taps (N,): ``energies`` in J, ``distances`` in m, ``rotations`` in rad, ``incidences`` from
    the contact normal to the striker's axis in rad, and row numbers ``rows`` in the file.
    ``deviations`` are the standard deviations of the distances due to the camera's noise, in m.
    """

    energies: Array
    distances: Array
    rotations: Array
    incidences: Array
    deviations: Array
    rows: NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A rejected tap with the reason."""

    row: int
    reason: str

    def __str__(self) -> str:
        return f"row {self.row}: {self.reason}"


@dataclass(frozen=True, slots=True)
class Draw:
    """Statistics of the taps of one energy in J: number of taps, number of taps that moved the
    object, mean speed in m/s and relative scatter of the speed (None for fewer than three taps)."""

    energy: float
    taps: int
    moved: int
    speed: float
    scatter: float | None


@dataclass(frozen=True, slots=True, eq=False)
class TapperCalibration:
    """The calibrated curve and its quality.

    ``energies`` in J and ``speeds`` in m/s are increasing; ``deviations`` are relative standard
    deviations of the speeds. ``scatter`` is the relative scatter of the speed from tap to tap.
    ``least_energy`` in J and ``least_travel`` in m describe the smallest reliable tap.
    ``by_friction`` is the relative change of all speeds if the friction in the object file changes,
    divided by the relative change of the friction. ``by_restitution`` is the relative change of all
    speeds if the restitution in the file changes, divided by the change of the restitution.
    """

    energies: tuple[float, ...]
    speeds: tuple[float, ...]
    deviations: tuple[float, ...]
    scatter: float
    used: int
    draws: tuple[Draw, ...]
    left_out: tuple[LeftOut, ...]
    least_energy: float
    least_travel: float
    by_friction: float
    by_restitution: float
    notes: tuple[str, ...]

    @property
    def uncertainty(self) -> float:
        """Root mean square of the relative standard deviations over the curve."""
        return float(np.sqrt(np.mean(np.square(self.deviations))))


def striker_speeds(record: TapRecord, tap: Tap) -> Array:
    """Compute the striker's speed (N,) in m/s from the displacement of each tap."""
    launch = tap.sliding.launch(record.distances, record.rotations)
    return np.asarray(launch.speed / launch_ratio(tap.impact, record.incidences))


def launch_ratio(impact: Impact, incidences: Array) -> Array:
    """Compute launch speed over striker speed for taps at the middle of the body's nearest side."""
    # The contact lies towards -x from the centre; for a polygon, at the distance of the nearest
    # side.
    angles = np.linspace(0.0, 2.0 * np.pi, 721)
    near = float(np.linalg.norm(impact.body.boundary(angles), axis=-1).min())
    result = impact.strike(1.0, incidences, np.array([-near, 0.0]))
    return np.asarray(np.linalg.norm(result.velocity, axis=-1))


def calibrate_tapper(record: TapRecord, tap: Tap) -> TapperCalibration:
    """Calibrate the curve of the tapper from taps on the object of ``tap``.

    Raises:
        CalibrationRefused: too few taps moved the object, there are fewer than three different
            energies, or the taps do not fit one curve.
    """
    groups = _groups(record.energies)
    moves = record.distances >= _NO_MOTION
    least_energy = _least(record, groups, moves)
    usable = moves & (record.energies >= least_energy * (1 - _ALIKE))
    left_out = [
        LeftOut(
            int(record.rows[k]),
            f"the object moved {record.distances[k] * 1e3:.2f} mm: a miss, or too weak a tap"
            if not moves[k]
            else f"energy {record.energies[k] * 1e3:.4g} mJ does not move the object reliably",
        )
        for k in np.flatnonzero(~usable)
    ]
    if usable.sum() < MIN_TAPS:
        raise CalibrationRefused(
            f"{int(usable.sum())} taps that moved the object are too few: at least "
            f"{MIN_TAPS} are needed; 30 over the range are recommended"
        )
    speeds = np.where(usable, striker_speeds(record, tap), 1.0)
    x, y = np.log(record.energies), np.log(speeds)
    # The speed is proportional to the square root of the displacement, so its relative error is
    # half that of the displacement.
    seen = 0.5 * record.deviations / np.maximum(record.distances, _NO_MOTION)
    levels = len(np.unique(groups[usable]))
    if levels < 3:
        raise CalibrationRefused(
            f"only {levels} different energies were used, too few for a "
            "curve: use at least 3, preferably 6, from the smallest tap to the largest"
        )
    while True:
        curve = _Curve(x[usable], y[usable], seen[usable])
        # For the shortest displacements, the camera's noise is the largest error. This noise is
        # included in the expected scatter, so that taps with short displacements are not rejected.
        off = np.abs(y - curve.at(x)[0]) / np.hypot(1.0, seen / max(curve.noise, _FLOOR))
        spread = max(1.4826 * float(np.median(off[usable])), _FLOOR)
        strange = usable & (off > _OUTLIER * spread)
        if not strange.any():
            break
        worst = int(np.argmax(np.where(strange, off, -1.0)))
        factor = math.exp(y[worst] - curve.at(x[[worst]])[0][0])
        left_out.append(
            LeftOut(
                int(record.rows[worst]),
                f"the striker's speed is {factor:.2f} times the speed of the fitted curve at this "
                f"energy (scatter of the taps: {100 * spread:.1f} %); did the tap miss, was it "
                "disturbed, or is a unit wrong?",
            )
        )
        usable[worst] = False
        needed = max(MIN_TAPS, len(x) // 2)
        if usable.sum() < needed:
            raise CalibrationRefused(
                f"no single curve fits the taps: fewer than {needed} of the "
                f"{len(x)} taps are consistent with one curve. Check the columns' units and that "
                "all taps hit the object's middle"
            )
    low, high = float(record.energies[usable].min()), float(record.energies[usable].max())
    at = np.geomspace(low, high, POINTS)
    at[[0, -1]] = low, high
    logs, deviations = curve.at(np.log(at))
    rising = np.maximum.accumulate(_isotonic(logs) + 1e-6 * np.arange(POINTS))
    by_friction, by_restitution = _propagation(record, tap, usable)
    draws = _draws(record, groups, moves, usable, speeds)
    notes = _notes(tap, curve, draws, by_friction, by_restitution, int(usable.sum()), high / low)
    smallest = usable & (record.energies <= low * (1 + _ALIKE))
    return TapperCalibration(
        energies=tuple(at.tolist()),
        speeds=tuple(np.exp(rising).tolist()),
        deviations=tuple(deviations.tolist()),
        scatter=curve.noise,
        used=int(usable.sum()),
        draws=draws,
        left_out=tuple(sorted(left_out, key=lambda entry: entry.row)),
        least_energy=low,
        least_travel=float(np.median(record.distances[smallest])),
        by_friction=by_friction,
        by_restitution=by_restitution,
        notes=notes,
    )


def _groups(energies: Array) -> NDArray[np.intp]:
    """Return the index of each tap's energy level; taps of nearly equal energy have the same
    level."""
    order = np.argsort(energies, kind="stable")
    rises = np.diff(energies[order]) > _ALIKE * energies[order][:-1]
    groups = np.empty(len(energies), dtype=np.intp)
    groups[order] = np.concatenate([[0], np.cumsum(rises)])
    return groups


def _least(record: TapRecord, groups: NDArray[np.intp], moves: NDArray[np.bool_]) -> float:
    """Return the lowest energy level, in J, such that this level and all higher levels move the
    object reliably.

    A tap that does not move the object was too weak only if taps with similar energies move the
    object little. If such taps move the object far, the tap missed and is ignored here.
    """
    if not moves.any():
        raise CalibrationRefused(
            "no tap moved the object: check that the distances are in the unit of their "
            "column's name"
        )
    x = np.log(record.energies)
    weak = np.zeros(len(x), dtype=bool)
    for k in np.flatnonzero(~moves):
        nearest = np.argsort(np.abs(x[moves] - x[k]), kind="stable")[:_NEIGHBOURS]
        weak[k] = np.median(record.distances[moves][nearest]) < _SHORT
    failing = [
        float(record.energies[groups == group].max())
        for group in np.unique(groups[weak])
        if 1.0 - weak[groups == group].mean() < _RELIABLE
    ]
    above = record.energies[record.energies > max(failing, default=0.0) * (1 + _ALIKE)]
    if not len(above):
        raise CalibrationRefused("no energy moved the object reliably: use larger energies")
    return float(above.min())


class _Departure(NamedTuple):
    """A Gaussian process fitted for one amplitude and length scale (``stretch``): its posterior
    probability ``share``, Cholesky factor of the covariance, weights of the taps, level a,
    noise."""

    share: float
    amplitude: float
    stretch: float
    factor: Array
    weights: Array
    level: float
    noise: float


class _Curve:
    """The smooth curve of ln speed over ln energy, with mean and standard deviation.

    The curves of all amplitudes and length scales are averaged, weighted by their likelihood, so
    that the standard deviation includes the uncertainty of the curve's shape.
    """

    def __init__(self, x: Array, y: Array, seen: Array) -> None:
        """Fit the curve to taps (N,) with ln energies ``x``, ln speeds ``y`` and camera noise
        ``seen`` of ln speed."""
        self._x = x
        self._range = max(float(x.max() - x.min()), 1e-6)
        self._drive = y - 0.5 * x
        self._seen = seen
        tried = []
        for amplitude in _AMPLITUDES:
            for stretch in _STRETCHES:
                evidence, noise = self._evidence(amplitude, stretch)
                fitted = self._solve(amplitude, stretch, noise)
                tried.append((evidence, amplitude, stretch, *fitted, noise))
        top = max(entry[0] for entry in tried)
        total = sum(math.exp(entry[0] - top) for entry in tried)
        self._departures = [
            _Departure(math.exp(entry[0] - top) / total, *entry[1:]) for entry in tried
        ]
        self.noise = math.sqrt(sum(d.share * d.noise**2 for d in self._departures))

    def _kernel(self, a: Array, b: Array, amplitude: float, stretch: float) -> Array:
        apart = (a[:, None] - b) / (stretch * self._range)
        return np.asarray(amplitude**2 * np.exp(-0.5 * apart**2))

    def _covariance(self, amplitude: float, stretch: float, noise: Array) -> Array:
        """Compute the covariance (..., N, N) of the taps for a tapper's scatter ``noise`` (...)."""
        own = noise[..., None] ** 2 + self._seen**2
        kernel = self._kernel(self._x, self._x, amplitude, stretch)
        return np.asarray(kernel + own[..., None] * np.eye(len(self._x)))

    def _solve(self, amplitude: float, stretch: float, noise: float) -> tuple[Array, Array, float]:
        """Compute Cholesky factor, weights, and the level a."""
        matrix = self._covariance(amplitude, stretch, np.array(noise))
        factor = np.asarray(np.linalg.cholesky(matrix), dtype=float)
        ones = np.linalg.solve(factor, np.ones(len(self._x)))
        right = np.linalg.solve(factor, self._drive)
        level = float(ones @ right / (ones @ ones))
        weights = np.asarray(np.linalg.solve(factor.T, right - level * ones), dtype=float)
        return factor, weights, level

    def _evidence(self, amplitude: float, stretch: float) -> tuple[float, float]:
        """Maximise the log marginal likelihood over the noise, with the level integrated out.

        Return the maximum and the noise.
        """
        highest = 1.2 * max(float(np.std(self._drive)), 1e-3)
        noise: Array = np.geomspace(highest / 12.0, highest, _NOISES, dtype=np.float64)
        factors = np.linalg.cholesky(self._covariance(amplitude, stretch, noise))
        columns = np.stack([np.ones_like(self._drive), self._drive], axis=-1)
        ones, drive = np.moveaxis(np.linalg.solve(factors, columns[None]), -1, 0)
        total = (ones**2).sum(axis=1)
        left = drive - ((ones * drive).sum(axis=1) / total)[:, None] * ones
        spread = 2.0 * np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(axis=1)
        evidence = -0.5 * ((left**2).sum(axis=1) + spread + np.log(total))
        best = int(np.argmax(evidence))
        return float(evidence[best]), float(noise[best])

    def at(self, x: Array) -> tuple[Array, Array]:
        """Compute ln v and its standard deviation at ln energies ``x``."""
        mean, square = np.zeros(len(x)), np.zeros(len(x))
        for d in self._departures:
            one, variance = self._at(x, d)
            mean += d.share * one
            square += d.share * (variance + one**2)
        return mean, np.sqrt(np.maximum(square - mean**2, 0.0))

    def _at(self, x: Array, d: _Departure) -> tuple[Array, Array]:
        """Compute mean and variance for one amplitude and length scale."""
        cross = self._kernel(x, self._x, d.amplitude, d.stretch)
        mean = d.level + 0.5 * x + cross @ d.weights
        ones = np.linalg.solve(d.factor, np.ones(len(self._x)))
        reduced = np.linalg.solve(d.factor, cross.T)
        variance = d.amplitude**2 - (reduced**2).sum(axis=0)
        variance = variance + (1.0 - reduced.T @ ones) ** 2 / (ones @ ones)
        return mean, np.maximum(variance, 0.0)


def _isotonic(values: Array) -> Array:
    """Fit a non-decreasing sequence to ``values`` (pool adjacent violators)."""
    blocks: list[tuple[float, int]] = []
    for value in values.tolist():
        blocks.append((value, 1))
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (b, m), (a, n) = blocks.pop(), blocks.pop()
            blocks.append(((a * n + b * m) / (n + m), n + m))
    return np.concatenate([np.full(n, value) for value, n in blocks])


def _propagation(record: TapRecord, tap: Tap, usable: NDArray[np.bool_]) -> tuple[float, float]:
    """Compute two derivatives by finite differences: the relative change of the speeds per relative
    change of the friction, and the relative change of the speeds per change of the restitution."""
    part = TapRecord(*(getattr(record, name)[usable] for name in TapRecord.__slots__))
    plain = striker_speeds(part, tap)
    step = 0.01
    friction, e = tap.sliding.friction, tap.impact.restitution
    rough = replace(tap, sliding=replace(tap.sliding, friction=friction * (1 + step)))
    towards = step if e + step <= 1.0 else -step
    lively = replace(tap, impact=replace(tap.impact, restitution=e + towards))
    by_friction = float(np.log(striker_speeds(part, rough) / plain).mean() / step)
    by_restitution = float(np.log(striker_speeds(part, lively) / plain).mean() / towards)
    return by_friction, by_restitution


def _draws(
    record: TapRecord,
    groups: NDArray[np.intp],
    moves: NDArray[np.bool_],
    usable: NDArray[np.bool_],
    speeds: Array,
) -> tuple[Draw, ...]:
    draws = []
    for group in np.unique(groups):
        own = groups == group
        good = np.log(speeds[own & usable])
        scatter = float(good.std(ddof=1)) if len(good) >= 3 else None
        speed = float(np.exp(good.mean())) if len(good) else 0.0
        energy = float(record.energies[own].mean())
        draws.append(Draw(energy, int(own.sum()), int((own & moves).sum()), speed, scatter))
    return tuple(draws)


def _notes(
    tap: Tap,
    curve: _Curve,
    draws: Sequence[Draw],
    by_friction: float,
    by_restitution: float,
    used: int,
    ratio: float,
) -> tuple[str, ...]:
    """Describe the assumed values, the propagation of their errors, and possible improvements."""
    mu, e = tap.sliding.friction, tap.impact.restitution
    warnings = [
        f"assumed from the object file: friction {mu:g}, restitution {e:g}, masses"
        f" {tap.body.mass:g} and {tap.impact.striker.mass:g} kg",
        f"1 % more friction changes all speeds by {by_friction:+.2f} %, and 0.01 more restitution "
        f"by {by_restitution:+.2f} %; taps on the same object are still correct, because the "
        "planner inverts the model with the same values",
    ]
    scattered = [d for d in draws if d.scatter is not None and d.scatter > 2.0 * curve.noise]
    for draw in scattered:
        warnings.append(
            f"taps of {draw.energy * 1e3:.4g} mJ scatter by {100 * (draw.scatter or 0):.0f} "
            f"%, but all taps together by {100 * curve.noise:.1f} %: do not use this energy"
        )
    if used < 20:
        warnings.append(
            f"the fit used only {used} taps; 30 taps, spread over the range of energies, are better"
        )
    if ratio < 4.0:
        warnings.append(
            "the largest energy is less than 4 times the smallest: the curve covers this range only"
        )
    return tuple(warnings)
