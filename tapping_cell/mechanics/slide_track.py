"""Launch of a slide, estimated from a few poses that were measured while the object moved.

During a slide whose spin is small, the speed v decreases linearly with time and the spin in
proportion to a power of the speed (docs/mechanics.md). With u = 1 - (t - t0) / T, the time t0 of
the launch and the duration T,

    distance travelled = D (1 - u^2),    rotation = A (1 - u^m),

so the launch has the speed 2 D / T and the spin m A / T. The distance D and the rotation A of the
whole slide are known from the poses at rest. Only t0, T and m are estimated, by damped Gauss-Newton
steps from the best point of a grid. Two poses of the moving object are enough. Weak priors keep
what the poses do not determine near the expected values; its standard deviation is then that of the
prior, and ``Launch`` contains NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.mechanics.planar import Array

PRIOR_TIME, PRIOR_DECAY = 1.0, 0.5
"""Prior standard deviations of ln T and ln m."""

DETERMINED = 0.6
"""An estimate counts if its standard deviation is below this share of that of the prior."""

SLIDE_MODEL = (0.02, 0.03)
"""Standard deviations of the slide model for a given launch, relative to distance and rotation per
distance. They limit what one track tells."""

_TIMES = np.exp(np.linspace(-1.5, 1.5, 13))
_DECAYS = np.exp(np.linspace(-0.9, 0.9, 9))
_STEPS = 8
_MOVING = 5.0
"""Standard deviations by which a pose of the moving object differs from those at rest."""
_LONG = 1.0
"""Prior standard deviation of the time of the launch, s."""


class Poses(NamedTuple):
    """Poses of sliding objects relative to the start of the slide, (..., poses); NaN if missing.

    time: s, from any origin. distance, rotation: m along the slide, and rad. distance_std,
    rotation_std: standard deviations.
    """

    time: Array
    distance: Array
    rotation: Array
    distance_std: Array
    rotation_std: Array


class Launch(NamedTuple):
    """Estimated launches (...,); NaN where the poses do not determine the value.

    time: of the launch, s. speed: m/s. spin: rad/s. decay: the power m. duration: s. speed_std,
    spin_std: standard deviations relative to the value; ``spin_std`` is that of spin over speed.
    """

    time: Array
    speed: Array
    spin: Array
    decay: Array
    duration: Array
    speed_std: Array
    spin_std: Array


def decay_of(gamma: float, torque_factor: float) -> float:
    """Return the power m = 1 + gamma kappa / 4 of a round body."""
    return 1.0 + gamma * torque_factor / 4.0


def sampled(launch_time: Array, duration: Array, decay: Array, at: Array) -> tuple[Array, Array]:
    """Return the shares of distance and rotation, (..., poses), reached at the times ``at``."""
    left = np.clip(1.0 - (at - launch_time[..., None]) / duration[..., None], 0.0, 1.0)
    return 1.0 - left**2, 1.0 - left ** decay[..., None]


def launch_of(
    poses: Poses,
    distance: ArrayLike,
    rotation: ArrayLike,
    deceleration: float,
    decay: float,
) -> Launch:
    """Estimate the launches of slides with the given ``distance`` and ``rotation`` (...,).

    ``deceleration`` (m/s^2) and ``decay`` are the expected values.
    """
    d, a = np.asarray(distance, dtype=float), np.asarray(rotation, dtype=float)
    seen = np.isfinite(poses.time + poses.distance + poses.rotation)
    time = np.where(seen, poses.time, 0.0)
    weight = [
        np.where(seen, 1.0 / np.where(seen, std, 1.0), 0.0)
        for std in (poses.distance_std, poses.rotation_std)
    ]
    measured = [np.where(seen, values, 0.0) for values in (poses.distance, poses.rotation)]
    expected = 0.5 * np.log(2.0 * np.maximum(d, 1e-9) / deceleration)
    prior = np.stack([np.zeros(d.shape), expected, np.full(d.shape, np.log(decay))], axis=-1)
    sigma = np.array([_LONG, PRIOR_TIME, PRIOR_DECAY])

    def misses(at: Array) -> Array:
        along, turned = sampled(at[..., 0], np.exp(at[..., 1]), np.exp(at[..., 2]), time)
        shares = (d[..., None] * along, a[..., None] * turned)
        parts = [w * (m - s) for w, m, s in zip(weight, measured, shares, strict=True)]
        return np.concatenate([*parts, (at - prior) / sigma], axis=-1)

    def cost(at: Array) -> Array:
        return np.asarray((misses(at) ** 2).sum(axis=-1))

    # The first pose that is surely on the way gives the time of the launch for every duration.
    left = np.clip(1.0 - measured[0] / np.maximum(d, 1e-9)[..., None], 0.0, 1.0)
    slides = weight[0] * measured[0] > _MOVING
    slides &= weight[0] * (d[..., None] - measured[0]) > _MOVING
    slides &= seen
    first = np.argmax(slides, axis=-1)[..., None]
    known = slides.sum(axis=-1) >= 2
    then = np.take_along_axis(time, first, axis=-1)[..., 0]
    rest = np.sqrt(np.take_along_axis(left, first, axis=-1)[..., 0])
    prior[..., 0] = then
    best, lowest = prior.copy(), np.full(d.shape, np.inf)
    for factor in _TIMES:
        duration = factor * np.exp(prior[..., 1])
        trial = np.stack([then - duration * (1.0 - rest), np.log(duration), prior[..., 2]], -1)
        best, lowest = _better(best, lowest, trial, cost(trial))
    middle = best.copy()
    for factor in _DECAYS:
        trial = middle.copy()
        trial[..., 2] = prior[..., 2] + np.log(factor)
        best, lowest = _better(best, lowest, trial, cost(trial))
    damping = np.full(d.shape, 1e-3)
    for _ in range(_STEPS):
        off, jacobian = misses(best), _slopes(misses, best)
        normal = np.einsum("...ki,...kj->...ij", jacobian, jacobian)
        scale = np.einsum("...ii->...i", normal) * damping[..., None]
        right = np.einsum("...ki,...k->...i", jacobian, off)
        step = np.linalg.solve(normal + scale[..., None] * np.eye(3), right[..., None])[..., 0]
        trial = best - np.clip(step, -0.5, 0.5)
        now = cost(trial)
        damping = np.where(now < lowest, damping / 10.0, damping * 10.0)
        best, lowest = _better(best, lowest, trial, now)
    jacobian = _slopes(misses, best)
    covariance = np.linalg.inv(np.einsum("...ki,...kj->...ij", jacobian, jacobian))
    std = np.sqrt(np.einsum("...ii->...i", covariance))
    timed = known & (std[..., 1] < DETERMINED * PRIOR_TIME)
    turns = timed & (std[..., 2] < DETERMINED * PRIOR_DECAY)
    duration, power = np.exp(best[..., 1]), np.exp(best[..., 2])
    blank, unturned = np.where(timed, 0.0, np.nan), np.where(turns, 0.0, np.nan)
    return Launch(
        best[..., 0] + blank,
        2.0 * d / duration + blank,
        power * a / duration + unturned,
        power + unturned,
        duration + blank,
        std[..., 1] + blank,
        std[..., 2] + unturned,
    )


def _better(best: Array, lowest: Array, trial: Array, cost: Array) -> tuple[Array, Array]:
    wins = cost < lowest
    return np.where(wins[..., None], trial, best), np.where(wins, cost, lowest)


def _slopes(misses: Callable[[Array], Array], at: Array) -> Array:
    """Return the derivatives (..., residuals, 3) of the residuals, by differences."""
    columns = []
    for index, step in enumerate((1e-6, 1e-5, 1e-5)):
        shift = np.zeros(3)
        shift[index] = step
        columns.append((misses(at + shift) - misses(at - shift)) / (2.0 * step))
    return np.stack(columns, axis=-1)
