"""Joint maximum likelihood fit of support friction and torque factor to all trials.

Every trial has local parameters: its launch (speed and spin) and, if it has a track, its time of
impact, its start pose and a small deviation of its friction. Friction and torque factor are shared.
The residuals compare measured quantities: samples of the track, or initial velocities and
displacement. Therefore no velocity is computed from differences of noisy poses, a slide that ends
between two frames causes no error, and a small displacement is weighted by its noise.

The fit minimises the squared residuals divided by their variances (``shared_least_squares.py``).
This module defines the residuals and their derivatives.

No object has an exactly uniform pressure distribution. If the centre of pressure is not at the
centre of mass, friction rotates the object by an amount that depends on the direction of travel. A
distance of half a millimetre between the two centres changes the rotation of the paper's disk by a
fifth. The centre of pressure is therefore also fitted, to first order, if the direction of travel
is known in the object frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.shared_least_squares import (
    Estimate,
    NormalEquations,
    Rows,
    eliminated,
    normal_equations,
    solve,
    sum_by_trial,
)
from tapping_cell.calibration.slide_curves import COARSE, TORQUE_FACTORS, SlideCurves
from tapping_cell.calibration.track import Slide
from tapping_cell.mechanics import Body
from tapping_cell.se2 import Array

# Local parameters, in this order: time of impact, speed, spin, offset of the start position and
# angle, and ln of the trial's friction over the shared friction.
_IMPACT, _SPEED, _SPIN, _START, _ANGLE, _FRICTION = range(6)
_LOCAL = 6
# Shared parameters: ln friction, ln torque factor, and the centre of pressure (x, y) divided by the
# support's radius.
_SHARED = 4
_LOWEST = (math.log(0.003), math.log(TORQUE_FACTORS[0]), -0.3, -0.3)
_HIGHEST = (math.log(5.0), math.log(TORQUE_FACTORS[1]), 0.3, 0.3)
# Prior standard deviation of the centre of pressure, divided by the support's radius; only worn or
# tilted objects have a larger offset.
_CENTRE_STD = 0.05
_STARTS = (0.6, 1.5, 3.5)
# Prior standard deviation of ln(friction of a trial / shared friction) if the friction of a trial
# is estimated from this trial alone.
_FREE = 0.3
_MIN_SCATTER = 1e-4
_NEAR_ONE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Measurements of one trial's slide. SI.

    Displacement and rotation are those between the poses at rest before and after the slide;
    ``rotation`` is signed. In addition, a motion has either a track (``slide``) or measured initial
    velocities. ``heading`` is the direction of travel in the object frame, NaN if unknown.
    """

    displacement: float
    rotation: float
    displacement_std: float
    rotation_std: float
    slide: Slide | None = None
    heading: float = math.nan
    speed: float = math.nan
    spin: float = math.nan
    speed_std: float = math.nan
    spin_std: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class SlideFit:
    """Result of the fit: values in SI, arrays with one entry for each trial.

    ``score`` (n, 4) and ``information`` (n, 4, 4) are the gradient and the curvature of half the
    sum of squares of each trial; the bootstrap uses them. Score and information refer to ln
    friction, ln torque factor, and x and y of the centre of pressure over the radius, with the
    local parameters eliminated. ``pressure_centre`` is in m in the object frame. ``speed``,
    ``spin`` and ``own_friction`` (relative to ``friction``) are estimated from each trial alone.
    """

    friction: float
    torque_factor: float
    pressure_centre: tuple[float, float]
    score: Array
    information: Array
    speed: Array
    spin: Array
    speed_std: Array
    spin_std: Array
    launch_speed: Array
    launch_spin: Array
    impact_time: Array
    own_friction: Array
    own_friction_std: Array
    friction_scatter: float
    position_rms: float
    rotation_rms: float
    misfit: Array
    evaluations: int


