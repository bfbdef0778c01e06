"""Separation of a scatter into a part proportional to the tap's size and a constant floor.

The deviations of series k are assumed to be normally distributed; the variance for a tap of size L
is (share_k L)^2 + floor^2. Shares and floor are maximum likelihood estimates. The floor is kept
only if a likelihood ratio test shows that it is not zero. Because zero is the limit of the floor's
range, the p-value is half of the p-value of the chi-squared distribution with one degree of freedom
(Self and Liang, JASA 82, 1987).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from tapping_cell.se2 import Array

MIN_TRIALS = 8
MIN_RATIO = 2.5
"""Minimum ratio of the 90 % quantile of the sizes to the 10 % quantile. If the sizes are more
similar, the taps do not determine a floor."""
SIGNIFICANCE = 0.01
_TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Parts:
    """Standard deviations of a scatter: ``shares`` of the size, one for each series, and ``floor``
    in the unit of the deviations. ``floor_std`` is the floor's standard error; it is 0 if the
    floor is not significant."""

    shares: tuple[float, ...]
    floor: float
    floor_std: float


def scatter_parts(series: Sequence[tuple[Array, Array]]) -> Parts | None:
    """Estimate the shares and the common floor of one or more series.

    Args:
        series: for each series, a pair of arrays (n,) in the same unit: the deviations of the taps
            (expected value 0) and the sizes of the taps.

    Returns:
        The estimate, or None if there are too few taps, or if their sizes are too similar to
        determine a floor.
    """
    taken = [_known(*pair) for pair in series]
    for deviation, size in taken:
        if deviation.size < MIN_TRIALS or not np.any(deviation):
            return None
        low, high = np.quantile(size, (0.1, 0.9))
        if high < MIN_RATIO * low:
            return None
    alone = [math.sqrt(float(np.mean((d / s) ** 2))) for d, s in taken]

    def cost(logarithms: Array) -> float:
        shares, floor = np.exp(logarithms[:-1]), math.exp(logarithms[-1])
        total = 0.0
        for (deviation, size), share in zip(taken, shares, strict=True):
            variance = (share * size) ** 2 + floor**2
            total += 0.5 * float(np.sum(np.log(variance) + deviation**2 / variance))
        return total

    small = [math.sqrt(float(np.mean(d[s <= np.quantile(s, 0.3)] ** 2))) + _TINY for d, s in taken]
    start = np.log([*alone, min(small)])
    bounds = [(math.log(0.01 * a), math.log(3.0 * a)) for a in alone]
    floor_bounds = (math.log(1e-3 * min(small)), math.log(3.0 * max(small)))
    found = minimize(cost, start, method="L-BFGS-B", bounds=[*bounds, floor_bounds])
    without = cost(np.log([*alone, _TINY * min(small)]))
    if 0.5 * float(chi2.sf(max(2.0 * (without - float(found.fun)), 0.0), 1)) > SIGNIFICANCE:
        return Parts(tuple(alone), 0.0, 0.0)
    shares, floor = np.exp(found.x[:-1]).tolist(), math.exp(float(found.x[-1]))
    return Parts(tuple(shares), floor, floor * _relative_error(taken, shares, floor))


def _known(deviation: Array, size: Array) -> tuple[Array, Array]:
    usable = np.isfinite(deviation) & (size > 0.0)
    return deviation[usable], size[usable]


def _relative_error(
    series: Sequence[tuple[Array, Array]], shares: Sequence[float], floor: float
) -> float:
    """Compute the standard error of the logarithm of the floor from the Fisher information."""
    count = len(shares)
    information = np.zeros((count + 1, count + 1))
    for k, ((_, size), share) in enumerate(zip(series, shares, strict=True)):
        variance = (share * size) ** 2 + floor**2
        slopes = np.zeros((count + 1, size.size))
        slopes[k], slopes[count] = 2.0 * (share * size) ** 2 / variance, 2.0 * floor**2 / variance
        information += 0.5 * slopes @ slopes.T
    return math.sqrt(float(np.linalg.pinv(information)[count, count]))
