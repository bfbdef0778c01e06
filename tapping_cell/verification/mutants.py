"""Single faults planted in the shipping logic: each must be caught, or its guard does nothing.

A mutant is a small replacement in the source of one module of ``logic`` or ``hardware``, applied
while the module is imported. The files on disk stay as they are.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType


@dataclass(frozen=True, slots=True)
class Mutant:
    """``old`` stands exactly once in the module's source, and becomes ``new``."""

    name: str
    module: str
    old: str
    new: str


MUTANTS: tuple[Mutant, ...] = ()


class MutantError(Exception):
    """A mutant no longer fits the source that it changes."""


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module with a mutant in it."""

    def __init__(self, name: str, path: str, mutant: Mutant) -> None:
        super().__init__(name, path)
        self._mutant = mutant

    def get_code(self, fullname: str):  # type: ignore[no-untyped-def]
        """The code of the changed source; never from a cache."""
        return compile(mutated(self._mutant), self.path, "exec", dont_inherit=True)


class _Finder(importlib.abc.MetaPathFinder):
    """Finds the module of a mutant before anybody else does."""

    def __init__(self, mutant: Mutant) -> None:
        self._mutant = mutant

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The specification of the module with the mutant; None for every other."""
        if name != self._mutant.module:
            return None
        source = str(_source_of(self._mutant.module))
        loader = _Loader(name, source, self._mutant)
        return importlib.util.spec_from_loader(name, loader)


def _source_of(module: str) -> Path:
    package = Path(__file__).resolve().parents[1]
    return package.joinpath(*module.split(".")[1:]).with_suffix(".py")


def mutated(mutant: Mutant) -> str:
    """The changed source of a mutant's module.

    Raises:
        MutantError: what is to be replaced does not stand in it exactly once.
    """
    source = _source_of(mutant.module).read_text(encoding="utf-8")
    count = source.count(mutant.old)
    if count != 1:
        raise MutantError(
            f"mutant '{mutant.name}': its text stands {count} times in {mutant.module}; it must"
            " stand there once"
        )
    return source.replace(mutant.old, mutant.new)


def plant(mutant: Mutant) -> None:
    """Plant a mutant in this process, before its module is imported.

    Raises:
        MutantError: the module was imported already, or the mutant no longer fits.
    """
    mutated(mutant)
    if mutant.module in sys.modules:
        raise MutantError(f"{mutant.module} was imported before mutant '{mutant.name}' was planted")
    sys.meta_path.insert(0, _Finder(mutant))