class _Samples(NamedTuple):
    """Measured poses of all trials, concatenated (N,); ``rows`` is the trial of each pose.

    A sample with an infinite time is the pose at rest after the slide, relative to the pose before
    the tap.
    """

    rows: Rows
    time: Array
    distance: Array
    rotation: Array
    distance_std: Array
    rotation_std: Array


class _Given(NamedTuple):
    """Directly measured initial velocities (n,), NaN if not measured."""

    speed: Array
    spin: Array
    speed_std: Array
    spin_std: Array


def fit_slides(motions: Sequence[Motion], body: Body, gravity: float) -> SlideFit:
    """Fit friction and torque factor of a body to its slides.

    A polygon is treated as its equivalent disk.

    Raises:
        ValueError: there are fewer than two motions.
    """
    if len(motions) < 2:
        raise ValueError(f"{len(motions)} slides cannot be fitted; at least two are needed")
    problem = _problem(motions, body, gravity)
    fine, coarse = problem.curves, problem.curves.on(COARSE)
    problem = problem._replace(curves=coarse)
    start = min(
        (_fitted(problem, _first_guess(problem, motions, k), _MIN_SCATTER) for k in _STARTS),
        key=lambda estimate: estimate.cost,
    )
    problem = _weighted(_unblurred(problem, motions, start), start)._replace(curves=fine)
    start = _fitted(problem, start, _MIN_SCATTER)
    problem = _weighted(problem, start)
    alone = _fitted(problem, start, _FREE, local_only=True)
    _, _, own_std = _deviations_alone(problem, alone)
    scatter = _between(alone.local[:, _FRICTION], own_std)
    best = _fitted(problem, start, max(scatter, _MIN_SCATTER))
    return _result(problem, best, scatter)


class _Problem(NamedTuple):
    """Data that are constant during the iterations."""

    curves: SlideCurves
    radius: float
    gamma: float
    gravity: float
    heading: Array
    tracked: NDArray[np.bool_]
    samples: _Samples
    given: _Given


def _problem(motions: Sequence[Motion], body: Body, gravity: float) -> _Problem:
    parts: list[tuple[Array, ...]] = []
    for index, m in enumerate(motions):
        if m.slide is not None:
            s = m.slide
            columns = (s.time, s.along, s.rotation, s.distance_std, s.rotation_std)
            parts.append((np.full(s.time.size, float(index)), *columns))
        rest = (index, math.inf, m.displacement, m.rotation, m.displacement_std, m.rotation_std)
        parts.append(tuple(np.array([value], dtype=float) for value in rest))
    rows, time, distance, rotation, distance_std, rotation_std = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    given = np.array([[m.speed, m.spin, m.speed_std, m.spin_std] for m in motions])
    return _Problem(
        curves=SlideCurves(body, gravity),
        radius=body.support_radius,
        gamma=body.gamma,
        gravity=gravity,
        heading=np.array([m.heading for m in motions]),
        tracked=np.array([m.slide is not None for m in motions]),
        samples=_Samples(
            rows.astype(np.intp), time, distance, rotation, distance_std, rotation_std
        ),
        given=_Given(*given.T),
    )


def _first_guess(problem: _Problem, motions: Sequence[Motion], torque_factor: float) -> Estimate:
    """Compute initial values from displacements and the tracks' decelerations."""
    distance = np.array([m.displacement for m in motions])
    rotation = np.array([m.rotation for m in motions])
    pulls = [
        m.speed**2 / (2 * m.displacement) if m.slide is None else m.slide.deceleration
        for m in motions
    ]
    friction = float(np.clip(np.median(pulls) / problem.gravity, 0.01, 3.0))
    shared = np.array([math.log(friction), math.log(torque_factor), 0.0, 0.0])
    speed, spin = problem.curves.launch(distance, rotation, friction, shared[1])
    local = np.zeros((len(motions), _LOCAL))
    local[:, _IMPACT] = [0.0 if m.slide is None else m.slide.impact for m in motions]
    local[:, _SPEED], local[:, _SPIN] = speed, spin
    return Estimate(shared, local)


