"""A planner that has crashed resumes its goal once, soon after the crash, and only if the stored
goal can be read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any, cast

import pytest
from logic_parts import goal_handling
from test_planner_with_played_devices import FAST, Actors

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.effects import Answer, Content, Effect, KeepGoal, Log, Publish
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.host import Activated, Configured, Deactivated, UnansweredRequest
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import State
from tapping_cell.logic.resumption import KeptGoal, Resumption
from tapping_cell.logic.task import Task
from tapping_cell.messages import (
    ArmState,
    Bool,
    ConfirmTap,
    ErrorCode,
    PlanState,
    PoseStamped,
    SetBool,
    TapperState,
    Time,
    Trigger,
)
from tapping_cell.se2 import Pose

GOAL = {
    "goal": [0.01, 0.02, 0.3],
    "tolerance": [0.001, 0.02],
    "max_taps": 20,
    "time_left": 60.0,
    "object_id": "",
    "ask": True,
    "stops": {},
}
FAR = Pose(0.08, 0.02, 0.25)
NOW = Now(100.0, 1_800_000_000_000_000_000)


@cache
def goals() -> GoalHandling:
    return goal_handling(now=NOW)


def configured() -> PlannerLogic:
    """Return a planner that has found a stored goal."""
    logic = PlannerLogic(PlannerSettings())
    event = Configured(goals().cell, goals(), kept_goal=GOAL, kept_goal_age=1.0)
    logic.on_lifecycle(event, NOW)
    return logic


def kept_goal(made: Sequence[Effect]) -> Content | None:
    """Return what the planner has stored last."""
    return [effect.content for effect in made if isinstance(effect, KeepGoal)][-1]


def started(
    kept: Content | None,
    age: float = 1.0,
    received: Sequence[tuple[str, Any]] = (),
    early: Sequence[tuple[str, Any]] = (),
) -> tuple[PlannerLogic, list[Effect]]:
    """Start a planner that receives the messages ``early`` before it is configured, and
    ``received`` before it is activated."""
    logic = PlannerLogic(PlannerSettings())
    event = Configured(goals().cell, goals(), kept_goal=kept, kept_goal_age=age)
    for topic, message in early:
        logic.on_message(topic, message, NOW)
    made = [*logic.on_lifecycle(event, NOW)]
    for topic, message in received:
        made += logic.on_message(topic, message, NOW)
    made += logic.on_lifecycle(Activated(), NOW)
    return logic, [*made, *logic.on_tick(NOW)]


def test_a_goal_is_resumed() -> None:
    logic, made = started(GOAL)
    assert logic.state is State.WAITING_FOR_CELL
    assert logic.last.goal.pose.position.x == 0.01
    assert logic.last.ask, "its taps are asked for as before"
    kept = [effect.content for effect in made if isinstance(effect, KeepGoal)]
    assert kept[0] is None and kept[-1] is not None, "kept again for the next crash"


@pytest.mark.parametrize(
    ("kept_since", "left"),
    [(20.0, 40.0), (100.0, 1.0), (0.2, 59.0), (-3600.0, 59.0)],
    ids=[
        "long before the crash",
        "time limit over",
        "just before",
        "before a start of the computer",
    ],
)
def test_a_resumed_goal_keeps_its_time_limit(kept_since: float, left: float) -> None:
    """The planner stores the goal rarely, and from then on only updates the time of the file. The
    age of this time is 1 s here."""
    _, made = started({**GOAL, "kept_at": NOW.steady - kept_since})
    kept = kept_goal(made)
    assert kept is not None and kept["time_left"] == pytest.approx(left)


@pytest.mark.parametrize(("more", "taps"), [({}, 0), ({"taps": 5}, 5)])
def test_a_resumed_goal_counts_the_taps_before_the_crash(more: dict[str, Any], taps: int) -> None:
    logic, made = started({**GOAL, **more})
    assert logic.last.taps == taps
    kept = kept_goal(made)
    assert kept is not None and kept["taps"] == taps, "also after the next crash"


def test_the_number_of_taps_counts_over_a_crash() -> None:
    actors = Actors()
    actors.send()
    for _ in range(2):
        actors.wait(actors.taps, "a tap")
        actors.process.kill()
        actors.process.start()
    end = actors.end()
    assert end.state == PlanState.REACHED
    assert end.taps == len(actors.taps())


def test_the_limit_of_taps_holds_over_crashes() -> None:
    actors = Actors(replace(FAST, attempts=100))
    actors.moves_when_fired = False
    actors.request_goal(FAR, max_taps=4)
    for crash in range(1, 4):
        actors.wait(lambda crash=crash: len(actors.taps()) == crash, "a tap")
        actors.process.kill()
        actors.process.start()
    end = actors.end()
    assert end.error_code == ErrorCode.TAP_LIMIT_REACHED
    assert end.taps == len(actors.taps()) == 4
    assert "after 4 of at most 4 taps" in end.error_msg


def test_a_tap_that_was_not_fired_is_not_counted_after_a_crash() -> None:
    actors = Actors(replace(FAST, ask=True))
    actors.tapper_answers = TapperState.NOT_FIRED
    kept = actors.process.disk

    def confirm() -> None:
        actors.until(PlanState.CONFIRMING)
        tap_id = actors.plans[-1].planned_tap.tap_id
        actors.call("confirm_tap", ConfirmTap.Request(tap_id=tap_id, confirm=True))

    actors.send()
    confirm()
    actors.wait(actors.taps, "a tap")
    assert kept.goal is not None and kept.goal["taps"] == 1, "its outcome is not known yet"
    actors.until(PlanState.SETTLING)
    actors.until(PlanState.CONFIRMING)
    assert kept.goal is not None and kept.goal["taps"] == 0
    actors.process.kill()
    actors.tapper_answers = TapperState.FIRED
    actors.process.start()
    actors.run(2.0)
    confirm()
    end = actors.end()
    assert end.state == PlanState.REACHED and end.taps == 1


def test_a_goal_whose_taps_cannot_be_stored_is_not_resumed() -> None:
    actors = Actors()
    actors.send()
    actors.until(PlanState.LOOKING)
    actors.process.disk.full = True
    actors.wait(actors.taps, "a tap")
    assert actors.process.disk.goal is None


def test_a_goal_sent_before_the_resumption_replaces_it() -> None:
    logic = configured()
    logic.on_lifecycle(Activated(), NOW)
    sent = PoseStamped()
    sent.header.frame_id = "table"
    sent.pose.position.x = -0.03
    logic.on_message("goal_pose", sent, NOW)
    logic.on_tick(NOW)
    assert logic.state is State.WAITING_FOR_CELL
    assert logic.last.goal.pose.position.x == -0.03, "the newer goal wins"


STOPPED = TapperState(
    state=TapperState.STOPPED, error_code=ErrorCode.TAPPER_STOPPED, error_msg="stopped"
)
PRESSED = ("emergency_stop", Bool(data=True))


@pytest.mark.parametrize(
    ("received", "code"),
    [
        ([PRESSED], ErrorCode.EMERGENCY_STOP),
        ([PRESSED, ("emergency_stop", Bool(data=False))], ErrorCode.EMERGENCY_STOP),
        ([("tapper_state", STOPPED)], ErrorCode.TAPPER_STOPPED),
        (
            [("tapper_state", STOPPED), ("tapper_state", TapperState(state=TapperState.SAFE))],
            ErrorCode.TAPPER_STOPPED,
        ),
    ],
    ids=["held", "released", "stopped", "cleared"],
)
def test_a_goal_is_not_resumed_after_a_stop(received: list[tuple[str, Any]], code: int) -> None:
    logic, made = started(GOAL, received=received)
    assert logic.state is State.FAILED and logic.last.error_code == code
    assert logic.last.goal.pose.position.x == 0.01, "clients recognise their goal"
    assert kept_goal(made) is None
    reports = [e.message for e in made if isinstance(e, Publish) and e.topic == "goal_report"]
    assert [report.error_code for report in reports] == [code]


@pytest.mark.parametrize("configured", [False, True])
@pytest.mark.parametrize(
    ("stops", "stopped_again"),
    [
        ({}, True),
        ({"tapper": [0]}, True),
        ({"tapper": [0, 7 * 10**9]}, False),
        ({"tapper": [0, 5 * 10**9]}, True),
    ],
)
def test_a_stop_that_was_cleared_while_no_planner_ran_ends_the_goal(
    stops: dict[str, list[int]], stopped_again: bool, configured: bool
) -> None:
    state = TapperState(state=TapperState.SAFE, last_stop=Time(sec=7))
    received = [("tapper_state", state)]
    early = [] if configured else received
    logic, _ = started({**GOAL, "stops": stops}, received=received, early=early)
    if stopped_again:
        assert logic.state is State.FAILED
        assert logic.last.error_code == ErrorCode.TAPPER_STOPPED
    else:
        assert logic.state is State.WAITING_FOR_CELL


def test_the_stops_that_the_planner_knows_are_stored_with_its_goal() -> None:
    state = ArmState(state=ArmState.IDLE, last_stop=Time(sec=7))
    goal = {**GOAL, "stops": {"arm": [0, 7 * 10**9]}}
    _, made = started(goal, received=[("arm_state", state)])
    kept = kept_goal(made)
    assert kept is not None and kept["stops"] == {"arm": [0, 7 * 10**9], "tapper": [0]}


def test_a_goal_is_not_resumed_after_a_deactivation() -> None:
    logic = configured()
    for lifecycle in (Activated(), Deactivated(), Activated()):
        logic.on_lifecycle(lifecycle, NOW)
    logic.on_tick(NOW)
    assert logic.state is State.IDLE


def test_an_activated_planner_still_reports_why_its_goal_failed() -> None:
    logic, _ = started(GOAL)
    for event in (Deactivated(), Activated()):
        made = logic.on_lifecycle(event, NOW)
    (plan,) = (e.message for e in made if isinstance(e, Publish) and e.topic == "plan_state")
    assert (plan.state, plan.error_code) == (PlanState.FAILED, ErrorCode.NOT_ACTIVE)
    assert "deactivated" in plan.error_msg


def test_homing_does_not_continue_the_goal_of_a_crashed_planner() -> None:
    unhomed = ArmState(
        state=ArmState.NOT_HOMED, error_code=ErrorCode.ARM_NOT_HOMED, error_msg="home the arm"
    )
    logic, _ = started(GOAL, received=[("arm_state", unhomed)])
    assert logic.state is State.FAILED and logic.last.error_code == ErrorCode.ARM_NOT_HOMED


def test_a_goal_is_not_resumed_if_the_planner_is_activated_late() -> None:
    logic = configured()
    later = Now(NOW.steady + 15.0, NOW.ros + 15 * 10**9)
    logic.on_lifecycle(Activated(), later)
    logic.on_tick(later)
    assert logic.state is State.IDLE


def cancelled(logic: PlannerLogic) -> tuple[bool, list[Effect]]:
    """Call the service that ends the present goal. Return its answer and all effects."""
    made = list(logic.on_request("~/cancel", Trigger.Request(), 1, NOW))
    (answer,) = (effect.response for effect in made if isinstance(effect, Answer))
    return answer.success, made


def test_a_resumed_goal_can_be_cancelled() -> None:
    logic, _ = started(GOAL)
    success, made = cancelled(logic)
    assert success and logic.state is State.CANCELED
    assert logic.last.error_code == ErrorCode.GOAL_CANCELED
    assert KeepGoal(None) in made


def test_a_goal_that_is_cancelled_before_its_resumption_is_not_resumed() -> None:
    logic = configured()
    assert cancelled(logic)[0]
    logic.on_lifecycle(Activated(), NOW)
    logic.on_tick(NOW)
    assert logic.state is State.IDLE


def test_a_cancel_before_the_planner_is_configured_deletes_the_stored_goal() -> None:
    logic = PlannerLogic(PlannerSettings())
    assert KeepGoal(None) in cancelled(logic)[1]


@pytest.mark.parametrize("is_configured", [False, True])
def test_a_stored_goal_is_not_resumed_if_its_cancellation_raises(is_configured: bool) -> None:
    logic = configured() if is_configured else PlannerLogic(PlannerSettings())
    lost = UnansweredRequest("~/cancel", Trigger.Request(), 1)
    made = logic.on_defect(ZeroDivisionError("defect"), NOW, lost)
    assert KeepGoal(None) in made
    logic.on_lifecycle(Activated(), NOW)
    logic.on_tick(NOW)
    assert logic.state is State.IDLE


def test_without_a_goal_there_is_nothing_to_cancel() -> None:
    logic, _ = started(None)
    assert not cancelled(logic)[0] and logic.state is State.IDLE


@pytest.mark.parametrize(
    ("age", "why"),
    [
        (16.0, "16.0 s have passed since the crash (resume_within is 15 s); send the goal again"),
        (-3.0, "clock was set back since, by more than 3.0 s"),
    ],
)
def test_a_goal_that_is_old_or_of_unknown_age_is_not_resumed(age: float, why: str) -> None:
    logic, made = started(GOAL, age=age)
    assert logic.state is State.IDLE
    assert KeepGoal(None) in made
    (warning,) = (effect.sentence for effect in made if isinstance(effect, Log))
    assert why in warning


def test_the_stops_that_were_stored_with_an_old_goal_do_not_end_a_newer_goal() -> None:
    logic, _ = started(GOAL, age=16.0)
    sent = PoseStamped()
    sent.header.frame_id = "table"
    logic.on_message("goal_pose", sent, NOW)
    state = TapperState(state=TapperState.SAFE, last_stop=Time(sec=7))
    logic.on_message("tapper_state", state, NOW)
    assert logic.state is State.WAITING_FOR_CELL


@pytest.mark.parametrize(
    "content",
    [
        {},
        {**GOAL, "goal": [10**400, 0, 0]},
        {**GOAL, "goal": [0.0, 0.0]},
        {**GOAL, "goal": ["x", 0, 0]},
        {**GOAL, "goal": [float("inf"), 0, 0]},
        {**GOAL, "tolerance": [1]},
        {**GOAL, "tolerance": ["wide", None]},
        {**GOAL, "max_taps": "many"},
        {**GOAL, "max_taps": 10**400},
        {**GOAL, "time_left": None},
        {**GOAL, "taps": "some"},
        {**GOAL, "taps": -1},
        {**GOAL, "taps": 21},
        {**GOAL, "stops": 5},
        {**GOAL, "stops": {"arm": 7}},
        {**GOAL, "stops": {"arm": ["then"]}},
    ],
    ids=range(16),
)
def test_stored_content_without_a_goal_is_discarded(content: dict[str, Any]) -> None:
    logic, made = started(content)
    assert logic.state is not State.WAITING_FOR_CELL
    assert KeepGoal(None) in made


def test_a_goal_received_before_the_node_is_configured_is_refused() -> None:
    logic = PlannerLogic(PlannerSettings())
    made = logic.on_message("goal_pose", PoseStamped(), NOW)
    reports = [e.message for e in made if isinstance(e, Publish) and e.topic == "goal_report"]
    assert [report.error_code for report in reports] == [ErrorCode.NOT_ACTIVE]


@pytest.mark.parametrize(("kept", "asks"), [({"ask": False}, False), ({"ask": True}, True)])
def test_asking_that_was_switched_on_before_the_crash_can_be_switched_off(kept, asks):
    """A goal that itself demands a confirmation still asks."""
    logic, made = started({**GOAL, **kept, "ask_always": True})
    assert logic.last.ask
    stored = kept_goal(made)
    assert stored is not None and stored["ask_always"], "also after the next crash"
    logic.on_request("ask", SetBool.Request(data=False), 1, NOW)
    assert logic.last.ask is asks


@pytest.mark.parametrize("probe", [False, True])
def test_a_resumed_goal_still_probes(probe: bool) -> None:
    _, made = started({**GOAL, "probe": probe})
    stored = kept_goal(made)
    assert stored is not None and stored["probe"] is probe


@pytest.mark.parametrize("resumable", [True, False])
@pytest.mark.parametrize("within", [0.0, 0.5, 30.0])
def test_a_goal_is_stored_if_it_may_be_resumed(within: float, resumable: bool) -> None:
    kept = Resumption(within, CellMonitor(0.5), Confirmations(False))
    task = SimpleNamespace(
        **{"resumable": resumable, "goal": FAR, "tolerance": (0.001, 0.02), "max_taps": 20},
        **{"taps": 3, "expires": NOW.steady + 60.0, "ask": True, "probe": False, "object_id": ""},
    )
    stored = list(kept.keep(cast(Task, task), NOW, is_tapping=True))
    assert bool(stored) == (resumable and within > 0)
    for effect in stored:
        assert isinstance(effect, KeepGoal) and effect.content is not None
        assert effect.content["taps"] == 4, "the tap under way counts"
        assert effect.content["time_left"] == 60.0


def test_the_time_limit_runs_on_until_the_goal_is_resumed() -> None:
    request = Request(PoseStamped(), 0.001, 0.02, 20, 60.0)
    kept = KeptGoal(request, False, {}, NOW.steady, NOW.steady + 90.0)
    for waited, left in ((0.0, 60.0), (20.0, 40.0), (59.5, 1.0), (80.0, 1.0)):
        now = Now(NOW.steady + waited, NOW.ros)
        assert kept.remaining(now) == replace(request, time_limit=left)
