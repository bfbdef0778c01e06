"""The simulated striker's speed for energies inside and outside the tapper's energy curve."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware.energy import EnergyCurve
from tapping_cell.simulation.striker_motion import striker_speed

MEASURED = EnergyCurve(((0.001, 0.1), (0.01, 0.4), (0.1, 1.2)))


@given(st.floats(0.0, 10.0))
def test_an_ideal_drive_gives_the_speed_of_its_energy(energy: float) -> None:
    assert striker_speed(EnergyCurve(), energy) == pytest.approx((energy / 0.05) ** 0.5)


@given(st.floats(0.001, 0.1))
def test_inside_the_table_the_curve_applies(energy: float) -> None:
    assert striker_speed(MEASURED, energy) == pytest.approx(MEASURED.speed_for(energy))


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_more_energy_never_gives_a_slower_striker(first: float, second: float) -> None:
    slower, faster = sorted((first, second))
    assert striker_speed(MEASURED, slower) <= striker_speed(MEASURED, faster) + 1e-12


def test_a_discharged_striker_does_not_move() -> None:
    assert striker_speed(MEASURED, 0.0) == striker_speed(MEASURED, -1e-9) == 0.0
