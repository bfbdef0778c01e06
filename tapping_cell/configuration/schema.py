"""Strict parsing of a YAML file into frozen dataclasses.

A section of a file is a frozen dataclass whose fields are declared with :func:`quantity` (a number
with a unit and a range), :func:`choice`, :func:`text` or :func:`section`. :func:`load` rejects
unknown keys, missing keys, wrong types and values out of range. The error names file, key, value
and range.
"""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

from tapping_cell.configuration.hints import (
    character_hint,
    did_you_mean,
    number_hint,
    plain_characters,
    unit_hint,
)
from tapping_cell.configuration.yaml_document import YamlError, parse_yaml

Section = TypeVar("Section")


class ConfigurationError(ValueError):
    """A configuration file that cannot be used; the message names file, key, value and range."""


MOST_KEYS = 20
"""Maximum number of keys from which the kind of a file is recognised."""
LONGEST_SHOWN = 60
"""Maximum number of characters of an invalid text that an error message shows."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Description and accepted values of a field: the unit, the closed range [minimum, maximum] of
    a number, and the texts to choose from."""

    description: str
    unit: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: tuple[str, ...] = ()
    numeric: bool = True
    longest: int = 4096
    """Maximum length of a text, in characters."""

    def range_text(self) -> str:
        """Return the range with its unit; empty if there is no range, as for a free text."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if not self.numeric:
            return ""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.minimum) and math.isinf(self.maximum):
            return "any finite number" + unit
        if math.isinf(self.maximum):
            return f"at least {self.minimum:g}{unit}"
        if math.isinf(self.minimum):
            return f"at most {self.maximum:g}{unit}"
        return f"{self.minimum:g} to {self.maximum:g}{unit}"


def quantity(
    description: str,
    unit: str = "",
    minimum: float = -math.inf,
    maximum: float = math.inf,
    default: Any = MISSING,
) -> Any:
    """Declare a number, or a sequence of numbers, each within [minimum, maximum].

    The ``unit`` of a sequence is that of each number, or a list of one unit for each, such as
    "m, m, rad".
    """
    limits = Limits(description, unit, minimum, maximum)
    return field(default=default, metadata={"limits": limits})


def choice(description: str, *choices: str, default: Any = MISSING) -> Any:
    """Declare a text that must be one of ``choices``."""
    return field(default=default, metadata={"limits": Limits(description, choices=choices)})


def text(description: str, default: Any = MISSING, longest: int = 4096) -> Any:
    """Declare a field that is not a number: a text of at most ``longest`` characters, or a
    Boolean."""
    limits = Limits(description, numeric=False, longest=longest)
    return field(default=default, metadata={"limits": limits})


def section(description: str, default: Any = MISSING) -> Any:
    """Declare a nested section, or a sequence of sections."""
    return field(default=default, metadata={"limits": Limits(description, numeric=False)})


LARGEST_FILE = 1_000_000
"""Maximum size of a file, in bytes. A larger file would take minutes to parse."""
MOST_FOLDERS = 40
"""Number of folders of a missing path in which a repetition is looked for."""


def read_yaml(path: Path) -> Any:
    """Read the document of a YAML file.

    Raises:
        ConfigurationError: the file is missing, too large, unreadable or malformed YAML; the
            message gives line and column.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ConfigurationError(
                f"{path}: has {size / 1e6:.1f} MB, but the limit is {LARGEST_FILE / 1e6:.0f} MB; "
                "check that this is the intended file"
            )
        return parse_yaml(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigurationError(
            f"{path}: cannot be read ({error.strerror}); give the path of an existing YAML file"
            + similar_path(path)
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: is not UTF-8 text; save it as UTF-8") from error
    except YamlError as error:
        raise ConfigurationError(f"{path}: {error}") from error


def similar_path(path: Path) -> str:
    """Return a hint at a file whose path is similar to that of a missing file; empty if there is
    none."""
    as_on_linux = Path(str(path).replace("\\", "/"))
    if as_on_linux != path and as_on_linux.is_file():
        return f"; did you mean '{as_on_linux}'?"
    if found := re.search(r"\b(file|package|https?):/", str(path)):
        return f"; write a path of this computer in place of the address {found[1]}://..."
    # A path that starts from the folder of the repository repeats the folders of the file in it.
    parts = path.parts
    for start, end in combinations(range(min(len(parts), MOST_FOLDERS)), 2):
        if parts[start:end] == parts[end : 2 * end - start]:
            once = Path(*parts[:start], *parts[end:])
            if once.is_file():
                return f"; '{once}' exists: a path in a file starts from the folder of that file"
    try:
        near = [] if path.exists() else [*path.parent.iterdir(), *path.parent.glob("*/*.y*ml")]
    except OSError:
        return ""
    return did_you_mean(path.name, (str(file.relative_to(path.parent)) for file in near))


def load(kind: type[Section], path: Path | str) -> Section:
    """Load a section of class ``kind`` from a YAML file.

    Raises:
        ConfigurationError: the file is invalid; the message names file, key, value and range.
    """
    path = Path(path)
    document = read_yaml(path)
    fields = [entry.name for entry in dataclasses.fields(kind)]  # type: ignore[arg-type]
    keys = list(document)[:MOST_KEYS] if isinstance(document, Mapping) else []
    if 2 * sum(bool(did_you_mean(name, fields)) for name in keys) < len(keys):
        shown = ", ".join(str(name)[:40] for name in keys)
        raise ConfigurationError(
            f"{path}: is a file of another kind, with the keys {shown}; those needed here are "
            f"{', '.join(fields)}; correct the path"
        )
    return build(kind, document, source=str(path))


def build(kind: type[Section], document: Any, source: str, key: str = "") -> Section:
    """Build a section of class ``kind`` from a document. ``source`` is the document's name in error
    messages."""
    fields = {entry.name: entry for entry in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if not isinstance(document, Mapping):
        raise ConfigurationError(
            f"{source}: {key or 'the document'} must be a mapping of keys to values, "
            f"not {_kind_name(document)}; the keys here are {', '.join(fields)}"
        )
    hints = typing.get_type_hints(kind)
    for name in document:
        if name not in fields:
            known = ", ".join(fields)
            inner = isinstance(document[name], Mapping)
            choices = [own for own in fields if not inner or _is_section(hints[own])]
            meant = (
                character_hint(str(name)) or did_you_mean(name, choices) or _place_of(name, hints)
            )
            if inner and key and not meant:
                meant = "; if it is a section beside this one, indent it less"
            raise ConfigurationError(
                f"{source}: unknown key '{_join(key, name)}'{meant}; the keys here are {known}"
            )
    values: dict[str, Any] = {}
    for name, entry in fields.items():
        if name in document:
            limits = entry.metadata["limits"]
            values[name] = _value(hints[name], document[name], limits, source, _join(key, name))
        elif entry.default is MISSING and entry.default_factory is MISSING:
            limits = entry.metadata["limits"]
            accepted = f" ({limits.range_text()})" if limits.range_text() else ""
            raise ConfigurationError(
                f"{source}: key '{_join(key, name)}' is missing: {limits.description}{accepted}"
            )
    try:
        return kind(**values)
    except ConfigurationError:
        raise
    except ValueError as error:
        raise ConfigurationError(f"{source}: {key or 'the document'}: {error}") from error


def _is_section(hint: Any) -> bool:
    """Return whether a field of this type holds a section or a mapping of names to values."""
    kinds = (hint, *typing.get_args(hint))
    return any(dataclasses.is_dataclass(k) or typing.get_origin(k) is Mapping for k in kinds)


def _place_of(name: object, hints: Mapping[str, Any]) -> str:
    """Return a hint at the sections that have the key ``name``; empty if there are none."""
    places = [
        f"'{own}.{name}'"
        for own, hint in hints.items()
        for kind in (hint, *typing.get_args(hint))
        if dataclasses.is_dataclass(kind) and name in {f.name for f in dataclasses.fields(kind)}
    ]
    return f"; did you mean {' or '.join(places)}? Check the indentation" if places else ""


def _join(key: str, name: object) -> str:
    return f"{key}.{name}" if key else str(name)


def _kind_name(value: Any) -> str:
    names = {
        type(None): "nothing",
        bool: "a truth value",
        int: "a number",
        float: "a number",
        str: "a text",
    }
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "a list"
    return names.get(type(value), type(value).__name__)


def _value(hint: Any, value: Any, limits: Limits, source: str, key: str) -> Any:
    """Check a value against its type and limits, and convert it to the declared type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        (inner,) = [argument for argument in arguments if argument is not type(None)]
        return _value(inner, value, limits, source, key)
    if dataclasses.is_dataclass(hint):
        return build(hint, value, source, key)  # type: ignore[arg-type]
    if origin is tuple:
        return _tuple(arguments, value, limits, source, key)
    if origin is Mapping:
        return _mapping(arguments[1], value, limits, source, key)
    if hint is float:
        return _number(value, limits, source, key)
    if hint is int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise _wrong(source, key, value, "a whole number", limits)
        _number(value, limits, source, key)
        return value
    if hint is bool:
        if not isinstance(value, bool):
            raise _wrong(source, key, value, "true or false", limits)
        return value
    if hint is str or origin is typing.Literal:
        if not isinstance(value, str):
            raise _wrong(source, key, value, "a text", limits)
        if len(value) > limits.longest or "\0" in value:
            wanted = f"a text of at most {limits.longest} characters, without NUL characters"
            raise _wrong(source, key, value, wanted, limits)
        if value and (
            value[0] != plain_characters(value[0]) or value[-1] != plain_characters(value[-1])
        ):
            raise _wrong(source, key, value, "a text in plain quotes or none", limits)
        if limits.choices and value not in limits.choices:
            raise _wrong(source, key, value, limits.range_text(), limits)
        return value
    raise TypeError(f"{key}: the schema does not support the type {hint}")


def _tuple(
    arguments: tuple[Any, ...], value: Any, limits: Limits, source: str, key: str
) -> tuple[Any, ...]:
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise _wrong(source, key, value, "a list", limits)
    if arguments[-1] is Ellipsis:
        kinds = [arguments[0]] * len(value)
    elif len(value) == len(arguments):
        kinds = list(arguments)
    else:
        raise _wrong(source, key, value, f"a list of {len(arguments)} entries", limits)
    units = limits.unit.split(", ")
    units = units if len(units) == len(kinds) else [limits.unit] * len(kinds)
    return tuple(
        _value(kind, entry, replace(limits, unit=unit), source, f"{key}[{index}]")
        for index, (kind, entry, unit) in enumerate(zip(kinds, value, units, strict=True))
    )


def _mapping(kind: Any, value: Any, limits: Limits, source: str, key: str) -> dict[str, Any]:
    """Check a mapping of names to values of type ``kind``."""
    if not isinstance(value, Mapping) or not all(isinstance(name, str) for name in value):
        raise _wrong(source, key, value, "a mapping of names to values", limits)
    return {
        name: _value(kind, entry, limits, source, _join(key, name)) for name, entry in value.items()
    }


def _number(value: Any, limits: Limits, source: str, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _wrong(source, key, value, "a number", limits)
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number) or not limits.minimum <= number <= limits.maximum:
        raise _wrong(source, key, value, limits.range_text(), limits)
    return number


def _wrong(source: str, key: str, value: Any, wanted: str, limits: Limits) -> ConfigurationError:
    shown = repr(value) if isinstance(value, (str, int, float, bool)) else _kind_name(value)
    if isinstance(value, str) and len(value) > LONGEST_SHOWN:
        shown = f"{value[:LONGEST_SHOWN]!r}... ({len(value)} characters)"
    return ConfigurationError(
        f"{source}: key '{key}' is {shown}, but must be {wanted}: {limits.description}"
        + _hint(value, wanted, limits)
    )


def _hint(value: Any, wanted: str, limits: Limits) -> str:
    """Return a hint at the likely mistake; empty if none is recognised."""
    if limits.choices:
        return did_you_mean(value, limits.choices) if isinstance(value, str) else ""
    if isinstance(value, str):
        value = value[:LONGEST_SHOWN]
        if wanted == "true or false":
            word = value.strip().lower()
            known = {"yes": "true", "on": "true", "no": "false", "off": "false"}
            return f"; write {known[word]}" if word in known else ""
        if wanted.startswith("a list"):
            return "; put the entries in brackets: [...]"
        return number_hint(value, limits.unit) if limits.numeric else character_hint(value)
    if isinstance(value, Mapping) and wanted.startswith("a list"):
        return "; begin each entry with '- '"
    if isinstance(value, list) and wanted.startswith("a list"):
        texts = (number_hint(entry) for entry in value if isinstance(entry, str))
        return next((hint for hint in texts if hint), "") if limits.numeric else ""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        if wanted.startswith("a list"):
            return "; put the numbers that belong together in brackets: [...]"
        if wanted.startswith("a text"):
            return "; put it in quotes"
        if isinstance(value, float) and wanted == "a whole number" and value.is_integer():
            return f"; write {value:.0f}"
        return unit_hint(value, limits.unit, limits.minimum, limits.maximum)
    return ""
