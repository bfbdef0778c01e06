"""The goal that a crash leaves on disk: a file that holds no goal never keeps the planner down."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tapping_cell.nodes.planner import goal_persistence

GOAL = {"goal": [0.01, 0.02, 0.3], "tolerance": [0.001, 0.02], "max_taps": 20}


@pytest.fixture
def memory(tmp_path: Path) -> goal_persistence.GoalMemory:
    return goal_persistence.GoalMemory(tmp_path, 60.0)


def leave(folder: Path, text: str) -> Path:
    file = folder / "goal.json"
    file.write_text(text, encoding="utf-8")
    return file


def test_a_goal_is_recalled_once(memory: goal_persistence.GoalMemory, tmp_path: Path) -> None:
    leave(tmp_path, json.dumps(GOAL))
    recalled = memory.recall()
    assert recalled is not None and recalled.message.pose.position.x == 0.01
    assert memory.recall() is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 200_000,
        '{"goal": ' * 100_000,
        "[]",
        "7",
        json.dumps({**GOAL, "goal": [10**400, 0, 0]}),
        json.dumps({**GOAL, "goal": [0, 0, 10**400]}),
        json.dumps({**GOAL, "goal": [0.0, 0.0]}),
        json.dumps({**GOAL, "goal": ["x", 0, 0]}),
        json.dumps({**GOAL, "goal": [float("inf"), 0, 0]}),
        json.dumps({**GOAL, "tolerance": [1]}),
        json.dumps({**GOAL, "tolerance": ["wide", None]}),
        json.dumps({**GOAL, "max_taps": "many"}),
        json.dumps({**GOAL, "max_taps": 10**400}),
        "\x00",
    ],
    ids=range(15),
)
def test_a_file_without_a_goal_is_forgotten(
    memory: goal_persistence.GoalMemory, tmp_path: Path, text: str
) -> None:
    file = leave(tmp_path, text)
    assert memory.recall() is None
    assert not file.exists()
