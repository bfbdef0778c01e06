"""Nodes under test keep goals and stops in a folder of the test, not of this account's cells."""

from pathlib import Path

import pytest

from tapping_cell.nodes import cell_identity


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cell_identity, "STATE", tmp_path / ".ros" / "tapping_cell")
