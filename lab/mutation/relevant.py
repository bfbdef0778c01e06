"""Finds the test files that a module's mutants need: those that import it, directly or through
other modules of ``logic``, ``hardware``, the lab and the tests."""

from __future__ import annotations

import ast
from collections.abc import Collection
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("test/pure/logic", "test/pure/hardware")
ROOMS = ("tapping_cell/logic", "tapping_cell/hardware", "lab", "test")


def test_files(modules: Collection[str]) -> list[str]:
    """Return the test files that import one of the modules."""
    files = [file for folder in FOLDERS for file in sorted((ROOT / folder).glob("test_*.py"))]
    return [str(file) for file in files if not _reached(file).isdisjoint(modules)]


def _reached(file: Path) -> set[str]:
    """Return all modules that a file imports, directly or not."""
    reached: set[str] = set()
    pending = _imports(file)
    while pending:
        reached |= pending
        files = {file for name in pending for file in _files(name)}
        pending = {name for each in files for name in _imports(each)} - reached
    return reached


def _files(name: str) -> list[Path]:
    """Return the file of a module in one of the rooms; a module of the tests has a name without a
    package."""
    places = [ROOT] if "." in name else [ROOT / "test/support", *(ROOT / each for each in FOLDERS)]
    files = [place / f"{name.replace('.', '/')}.py" for place in places]
    return [
        each for each in files if str(each.relative_to(ROOT)).startswith(ROOMS) and each.exists()
    ]


@cache
def _imports(file: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found
