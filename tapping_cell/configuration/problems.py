"""Collect all errors in a document, whereas ``schema.build`` stops at the first one."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from tapping_cell.configuration.schema import ConfigurationError, build


def problems_of(kind: type, document: Any, source: str, key: str = "") -> list[str]:
    """Return all errors in a document that should be a section of class ``kind``.

    Each key is checked separately by :func:`tapping_cell.configuration.schema.build`. The messages
    are those of this function.
    """
    if not isinstance(document, Mapping):
        return _errors(kind, document, source, key)
    fields = {entry.name: entry for entry in dataclasses.fields(kind)}
    hints = typing.get_type_hints(kind)
    found = [
        sentence
        for name in document
        if name not in fields
        for sentence in _errors(kind, {name: document[name]}, source, key)
    ]
    for name, entry in fields.items():
        place = f"{key}.{name}" if key else name
        if name in document:
            inner = _sections_in(hints[name], document[name])
            if inner is not None:
                for section, value, index in inner:
                    found += problems_of(section, value, source, place + index)
                continue
        elif entry.default is not dataclasses.MISSING:
            continue
        alone = {name: document[name]} if name in document else {}
        found += _errors(_only(kind, name), alone, source, key)
    return found or _errors(kind, document, source, key)


def _errors(kind: type, document: Any, source: str, key: str) -> list[str]:
    """Return a list with the message of the error that ``build`` raises; empty if it raises
    none."""
    try:
        build(kind, document, source, key)
    except ConfigurationError as error:
        return [str(error)]
    return []


def _only(kind: type, name: str) -> type:
    """Return a copy of a section class that has only the key ``name``, and no checks across
    keys."""
    (entry,) = [field for field in dataclasses.fields(kind) if field.name == name]
    hint = typing.get_type_hints(kind)[name]
    fresh = dataclasses.field(default=entry.default, metadata=entry.metadata)
    return dataclasses.make_dataclass(kind.__name__, [(name, hint, fresh)])


def _sections_in(hint: Any, value: Any) -> list[tuple[type, Any, str]] | None:
    """Return class, value and index of each section that a key contains. The index is a text such
    as "[2]", or "" for a section that is not in a list. Return None if the key contains plain
    values."""
    if dataclasses.is_dataclass(hint):
        return [(typing.cast(type, hint), value, "")]
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType) and value is not None:
        inner = [argument for argument in arguments if argument is not type(None)]
        return _sections_in(inner[0], value)
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    if origin is tuple and dataclasses.is_dataclass(arguments[0]) and listed:
        return [
            (typing.cast(type, arguments[0]), entry, f"[{index}]")
            for index, entry in enumerate(value)
        ]
    return None
