"""The queue of goals: no goal is sent before a person starts the queue, and none after a goal that
failed."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.nodes.page.goal_queue import (
    MAX_NAMES,
    MAX_WAITING,
    GoalQueue,
    NamedGoals,
    QueueFull,
    RequestedGoal,
)
from tapping_cell.se2 import Pose

EVENTS = st.lists(
    st.sampled_from(["add", "run", "hold", "reached", "failed", "blocked", "remove", "look"]),
    max_size=60,
)


@given(EVENTS)
def test_queued_goals_are_sent_once_in_order_and_only_while_enabled(events: list[str]) -> None:
    queue, added, sent = GoalQueue(), 0, []
    running = busy = False
    removed: set[float] = set()
    for event in events:
        if event == "add":
            added += 1
            queue.add(RequestedGoal(Pose(float(added), 0.0, 0.0)))
        elif event == "run":
            queue.run()
            running = True
        elif event == "hold":
            queue.hold()
            running = False
        elif event in ("reached", "failed"):
            queue.ended(event == "reached", "why")
            busy = False
            running = running and event == "reached"
        elif event == "remove" and queue.rows():
            number, goal = queue.rows()[0]
            assert queue.remove(number) and not queue.remove(number)
            removed.add(goal.pose.x)
        goal_now = queue.next(busy, "stopped" if event == "blocked" else "")
        running = running and event != "blocked"
        if goal_now is not None:
            assert running and not busy
            sent.append(goal_now.pose.x)
            busy = True
    assert sent == sorted(set(sent)) and not removed & set(sent)
    assert len(sent) + len(removed) + len(queue.rows()) == added


def test_a_failed_goal_holds_the_queue_and_gives_the_reason() -> None:
    queue = GoalQueue()
    for x in (1.0, 2.0):
        queue.add(RequestedGoal(Pose(x, 0.0, 0.0)))
    assert queue.next(False, "") is None, "nothing moves before it is run"
    queue.run()
    assert queue.next(False, "") is not None
    queue.ended(False, "the arm is stopped (508)")
    assert not queue.running and "508" in queue.held
    assert queue.next(False, "") is None
    queue.run()
    assert queue.held == "" and queue.next(False, "") == RequestedGoal(Pose(2.0, 0.0, 0.0))


def test_an_incompatible_description_is_refused_with_a_message() -> None:
    queue, names = GoalQueue(), NamedGoals()
    for number in range(MAX_WAITING):
        queue.add(RequestedGoal(Pose(0.0, 0.0, 0.0)))
        names.keep(f"place {number}", Pose(0.0, 0.0, 0.0))
    with pytest.raises(QueueFull, match="50 goals are already waiting"):
        queue.add(RequestedGoal(Pose(0.0, 0.0, 0.0)))
    assert MAX_NAMES == MAX_WAITING
    with pytest.raises(QueueFull, match="50 goals already have names"):
        names.keep("one more", Pose(0.0, 0.0, 0.0))
    names.keep("place 0", Pose(1.0, 0.0, 0.0))
    assert names.rows()[0] == ("place 0", Pose(1.0, 0.0, 0.0))


def test_names_are_kept_across_a_restart() -> None:
    names = NamedGoals()
    names.keep("home", Pose(0.01, -0.02, 0.5))
    names.keep("Left", Pose(-0.1, 0.0, 0.0))
    names.keep("gone", Pose(0.0, 0.0, 0.0))
    assert names.forget("gone") and not names.forget("gone")
    again = NamedGoals(json.loads(json.dumps(names.as_content())))
    assert again.rows() == [("home", Pose(0.01, -0.02, 0.5)), ("Left", Pose(-0.1, 0.0, 0.0))]


@pytest.mark.parametrize(
    "content", [None, [], "x", {"a": None}, {"a": [1, 2]}, {"a": ["x", 0, 0]}, {"a": 5}]
)
def test_an_unreadable_name_file_is_treated_as_empty(content: Any) -> None:
    assert NamedGoals(content).rows() == []
