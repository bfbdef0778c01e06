"""Every mutant replaces existing code, and its hunt draws kinds of faults that its cell has."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import tapping_cell
from tapping_cell.verification.all_mutants import ALL_MUTANTS
from tapping_cell.verification.faults import ASK_MAKERS, MAKERS, SET_UP_MAKERS
from tapping_cell.verification.fixed_faults import FIXED_MAKERS, FIXED_SET_UP_MAKERS
from tapping_cell.verification.fixed_mutants import FIXED_MUTANTS
from tapping_cell.verification.mode_mutants import MODE_MUTANTS
from tapping_cell.verification.mutants import Mutant, mutated, parts_of
from tapping_cell.verification.table_faults import TABLE_MAKERS
from tapping_cell.verification.table_mutants import TABLE_MUTANTS


def kinds_of_cell(mutant: Mutant) -> set[str]:
    """Return the kinds of faults that the cells of a mutant's hunt have."""
    if mutant.fixed:
        return {*FIXED_MAKERS, *(FIXED_SET_UP_MAKERS if mutant.set_up else ())}
    kinds = set(TABLE_MAKERS if mutant.several else MAKERS)
    if mutant.set_up:
        kinds |= set(SET_UP_MAKERS)
    if mutant.ask:
        kinds |= set(ASK_MAKERS)
    return kinds


@pytest.mark.parametrize("mutant", ALL_MUTANTS, ids=lambda mutant: mutant.name)
def test_every_mutant_applies_to_the_source(mutant: Mutant) -> None:
    for part in parts_of(mutant):
        compile(mutated(part), "mutant", "exec")
    assert set(mutant.kinds) <= kinds_of_cell(mutant)


def test_exceptions_are_planted_in_a_mutated_module_too(tmp_path: Path) -> None:
    """The package is imported by a symbolic link, as from a build folder."""
    (tmp_path / "tapping_cell").symlink_to(Path(tapping_cell.__path__[0]))
    program = """
from tapping_cell.verification.all_mutants import ALL_MUTANTS
from tapping_cell.verification.mutants import plant
plant(next(mutant for mutant in ALL_MUTANTS if mutant.module == "tapping_cell.logic.planner"))
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.verification.planted_exception import PlantedError, PlantedException
try:
    PlantedException(0).run(PlannerLogic._may_have_been_fired, None, None)
except PlantedError as error:
    print(error)
"""
    ran = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.stdout.startswith("planner.py:"), ran.stderr


def test_there_are_enough_mutants_with_unique_names() -> None:
    names = [mutant.name for mutant in ALL_MUTANTS]
    assert len(set(names)) == len(names) >= 30
    assert all(mutant.fixed for mutant in FIXED_MUTANTS)
    assert all(mutant.set_up or mutant.ask for mutant in MODE_MUTANTS)
    assert all(mutant.several for mutant in TABLE_MUTANTS)
