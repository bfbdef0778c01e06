"""Fit of friction, torque factor, impact and scatter of an object to the taps of ordinary goals.

A tap is planned for a launch (velocity and spin). The true launch differs from it, because
restitution, mass and contact friction are not those of the object file. The fit therefore has these
parameters beside the friction mu and the torque factor kappa:

- ``speed``: logarithm of the ratio of true to planned launch speed.
- ``slope``: logarithm of the ratio of the true to the planned slope of the impulse relative to the
  contact normal. The slope is at most the contact friction. It determines the spin, but also the
  direction in which the object moves, so that the directions of the taps tell the spin.
- ``lever``: change of that slope by the lever arm of the contact normal, over the radius of
  gyration. A wrong mass or restitution has this effect where the normal misses the centre, as it
  does on the edges of a polygon.
- ``aim``: constant error of the direction.

The poses at rest determine mu / speed^2 only. The launch speed has a prior, or is measured in the
track of the slide, where the camera saw it. Priors of the other parameters limit what the taps do
not tell. The fit is a robust least-squares fit to all taps; the intervals contain the uncertainty
of all parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

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
from tapping_cell.mechanics import Polygon, Sliding
from tapping_cell.mechanics.planar import cross, to_left, turn
from tapping_cell.mechanics.slide_track import PRIOR_DECAY, SLIDE_MODEL, decay_of
from tapping_cell.mechanics.tap import line_of_action
from tapping_cell.se2 import Array, wrap_angle

FEWEST_TAPS = 5
_FEWEST_TRACKS = 3
"""Fewer tracks cannot contradict one another and are not used."""
_FRICTION_UNCERTAIN = 0.1
"""Relative standard deviation of the friction above which the taps do not tell it."""
_FACTOR_UNCERTAIN = 0.25
"""Relative standard deviation of the torque factor above which the taps do not tell it."""
_SCATTER = (0.05, 0.15, 0.02)
"""Initial standard deviations of the residuals: distance and rotation (relative), and direction
(rad)."""
_SLOPE = 0.1
"""Standard deviation of the rotation per distance, in rad/m, for taps that hardly rotate the
object."""
_OUTLIER = 5.0
"""Number of standard deviations above which a tap is an outlier, for example due to a collision or
a miss."""
_UNKNOWN = 0.5
"""Relative standard deviation at or above which the torque factor counts as not determined."""
_DETERMINED = 0.6
"""A parameter of the impact counts as determined if its standard deviation is below this share of
that of its prior."""
_MIN_SCATTER = 0.002
_POLYGON_IMPACT = 0.03
"""Relative standard deviation of the rotation per distance of polygons, whose impulses depend on
the contact in more ways than slope and lever describe."""
_OTHER_IMPACT = 0.3
"""Relative standard deviation of the rotations if an impact transmits half of the planned
tangential impulse."""
_CONTRADICTION = 3.0
"""Scatter of the tracks, in standard deviations, above which they are not used."""
_PRIOR = np.array([0.25, 0.20, 0.35, 0.05, 0.02])
"""Standard deviations of speed, slope, logarithm of the contact friction, lever, and aim (rad).
Objects whose restitution is 0.4 to 0.9 instead of 0.6, contact friction 0.1 to 0.35 instead of 0.2,
and mass wrong by a factor of up to 2 have 0.24, 0.13 (round) and 0.25 (polygons), 0.36, and 0.05
(polygons)."""
_LOW = np.array([*np.log([0.01, 0.05]), -1.0, -2.0, math.log(0.001), -0.3, -0.2])
_HIGH = np.array([*np.log([2.0, 20.0]), 1.0, 2.0, math.log(2.0), 0.3, 0.2])
_STEP = 1e-4


class Launches(NamedTuple):
    """Launches of taps in the tracks of their slides, (n,); NaN if the track does not show them.

    speed: m/s. spin: rad/s. speed_std, spin_std: standard deviations relative to the value;
    ``spin_std`` is that of spin over speed.
    """

    speed: Array
    spin: Array
    speed_std: Array
    spin_std: Array

    def of(self, rows: NDArray[np.bool_]) -> Launches:
        """Return the launches of the taps in ``rows``."""
        return Launches(*(part[rows] for part in self))


@dataclass(frozen=True, slots=True)
class LearntObject:
    """Result of the fit: ``content`` is the file with new values; ``used`` and ``left_out`` count
    taps, and ``tracked`` those of the used taps whose track shows the launch speed.

    ``precision``: relative standard deviations of friction and torque factor for a known launch,
    which is how well the file predicts further taps of this cell.
    """

    content: ObjectFile
    estimates: tuple[Estimate, ...]
    used: int
    left_out: int
    tracked: int
    precision: tuple[float, float]


def learn_object(
    content: ObjectFile,
    commanded: ArrayLike,
    measured: ArrayLike,
    launches: Launches | None = None,
) -> LearntObject:
    """Fit an object to taps that were planned with the mechanics of ``content``.

    Args:
        content: object file with which the taps were planned.
        commanded, measured: displacements (n, 3) in the object frame before the tap, m and rad.
        launches: launches in the tracks of the slides, evaluated with ``content``.

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
    seen = Launches(*np.full((4, usable.size), math.nan)) if launches is None else launches
    taps = _Taps(content, asked, moved, seen.of(usable))
    rows = np.ones(len(asked), dtype=bool)
    scatter, start = np.array(_SCATTER), taps.start
    for _ in range(3):
        # A divisor that follows the fit would favour predictions that are too large.
        divisor = _divisor(taps.predicted(start))
        found = least_squares(
            taps.residuals,
            start,
            bounds=(_LOW, _HIGH),
            loss="soft_l1",
            diff_step=_STEP,
            ftol=1e-4,
            args=(rows, scatter, divisor),
        )
        start = found.x
        taps.check_tracks(start, rows)
        errors = taps.errors(start, divisor)
        robust = [max(1.4826 * float(np.median(np.abs(e[rows]))), _MIN_SCATTER) for e in errors]
        rows = np.max(np.abs(errors) / np.array(robust)[:, None], axis=0) < _OUTLIER
        count = int(rows.sum())
        if count < FEWEST_TAPS:
            raise RecordError(
                f"only {count} of {len(asked)} taps are consistent with one another; at "
                f"least {FEWEST_TAPS} are needed. Check that the object lies flat, and that arm "
                "and tapper are calibrated"
            )
        scatter = np.maximum(np.std(errors[:, rows], axis=1, ddof=2), _MIN_SCATTER)
    deviations = scatter.tolist()
    expected = taps.predicted(start)[rows]
    place, angle = _parts(expected, errors[:, rows], divisor[rows])
    if place is not None and place.floor > 0.0:
        deviations[0], deviations[2] = place.shares
    if angle is not None and angle.floor > 0.0:
        deviations[1] = angle.shares[0]
    slopes = np.stack(
        [
            taps.residuals(start + step, rows, scatter, divisor)
            - taps.residuals(start - step, rows, scatter, divisor)
            for step in _STEP * np.eye(len(start))
        ],
        axis=1,
    ) / (2.0 * _STEP)
    information = slopes.T @ slopes
    spread = np.sqrt(np.diag(np.linalg.pinv(information)))
    of_model = _model_errors(taps, start, expected, errors[0, rows])
    spread[:2] = np.hypot(spread[:2], of_model)
    alone = np.sqrt(np.diag(np.linalg.pinv(information[:2, :2])))
    wide = float(t.ppf(0.975, count - 2))
    friction, factor, speed, slope, rubbing = np.exp(start[:5]).tolist()
    told = spread[2:] < _DETERMINED * _PRIOR
    estimates = (
        _about("friction", friction, spread[0], wide, content.friction),
        _about(
            "torque_factor",
            factor,
            spread[1],
            wide,
            content.torque_factor,
            fitted=bool(max(alone[1], of_model[1]) < _UNKNOWN),
        ),
        _about("launch_speed", speed, spread[2], wide, 1.0, fitted=bool(told[0])),
        _about("tangential_impulse", slope, spread[3], wide, 1.0, fitted=bool(told[1])),
        _about(
            "contact_friction",
            rubbing,
            spread[4],
            wide,
            content.contact_friction,
            fitted=bool(told[2]),
        ),
        *(
            _scatter(name, deviation, count, getattr(content.scatter, name), unit)
            for name, deviation, unit in zip(
                ("distance", "rotation", "direction"), deviations, ("", "", "rad"), strict=True
            )
        ),
        *floor_estimates(place, angle, content),
        _smallest(content, expected),
    )
    # The floors of the old file do not apply to the new scatter.
    own = replace(content.scatter, position_floor=0.0, angle_floor=0.0)
    # These scales change speed and slope of a sticking impact by the factors found.
    one, two, three = content.impact_scale
    one, two, three = (float(f"{b / speed:.6g}") for b in (one / slope, two, three))
    made = with_estimates(
        replace(content, scatter=own, impact_scale=(one, two, three), calibration=None), estimates
    )
    return LearntObject(
        made,
        estimates,
        count,
        int(usable.size) - count,
        int(np.isfinite(taps.launches.speed[rows]).sum()),
        (float(alone[0]), float(alone[1])),
    )


