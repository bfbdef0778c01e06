"""Bootstrap confidence intervals for fits that minimise a sum of costs, one for each trial.

The score s_i(t) of trial i is the gradient of the trial's cost with respect to the parameters t, so
an estimate t solves sum_i s_i(t) = 0. Near the fitted estimate t_0, the score is approximately
s_i(t) = s_i + H_i (t - t_0), where s_i is the score at t_0 and H_i the information: the second
derivative of the cost at t_0. One Newton step gives the estimate from a resample and the standard
error of this estimate, so thousands of resamples cost only a matrix product. Trials are resampled
within each run, so every run keeps its number of trials. The interval is the studentised one
(percentile-t; Davison and Hinkley, Bootstrap Methods and their Application, 1997, section 5.2.1).
The coverage of this interval is correct even for a small number of trials. For such a number, the
plain percentile interval is too short.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tapping_cell.se2 import Array

REPLICATES = 2000
LEVEL = 0.95
# The deviation of a resample from the estimate is clipped at this many standard errors, because a
# resample may lack the trials that determine a parameter.
_MAX_STD = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Spread:
    """Lower and upper end of the interval, both as differences from the estimate, and the standard
    error; each of shape (p,)."""

    low: Array
    high: Array
    std: Array


def spread(
    score: Array,
    information: Array,
    runs: Sequence[int],
    seed: int = 0,
    replicates: int = REPLICATES,
) -> Spread:
    """Compute the interval of an estimate from the scores (n, p) and information (n, p, p).

    ``runs`` (n,) is the run of each trial.

    Raises:
        ValueError: the trials do not determine the parameters.
    """
    labels = np.asarray(runs)
    count, size = score.shape
    _, std = _newton(np.ones((1, count)), score, information)
    if not np.isfinite(std).all():
        raise ValueError("the trials do not determine the parameters")
    random = np.random.default_rng(seed)
    weights = np.zeros((replicates, count))
    for run in np.unique(labels):
        members = np.flatnonzero(labels == run)
        chosen = random.integers(members.size, size=(replicates, members.size))
        for place, member in enumerate(members):
            weights[:, member] = (chosen == place).sum(axis=1)
    offset, own_std = _newton(weights, score, information)
    usable = np.isfinite(offset).all(axis=1) & np.isfinite(own_std).all(axis=1)
    ratio = offset[usable] / np.maximum(own_std[usable], 1e-3 * std + 1e-300)
    # Resampling within a run of n trials gives a variance that is too small by the factor (n - 1) /
    # n. The variance is corrected with the mean of n / (n - 1) over all trials.
    sizes = np.array([np.sum(labels == run) for run in labels], dtype=float)
    ratio *= math.sqrt(float(np.mean(sizes / np.maximum(sizes - 1, 1))))
    ratio = np.clip(ratio, -_MAX_STD, _MAX_STD)
    tail = (1 - LEVEL) / 2
    upper, lower = np.quantile(ratio, [1 - tail, tail], axis=0)
    # For few trials the standard error is slightly too small, because each fitted parameter uses up
    # a degree of freedom. The factor corrects this.
    std = std[0] * math.sqrt(count / max(count - size, 1))
    return Spread(low=-upper * std, high=-lower * std, std=std)


def _newton(weights: Array, score: Array, information: Array) -> tuple[Array, Array]:
    """Compute offsets and standard errors (b, p) of the estimates for trial weights (b, n)."""
    count, size = score.shape
    h = (weights @ information.reshape(count, -1)).reshape(-1, size, size)
    inverse = np.full_like(h, math.nan)
    scale = np.sqrt(np.maximum(np.einsum("bii->bi", h), 1e-300))
    unit = h / scale[:, :, None] / scale[:, None, :]
    good = np.linalg.cond(unit) < 1e12
    inverse[good] = np.linalg.inv(unit[good])
    inverse = inverse / scale[:, :, None] / scale[:, None, :]
    offset = -np.einsum("bij,bj->bi", inverse, weights @ score)
    # The standard error of a resample needs the scores at the estimate of that resample.
    at_own = score[None] + np.einsum("nij,bj->bni", information, np.nan_to_num(offset))
    outer = np.einsum("bn,bni,bnj->bij", weights, at_own, at_own)
    covariance = inverse @ outer @ inverse
    return offset, np.sqrt(np.maximum(np.einsum("bii->bi", covariance), 0.0))