def _unblurred(problem: _Problem, motions: Sequence[Motion], at: Estimate) -> _Problem:
    """Remove samples whose exposure contains the impact, because they mix several poses."""
    samples = problem.samples
    exposure = np.array([0.0 if m.slide is None else m.slide.exposure for m in motions])
    away = np.abs(samples.time - at.local[samples.rows, _IMPACT])
    keep = away > exposure[samples.rows] / 2
    return problem._replace(samples=_Samples(*(column[keep] for column in samples)))


def _weighted(problem: _Problem, at: Estimate) -> _Problem:
    """Scale the assumed standard deviations so that they agree with the residuals of the fit."""
    misses = _misses(problem, at)
    samples, given = problem.samples, problem.given
    sampled = np.isfinite(samples.time)
    if sampled.any():
        count = 2.0 * sampled.sum()
        used = 5.0 * problem.tracked.sum()
        lost = math.sqrt(count / max(count - used, 0.1 * count))
        scale = [max(lost * _rms(r[sampled]), 0.05) for r in (misses.distance, misses.rotation)]
        samples = samples._replace(
            distance_std=np.where(sampled, scale[0], 1.0) * samples.distance_std,
            rotation_std=np.where(sampled, scale[1], 1.0) * samples.rotation_std,
        )
    known = ~problem.tracked
    if known.sum() >= 4:
        off = (given.speed - at.local[:, _SPEED]) / given.speed_std
        off_spin = (given.spin - at.local[:, _SPIN]) / given.spin_std
        given = given._replace(
            speed_std=given.speed_std * max(_spread(off[known]), 0.05),
            spin_std=given.spin_std * max(_spread(off_spin[known]), 0.05),
        )
    return problem._replace(samples=samples, given=given)


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2))) if values.size else math.nan


def _spread(values: Array) -> float:
    """Estimate the standard deviation about zero robustly, from the median of magnitudes."""
    return 1.4826 * float(np.median(np.abs(values)))


def _between(values: Array, deviations: Array) -> float:
    """Estimate robustly that part of the standard deviation between trials that is not explained by
    the measurement noise."""
    known = np.isfinite(deviations) & (deviations < 0.5 * _FREE)
    if known.sum() < 4:
        return 0.0
    spread = _spread(values[known] - np.median(values[known]))
    return math.sqrt(max(spread**2 - float(np.median(deviations[known] ** 2)), 0.0))


class _Misses(NamedTuple):
    """Normalised residuals of the samples, (N,) each, and their derivatives, (N, 10) each."""

    distance: Array
    rotation: Array
    by_distance: Array
    by_rotation: Array


def _misses(problem: _Problem, at: Estimate) -> _Misses:
    samples, rows, local = problem.samples, problem.samples.rows, at.local
    resting = np.isinf(samples.time)
    since = np.maximum(samples.time - local[rows, _IMPACT], 0.0)
    friction = np.exp(at.shared[0] + local[:, _FRICTION])
    speed, spin = local[:, _SPEED], local[:, _SPIN]
    torque_factor = float(at.shared[1])
    state, slopes = problem.curves.at((speed, spin), since, rows, friction, torque_factor)
    bump = 1e-4 * speed / problem.radius
    other, _ = problem.curves.at((speed, spin + bump), since, rows, friction, torque_factor)
    moving = (since > 0) & ~resting
    finite_since = np.where(moving, since, 0.0)

    def derivatives(value: Array, perturbed: Array, rate: Array, by_torque: Array) -> Array:
        """Compute the derivatives (N, 10) of ``value``, which is the distance or the rotation."""
        derivative = np.zeros((rows.size, _LOCAL + _SHARED))
        by_spin = (perturbed - value) / bump[rows]
        # If the launch velocity and the time are multiplied by c, distance and rotation are
        # multiplied by c^2. Euler's theorem therefore gives the derivative with respect to the
        # speed. If the friction is multiplied by c, the distance, the rotation and the time at
        # which they are reached are divided by c. This gives the derivative with respect to ln
        # friction.
        by_speed = (2 * value - finite_since * rate - spin[rows] * by_spin) / speed[rows]
        derivative[:, _IMPACT] = np.where(moving, -rate, 0.0)
        derivative[:, _SPEED], derivative[:, _SPIN] = by_speed, by_spin
        derivative[:, _FRICTION] = derivative[:, _LOCAL] = finite_since * rate - value
        derivative[:, _LOCAL + 1] = by_torque
        return derivative

    begun = np.where(resting, 0.0, 1.0)
    by_centre = _turned_by_centre(problem, at, since, friction)
    along = derivatives(state.distance, other.distance, state.speed, slopes.distance)
    along[:, _START] = begun
    turned = derivatives(state.rotation, other.rotation, state.spin, slopes.rotation)
    turned[:, _ANGLE] = begun
    turned[:, _LOCAL + 2 :] = by_centre
    distance = state.distance + begun * local[rows, _START]
    rotation = state.rotation + begun * local[rows, _ANGLE] + by_centre @ at.shared[2:]
    return _Misses(
        (samples.distance - distance) / samples.distance_std,
        (samples.rotation - rotation) / samples.rotation_std,
        -along / samples.distance_std[:, None],
        -turned / samples.rotation_std[:, None],
    )


