"""Summary of the results of trials; lengths in mm and angles in degrees."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tapping_cell.planning.evaluation.task import End, Results

NORMAL_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


def summarise(results: Results, planned_taps: int | None = None) -> dict[str, Any]:
    """Summarise an evaluation.

    ``success_rate``: share of all trials, the refused ones included, that ended at the goal
    according to the session; ``done``: their number. ``truly_inside_rate``: share of the trials
    done in which the true pose is within the full tolerance; ``truly_inside``: their number.
    ``taps`` and ``seconds`` are of the trials that were not refused before the first tap.
    ``planned_taps``: number of taps of the method's plan, for methods that guarantee it.
    ``within_planned_rate``: share of all trials that ended at the goal within this number.
    """
    began = results.end != End.REFUSED_BEFORE
    done = results.end == End.DONE
    everything = np.ones_like(done)
    taps = results.taps[began]
    summary: dict[str, Any] = {
        "trials": int(results.taps.size),
        "done": int(np.sum(done)),
        "success_rate": _share(done, everything),
        "truly_inside": int(np.sum(results.inside & done)),
        "truly_inside_rate": _share(results.inside & done, done),
        "taps": tap_figures(taps),
        "refused_before": int(np.sum(~began)),
        "refused_later": int(np.sum(results.end == End.REFUSED_LATER)),
        "over_edge": int(np.sum(results.over_edge)),
        "endless": int(np.sum(results.end == End.ENDLESS)),
        "residual_mm": _spread(1e3 * results.distance[done]),
        "residual_deg": _spread(np.degrees(np.abs(results.rotation[done]))),
    }
    seconds = results.seconds[began]
    if np.all(np.isfinite(seconds)) and seconds.size:
        summary["seconds"] = {**mean_of(seconds), "p90": float(np.percentile(seconds, 90))}
    if planned_taps is not None:
        summary["planned_taps"] = planned_taps
        summary["within_planned_rate"] = _share(done & (results.taps <= planned_taps), everything)
    return summary


def mean_of(values: np.ndarray[Any, Any]) -> dict[str, Any]:
    """Return the mean with its 95 % confidence interval."""
    mean = float(np.mean(values))
    error = NORMAL_95 * float(np.std(values)) / math.sqrt(values.size)
    return {"mean": mean, "mean_interval": [mean - error, mean + error]}


def tap_figures(taps: np.ndarray[Any, np.dtype[np.int64]]) -> dict[str, Any]:
    """Compute the mean with its 95 % confidence interval, percentiles, maximum and histogram of tap
    counts."""
    if taps.size == 0:
        return {"mean": math.nan, "mean_interval": [math.nan] * 2, "histogram": {}}
    counts = np.bincount(taps)
    return {
        **mean_of(taps),
        "p50": int(np.percentile(taps, 50, method="inverted_cdf")),
        "p90": int(np.percentile(taps, 90, method="inverted_cdf")),
        "p99": int(np.percentile(taps, 99, method="inverted_cdf")),
        "max": int(taps.max()),
        "histogram": {str(number): int(count) for number, count in enumerate(counts) if count},
    }


def _share(part: np.ndarray[Any, Any], whole: np.ndarray[Any, Any]) -> float:
    return float(np.sum(part & whole) / np.sum(whole)) if np.any(whole) else math.nan


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float]:
    if values.size == 0:
        return {"mean": math.nan, "p99": math.nan, "max": math.nan}
    return {
        "mean": float(np.mean(values)),
        "p99": float(np.percentile(values, 99)),
        "max": float(np.max(values)),
    }
