"""A bank of Kalman filters that is robust to a wrong prior, to outliers and to lasting changes.

Each filter of the bank starts from a prior of a different width (static multiple models: Magill,
IEEE Trans. Automatic Control 10, 1965). The narrow prior suits most objects. For an object whose
values differ greatly from the expected ones, a filter with a wide prior gives a good estimate after
only one additional measurement. A measurement may be an outlier (a bumped object, a striker that
missed). Each filter weights measurements by the probability that they are valid (probabilistic data
association: Bar-Shalom and Tse, Automatica 11, 1975). The true values may also change permanently.
An additional filter, the candidate, assumes that the true values changed at the last measurement.
If the next measurement agrees with the candidate, the candidate outweighs the other filters and
replaces them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tapping_cell.planning.interface import Array

BUMP = 0.02
"""Prior probability that a measurement is an outlier."""

CHANGE = 0.004
"""Prior probability, per measurement, that the true values have changed."""

MIN_WEIGHT = 1e-9

_BISECTIONS = 40


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior distribution: a mixture with one normal distribution per filter.

    weight: (filters,), with a sum of 1. mean, deviation: mean and standard deviation, (filters,
    numbers). change: index of the filter from whose prior the candidate starts. span: width of the
    uniform distribution of outliers.
    """

    weight: Array
    mean: Array
    deviation: Array
    change: int
    span: float


@dataclass(frozen=True, slots=True)
class Belief:
    """Estimate of some numbers (parameters) of one object, or of several objects (leading axes).

    weight: (..., filters); the last filter is the candidate. mean: (..., filters, numbers).
    covariance: (..., filters, numbers, numbers).
    """

    weight: Array
    mean: Array
    covariance: Array

    @classmethod
    def start(cls, prior: Prior, shape: tuple[int, ...] = ()) -> Belief:
        """Return the belief about objects that were never measured: the prior."""
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
        """Return the belief about the objects in ``rows``."""
        return Belief(self.weight[rows], self.mean[rows], self.covariance[rows])

    def put(self, rows: NDArray[np.intp], other: Belief) -> None:
        """Replace the belief about the objects in ``rows``."""
        self.weight[rows] = other.weight
        self.mean[rows] = other.mean
        self.covariance[rows] = other.covariance

    def expected(self, combine: Array | None = None) -> Array:
        """Return the expected numbers (..., numbers), over all filters except the candidate.

        combine: (sums, numbers); if given, the expected sums (..., sums) of the numbers with these
        weights are returned instead.
        """
        main = self.weight[..., :-1]
        share = main / main.sum(axis=-1, keepdims=True)
        expected = np.einsum("...h,...hi->...i", share, self.mean[..., :-1, :])
        return np.asarray(expected if combine is None else expected @ combine.T)

    def deviation(self, combine: Array | None = None) -> Array:
        """Return the standard deviations about ``expected``, over all filters except the candidate.
        ``combine``: as for ``expected``."""
        main = self.weight[..., :-1]
        share = main / main.sum(axis=-1, keepdims=True)
        matrix = np.eye(self.mean.shape[-1]) if combine is None else combine
        off = self.mean[..., :-1, :] @ matrix.T - self.expected(matrix)[..., None, :]
        own = np.einsum("...ij,ki,kj->...k", self.covariance[..., :-1, :, :], matrix, matrix)
        return np.asarray(np.sqrt(np.einsum("...h,...hi->...i", share, own + off * off)))

    def quantile(self, slope: ArrayLike, probability: float, noise: ArrayLike = 0.0) -> Array:
        """Compute a quantile, (...,), of the scalar product of slope and numbers, plus noise, over
        all filters including the candidate.

        slope: (..., numbers). noise: standard deviation of the added noise, (...,).
        """
        h = np.asarray(slope, dtype=float)
        mean = np.einsum("...hi,...i->...h", self.mean, h)
        variance = np.einsum("...hij,...i,...j->...h", self.covariance, h, h)
        deviation = np.sqrt(np.maximum(variance + np.asarray(noise)[..., None] ** 2, 1e-18))
        low, high = (mean - 9.0 * deviation).min(axis=-1), (mean + 9.0 * deviation).max(axis=-1)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            below = (self.weight * scipy.special.ndtr((middle[..., None] - mean) / deviation)).sum(
                axis=-1
            )
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
        """Update the belief with a measurement of the scalar product of slope and numbers.

        Returns the new belief and the probability that the measurement is valid.

        Args:
            prior: prior from which the belief started.
            slope: (..., numbers).
            measured: (...,). NaN means no measurement and leaves the estimate unchanged.
            share: (...,), standard deviation of a measurement relative to the true value.
            floor: (...,), standard deviation of a measurement if the true value is 0.
        """
        h, y = np.asarray(slope, dtype=float), np.asarray(measured, dtype=float)
        known = np.isfinite(y)
        y = np.where(known, y, 0.0)[..., None]
        weight, mean, covariance = self._with_fresh(prior)
        relative, absolute = np.asarray(share)[..., None], np.asarray(floor)[..., None]
        expected = np.einsum("...hi,...i->...h", mean, h)
        cross = np.einsum("...hij,...j->...hi", covariance, h)
        variance = np.einsum("...hi,...i->...h", cross, h)
        # The relative noise refers to the true value, which is approximated by the updated
        # estimate.
        noise = (relative * expected) ** 2 + absolute**2
        updated = expected + variance / (variance + noise + 1e-300) * (y - expected)
        noise = (relative * updated) ** 2 + absolute**2 + 1e-18
        total = variance + noise
        error = y - expected
        valid = (1.0 - BUMP) * np.exp(-0.5 * error**2 / total) / np.sqrt(2.0 * np.pi * total)
        likelihood = valid + BUMP / prior.span
        p_valid = np.where(known[..., None], valid / likelihood, 0.0)
        gain = cross / total[..., None]
        outer = gain[..., :, None] * gain[..., None, :]
        mean = mean + (p_valid * error)[..., None] * gain
        covariance = covariance - (p_valid * total)[..., None, None] * outer
        covariance = covariance + (p_valid * (1.0 - p_valid) * error**2)[..., None, None] * outer
        weight = weight * np.where(known[..., None], likelihood, 1.0)
        weight = np.maximum(weight / weight.sum(axis=-1, keepdims=True), MIN_WEIGHT)
        probability = (weight * p_valid).sum(axis=-1) / weight.sum(axis=-1)
        return _settled(weight, mean, covariance), np.where(known, probability, 0.0)

    def _with_fresh(self, prior: Prior) -> tuple[Array, Array, Array]:
        """Return weights, means and covariances with one more filter, a new candidate, which
        assumes that the true values have just changed."""
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
    """Keep the more probable of the last two filters (the old and the new candidate) as the
    candidate. If the old candidate outweighs all other filters, it replaces them."""
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
    candidate_weight = np.where(wins[..., None], MIN_WEIGHT, candidate_weight)
    weight = np.concatenate([main_weight, candidate_weight], axis=-1)
    return Belief(
        weight / weight.sum(axis=-1, keepdims=True),
        np.concatenate([main_mean, candidate_mean], axis=-2),
        np.concatenate([main_covariance, candidate_covariance], axis=-3),
    )
