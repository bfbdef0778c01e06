"""A stored file that a crash has left unusable never prevents a node from starting."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tapping_cell.nodes.kept_content import KeptContent


def test_stored_content_is_loaded_and_removed(tmp_path: Path) -> None:
    kept = KeptContent(tmp_path / "cell" / "goal.json")
    assert kept.recall() is None
    kept.keep({"goal": [0.01, 0.02, 0.3]})
    assert kept.recall() == {"goal": [0.01, 0.02, 0.3]} and kept.age() < 60.0
    kept.keep(None)
    assert kept.recall() is None


@pytest.mark.parametrize("text", ["", "[" * 200_000, "[]", "7", "\x00", '{"goal": ' * 100_000])
def test_an_unreadable_file_gives_empty_content(tmp_path: Path, text: str) -> None:
    file = tmp_path / "goal.json"
    file.write_text(text, encoding="utf-8")
    assert KeptContent(file).recall() == {}


def test_old_content_is_kept_until_the_new_content_is_complete(tmp_path: Path) -> None:
    file = tmp_path / "goal.json"
    kept = KeptContent(file)
    kept.keep({"goal": 1})
    with pytest.raises(TypeError):
        kept.keep({"goal": object()})
    assert json.loads(file.read_text()) == {"goal": 1}