def _linearised(problem: _Problem, at: Estimate, prior: float) -> NormalEquations:
    """Linearise the problem.

    ``prior`` is the prior standard deviation of ln(friction of a trial / shared friction).
    """
    misses, rows, local = _misses(problem, at), problem.samples.rows, at.local
    count = local.shape[0]
    off = np.concatenate([misses.distance, misses.rotation])
    jacobian = np.concatenate([misses.by_distance, misses.by_rotation])
    hessian, gradient = sum_by_trial(jacobian, off, np.concatenate([rows, rows]), count)
    cost = float(off @ off)
    cost += _add_given(problem, local, hessian, gradient)
    hessian[:, _FRICTION, _FRICTION] += prior**-2
    gradient[:, _FRICTION] += local[:, _FRICTION] * prior**-2
    cost += float(np.sum((local[:, _FRICTION] / prior) ** 2))
    for unused in (_IMPACT, _START, _ANGLE):
        hessian[~problem.tracked, unused, unused] += 1.0
    # The prior of the centre of pressure is divided among the trials, so that the sum over the
    # trials contains it once.
    for index in (2, 3):
        hessian[:, _LOCAL + index, _LOCAL + index] += _CENTRE_STD**-2 / count
        gradient[:, _LOCAL + index] += at.shared[index] * _CENTRE_STD**-2 / count
        cost += float(at.shared[index] / _CENTRE_STD) ** 2
    return normal_equations(cost / 2, hessian, gradient, _LOCAL)


def _turned_by_centre(problem: _Problem, at: Estimate, since: Array, friction: Array) -> Array:
    """Compute derivatives (N, 2) of the rotations with respect to the centre of pressure over the
    radius.

    Friction at the centre of pressure c accelerates the rotation, d omega / dt = - kappa gamma (mu
    g / R) (c x v) / v. This rotation decays like any spin: while sliding dominates over spinning, v
    decreases linearly and d omega / dt = - p omega (mu g / v), with p = kappa gamma / 4.
    """
    rows = problem.samples.rows
    pull = (friction * problem.gravity)[rows]
    speed = at.local[rows, _SPEED]
    strength = problem.gamma * math.exp(float(at.shared[1]))
    p = strength / 4
    if abs(p - 1) < _NEAR_ONE:
        p = 1 + _NEAR_ONE
    left = np.maximum(1 - pull * since / speed, 0.0)
    shape = (1 - left**2) / 2 - (1 - left ** (p + 1)) / (p + 1)
    turned = speed**2 / pull * strength / problem.radius * shape / (1 - p)
    heading = problem.heading[rows]
    known = np.isfinite(heading)
    angle = np.where(known, heading, 0.0)
    return np.asarray(
        np.where(known, turned, 0.0)[:, None] * np.stack([np.sin(angle), -np.cos(angle)], axis=1)
    )


