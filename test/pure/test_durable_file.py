"""A replaced file has either its old or its new content, also after a loss of power."""

import os
import stat
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.durable_file import part_of, replace_text

TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\r"))


@given(old=TEXTS, new=TEXTS)
def test_the_new_text_replaces_the_old_one(tmp_path_factory, old, new):
    path = tmp_path_factory.mktemp("files") / "record.json"
    for text in (old, new):
        replace_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert list(path.parent.iterdir()) == [path]


def test_the_text_is_on_the_disk_before_the_file_gets_its_name(tmp_path, monkeypatch):
    path = tmp_path / "record.json"
    replace_text(path, "old")
    seen: list[tuple[int, str]] = []

    def fsync(descriptor: int) -> None:
        if stat.S_ISREG(os.fstat(descriptor).st_mode):
            seen.append((os.fstat(descriptor).st_size, path.read_text(encoding="utf-8")))
        else:
            seen.append((-1, path.read_text(encoding="utf-8")))

    monkeypatch.setattr(os, "fsync", fsync)
    replace_text(path, "longer")
    # The folder follows: its entry for the new file would otherwise be lost with the power.
    assert seen == [(6, "old"), (-1, "longer")]


def test_a_failure_to_write_leaves_the_old_text(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    replace_text(path, "old")
    part_of(path).mkdir()
    with pytest.raises(OSError):
        replace_text(path, "new")
    assert path.read_text(encoding="utf-8") == "old"


def test_a_full_disk_leaves_the_old_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "record.json"
    replace_text(path, "old")

    def fail(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        replace_text(path, "new")
    assert path.read_text(encoding="utf-8") == "old"
