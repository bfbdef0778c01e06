"""A bank of Kalman filters: a belief about a few numbers, robust to a wrong prior and to bumps.

Each filter of the bank starts from a prior of its own width (static multiple models: Magill, IEEE
Trans. Automatic Control 10, 1965), so that a belief that holds for most objects costs an object
that is quite different only one measurement. A measurement may also be no measurement at all (a
bumped object, a striker that missed): each filter weighs it by the probability that it is one
(probabilistic data association: Bar-Shalom and Tse, Automatica 11, 1975). And the truth may change
for good: one more filter, the candidate, assumes that it did so at the last measurement; when a
second one agrees with it, the candidate outweighs the others and replaces them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from tapping_cell.planning.interface import Array

BUMP = 0.02
"""Probability that a measurement says nothing about the numbers."""

CHANGE = 0.004
"""Probability that the truth is another one from a measurement on."""

LEAST_WEIGHT = 1e-9

_BISECTIONS = 40


@dataclass(frozen=True, slots=True)
class Prior:
    """What is believed before any measurement: one normal distribution a filter.

    weight: (filters,), adds up to 1. mean, deviation: (filters, numbers). change: index of the
    filter that a changed truth is drawn from. span: range over which a bump spreads a measurement
    evenly.
    """

    weight: Array
    mean: Array
    deviation: Array
    change: int
    span: float


@dataclass(frozen=True, slots=True)
class Belief:
    """What is believed of one object's numbers, or of many objects' (leading axes).

    weight: (..., filters), the last one the candidate. mean: (..., filters, numbers).
    covariance: (..., filters, numbers, numbers).
    """

    weight: Array
    mean: Array
    covariance: Array

    @classmethod
    def start(cls, prior: Prior, shape: tuple[int, ...] = ()) -> Belief:
        """The prior, for objects never measured."""
        count, numbers = prior.mean.shape
        order = [*range(count), prior.change]
        weight = np.append(prior.weight, 0.0)
        covariance = prior.deviation[order][:, :, None] ** 2 * np.eye(numbers)
        return cls(
            np.broadcast_to(weight, (*shape, count + 1)).copy(),
            np.broadcast_to(prior.mean[order], (*shape, count + 1, numbers)).copy(),
            np.broadcast_to(covariance, (*shape, count + 1, numbers, numbers)).copy(),
        )

    def of(self, rows: NDArray[np.intp]) -> Belief:
        """The belief of some of many objects."""
        return Belief(self.weight[rows], self.mean[rows], self.covariance[rows])

    def put(self, rows: NDArray[np.intp], other: Belief) -> None:
        """Replace the belief of some of many objects."""
        self.weight[rows] = other.weight
        self.mean[rows] = other.mean
        self.covariance[rows] = other.covariance

    def expected(self) -> Array:
        """Expected numbers (..., numbers) of all filters but the candidate."""
        main = self.weight[..., :-1]
        share = main / main.sum(axis=-1, keepdims=True)
        return np.asarray(np.einsum("...h,...hi->...i", share, self.mean[..., :-1, :]))

    def deviation(self) -> Array:
        """Standard deviations (..., numbers) about ``expected``, without the candidate."""
        main = self.weight[..., :-1]
        share = main / main.sum(axis=-1, keepdims=True)
        off = self.mean[..., :-1, :] - self.expected()[..., None, :]
        own = np.diagonal(self.covariance[..., :-1, :, :], axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(np.einsum("...h,...hi->...i", share, own + off * off)))

    def quantile(self, slope: ArrayLike, probability: float, noise: ArrayLike = 0.0) -> Array:
        """Quantile (...,) of slope . numbers + noise over all filters, the candidate as well.

        slope: (..., numbers). noise: deviation of what is added, (...,).
        """
        h = np.asarray(slope, dtype=float)
        mean = np.einsum("...hi,...i->...h", self.mean, h)
        variance = np.einsum("...hij,...i,...j->...h", self.covariance, h, h)
        deviation = np.sqrt(np.maximum(variance + np.asarray(noise)[..., None] ** 2, 1e-18))
        low, high = (mean - 9.0 * deviation).min(axis=-1), (mean + 9.0 * deviation).max(axis=-1)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            below = (self.weight * ndtr((middle[..., None] - mean) / deviation)).sum(axis=-1)
            low = np.where(below < probability, middle, low)
            high = np.where(below < probability, high, middle)
        return np.asarray((low + high) / 2)

    def observe(
        self,
        prior: Prior,
        slope: ArrayLike,
        measured: ArrayLike,
        share: ArrayLike,
        floor: ArrayLike,
    ) -> tuple[Belief, Array]:
        """The belief after measuring slope . numbers, and the probability that it was no bump.

        Args:
            prior: the one that the belief started from.
            slope: (..., numbers).
            measured: (...,). NaN where nothing was measured: that says nothing.
            share: (...,), deviation of a measurement as a share of the true value.
            floor: (...,), deviation of a measurement of 0.
        """
        h, y = np.asarray(slope, dtype=float), np.asarray(measured, dtype=float)
        known = np.isfinite(y)
        y = np.where(known, y, 0.0)[..., None]
        weight, mean, covariance = self._with_fresh(prior)
        relative, least = np.asarray(share)[..., None], np.asarray(floor)[..., None]
        expected = np.einsum("...hi,...i->...h", mean, h)
        reach = np.einsum("...hij,...j->...hi", covariance, h)
        spread = np.einsum("...hi,...i->...h", reach, h)
        # The share is one of the true value: of the estimate after this very measurement.
        noise = (relative * expected) ** 2 + least**2
        better = expected + spread / (spread + noise + 1e-300) * (y - expected)
        noise = (relative * better) ** 2 + least**2 + 1e-18
        total = spread + noise
        error = y - expected
        sound = (1.0 - BUMP) * np.exp(-0.5 * error**2 / total) / np.sqrt(2.0 * np.pi * total)
        likelihood = sound + BUMP / prior.span
        taken = np.where(known[..., None], sound / likelihood, 0.0)
        gain = reach / total[..., None]
        outer = gain[..., :, None] * gain[..., None, :]
        mean = mean + (taken * error)[..., None] * gain
        covariance = covariance - (taken * total)[..., None, None] * outer
        covariance = covariance + (taken * (1.0 - taken) * error**2)[..., None, None] * outer
        weight = weight * np.where(known[..., None], likelihood, 1.0)
        weight = np.maximum(weight / weight.sum(axis=-1, keepdims=True), LEAST_WEIGHT)
        probability = (weight * taken).sum(axis=-1) / weight.sum(axis=-1)
        return _settled(weight, mean, covariance), np.where(known, probability, 0.0)

    def _with_fresh(self, prior: Prior) -> tuple[Array, Array, Array]:
        """One more filter: the truth has changed just now."""
        shape = self.weight.shape[:-1]
        numbers = prior.mean.shape[1]
        spread = np.diag(prior.deviation[prior.change] ** 2)
        fresh = np.broadcast_to(prior.mean[prior.change], (*shape, 1, numbers))
        wide = np.broadcast_to(spread, (*shape, 1, numbers, numbers))
        return (
            np.concatenate([(1.0 - CHANGE) * self.weight, np.full((*shape, 1), CHANGE)], axis=-1),
            np.concatenate([self.mean, fresh], axis=-2),
            np.concatenate([self.covariance, wide], axis=-3),
        )


def _settled(weight: Array, mean: Array, covariance: Array) -> Belief:
    """Keep the better of the two last filters as the candidate; one that outweighs all others
    replaces them."""
    old_better = weight[..., -2] > weight[..., -1]
    wins = old_better & (weight[..., -2] > weight[..., :-2].sum(axis=-1))
    pick = np.where(old_better, -2, -1)[..., None]
    candidate_weight = np.take_along_axis(weight, pick, axis=-1)
    candidate_mean = np.take_along_axis(mean, pick[..., None], axis=-2)
    candidate_covariance = np.take_along_axis(covariance, pick[..., None, None], axis=-3)
    main_weight, main_mean, main_covariance = (
        weight[..., :-2],
        mean[..., :-2, :],
        covariance[..., :-2, :, :],
    )
    count = main_weight.shape[-1]
    main_weight = np.where(wins[..., None], candidate_weight / count, main_weight)
    main_mean = np.where(wins[..., None, None], candidate_mean, main_mean)
    main_covariance = np.where(wins[..., None, None, None], candidate_covariance, main_covariance)
    candidate_weight = np.where(wins[..., None], LEAST_WEIGHT, candidate_weight)
    weight = np.concatenate([main_weight, candidate_weight], axis=-1)
    return Belief(
        weight / weight.sum(axis=-1, keepdims=True),
        np.concatenate([main_mean, candidate_mean], axis=-2),
        np.concatenate([main_covariance, candidate_covariance], axis=-3),
    )
