"""Mutants change what a function does and nothing else, and keep their ids."""

from __future__ import annotations

import ast
import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from lab.mutation import MODULES
from lab.mutation.mutants import Source
from lab.mutation.operators import replacements
from lab.mutation.relevant import test_files as files_for
from lab.mutation.runs import _fork, _receive

MODULE = '''
"""A module to be changed."""

from enum import Enum

LIMIT = 2.0
HALF = 0.5 * LIMIT


class Colour(Enum):
    RED = 1
    GREEN = 2


class Lamp:
    def __init__(self):
        self.colour = Colour.RED

    @property
    def is_red(self):
        return self.colour is Colour.RED

    def exceeds(self, value):
        """A sentence that is left alone."""
        if value is None:
            raise ValueError(f"the value is missing, limit {1.0 + LIMIT}")
        return value > LIMIT
'''


@pytest.fixture
def lamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "lamp_to_change.py").write_text(MODULE, encoding="utf-8")
    sys.modules.pop("lamp_to_change", None)
    return importlib.import_module("lamp_to_change")


@pytest.mark.parametrize(
    ("code", "changed"),
    [
        ("a or b or c", ["b or c", "a or c", "a or b"]),
        ("a - b", ["a", "a + b"]),
        ("a + 'text'", []),
        ("not a", ["a"]),
        ("a <= b < c", ["a > b < c", "a <= b >= c"]),
        ("a is None", ["a is not None"]),
        ("max(a, b)", ["min(a, b)", "b", "a"]),
        ("any(a)", ["all(a)"]),
        ("a if b else c", ["a if False else c", "a if True else c"]),
        ("0.1", ["0.2", "0.05"]),
        ("True", ["False"]),
        ("'text'", []),
        ("Colour.GREEN", ["Colour.RED"]),
    ],
)
def test_an_expression_has_these_mutants(code: str, changed: list[str], lamp: ModuleType) -> None:
    node = ast.parse(code, mode="eval").body
    assert [ast.unparse(new) for _, new in replacements(node, lamp)] == changed
    assert ast.unparse(node) == code, "the original is kept"


@pytest.mark.parametrize(
    ("code", "changed"),
    [
        ("act(a)", ["pass"]),
        ("self.a = self.b = c", ["self.b = c", "self.a = c"]),
        ("a = self.b = c", ["a = c"]),
        ("a = c", []),
        ("self.a += 1", ["pass"]),
        ("if a:\n    act(b)", ["if False:\n    act(b)", "if True:\n    act(b)"]),
        ("for a in b:\n    act(a)", ["for a in list(b)[:1]:\n    act(a)"]),
        ("while a:\n    act(a)", ["while False:\n    act(a)"]),
        ("return", []),
    ],
)
def test_a_statement_has_these_mutants(code: str, changed: list[str], lamp: ModuleType) -> None:
    (node,) = ast.parse(code).body
    assert [ast.unparse(new) for _, new in replacements(node, lamp)] == changed


def test_a_planted_mutant_changes_the_imported_module_but_not_its_file(lamp: ModuleType) -> None:
    def behaviour(name: str) -> object:
        """Return what the module does with a mutant, as computed in a process of its own."""

        def work() -> object:
            source = Source(lamp)
            source.plant(next(mutant for mutant in source.mutants if mutant.name == name))
            made = lamp.Lamp()
            return made.is_red, made.exceeds(2.0), made.exceeds(3.0), lamp.HALF

        return _receive(*_fork(work))

    names = [mutant.name for mutant in Source(lamp).mutants]
    assert names == [mutant.name for mutant in Source(lamp).mutants]
    assert len(names) == len(set(names))
    seen = {name: behaviour(name) for name in names}
    assert {name: done for name, done in seen.items() if done != (True, False, True, 1.0)} == {
        ":LIMIT:0:value:0": (True, False, False, 1.0),
        ":LIMIT:0:value:1": (True, True, True, 1.0),
        ":HALF:0:value:0": (True, False, True, 2.0),
        ":HALF:0:value:1": (True, False, True, 0.5),
        ":Lamp.__init__:1:member:0": (False, False, True, 1.0),
        ":Lamp.is_red:1:compare:0": (False, False, True, 1.0),
        ":Lamp.is_red:1:member:0": (False, False, True, 1.0),
        ":Lamp.exceeds:2:true:0": None,
        ":Lamp.exceeds:4:compare:0": (True, True, False, 1.0),
    }
    assert lamp.Lamp().is_red and Path(str(lamp.__file__)).read_text(encoding="utf-8") == MODULE


@pytest.mark.parametrize("name", MODULES)
def test_every_module_has_mutants_with_ids_of_their_own_and_tests(name: str) -> None:
    source = Source(importlib.import_module(f"tapping_cell.{name}"))
    names = [mutant.name for mutant in source.mutants]
    assert len(names) == len(set(names)) > 20
    assert files_for({source.module.__name__})
    assert all(mutant.change() for mutant in source.mutants)
