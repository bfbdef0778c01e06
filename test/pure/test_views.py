"""The layouts for RViz and Foxglove use only topics and fields that the cell has."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
VIEWS = ROOT / "config" / "views"
PAGE = (ROOT / "docs" / "nodes.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| `/?([\w/]+)` \| (.+)$", PAGE, re.MULTILINE))
OF_OTHERS = {"robot_description", "clicked_point", "initialpose"}
"""Topics that docs/nodes.md does not list: the one of robot_state_publisher, and those of two
publishing tools of Foxglove that the cell does not use."""


def values(tree: object) -> Iterator[tuple[str, object]]:
    """Yield all keys with their values, recursively."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield key, value
            yield from values(value)
    elif isinstance(tree, list):
        for value in tree:
            yield from values(value)


def test_rviz_subscriptions_match_the_cell_topics() -> None:
    layout = yaml.safe_load((VIEWS / "cell.rviz").read_text(encoding="utf-8"))
    manager = layout["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "table"
    topics = [value for _, value in values(layout) if isinstance(value, dict) and "Depth" in value]
    assert len(topics) == 5
    for topic in topics:
        name = topic["Value"].removeprefix("/")
        if name in OF_OTHERS:
            continue
        row = ROWS[name]
        assert (topic["Durability Policy"] == "Transient Local") == ("transient local" in row), name
        best_effort = "best effort" in row and "reliable" not in row
        assert (topic["Reliability Policy"] == "Best Effort") == best_effort, name


def test_foxglove_shows_topics_and_fields_of_the_cell() -> None:
    layout = json.loads((VIEWS / "foxglove_layout.json").read_text(encoding="utf-8"))
    shown = set()
    for key, value in values(layout["configById"]):
        if key == "topics":
            shown |= set(value)
        if key.lower().endswith("topic") or key == "topicToRender":
            shown.add(value)
        if key == "value":
            topic, *fields = re.sub(r"\[0\]|\.@.+", "", value).split(".")
            shown.add(topic)
            kind = "".join(word.capitalize() for word in topic.strip("/").split("_"))
            message = (ROOT / "msg_defs" / "msg" / f"{kind}.msg").read_text(encoding="utf-8")
            *lists, field = fields
            for name in lists:
                kind = re.search(rf"^(\w+)\[\] {name}\b", message, re.MULTILINE)[1]
                message = (ROOT / "msg_defs" / "msg" / f"{kind}.msg").read_text(encoding="utf-8")
            assert re.search(rf"^\w+ {field}\b", message, re.MULTILINE), value
    assert len(shown) >= 9
    assert {name.removeprefix("/") for name in shown} - OF_OTHERS <= set(ROWS)


def test_foxglove_places_every_panel_once() -> None:
    layout = json.loads((VIEWS / "foxglove_layout.json").read_text(encoding="utf-8"))
    placed = re.findall(r'"(?:first|second)": "([^"]+)"', json.dumps(layout["layout"]))
    assert sorted(placed) == sorted(layout["configById"])
