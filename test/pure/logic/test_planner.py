"""The planner's handlers: whose requests they serve, and what they publish at each tick."""

from __future__ import annotations

from functools import cache
from typing import Any, cast

import pytest
from logic_parts import alone, goal_handling

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import Answer, Effect, JobEnded, JobProgress, Publish, TouchGoal
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.host import Activated, Configured, Deactivated
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import Looking, Planning, State, WaitingForCell
from tapping_cell.messages import (
    ErrorCode,
    ObjectState,
    PlanState,
    PoseStamped,
    PositionObject,
    Trigger,
)

START = Now(100.0, 1_800_000_000_000_000_000)


def after(seconds: float) -> Now:
    return Now(START.steady + seconds, START.ros + round(1e9 * seconds))


@cache
def goals() -> GoalHandling:
    return goal_handling(now=START)


def planner() -> PlannerLogic:
    made = PlannerLogic(PlannerSettings())
    made.on_lifecycle(Configured(goals().cell, goals()), START)
    made.on_lifecycle(Activated(), START)
    return made


def pose(x: float = 0.02, stamp: int = 0) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id, message.header.stamp = "table", to_stamp(stamp)
    message.pose.position.x, message.pose.orientation.w = x, 1.0
    return message


def send(made: PlannerLogic, token: object = "ours") -> list[Effect]:
    goal = PositionObject.Goal(goal_pose=pose())
    effects = made.on_request("position_object", goal, cast(Any, token), START)
    assert made.state is State.WAITING_FOR_CELL
    return list(effects)


def reports(effects: Any) -> list[PlanState]:
    published = [effect for effect in effects if isinstance(effect, Publish)]
    return [cast(PlanState, each.message) for each in published if each.topic == "plan_state"]


@pytest.mark.parametrize("token", ["ours", "another client's"])
def test_only_the_client_of_a_goal_cancels_it(token: str) -> None:
    made = planner()
    send(made)
    answers = [
        effect
        for effect in made.on_request("cancel", Trigger.Request(), cast(Any, token), START)
        if isinstance(effect, Answer)
    ]
    ours = token == "ours"
    assert made.state is (State.CANCELED if ours else State.WAITING_FOR_CELL)
    assert [cast(Any, each.response).error_code for each in answers] == (
        [ErrorCode.GOAL_CANCELED] if ours else []
    )


@pytest.mark.parametrize("goal", [True, False])
def test_the_state_is_published_twice_a_second_and_the_stored_goal_kept_young(goal: bool) -> None:
    made = planner()
    if goal:
        send(made)
        made.on_tick(START)  # reports what the cell lacks
    for seconds, due in ((0.1, False), (0.4, False), (0.6, True), (0.7, False), (1.2, True)):
        effects = made.on_tick(after(seconds))
        assert len(reports(effects)) == due
        assert any(isinstance(effect, TouchGoal) for effect in effects) == (due and goal)


def test_an_inactive_planner_publishes_nothing_at_a_tick() -> None:
    made = planner()
    made.on_lifecycle(Deactivated(), START)
    assert not made.on_tick(after(10.0))


def deciding(made: PlannerLogic) -> Planning:
    """Let a job compute a decision."""
    seen = ObjectState(object_id=goals().cell.object.name, visible=True, at_rest=True)
    made.on_message("object_states", alone(seen), START)
    task = cast(WaitingForCell, made._record).task
    look = Looking(task=task, deadline=after(9.0).steady, since=START.steady)
    record = Planning(task=task, deadline=after(9.0).steady, look=look, job=41)
    made._record = record
    return record


@pytest.mark.parametrize(
    "event",
    [
        JobEnded(40, None),
        JobEnded(40, None, HardwareFault(FaultReason.TIMEOUT, "a job of another goal")),
        JobProgress(41, "something"),
    ],
)
def test_the_end_of_another_job_decides_nothing(event: Any) -> None:
    made = planner()
    send(made)
    record = deciding(made)
    assert not made.on_job(event, START) and made._record is record


def test_a_job_that_raised_raises_in_the_handler() -> None:
    made = planner()
    send(made)
    deciding(made)
    with pytest.raises(ZeroDivisionError):
        made.on_job(JobEnded(41, None, ZeroDivisionError()), START)


@pytest.mark.parametrize("lost", [None, Deactivated(), Activated()])
def test_after_a_defect_the_planner_is_as_active_as_its_node(lost: Any) -> None:
    made = planner()
    effects = made.on_defect(ValueError("a defect"), START, lost)
    assert reports(effects), "whoever waits for the planner learns its state"
    assert bool(made.on_tick(after(1.0))) == (not isinstance(lost, Deactivated))


@pytest.mark.parametrize(("stamp", "refused"), [(-1.0, True), (1.0, False), (3.0, False)])
def test_a_goal_of_the_topic_replaces_only_an_older_one(stamp: float, refused: bool) -> None:
    made = planner()
    made.on_message("goal_pose", pose(0.02, after(0.0).ros), after(0.5))
    first = made._task
    effects = made.on_message("goal_pose", pose(0.03, after(stamp).ros), after(0.6))
    assert (made._task is first) == refused
    codes = [each.error_code for each in reports(effects)]
    assert (ErrorCode.GOAL_STALE in codes) == refused
