"""Editing of values in a YAML text that leaves everything else, including comments, unchanged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import yaml

from tapping_cell.configuration.provenance import Provenance, provenance_yaml
from tapping_cell.configuration.schema import ConfigurationError


def numbers_text(value: float | Sequence[float]) -> str:
    """Format a number or a list of numbers as YAML, with nine significant digits."""
    if isinstance(value, Sequence):
        return "[" + ", ".join(numbers_text(entry) for entry in value) + "]"
    return repr(float(f"{value:.9g}"))


def with_section(
    text: str, name: str, values: Mapping[str, str], record: Provenance, source: str
) -> str:
    """Set keys of the section ``name`` to YAML ``values``, and replace its calibration record.

    Missing keys are added at the end of the section.

    Raises:
        ConfigurationError: the section is missing or not written with one key per line.
    """
    root = yaml.compose(text)
    section = _child(root, name)
    if not isinstance(section, yaml.MappingNode) or section.flow_style or not section.value:
        raise ConfigurationError(
            f"{source}: the section '{name}' is missing or written in braces; write one key "
            "per line"
        )
    indent = section.value[0][0].start_mark.column
    nodes = {key: _child(section, key) for key in values}
    changes = [
        (node.start_mark.index, node.end_mark.index, values[key])
        for key, node in nodes.items()
        if node is not None
    ]
    end = _line_end(text, _last(section))
    added = [f"{key}: {values[key]}" for key, node in nodes.items() if node is None]
    tail = "".join(" " * indent + line + "\n" for line in added) + provenance_yaml(record, indent)
    for key_node, value_node in section.value:
        if key_node.value == "calibration":
            start = key_node.start_mark.index - key_node.start_mark.column
            changes.append((start, _line_end(text, _last(value_node)), ""))
    changes.append((end, end, tail if text[:end].endswith("\n") else "\n" + tail))
    return _replaced(text, changes)


def with_value(text: str, name: str, value: str) -> str:
    """Replace the value of a key; dots in ``name`` separate sections."""
    node = yaml.compose(text)
    for part in name.split("."):
        node = _child(node, part)
    if node is None:
        return text
    return text[: node.start_mark.index] + value + text[node.end_mark.index :]


def with_items(text: str, name: str, values: Sequence[str]) -> str:
    """Replace the items of the list at the key ``name`` by as many YAML ``values``. Return the text
    unchanged if there is no such list."""
    node = _child(yaml.compose(text), name)
    if not isinstance(node, yaml.SequenceNode):
        return text
    changes = [
        (item.start_mark.index, item.end_mark.index, value)
        for item, value in zip(node.value, values, strict=True)
    ]
    return _replaced(text, changes)


def _child(node: yaml.Node | None, name: str) -> yaml.Node | None:
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((value for key, value in node.value if key.value == name), None)


def _last(node: yaml.Node) -> int:
    """Return the index at which the last scalar or flow collection of a node ends."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _last(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)


def _line_end(text: str, index: int) -> int:
    """Return the start of the line after ``index``, or ``index`` if it is the start of a line."""
    if index and text[index - 1 : index] == "\n":
        return index
    after = text.find("\n", index)
    return len(text) if after < 0 else after + 1


def with_entry(text: str, path: Sequence[str], index: int, values: Mapping[str, str]) -> str:
    """Set keys of one entry of the list at ``path`` to YAML ``values``.

    Raises:
        ConfigurationError: the list, the entry or one of its keys is missing.
    """
    node: yaml.Node | None = yaml.compose(text)
    for name in path:
        node = _child(node, name)
    if not isinstance(node, yaml.SequenceNode) or index >= len(node.value):
        raise ConfigurationError(f"there is no entry {index} of the list '{'.'.join(path)}'")
    changes = []
    for key, value in values.items():
        place = _child(node.value[index], key)
        if place is None:
            raise ConfigurationError(f"'{'.'.join(path)}[{index}]' has no key '{key}'")
        changes.append((place.start_mark.index, place.end_mark.index, value))
    return _replaced(text, changes)


def _replaced(text: str, changes: list[tuple[int, int, str]]) -> str:
    """Replace each range of characters, given by its start and end, by a new text."""
    for start, stop, new in sorted(changes, reverse=True):
        text = text[:start] + new + text[stop:]
    return text
