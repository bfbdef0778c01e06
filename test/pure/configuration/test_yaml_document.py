"""YAML values are read as a person reads them, or refused with their line."""

from __future__ import annotations

import math
from decimal import Decimal
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.configuration.yaml_document import YamlError, format_yaml, parse_yaml


@pytest.mark.parametrize(
    "number",
    [
        "011",
        "-012",
        "00",
        "089",
        "0b11",
        "0o17",
        "0x1F",
        "0X1f",
        "1_000",
        "1_0.5",
        "0_1",
        "1:30",
        "190:20:30",
        "1:30.5",
        "+1_000",
        "4_8",
    ],
)
def test_a_number_that_readers_understand_differently_is_refused_with_its_line(number: str) -> None:
    for text in (f"a: 1\nid: {number}\n", f"a: 1\nb: [1, {number}]\n", f"a: 1\n{number}: b\n"):
        with pytest.raises(YamlError, match=r"line 2, column \d+: '.*in quotes if it is a text"):
            parse_yaml(text)
    assert parse_yaml(f"id: '{number}'") == parse_yaml(f"id: !!str {number}") == {"id": number}


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("yes", "yes"),
        ("no", "no"),
        ("on", "on"),
        ("Off", "Off"),
        ("y", "y"),
        ("TRUE", True),
        ("false", False),
        ("~", None),
        ("", None),
        ("null", None),
        ("2026-11-28", "2026-11-28"),
        ("1e3", 1000.0),
        ("1E-3", 0.001),
        (".5", 0.5),
        ("5.", 5.0),
        ("+7", 7),
        ("-0", 0),
        ("0", 0),
        ("0.5", 0.5),
        ("011.5", 11.5),
        ("12,5", "12,5"),
        ("1.2.3", "1.2.3"),
        (".inf", math.inf),
        ("-.INF", -math.inf),
        ("<<", "<<"),
        ("0xG", "0xG"),
        ("1e", "1e"),
    ],
)
def test_a_plain_value_follows_the_core_schema_of_yaml_1_2(written: str, value: Any) -> None:
    read = parse_yaml(f"key: {written}")["key"]
    assert read == value and type(read) is type(value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [0,15, 0]", "line 1, column 5: '0,15' may be two numbers or 0.15"),
        ("a:\n\tb: 1", "line 2, column 1: .*; indent with spaces, not with tabs"),
        ("a: 1\nb\u00a0: 2\nc 3\n", "line 3.*"),
        ("a: 1\na: 2", "line 2, column 1: the key 'a' appears twice"),
        ("a: 1\n# two\u2028b: 2\n", r"line 2 contains the character U\+2028.*delete it"),
        ("a: 1\n# two\x85b: 2\n", r"line 2 contains the character U\+0085.*delete it"),
        ("a: &a {b: 1}\nc: {<<: *a}", "the merge key << is not supported; write the merged keys"),
    ],
)
def test_a_typing_mistake_is_named_with_line_and_remedy(text: str, words: str) -> None:
    with pytest.raises(YamlError, match=words):
        parse_yaml(text)


def test_a_last_line_that_begins_an_empty_document_is_ignored() -> None:
    assert parse_yaml("a: 1\n---\n") == {"a": 1}  # as ``ros2 topic echo`` prints
    with pytest.raises(YamlError, match="a second document begins here"):
        parse_yaml("a: 1\n---\n---\n")


def test_lists_with_consistent_commas_are_read() -> None:
    assert parse_yaml("[1,2,3]") == [1, 2, 3] == parse_yaml("[1, 2, 3]")
    assert parse_yaml("[0.1,0.2, 0.3]") == [0.1, 0.2, 0.3]


_WORDS = st.text(alphabet="0123456789+-._:,eExoOb yno~#'\"\u2212é", max_size=12) | st.text(
    max_size=8
)
_CONTENT = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | _WORDS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(_WORDS, inner, max_size=4),
    max_leaves=12,
)


@given(content=_CONTENT)
def test_everything_written_is_read_back(content: Any) -> None:
    assert parse_yaml(format_yaml(content)) == content


@given(text=st.text(alphabet="0123456789+-._:,eExob", min_size=1, max_size=10))
def test_a_plain_number_has_the_value_of_its_decimal_digits(text: str) -> None:
    """Python's decimal module is the independent reader; it accepts underscores and other zeros."""
    try:
        read = parse_yaml(f"key: {text}")
    except YamlError:
        return
    value = read["key"] if isinstance(read, dict) and "key" in read else None
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        assert math.isclose(value, float(Decimal(text)), rel_tol=0.0, abs_tol=0.0)
        assert "_" not in text


_LINES = st.sampled_from(
    ["a: 1", "  b: [1, 2]", "- x", "\tc: 3", "&q d: *q", "? e", ": f", "{g: 1", "]", "|\n h", "'"]
)


@given(text=st.lists(_LINES | st.text(max_size=6), max_size=8).map("\n".join))
def test_any_text_is_read_or_refused_with_one_kind_of_error(text: str) -> None:
    try:
        parse_yaml(text)
    except YamlError as error:
        assert str(error).startswith("malformed YAML")
