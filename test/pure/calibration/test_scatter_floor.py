"""A tap's scatter is separated into a part proportional to its length and a constant floor."""

import numpy as np
import pytest

from tapping_cell.calibration.scatter_floor import scatter_parts


def _series(share: float, floor: float, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = np.exp(rng.uniform(np.log(0.0017), np.log(0.03), count))
    return np.hypot(share * size, floor) * rng.standard_normal(count), size


def test_both_parts_are_found() -> None:
    off = []
    for seed in range(40):
        series = [
            _series(0.05, 2e-4, 80, seed),
            _series(0.0175, 2e-4, 80, 1000 + seed),
        ]
        parts = scatter_parts(series)
        assert parts is not None
        off.append((parts.floor - 2e-4) / parts.floor_std)
        assert parts.floor == pytest.approx(2e-4, rel=0.4)
        assert parts.shares[0] == pytest.approx(0.05, rel=0.45)
    assert abs(np.mean(off)) < 0.5
    assert np.std(off) == pytest.approx(1.0, abs=0.35)


def test_proportional_scatter_has_no_floor() -> None:
    """With a false alarm rate of 1 %, more than 6 false alarms in 200 series have a probability of
    0.4 %."""
    found = [scatter_parts([_series(0.05, 0.0, 60, seed)]) for seed in range(200)]
    assert sum(parts is not None and parts.floor > 0.0 for parts in found) <= 6


def test_taps_of_one_size_do_not_determine_a_floor() -> None:
    rng = np.random.default_rng(1)
    assert scatter_parts([(1e-4 * rng.standard_normal(50), np.full(50, 0.01))]) is None


def test_few_taps_do_not_determine_a_floor() -> None:
    assert scatter_parts([_series(0.05, 1e-3, 7, 1)]) is None
