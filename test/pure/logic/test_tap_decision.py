"""What follows from a decision: another observation, a tap, a proposal, or the end of the goal."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tapping_cell.logic.clock import Now
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.effects import Log, Publish
from tapping_cell.logic.goal_validation import REFUSALS
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import (
    Confirming,
    End,
    Event,
    Firing,
    Looking,
    Placing,
    Planning,
    State,
    WaitingForCell,
)
from tapping_cell.logic.tap_decision import act, answered, not_awaited
from tapping_cell.logic.tap_steps import PlannerParts
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ErrorCode, ObjectState
from tapping_cell.planning import Done, ObserveAgain, Refusal, RefusalReason
from tapping_cell.se2 import Pose

START = 100.0
NOW = Now(START, 10**18)
POSE = Pose(0.05, -0.02, 1.0)
SETTINGS = PlannerSettings()
READY, NOT_READY = None, (ErrorCode.ARM_NOT_HOMED, "the arm is not homed")
LATE = (ErrorCode.CAMERA_SILENT, "the camera is silent")


class Task:
    """A goal whose tap limits are not reached."""

    def __init__(self, ask: bool = False, prescribed: bool = False) -> None:
        self.object_id, self.touched, self.purpose = "disk", list[str](), "its goal is free"
        self.ask, self.prescribed = ask, prescribed
        self.taps, self.max_taps, self.without_effect = 2, 20, 0
        self.session = SimpleNamespace(predicted_covariance=lambda strike, before: np.eye(3))
        self.skipped: list[Any] = []
        self.is_observed = True

    def before(self, seen: ObjectState) -> Pose:
        return POSE

    def skip(self, strike: Any) -> None:
        self.skipped.append(strike)

    def observed(self, *_: Any) -> bool:
        return self.is_observed


class Cell:
    """The planner's parts beside the cycle of a tap."""

    def __init__(self, missing: Any = READY, has_arm: bool = True) -> None:
        self.watched: list[str] = []
        self.tracks = 0
        self.monitor = SimpleNamespace(
            watch=self.watched.append,
            pose_of=lambda name: POSE,
            why_not_ready=lambda now: missing,
            why_not_observed=lambda *_: (ErrorCode.OBJECT_NOT_SEEN, "it is not seen"),
            begin_track=lambda: setattr(self, "tracks", self.tracks + 1),
            has_arm=has_arm,
        )
        self.confirmations = Confirmations(False)
        self.allowances: list[float] = []

    def parts(self) -> PlannerParts:
        def tap(shot: Any, allowance: float, height: float, now: Now) -> Publish:
            self.allowances.append(allowance)
            return Publish("tap_command", cast(Any, shot))

        return PlannerParts(
            SETTINGS,
            cast(Any, self.monitor),
            cast(Any, SimpleNamespace(cell=SimpleNamespace(strike_height=0.01))),
            cast(Any, SimpleNamespace(next_id=lambda now: 7, tap=tap)),
            self.confirmations,
            cast(Any, SimpleNamespace(keep=lambda *_, **__: iter(["the goal is stored"]))),
            iter(()),
        )


STRIKE = cast(
    Any,
    SimpleNamespace(
        detour="",
        predicted=POSE,
        plan=SimpleNamespace(strike_pose=POSE, striker_speed=0.4, tapper="tapper"),
    ),
)


def looking(task: Task, deadline: float = START + 5.0) -> Looking:
    return Looking(task=cast(Any, task), deadline=deadline, shot=None, since=START - 1.0)


def planning(task: Task, deadline: float = START + 5.0) -> Planning:
    return Planning(task=cast(Any, task), deadline=deadline, look=looking(task, deadline))


def acted(at: Any, decision: Any, cell: Cell | None = None) -> list[Any]:
    """Return the steps without log entries."""
    steps = act(at, decision, ObjectState(), (cell or Cell()).parts(), NOW)
    return [step for step in steps if not isinstance(step, Log)]


@pytest.mark.parametrize("where", [looking, planning])
@pytest.mark.parametrize("late", [True, False])
@pytest.mark.parametrize("reason", sorted(REFUSALS))
def test_only_a_camera_that_may_become_finer_delays_a_refusal(where, late, reason):
    at = where(Task(), START - 0.1 if late else START + 5.0)
    steps = acted(at, Refusal(reason, "why"))
    if reason == RefusalReason.CAMERA_TOO_COARSE and not late:
        again = [Go(Event.OBSERVATION_REQUESTED, at.look)] if where is planning else []
        assert steps == again
    else:
        assert steps == [End(code=REFUSALS[reason], sentence="why")]


@pytest.mark.parametrize("where", [looking, planning])
def test_a_longer_observation_returns_from_the_computation(where) -> None:
    at = where(Task())
    steps = acted(at, ObserveAgain(POSE, 0.9))
    assert steps == ([Go(Event.OBSERVATION_REQUESTED, at.look)] if where is planning else [])


@pytest.mark.parametrize("where", [looking, planning])
@pytest.mark.parametrize("prescribed", [True, False])
def test_a_goal_that_is_met_ends(where, prescribed: bool) -> None:
    steps = acted(where(Task(prescribed=prescribed)), Done(POSE, None))
    assert steps[-1] == End(State.IDLE if prescribed else State.REACHED)
    assert [step.event for step in steps[:-1]] == ([Event.OBSERVED] if where is looking else [])


def test_the_tapped_object_is_watched_and_touched_ones_are_named_once() -> None:
    cell, task = Cell(), Task()
    task.touched = ["square", "bar"]
    at = looking(task)
    for words in ("'square', 'bar' moved", ""):
        steps = list(act(at, ObserveAgain(POSE, 0.9), ObjectState(), cell.parts(), NOW))
        assert cell.watched.pop() == "disk"
        assert bool(steps) == bool(words)
        assert not words or words in steps[0].sentence


