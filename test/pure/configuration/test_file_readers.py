"""Damaged files of every kind are refused in one sentence, or read as an independent reader reads
them. The fuzzer in ``test/support/file_readers.py`` damages more files."""

from __future__ import annotations

import pytest
from file_readers import TARGETS, outcome_of
from hypothesis import given
from hypothesis import strategies as st


@pytest.mark.parametrize("name", TARGETS)
@given(seed=st.integers(0, 2**32))
def test_a_damaged_file_is_refused_or_read_rightly(name: str, seed: int) -> None:
    outcome_of(name, seed)
