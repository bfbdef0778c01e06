"""Table of the mutants in benchmarks/RESULTS.md."""

from __future__ import annotations

import re
from collections.abc import Sequence

from benchmarks.__main__ import RESULTS, write_section
from lab.mutation.equivalent import REASONS
from lab.mutation.mutants import Mutant, Source
from lab.mutation.runs import Result

SECTION = "mutation"


def survivor(mutant: Mutant) -> str:
    """Return the line of a mutant that nothing has found."""
    reason = REASONS.get(mutant.name, "")
    return f"  {mutant.name}  {mutant.change()}" + (f"  ({reason})" if reason else "")


def lines(source: Source, results: Sequence[Result]) -> list[str]:
    """Return the lines of a module: its counts, and its survivors."""
    tests = sum(bool(each.test) for each in results)
    campaign = sum(bool(each.violation) for each in results)
    left = [each.mutant for each in results if not (each.test or each.violation)]
    explained = sum(mutant.name in REASONS for mutant in left)
    found = f"tests found {tests:>3}" + (f", the campaign {campaign:>2}" if campaign else "")
    counts = (
        f"{source.name:<22} {len(results):>3} of {len(source.mutants):>3} mutants; {found};"
        f" survivors {len(left):>2}, with a reason {explained:>2}"
    )
    return [counts, *(survivor(mutant) for mutant in left)]


def write(modules: dict[str, list[str]], goals: int | None) -> None:
    """Replace the lines of these modules in the page of results, and keep the other modules."""
    page = RESULTS.read_text(encoding="utf-8") if RESULTS.exists() else ""
    section = re.search(rf"^## {SECTION}\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL)
    kept: dict[str, list[str]] = {}
    for line in re.findall(r"^    (.+)$", section[1] if section else "", re.MULTILINE):
        name = next(reversed(kept)) if line.startswith(" ") else line.split()[0]
        kept.setdefault(name, []).append(line)
    kept |= modules
    text = "\n".join(f"    {line}" for name in sorted(kept) for line in kept[name])
    command = f"python -m lab mutate --write{f' --campaign {goals}' if goals else ''}"
    write_section(RESULTS, SECTION, text, command)
