"""Table of the mutants in benchmarks/RESULTS.md."""

from __future__ import annotations

from lab.mutation.equivalent import REASONS
from lab.mutation.mutants import Mutant
from lab.mutation.runs import Result


def survivor(mutant: Mutant) -> str:
    """Return the line of a mutant that nothing has found."""
    reason = REASONS.get(mutant.name, "")
    return f"  {mutant.name}  {mutant.change()}" + (f"  ({reason})" if reason else "")


def row(name: str, results: list[Result]) -> str:
    """Return the line of a module."""
    tests = sum(bool(each.test) for each in results)
    campaign = sum(bool(each.violation) for each in results)
    left = [each.mutant for each in results if not (each.test or each.violation)]
    explained = sum(mutant.name in REASONS for mutant in left)
    return (
        f"{name:<22} {len(results):>5} mutants: tests found {tests:>5}, the campaign"
        f" {campaign:>3}; {len(left):>3} survive, {explained:>3} with a reason"
    )


def write(*_: object) -> None:
    raise NotImplementedError
