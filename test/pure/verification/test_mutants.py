"""Every mutant replaces existing code, and its hunt draws kinds of faults that its cell has."""

from __future__ import annotations

import pytest

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


def test_there_are_enough_mutants_with_unique_names() -> None:
    names = [mutant.name for mutant in ALL_MUTANTS]
    assert len(set(names)) == len(names) >= 30
    assert all(mutant.fixed for mutant in FIXED_MUTANTS)
    assert all(mutant.set_up or mutant.ask for mutant in MODE_MUTANTS)
    assert all(mutant.several for mutant in TABLE_MUTANTS)