@pytest.mark.parametrize("detour", ["", "the first choice leaves the table"])
def test_why_another_tap_was_chosen_is_logged(detour: str) -> None:
    strike = SimpleNamespace(**{**vars(STRIKE), "detour": detour})
    steps = act(planning(Task()), cast(Any, strike), ObjectState(), Cell().parts(), NOW)
    logged = [step.sentence for step in steps if isinstance(step, Log)]
    assert logged == ([f"tap 3: {detour}"] if detour else [])


@pytest.mark.parametrize("has_arm", [True, False])
@pytest.mark.parametrize("where", [looking, planning])
def test_a_tap_is_stored_commanded_and_awaited(where, has_arm: bool) -> None:
    cell = Cell(has_arm=has_arm)
    steps = acted(where(Task()), STRIKE, cell)
    if where is looking:
        assert steps.pop(0).event is Event.OBSERVED
    kept, published, go = steps
    assert kept == "the goal is stored", "first, so that no crash loses the tap"
    shot = published.message
    assert (shot.tap_id, shot.number, shot.object_id) == (7, 3, "disk")
    assert (shot.before, shot.purpose, cell.tracks) == (POSE, "its goal is free", 1)
    assert cell.allowances == [SETTINGS.place_deadline + SETTINGS.fire_deadline]
    assert go.event is Event.TAP_COMMANDED and go.record.shot is shot
    kind, wait = (Placing, SETTINGS.place_deadline) if has_arm else (Firing, SETTINGS.fire_deadline)
    assert isinstance(go.record, kind) and go.record.deadline == START + wait


def test_a_cell_that_is_not_ready_gets_no_tap() -> None:
    steps = acted(planning(Task()), STRIKE, Cell(NOT_READY))
    assert [step.event for step in steps] == [Event.CELL_NOT_READY]
    assert isinstance(steps[0].record, WaitingForCell)


def test_the_limit_of_taps_ends_the_goal_before_the_next_one() -> None:
    task = Task()
    task.taps, task.residual = 20, lambda pose: (0.002, 0.1)  # type: ignore[attr-defined]
    (end,) = acted(planning(task), STRIKE)
    assert end.code == ErrorCode.TAP_LIMIT_REACHED


def proposed(cell: Cell, task: Task) -> Confirming:
    steps = acted(planning(task), STRIKE, cell)
    assert [step.event for step in steps] == [Event.TAP_PROPOSED], "nothing is commanded"
    record = steps[0].record
    assert record.deadline == START + SETTINGS.confirm_deadline
    assert record.answer_by == NOW.ros + round(1e9 * SETTINGS.confirm_deadline)
    return cast(Confirming, record)


@pytest.mark.parametrize("prescribed", [True, False])
def test_a_tap_that_must_be_confirmed_is_proposed_and_then_commanded(prescribed: bool) -> None:
    cell, task = Cell(), Task(ask=True, prescribed=prescribed)
    at = proposed(cell, task)
    assert "answer for tap 7" in not_awaited(8, at).error_msg
    assert "no tap is waiting" in not_awaited(8, planning(task)).error_msg
    assert not_awaited(8, at).error_code == ErrorCode.TAP_NOT_AWAITED
    response, steps = answered(at, True, cell.parts(), NOW)
    assert response.accepted
    assert [step.event for step in steps if isinstance(step, Go)] == [Event.TAP_COMMANDED]
    # The confirmation holds for the same tap, if it must be planned again.
    steps = list(act(planning(task), STRIKE, ObjectState(), cell.parts(), NOW))
    assert steps[-1].event is Event.TAP_COMMANDED
    assert ["remains valid" in step.sentence for step in steps if isinstance(step, Log)] == [True]


@pytest.mark.parametrize("prescribed", [True, False])
def test_a_rejected_tap_is_skipped_or_ends_a_single_tap(prescribed: bool) -> None:
    cell, task = Cell(), Task(ask=True, prescribed=prescribed)
    response, steps = answered(proposed(cell, task), False, cell.parts(), NOW)
    assert response.accepted
    (step,) = [each for each in steps if not isinstance(each, Log)]
    if prescribed:
        assert step.code == ErrorCode.TAP_NOT_CONFIRMED and not task.skipped
    else:
        assert step.event is Event.TAP_DROPPED and task.skipped == [STRIKE]
        assert (step.record.since, step.record.deadline) == (
            START,
            START + SETTINGS.observe_deadline,
        )


@pytest.mark.parametrize(
    ("missing", "observed", "accepted", "event"),
    [
        (NOT_READY, True, False, Event.CELL_NOT_READY),
        (LATE, True, True, Event.CELL_NOT_READY),
        (READY, False, False, Event.TAP_DROPPED),
    ],
)
def test_an_answer_for_a_cell_that_is_not_ready_fires_nothing(missing, observed, accepted, event):
    cell, task = Cell(), Task(ask=True)
    at = proposed(cell, task)
    task.is_observed = observed
    cell.monitor.why_not_ready = lambda now: missing
    response, steps = answered(at, True, cell.parts(), NOW)
    assert [step.event for step in steps if isinstance(step, Go)] == [event]
    assert response.accepted == accepted
    if not accepted:
        assert response.error_code in (ErrorCode.ARM_NOT_HOMED, ErrorCode.OBJECT_NOT_SEEN)
        assert "tap 3 is planned again" in response.error_msg
    # What only came too late keeps the confirmation.
    cell.monitor.why_not_ready = lambda now: READY
    task.is_observed = True
    again = acted(planning(task), STRIKE, cell)[-1].event
    assert again is (Event.TAP_COMMANDED if accepted else Event.TAP_PROPOSED)
