"""The state that the page and the verb ``status`` show."""

from __future__ import annotations

import time

import pytest
from tapping_cell_msgs.msg import PlanState

from tapping_cell.nodes.page.cell_view import CellView


def test_the_goal_of_a_planner_that_sends_no_messages_is_not_shown_as_under_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    view, now = CellView(), time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now)
    view.on_plan(PlanState(state=PlanState.LOOKING))
    assert view.mode().word == "moving"
    now += 10.0
    assert view.mode().word == "not ready"
