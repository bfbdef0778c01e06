"""The codecs' properties on bytes that hypothesis draws; the fuzzer runs them on a million."""

from __future__ import annotations

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from serial_codecs import SEEDS, TARGETS, boards, mutated

NOISY_LINES = st.integers(0, 2**32).map(lambda seed: mutated(random.Random(seed)))


@pytest.mark.parametrize("name", TARGETS)
@settings(max_examples=300, deadline=None)
@given(data=st.one_of(st.binary(max_size=300), NOISY_LINES))
def test_a_codecs_properties_hold_for_any_bytes(name: str, data: bytes) -> None:
    TARGETS[name](data)


@settings(max_examples=150, deadline=None)
@given(data=st.one_of(st.binary(max_size=120), NOISY_LINES))
def test_the_emulated_boards_stand_any_bytes_and_talk_sense(data: bytes) -> None:
    boards(data)


@pytest.mark.parametrize("name", ["grbl-in", "marlin-in", "tapper-in"])
def test_the_seeds_themselves_hold(name: str) -> None:
    for seed in SEEDS:
        TARGETS[name](seed)
