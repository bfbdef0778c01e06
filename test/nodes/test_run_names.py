"""The recorder refuses invalid names and folders."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.nodes.recorder.run_names import LONGEST_NAME, is_run_name
from tapping_cell.nodes.recorder.run_recorder import checked_folder, checked_name


@pytest.mark.parametrize("name", ["..", ".", "a/b", "/etc", "a\x00b", "a\nb", ".hidden", "x" * 121])
def test_an_invalid_or_traversing_name_is_refused(name: str) -> None:
    assert not is_run_name(name)
    with pytest.raises(ValueError, match="at most 120"):
        checked_name(name)


@pytest.mark.parametrize("folder", ["", "a\x00b", "a\nb", "x" * 2000])
def test_an_invalid_folder_is_refused(folder: str) -> None:
    with pytest.raises(ValueError, match="1 to 1024 printable characters"):
        checked_folder(folder)


@given(st.text(max_size=200))
def test_a_run_name_is_one_folder_name_of_valid_length(name: str) -> None:
    if is_run_name(name):
        assert len(name.encode()) <= LONGEST_NAME
        assert "/" not in name and "\0" not in name and name not in (".", "..")


def test_ordinary_names_are_accepted() -> None:
    assert checked_name("") == ""
    for name in ("2026-11-22_06-34-11_to_40_-30_20", "my run 3", "Zelle-ü"):
        assert checked_name(name) == name