class _Taps:
    """The taps of a fit, as functions of its parameters: the logarithms of friction and torque
    factor, speed, slope, the logarithm of the contact friction, lever, and aim."""

    def __init__(self, content: ObjectFile, asked: Array, moved: Array, launches: Launches) -> None:
        body = self.body = content.body()
        twist = Sliding(body, content.friction, content.torque_factor, GRAVITY).twist_for(asked)
        self._speed = np.hypot(twist[:, 0], twist[:, 1])
        self._contact, self._slope = line_of_action(body, twist)
        self._arm = cross(self._contact.normal, self._contact.point) / body.radius_of_gyration
        self._moved, self.launches = moved, launches
        ratio = np.hypot(moved[:, 0], moved[:, 1]) / np.hypot(asked[:, 0], asked[:, 1])
        self._prior = np.array([0.0, 0.0, math.log(content.contact_friction), 0.0, 0.0])
        # Beside the largest planned slope, because at this slope itself a larger contact friction
        # changes nothing.
        limit = min(content.contact_friction, max(0.98 * float(np.abs(self._slope).max()), 0.01))
        start = [
            math.log(content.friction / float(np.median(ratio))),
            math.log(content.torque_factor),
            *(0.0, 0.0),
            math.log(limit),
            *(0.0, 0.0),
        ]
        self.start = np.clip(start, _LOW, _HIGH)
        # The track was evaluated with a prior of the decay of the spin around that of the file.
        # Without this prior, the spin and its standard deviation are larger.
        length = np.hypot(moved[:, 0], moved[:, 1])
        decay = launches.spin / launches.speed * 2.0 * length / moved[:, 2]
        kept = 1.0 - np.minimum(launches.spin_std / PRIOR_DECAY, 0.99) ** 2
        expected = decay_of(body.gamma, content.torque_factor)
        with np.errstate(invalid="ignore"):
            own = expected * np.maximum(decay / expected, 1e-3) ** (1.0 / kept)
        self._spin = own * moved[:, 2] / (2.0 * length)
        self._spin_std = launches.spin_std / np.sqrt(kept)
        self._known: dict[tuple[float, ...], Array] = {}

    def predicted(self, parameters: Array) -> Array:
        """Return the displacements (n, 3) in the object frame."""
        friction, factor, speed, slope, rubbing, lever, aim = parameters.tolist()
        key = (factor, slope, rubbing, lever)
        if key not in self._known:
            self._known[key] = self._slide(factor, self._impulses(slope, rubbing, lever))
        # The displacement of a slide is proportional to speed^2 / friction.
        size = (self._speed * math.exp(speed)) ** 2 / math.exp(friction)
        return turn(self._known[key] * size[:, None], np.asarray(aim))

    def errors(self, parameters: Array, divisor: Array) -> Array:
        """Return the relative errors of distance and rotation, and the errors of the direction in
        rad, (3, n)."""
        return _errors(self.predicted(parameters), self._moved, divisor)

    def residuals(
        self, parameters: Array, rows: NDArray[np.bool_], scatter: Array, divisor: Array
    ) -> Array:
        """Return the residuals of the taps in ``rows``, of their tracks, and of the priors."""
        poses = self.errors(parameters, divisor)[:, rows] / scatter[:, None]
        prior = (parameters[2:] - self._prior) / _PRIOR
        return np.concatenate([poses.ravel(), self._track_residuals(parameters, rows), prior])

    def check_tracks(self, parameters: Array, rows: NDArray[np.bool_]) -> None:
        """Forget the launches if they contradict one another, because then the slides were not
        free: a striker that stays in contact moves the object on."""
        distance = self._track_residuals(parameters, rows)
        distance = distance[: int((rows & np.isfinite(self.launches.speed)).sum())]
        if distance.size and 1.4826 * float(np.median(np.abs(distance))) > _CONTRADICTION:
            self.launches = Launches(*np.full((4, len(rows)), math.nan))

    def _track_residuals(self, parameters: Array, rows: NDArray[np.bool_]) -> Array:
        seen = rows & np.isfinite(self.launches.speed)
        if seen.sum() < _FEWEST_TRACKS:
            return np.empty(0)
        friction, factor = parameters[:2].tolist()
        turns = np.isfinite(self._spin_std + self._spin)
        key = (factor,)
        if key not in self._known:
            spin = np.where(turns, self._spin, 0.0)
            launch = np.zeros((len(spin), 3))
            launch[:, 0], launch[:, 2] = 1.0, spin
            self._known[key] = self._slide(factor, launch)
        launches, moved = self.launches, self._moved
        rest = self._known[key]
        length = np.hypot(rest[:, 0], rest[:, 1])
        size = launches.speed**2 / math.exp(friction)
        went = np.hypot(moved[:, 0], moved[:, 1])
        error = np.hypot(2.0 * launches.speed_std, SLIDE_MODEL[0])
        distance = np.log(went / (length * size)) / error
        turned = moved[:, 2] / went
        rotation = turned - rest[:, 2] / length
        rotation = rotation / np.hypot(
            np.hypot(self._spin_std, SLIDE_MODEL[1]) * turned, 0.1 * _SLOPE
        )
        return np.concatenate([distance[seen], rotation[seen & turns]])

    def transmitted(self, parameters: Array) -> float:
        """Return the ratio of the tangential impulses to the planned ones; 1 if enough tracks show
        the spin, which then does not depend on the impulses."""
        seen = np.isfinite(self._spin + self._spin_std + self.launches.speed)
        planned = np.abs(self._slope)
        if seen.sum() >= _FEWEST_TRACKS or not planned.any():
            return 1.0
        slope, rubbing = np.exp(parameters[3:5]).tolist()
        return float(np.minimum(slope * planned, rubbing).sum() / planned.sum())

    def _impulses(self, slope: float, rubbing: float, lever: float) -> Array:
        """Return the launches (n, 3) of impulses of unit speed, whose slopes are changed."""
        limit = math.exp(rubbing)
        tangent = np.clip(math.exp(slope) * self._slope + lever * self._arm, -limit, limit)
        normal, point = self._contact.normal, self._contact.point
        push = normal + tangent[:, None] * to_left(normal)
        push = push / np.hypot(push[:, 0], push[:, 1])[:, None]
        spin = cross(point, push) / self.body.radius_of_gyration**2
        return np.column_stack([push, spin])

    def _slide(self, factor: float, launches: Array) -> Array:
        return Sliding(self.body, 1.0, math.exp(factor), GRAVITY).displace(launches)


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
        notes=(f"95 % intervals: {intervals}", *advice(learnt)),
    )


