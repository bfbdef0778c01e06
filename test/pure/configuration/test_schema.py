"""Configuration files are read strictly: unknown, missing and out-of-range values are refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.configuration.schema import (
    ConfigurationError,
    build,
    choice,
    load,
    quantity,
    section,
    text,
)


@dataclass(frozen=True, slots=True)
class Inner:
    depth: float = quantity("how deep", "m", 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Outer:
    length: float = quantity("how long", "m", -2.0, 3.0)
    count: int = quantity("how many", "", 1, 9, default=2)
    colour: str = choice("which colour", "red", "blue", default="red")
    name: str = text("what it is called", default="thing")
    pair: tuple[float, float] = quantity("two numbers", "m", 0.0, 1.0, default=(0.0, 1.0))
    inner: Inner | None = section("what is inside", default=None)
    many: tuple[Inner, ...] = section("several", default=())
    named: Mapping[str, float] | None = quantity("by name", "m", 0.0, 1.0, default=None)


numbers = st.floats(allow_nan=True, allow_infinity=True) | st.integers(-10, 10)
values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3)
    | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)
keys = st.sampled_from(
    ["length", "count", "colour", "name", "pair", "inner", "many", "named", "other"]
)


@given(document=st.dictionaries(keys, values) | values)
def test_any_document_is_read_within_limits_or_refused_with_its_name(document: object) -> None:
    try:
        outer = build(Outer, document, source="file.yaml")
    except ConfigurationError as error:
        assert str(error).startswith("file.yaml: ")
        return
    assert -2.0 <= outer.length <= 3.0
    assert 1 <= outer.count <= 9
    assert outer.colour in ("red", "blue")
    assert all(0.0 <= value <= 1.0 for value in outer.pair)
    assert all(0.0 <= entry.depth <= 1.0 for entry in outer.many)
    assert all(0.0 <= value <= 1.0 for value in (outer.named or {}).values())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("length: 4", ("'length'", "4", "-2 to 3 m", "how long")),
        ("length: 1\nlenght: 2", ("unknown key 'lenght'",)),
        ("count: 3", ("'length'", "missing")),
        ("length: one", ("'length'", "'one'", "a number")),
        ("length: 1\ncount: 2.5", ("'count'", "whole number")),
        ("length: 1\ncolour: green", ("'colour'", "red, blue")),
        ("length: 1\npair: [1]", ("'pair'", "2 entries")),
        ("length: 1\npair: [0, 7]", ("'pair[1]'", "7", "0 to 1 m")),
        ("length: 1\ninner: {deep: 1}", ("unknown key 'inner.deep'",)),
        ("length: 1\nmany: [{depth: 0}, {depth: 2}]", ("'many[1].depth'", "2")),
        ("length: 1\nnamed: {first: 2}", ("'named.first'", "2", "0 to 1 m")),
        ("length: 1\nnamed: [1]", ("'named'", "a list", "a mapping of names")),
        ("length: 1\nlength: 2", ("'length'", "twice", "line 2")),
        ("length: [1", ("malformed YAML", "line 1")),
        ("length: .nan", ("'length'", "nan")),
        ("", ("nothing",)),
    ],
)
def test_a_refusal_names_file_key_value_and_range(
    tmp_path: Path, content: str, words: tuple[str, ...]
) -> None:
    path = tmp_path / "some.yaml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load(Outer, path)
    for word in (str(path), *words):
        assert word in str(caught.value)


def test_a_missing_string_is_reported_without_a_range() -> None:
    @dataclass(frozen=True, slots=True)
    class Named:
        name: str = text("what it is called")

    with pytest.raises(ConfigurationError) as raised:
        build(Named, {}, "file")
    assert str(raised.value) == "file: key 'name' is missing: what it is called"


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nowhere\.yaml: cannot be read"):
        load(Outer, tmp_path / "nowhere.yaml")


@given(length=st.floats(-2.0, 3.0), depth=st.floats(0.0, 1.0))
def test_written_files_are_read_back(
    tmp_path_factory: pytest.TempPathFactory, length: float, depth: float
) -> None:
    path = tmp_path_factory.mktemp("yaml") / "some.yaml"
    path.write_text(yaml.safe_dump({"length": length, "inner": {"depth": depth}}))
    assert load(Outer, path) == Outer(length=length, inner=Inner(depth))


@pytest.mark.parametrize("number", ["1e-3", "1E0", "-1.5e-1", ".5", "+2"])
def test_numbers_are_read_in_common_notations(tmp_path: Path, number: str) -> None:
    path = tmp_path / "some.yaml"
    path.write_text(f"length: {number}")
    assert load(Outer, path).length == float(number)


@pytest.mark.parametrize("name", ["x" * 4097, "x" * 200_000, "a\x00b"])
def test_an_overlong_string_is_refused_with_a_short_message(name: str) -> None:
    with pytest.raises(ConfigurationError, match="at most 4096 characters") as refused:
        build(Outer, {"length": 1.0, "name": name}, source="file.yaml")
    assert len(str(refused.value)) < 300
    assert build(Outer, {"length": 1.0, "name": "x" * 4096}, source="file.yaml").name == "x" * 4096
