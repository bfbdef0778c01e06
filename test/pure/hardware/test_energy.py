"""The curve between speed and energy is monotonic, exact for an ideal drive, and invertible."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware.energy import EnergyCurve

rises = st.lists(st.tuples(st.floats(1e-4, 0.1), st.floats(1e-3, 0.5)), min_size=2, max_size=8)


def curve_of(steps: list[tuple[float, float]]) -> EnergyCurve:
    energies = itertools.accumulate(step[0] for step in steps)
    speeds = itertools.accumulate(step[1] for step in steps)
    return EnergyCurve(tuple(zip(energies, speeds, strict=True)))


@given(rises, st.floats(0, 1), st.floats(0, 1))
def test_energy_and_speed_increase_together_and_convert_back(steps, a, b):
    curve = curve_of(steps)
    span = curve.fastest - curve.slowest
    slow, fast = sorted(min(curve.slowest + part * span, curve.fastest) for part in (a, b))
    assert curve.energy_for(slow) <= curve.energy_for(fast)
    for speed in (slow, fast):
        energy = min(max(curve.energy_for(speed), curve.table[0][0]), curve.table[-1][0])
        assert curve.speed_for(energy) == pytest.approx(speed, rel=1e-9)


@given(st.floats(0.02, 1.0), st.floats(0.05, 2.0))
def test_an_ideal_spring_needs_two_points(mass: float, speed: float) -> None:
    ends = (0.04, 2.5)
    curve = EnergyCurve(tuple((mass * v**2 / 2, v) for v in ends))
    assert curve.energy_for(speed) == pytest.approx(mass * speed**2 / 2, rel=1e-9)


@pytest.mark.parametrize(
    "table",
    [
        ((0.1, 1.0),),
        ((0.1, 1.0), (0.2, 0.9)),
        ((0.2, 1.0), (0.1, 1.1)),
        ((0.0, 1.0), (0.1, 1.1)),
        ((0.1, 1.0), (math.nan, 1.1)),
    ],
)
def test_a_table_that_does_not_rise_is_refused(table: tuple[tuple[float, float], ...]) -> None:
    with pytest.raises(ValueError):
        EnergyCurve(table)


def test_values_outside_the_table_are_refused_with_a_message() -> None:
    curve = EnergyCurve(((0.01, 0.2), (0.1, 1.0)))
    with pytest.raises(ValueError, match=r"1200\.0 mm/s is outside the tapper's 200\.0 to 1000"):
        curve.energy_for(1.2)
    with pytest.raises(ValueError, match="outside"):
        curve.speed_for(1.0)
