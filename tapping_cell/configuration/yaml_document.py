"""Reading of a YAML text in which every value means what a person reads.

Plain values follow the core schema of YAML 1.2: null, true and false, decimal numbers, everything
else is text. Notations that YAML 1.1 and 1.2 read as different numbers are refused, because the ROS
nodes read parameter files with YAML 1.1: leading zeros, binary, octal and hexadecimal numbers,
digits with underscores, and base 60 (1:30).
"""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import yaml

from tapping_cell.configuration.hints import character_hint, git_hint

DEEPEST = 40
"""Maximum depth of nested lists and mappings."""
MOST_VALUES = 100_000
"""Maximum number of values in a document, counting each repetition of an alias."""

_INTEGER = re.compile(r"[-+]?[0-9]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)")
_NO_SPACE = re.compile(r"\s*(- +)?\w+:[^\s:/]")
"""A key whose colon has no space behind it, at the beginning of a line or in braces."""
_NAN = (".nan", ".NaN", ".NAN")
_WORDS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_AMBIGUOUS = (
    (re.compile(r"[-+]?0[0-9_]+"), "starts with 0 and is octal for some programs"),
    (re.compile(r"[-+]?0[bB][01_]+"), "is binary"),
    (re.compile(r"[-+]?0[oO][0-7_]+"), "is octal"),
    (re.compile(r"[-+]?0[xX][0-9a-fA-F_]+"), "is hexadecimal"),
    (re.compile(r"[-+]?\.?[0-9][0-9_]*(\.[0-9_]*)?([eE][-+]?[0-9]+)?"), "contains underscores"),
    (re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?"), "is base 60 for some programs"),
)
"""Notations that are refused, in this order, unless ``_INTEGER`` or ``_FLOAT`` accepted them."""


class YamlError(ValueError):
    """A text that is not YAML, or that is ambiguous; the message gives line and column."""


def parse_yaml(text: str) -> Any:
    """Return the document of a YAML text: dictionaries, lists, texts, numbers, Booleans, None.

    Raises:
        YamlError: the text is malformed, nested too deeply or ambiguous, or a key appears twice.
    """
    if conflict := git_hint(text):
        raise YamlError(f"malformed YAML: {conflict}")
    if found := re.search("[\x85\u2028\u2029]", text):
        raise YamlError(
            f"malformed YAML: line {text.count(chr(10), 0, found.start()) + 1} contains the "
            f"character U+{ord(found[0]):04X}, which is a new line for some programs only; delete "
            "it, or begin a new line there"
        )
    if re.search("^%YAML:", text, re.MULTILINE):
        raise YamlError(
            "the line %YAML:1.0 is that of OpenCV's cv::FileStorage; delete this line and each "
            "!!opencv-matrix, and name the keys as in the supplied file"
        )
    try:
        return _Document(text).read()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or str(error)
        if mark is None:
            raise YamlError(f"malformed YAML: {problem}") from error
        # At the end of the text, libyaml reports the line after the last one.
        line = min(mark.line, text.count("\n", 0, len(text.rstrip("\n"))))
        lines = text.split("\n")[max(0, line - 1) : line + 1]
        raise YamlError(
            f"malformed YAML at line {line + 1}, column {mark.column + 1}: {problem}"
            + (character_hint("\n".join(lines), tabs=True) or _syntax_hint(lines, text))
        ) from error


def _syntax_hint(lines: list[str], text: str) -> str:
    """Return a hint at the fences of a web page, or at a colon that is missing or has no space
    behind it; empty if there are none."""
    if re.search("^```", text, re.MULTILINE):
        return "; delete the lines with ```, which a web page puts around a file"
    joined = next((line.strip() for line in lines if _NO_SPACE.match(line)), "")
    if joined:
        return f"; write a space after the colon in '{joined[:40]}'"
    equals = re.search(r"^\s*\w+ *= *\S", text, re.MULTILINE)
    return f"; write 'key: value', not '{equals[0].strip()}...'" if equals else ""


class _Dumper(yaml.SafeDumper):
    """Quotes every text that :func:`parse_yaml` would not read as the same text."""


_Dumper.add_implicit_resolver("number", re.compile("[-+.]?[0-9]"), list("-+.0123456789"))


def format_yaml(content: Any, **layout: Any) -> str:
    """Format a document, with its keys in their order; ``layout`` as for ``yaml.dump``."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, **layout))


class _Document:
    """Builds the values of a document from libyaml's events.

    libyaml's own composer overflows the stack on deeply nested text, and PyYAML's is slow.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._events = yaml.parse(text, yaml.CSafeLoader)
        self._anchors: dict[str, tuple[Any, int]] = {}
        self._count = 0

    def read(self) -> Any:
        next(self._events)  # start of the stream
        if isinstance(next(self._events), yaml.StreamEndEvent):
            return None
        value = self._value(next(self._events), 0)
        next(self._events)  # end of the document
        after = next(self._events)
        if isinstance(after, yaml.DocumentStartEvent) and _is_empty(next(self._events)):
            next(self._events)  # end of the empty document after a last line "---"
            after = next(self._events)
        if not isinstance(after, yaml.StreamEndEvent):
            raise _error("a second document begins here; keep one document in a file", after)
        return value

    def _value(self, event: Any, depth: int) -> Any:
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchors:
                raise _error(f"the alias *{event.anchor} has no anchor before it", event)
            value, count = self._anchors[event.anchor]
            self._add(count, event)
            return value
        if depth > DEEPEST:
            raise _error(f"nested too deeply (limit {DEEPEST} levels)", event)
        before = self._count
        self._add(1, event)
        if isinstance(event, yaml.ScalarEvent):
            value = _scalar(event)
        else:
            if event.tag is not None:
                raise _unknown_tag(event)
            mapping = isinstance(event, yaml.MappingStartEvent)
            value = self._mapping(depth) if mapping else self._list(event, depth)
        if event.anchor is not None:
            self._anchors[event.anchor] = value, self._count - before
        return value

    def _add(self, count: int, event: Any) -> None:
        self._count += count
        if self._count > MOST_VALUES:
            raise _error(f"more than {MOST_VALUES} values; check that this file is meant", event)

    def _mapping(self, depth: int) -> dict[Any, Any]:
        values: dict[Any, Any] = {}
        lines: dict[Any, int] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self._value(event, depth + 1)
            if key is None or isinstance(key, (list, dict)):
                raise _error("a key must be a word or a number", event)
            if key == "<<":
                raise _error("the merge key << is not supported; write the merged keys here", event)
            if key in values:
                first = f"the key '{key}' appears twice, first in line {lines[key]}"
                raise _error(f"{first}; delete one of them", event)
            lines[key] = getattr(event.start_mark, "line", 0) + 1
            content = next(self._events)
            if _is_empty(content) and _NO_SPACE.match(str(key)):
                raise _error(f"'{key}' needs a space after its colon", event)
            values[key] = self._value(content, depth + 1)
        return values

    def _list(self, start: Any, depth: int) -> list[Any]:
        values, events = [], []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            events.append(event)
            values.append(self._value(event, depth + 1))
        if start.flow_style:
            self._check_commas(events)
        return values

    def _check_commas(self, events: list[Any]) -> None:
        """Refuse a list such as [0,15, 0], whose first comma may be a decimal comma."""
        gaps = [
            (self._text[a.end_mark.index : b.start_mark.index], a, b) for a, b in pairwise(events)
        ]
        if all(gap == "," for gap, _, _ in gaps):
            return
        for gap, left, right in gaps:
            whole, part = getattr(left, "value", ""), getattr(right, "value", "")
            if gap == "," and _INTEGER.fullmatch(whole) and re.fullmatch("[0-9]+", part):
                raise _error(
                    f"'{whole},{part}' may be two numbers or {whole}.{part}; write "
                    f"'{whole}, {part}' or '{whole}.{part}'",
                    left,
                )


def _scalar(event: Any) -> Any:
    """Return the value of a scalar."""
    text = event.value
    if event.tag is not None and event.tag not in ("!", "tag:yaml.org,2002:str"):
        raise _unknown_tag(event)
    if not event.implicit[0]:  # quoted, or a text by its tag
        return text
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text) and (text.lstrip("+-")[0] != "0" or len(text.lstrip("+-")) == 1):
        try:
            return int(text)
        except ValueError as error:
            raise _error(f"a number of {len(text)} digits is too long", event) from error
    if _FLOAT.fullmatch(text) and not _INTEGER.fullmatch(text):
        return float(text.replace(".inf", "inf").replace(".Inf", "inf").replace(".INF", "inf"))
    if text in _NAN:
        return float("nan")
    for pattern, reason in _AMBIGUOUS:
        if pattern.fullmatch(text):
            raise _error(
                f"'{text[:40]}' {reason}; write a decimal number without leading zeros, "
                "or put it in quotes if it is a text",
                event,
            )
    return text


def _is_empty(event: Any) -> bool:
    return isinstance(event, yaml.ScalarEvent) and event.value == "" and event.implicit[0]


def _unknown_tag(event: Any) -> YamlError:
    return _error(
        f"the tag {event.tag} is not supported; write the plain value, angles in rad", event
    )


def _error(problem: str, event: Any) -> YamlError:
    mark = event.start_mark
    return YamlError(f"malformed YAML at line {mark.line + 1}, column {mark.column + 1}: {problem}")