def advice(learnt: LearntObject) -> tuple[str, ...]:
    """Say which of the values the taps do not tell, what that means, and what to do."""
    friction, factor, *_ = learnt.estimates
    words = []
    if friction.std > _FRICTION_UNCERTAIN * friction.value:
        words.append(
            f"the friction itself is known only from {friction.low:.3g} to {friction.high:.3g}, "
            f"because the launch speed was measured in {learnt.tracked} of {learnt.used} taps: a "
            "faster impact looks like less friction. The file nevertheless predicts distances to "
            f"{100 * learnt.precision[0]:.1f} %. To learn the friction itself, let the camera "
            "follow the slides at 30 Hz or more, or use single-tap and object fit"
        )
    if not factor.fitted or factor.std > _FACTOR_UNCERTAIN * factor.value:
        words.append(
            "the torque factor is not known well: send more goals that turn the object, or use "
            "single-tap and object fit"
        )
    return tuple(words)


def _errors(predicted: Array, measured: Array, divisor: Array) -> Array:
    """Compute the errors of the logarithm of the distance, of the rotation over ``divisor``, and of
    the direction in rad, (3, n)."""
    length = np.hypot(predicted[:, 0], predicted[:, 1])
    moved = np.hypot(measured[:, 0], measured[:, 1])
    distance = np.log(moved / length)
    rotation = (measured[:, 2] * length / moved - predicted[:, 2]) / divisor
    cross_product = cross(predicted[:, :2], measured[:, :2])
    direction = np.arctan2(cross_product, (predicted[:, :2] * measured[:, :2]).sum(axis=1))
    return np.stack([distance, rotation, wrap_angle(direction)])


