"""The soak test detects a resource use that grows over time; the resource use of the drivers does
not grow."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tapping_cell.cli import main
from tapping_cell.cli.driver_soak import ALLOWED_BLOCKS, ALLOWED_RESIDENT, Soak, soak
from tapping_cell.cli.fault_trials import Dialect

STEADY = Soak("grbl", 1.0, 700, (1000, 1100, 1000), (9_000, 9_100), (1, 1), (5, 5), True)


@pytest.mark.parametrize("dialect", Dialect)
def test_a_minute_of_faulty_lines_leaks_no_resources(dialect: Dialect) -> None:
    run = soak(dialect, 0.01, 4)
    assert run.steady and run.clean and run.taps > 3, run


def test_growth_of_any_resource_is_detected() -> None:
    assert STEADY.steady
    assert not replace(STEADY, blocks=(1000, 1001 + ALLOWED_BLOCKS)).steady
    assert not replace(STEADY, resident=(1000, 1001 + ALLOWED_RESIDENT)).steady
    assert not replace(STEADY, threads=(1, 2)).steady
    assert not replace(STEADY, descriptors=(5, 6)).steady


@pytest.mark.parametrize("arguments", [["--soak", "0"], ["--taps", "0"]], ids=lambda a: " ".join(a))
def test_invalid_numbers_are_refused(arguments, capsys):
    assert main(["faults", *arguments]) == 2
    assert "must be" in capsys.readouterr().err
