"""The state that the page and the verb ``status`` show."""

from __future__ import annotations

import time

import pytest
from tapping_cell_msgs.msg import ArmState, ErrorCode, GoalReport, PlanState, TapRecord

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


def test_the_end_of_an_arrangement_is_not_that_of_its_last_object() -> None:
    view = CellView()
    view.names = ["disk", "ring"]
    records = [TapRecord(object_id=name) for name in ("disk", "ring", "ring")]
    view.on_report(GoalReport(state=PlanState.REACHED, object_id="ring", taps=3, records=records))
    log = view.state()["log"]
    assert isinstance(log, list) and log[-1]["text"] == "arrangement reached after 3 taps"


def test_a_stop_that_is_being_cleared_is_not_logged_as_a_fault() -> None:
    view = CellView()
    stop = {"error_code": ErrorCode.ARM_STOPPED, "error_msg": "the arm was stopped"}
    fault = {"error_code": ErrorCode.ARM_ALARM, "error_msg": "the arm has an alarm"}
    for state, error, logged in (
        (ArmState.STOPPED, stop, 1),
        (ArmState.FAULT, stop, 1),
        (ArmState.NOT_HOMED, {}, 1),
        (ArmState.FAULT, fault, 2),
    ):
        view._on_arm(ArmState(state=state, **error))
        log = view.state()["log"]
        assert isinstance(log, list) and len(log) == logged