def _divisor(predicted: Array) -> Array:
    """Return the rotations by which the errors of the rotation are divided, (n,)."""
    length = np.hypot(predicted[:, 0], predicted[:, 1])
    return np.hypot(predicted[:, 2], _SLOPE / _SCATTER[1] * length)


def _model_errors(taps: _Taps, found: Array, predicted: Array, error: Array) -> Array:
    """Return the standard deviations of the logarithms of friction and torque factor due to the
    model of slide and impact. ``error``: errors (n,) of the logarithm of the distance.

    Distances that depend on the length of the tap otherwise than predicted show that the striker
    hits the object again. The distance is proportional to the square of the impulse, so the second
    impulse has half of this error, and may change the rotation by its own share. In a track, the
    object then seems to slide farther. If the tangential impulses are much smaller than planned,
    the impact is not that of the model, and the small rotations have other causes too.
    """
    length = np.log(np.hypot(predicted[:, 0], predicted[:, 1]))
    farther = float(np.polyfit(length, error, 1)[0] * np.std(length))
    decay = decay_of(taps.body.gamma, math.exp(found[1]))
    impact = _POLYGON_IMPACT if isinstance(taps.body, Polygon) else 0.0
    impact = math.hypot(impact, _OTHER_IMPACT * (1.0 / taps.transmitted(found) - 1.0))
    rotation = math.hypot(SLIDE_MODEL[1], impact, 0.5 * farther)
    return np.array([math.hypot(SLIDE_MODEL[0], farther), rotation * decay / (decay - 1.0)])


def _parts(predicted: Array, errors: Array, divisor: Array) -> tuple[Parts | None, Parts | None]:
    """Divide the scatter, of the position and of the angle, into a part proportional to the size of
    the tap and a constant floor."""
    length, rotation = np.hypot(predicted[:, 0], predicted[:, 1]), predicted[:, 2]
    off = divisor * errors[1]
    return (
        scatter_parts([(np.expm1(errors[0]) * length, length), (errors[2] * length, length)]),
        scatter_parts([(off, np.abs(rotation))]),
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
