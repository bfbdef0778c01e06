"""All mutants, in the order in which the mutation test tries them."""

from __future__ import annotations

from tapping_cell.verification.command_mutants import COMMAND_MUTANTS
from tapping_cell.verification.exception_mutants import EXCEPTION_MUTANTS
from tapping_cell.verification.fixed_mutants import FIXED_MUTANTS
from tapping_cell.verification.mode_mutants import MODE_MUTANTS
from tapping_cell.verification.mutants import MUTANTS, Mutant
from tapping_cell.verification.table_mutants import TABLE_MUTANTS

ALL_MUTANTS: tuple[Mutant, ...] = (
    *FIXED_MUTANTS,
    *MODE_MUTANTS,
    *TABLE_MUTANTS,
    *COMMAND_MUTANTS,
    *EXCEPTION_MUTANTS,
    *MUTANTS,
)