def _add_given(problem: _Problem, local: Array, hessian: Array, gradient: Array) -> float:
    """Add the terms of measured initial velocities in place; return twice their cost."""
    known, given, cost = ~problem.tracked, problem.given, 0.0
    pairs = ((_SPEED, given.speed, given.speed_std), (_SPIN, given.spin, given.spin_std))
    for index, value, deviation in pairs:
        off = (value[known] - local[known, index]) / deviation[known]
        hessian[known, index, index] += deviation[known] ** -2
        gradient[known, index] -= off / deviation[known]
        cost += float(off @ off)
    return cost


def _limited(trial: Estimate, before: Estimate) -> Estimate:
    """Limit a step to the valid range: positive launch speeds, frictions within their bounds."""
    local = trial.local
    local[:, _SPEED] = np.maximum(local[:, _SPEED], 0.3 * before.local[:, _SPEED])
    np.clip(local[:, _FRICTION], -1.0, 1.0, out=local[:, _FRICTION])
    return trial._replace(shared=np.clip(trial.shared, _LOWEST, _HIGHEST))


def _fitted(
    problem: _Problem, start: Estimate, prior: float, *, local_only: bool = False
) -> Estimate:
    """Solve the least squares problem; ``prior`` is the prior standard deviation of ln(friction of
    a trial / shared friction)."""
    return solve(lambda at: _linearised(problem, at, prior), start, _limited, local_only=local_only)


def _deviations_alone(problem: _Problem, alone: Estimate) -> Array:
    """Compute the standard deviations (3, n) of speed, spin and ln friction that are estimated from
    each trial alone."""
    covariance = np.linalg.inv(_linearised(problem, alone, _FREE).h_local)
    return np.sqrt([covariance[:, index, index] for index in (_SPEED, _SPIN, _FRICTION)])


def _result(problem: _Problem, best: Estimate, scatter: float) -> SlideFit:
    score, information = eliminated(_linearised(problem, best, max(scatter, _MIN_SCATTER)))
    alone = _fitted(problem, best, _FREE, local_only=True)
    speed_std, spin_std, own_std = _deviations_alone(problem, alone)
    tracked, given = problem.tracked, problem.given
    samples, misses = problem.samples, _misses(problem, best)
    sampled = np.isfinite(samples.time)
    squares = np.where(sampled, misses.distance**2 + misses.rotation**2, 0.0)
    total = np.bincount(samples.rows, squares, minlength=tracked.size)
    count = np.bincount(samples.rows, 2.0 * sampled, minlength=tracked.size)
    speed_off = (given.speed - best.local[:, _SPEED]) / given.speed_std
    launch_off = np.hypot(speed_off, (given.spin - best.local[:, _SPIN]) / given.spin_std)
    x, y = (problem.radius * best.shared[2:]).tolist()
    by_track = np.sqrt(total / np.maximum(count, 1.0))
    return SlideFit(
        friction=math.exp(best.shared[0]),
        torque_factor=math.exp(best.shared[1]),
        pressure_centre=(x, y),
        score=score,
        information=information,
        speed=np.where(tracked, alone.local[:, _SPEED], given.speed),
        spin=np.where(tracked, alone.local[:, _SPIN], given.spin),
        speed_std=np.where(tracked, speed_std, given.speed_std),
        spin_std=np.where(tracked, spin_std, given.spin_std),
        launch_speed=best.local[:, _SPEED],
        launch_spin=best.local[:, _SPIN],
        impact_time=np.where(tracked, best.local[:, _IMPACT], math.nan),
        own_friction=np.exp(alone.local[:, _FRICTION]),
        own_friction_std=own_std,
        friction_scatter=scatter,
        position_rms=_rms(misses.distance[sampled] * samples.distance_std[sampled]),
        rotation_rms=_rms(misses.rotation[sampled] * samples.rotation_std[sampled]),
        misfit=np.where(tracked, by_track, launch_off / math.sqrt(2.0)),
        evaluations=best.evaluations,
    )
