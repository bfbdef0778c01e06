"""The cycle of one tap, state by state, for a cell and a goal that answer as told."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tapping_cell.logic import tap_cycle
from tapping_cell.logic.arrangement import ArrangementTask
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Log, RunJob
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import (
    Confirming,
    End,
    Event,
    Firing,
    Looking,
    Placing,
    Planning,
    Settling,
    WaitingForCell,
)
from tapping_cell.logic.tap_steps import PARKING_S, PlannerParts, disturbed
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ErrorCode, ObjectState, TapperState
from tapping_cell.planning import ObserveAgain
from tapping_cell.se2 import Pose

START = 100.0
NOW = Now(START, 10**18)
POSE = Pose(0.05, -0.02, 1.0)
SETTINGS = PlannerSettings()
UNHOMED = (ErrorCode.ARM_NOT_HOMED, "the arm is not homed")
SILENT = (ErrorCode.CAMERA_SILENT, "the camera is silent")


class Task:
    """A goal."""

    def __init__(self, **known: Any) -> None:
        self.object_id, self.expires, self.taps, self.purpose = "disk", math.inf, 2, ""
        self.is_resumed, self.ready, self.resumable, self.prescribed = False, True, True, False
        self.late = self.not_fired = 0
        self.touched: list[str] = []
        self.arm: Any = None
        self.observations: list[tuple[Any, ...]] = []
        self.skipped: list[Any] = []
        self.taken: list[Any] = []
        self.is_observed, self.is_outdated, self.job = True, False, None
        self.session = SimpleNamespace(edge_warning=lambda pose: "")
        for name, value in known.items():
            setattr(self, name, value)

    def observed(self, *asked: Any) -> bool:
        self.observations.append(asked)
        return self.is_observed

    def computation(self, frames: int) -> Any:
        self.frames = frames
        return self.job

    def decide(self, seen: ObjectState, frames: int) -> Any:
        return ObserveAgain(POSE, 0.9)

    def conclude(self, result: Any) -> Any:
        return result

    def outdated(self, *_: Any) -> bool:
        return self.is_outdated

    def take_in(self, shot: Any, seen: Any, track: Any) -> None:
        self.taken.append(shot)

    def skip(self, strike: Any) -> None:
        self.skipped.append(strike)


class Cell:
    """What the planner has received, and what it asks its parts for."""

    def __init__(self, **known: Any) -> None:
        self.sent: list[str] = []
        self.withdrawals: list[str] = []
        self.unknown: Any = None
        self.searched: list[float] = []
        facts = {
            **{"ready": None, "unhomed": None, "rests": False, "withdrawn": True, "silent": False},
            **{"away": False, "outcome": TapperState.NONE, "lost": False, "reach": None},
            **{"in_position": False, "unseen": 0.0, "has_arm": True, "others": False},
            **{"may_park": True, "withdrawn_tap": False, "error": (0, "")},
        }
        assert known.keys() <= facts.keys()
        self.facts = SimpleNamespace(**{**facts, **known})
        facts_ = self.facts
        report = SimpleNamespace(error_code=facts_.error[0], error_msg=facts_.error[1])
        self.monitor = SimpleNamespace(
            object=ObjectState(),
            tip=(0.1, 0.0, 0.02, 0.0),
            has_arm=facts_.has_arm,
            why_not_ready=lambda now: facts_.ready,
            homing_error=lambda: facts_.unhomed,
            at_rest_after=lambda time, now: facts_.rests,
            is_withdrawn=lambda now: facts_.withdrawn,
            silent=lambda device, now: facts_.silent and device == "object",
            unseen_for=lambda now: facts_.unseen,
            why_not_observed=lambda *_: (ErrorCode.OBJECT_NOT_SEEN, "it is not seen"),
            seen_away_from=lambda pose, *limits: facts_.away,
            outcome=lambda tap_id: facts_.outcome,
            tapper_of=lambda tap_id: report,
            is_disconnected=lambda now: facts_.lost,
            reach_error=lambda tap_id: facts_.reach,
            in_position=lambda tap_id: facts_.in_position,
            watch=lambda name: None,
            track=lambda seen: None,
        )

    def _note(self, what: str) -> Any:
        def send(*_: Any, **__: Any) -> Any:
            self.sent.append(what)
            return iter([what])

        return send

    def _update(self, task: Any, since: float, search_since: float, now: Now) -> Any:
        self.searched.append(search_since)
        return self.unknown

    def parts(self) -> PlannerParts:
        sender = SimpleNamespace(
            withdraw=self._note("withdraw"),
            withdraw_orphan=self._note("orphan"),
            park=self._note("park"),
            clear_view=lambda now: self.sent.append("clear view"),
            may_park=self.facts.may_park,
            is_withdrawn=lambda shot: self.facts.withdrawn_tap,
        )
        return PlannerParts(
            SETTINGS,
            cast(Any, self.monitor),
            cast(
                Any,
                SimpleNamespace(
                    others_moved=lambda task, now: self.facts.others,
                    update_free_space=self._update,
                ),
            ),
            cast(Any, sender),
            cast(
                Any,
                SimpleNamespace(
                    withdraw=self.withdrawals.append,
                    forget=lambda: self.withdrawals.append("forgotten"),
                ),
            ),
            cast(Any, SimpleNamespace(keep=self._note("keep"))),
            iter([41]),
        )


def shot(outcome: int = TapperState.NONE) -> Any:
    plan = SimpleNamespace(flight=0.03)
    return SimpleNamespace(
        **{"tap_id": 7, "number": 3, "before": POSE, "outcome": outcome, "counted": False},
        **{"in_position": True, "strike": SimpleNamespace(plan=plan)},
    )


def steps_of(at: Any, cell: Cell, now: Now = NOW) -> list[Any]:
    """Return the steps, without log entries and the messages of the fakes."""
    steps = tap_cycle.advance(at, cell.parts(), now)
    return [step for step in steps if isinstance(step, Go | End | RunJob)]


def in_state(kind: Any, task: Task, deadline: float = START + 5.0, **more: Any) -> Any:
    given: dict[str, Any] = {"task": task, "deadline": deadline}
    if kind is Looking:
        given["since"] = START - 1.0
    if kind in (Placing, Firing):
        given["shot"] = shot()
    if kind is Confirming:
        given |= {"look": in_state(Looking, task), "proposed": shot(), "answer_by": 0}
    return kind(**{**given, **more})


KINDS = (WaitingForCell, Looking, Confirming, Placing, Firing, Settling)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("late", [True, False])
def test_the_time_limit_of_the_goal_ends_every_wait(kind, late: bool) -> None:
    task = Task(expires=START + (-0.1 if late else 0.1))
    steps = steps_of(in_state(kind, task), Cell(ready=SILENT, withdrawn=False))
    codes = [step.code for step in steps if isinstance(step, End)]
    assert codes == ([ErrorCode.DEADLINE_EXCEEDED] if late else [])


def test_a_decision_under_way_is_not_made_again() -> None:
    task = Task()
    at = Planning(task=cast(Any, task), look=in_state(Looking, task), job=41)
    assert steps_of(at, Cell()) == []


# Waiting for the cell


def test_a_ready_cell_is_observed_and_keeps_the_last_tap() -> None:
    last = shot()
    (go,) = steps_of(in_state(WaitingForCell, Task(), shot=last, moved_aside=True), Cell())
    assert go.event is Event.CELL_READY
    look = go.record
    assert (look.shot, look.moved_aside, look.since, look.struck_at) == (
        *(last, True, START),
        math.inf,
    )
    assert look.deadline == START + SETTINGS.observe_deadline


@pytest.mark.parametrize("resumed", [True, False])
@pytest.mark.parametrize("missing", [SILENT, UNHOMED])
def test_homing_does_not_continue_a_resumed_goal(missing, resumed: bool) -> None:
    cell = Cell(ready=missing, unhomed=UNHOMED if missing == UNHOMED else None)
    (step,) = steps_of(in_state(WaitingForCell, Task(is_resumed=resumed)), cell)
    if resumed and missing == UNHOMED:
        assert step.code == ErrorCode.ARM_NOT_HOMED and not cell.sent
    else:
        assert (step.event, step.record.missing) == (None, missing)
        assert cell.sent == ["orphan"]


def test_what_the_cell_lacks_ends_the_goal_when_the_wait_is_over() -> None:
    at = in_state(WaitingForCell, Task(), START - 0.1, missing=SILENT)
    (end,) = steps_of(at, Cell(ready=SILENT))
    assert end.code == ErrorCode.CAMERA_SILENT and "the camera is silent" in end.sentence
    assert steps_of(replace(at, deadline=START + 1.0), Cell(ready=SILENT)) == []


# Looking


@pytest.mark.parametrize("rests", [True, False])
def test_a_fixed_tappers_object_is_observed_from_its_strike_on(rests: bool) -> None:
    task = Task(is_observed=False)
    steps_of(in_state(Looking, task, struck_at=START - 0.5), Cell(rests=rests))
    ((_, since, frames, _),) = task.observations
    assert since == (START - 0.5 if rests else START - 1.0)
    assert frames == SETTINGS.frames_needed


@pytest.mark.parametrize("at_first", [True, False])
def test_an_observation_waits_while_a_solver_computes(at_first: bool) -> None:
    """Before the last tap is taken in, and again if other obstacles need another solution."""
    task = Task(ready=not at_first)
    cell = Cell()
    if not at_first:
        answers = iter([True, False])
        task.__class__ = type("Slow", (Task,), {"ready": property(lambda self: next(answers))})
    steps = steps_of(in_state(Looking, task, START - 0.1), cell)
    assert [step.event for step in steps] == [None]
    assert steps[0].record.deadline == START + SETTINGS.observe_deadline
    assert cell.searched == ([] if at_first else [START - 1.0])


@pytest.mark.parametrize("withdrawn", [True, False])
def test_the_table_is_searched_only_behind_a_withdrawn_arm(withdrawn: bool) -> None:
    cell = Cell(withdrawn=withdrawn)
    steps_of(in_state(Looking, Task()), cell)
    assert cell.searched == [START - 1.0 if withdrawn else -math.inf]


@pytest.mark.parametrize("late", [True, False])
def test_a_table_that_was_not_searched_ends_the_goal_when_it_is_late(late: bool) -> None:
    cell = Cell()
    cell.unknown = (ErrorCode.NOT_READY, "not searched")
    steps = steps_of(in_state(Looking, Task(), START + (-0.1 if late else 1.0)), cell)
    assert [step.code for step in steps] == ([ErrorCode.NOT_READY] if late else [])


@pytest.mark.parametrize("late", [True, False])
def test_a_slow_decision_is_computed_by_a_job(late: bool) -> None:
    task = Task(job=lambda: "the result")
    at = in_state(Looking, task, START + (-0.1 if late else 1.0))
    run, go = steps_of(at, Cell())
    assert (run.job.number, run.job.run(cast(Any, None))) == (41, "the result")
    assert go.event is Event.OBSERVED and (go.record.job, go.record.look) == (41, at)
    assert task.frames == (0 if late else SETTINGS.frames_needed), "no time for a longer one"
    assert task.arm == (0.1, 0.0, 0.02, 0.0)


def test_a_tap_that_was_fired_is_taken_in_once() -> None:
    task, cell = Task(), Cell()
    fired = shot(TapperState.FIRED)
    steps = steps_of(in_state(Looking, task, shot=fired), cell)
    assert task.taken == [fired] and cell.withdrawals == ["forgotten"]
    assert steps[0].event is None and steps[0].record.shot is None
    assert "keep" not in cell.sent


@pytest.mark.parametrize("warning", ["", "the object is near the edge"])
def test_an_object_near_the_edge_is_logged(warning: str) -> None:
    task = Task(session=SimpleNamespace(edge_warning=lambda pose: warning))
    at = in_state(Looking, task, shot=shot(TapperState.FIRED))
    steps = tap_cycle.advance(at, Cell().parts(), NOW)
    logged = [step.sentence for step in steps if isinstance(step, Log)]
    assert logged == ([warning] if warning else [])


def test_a_tap_that_was_not_fired_counts_and_is_stored_as_such() -> None:
    task, cell = Task(), Cell()
    steps = steps_of(in_state(Looking, task, shot=shot(TapperState.NOT_FIRED)), cell)
    assert not task.taken and task.late == 1 and cell.sent == ["keep"]
    assert steps[0].event is None and steps[0].record.shot is None
    task.late = SETTINGS.late_attempts - 1
    *_, end = steps_of(in_state(Looking, task, shot=shot(TapperState.NOT_FIRED)), cell)
    assert end.code == ErrorCode.NOT_READY


@pytest.mark.parametrize(
    ("facts", "aside", "late", "outcome"),
    [
        ({}, False, False, None),
        ({}, False, True, ErrorCode.OBJECT_NOT_SEEN),
        ({"silent": True}, False, False, Event.CELL_NOT_READY),
        ({"unseen": 0.6}, False, False, None),
        ({"unseen": 0.9}, False, False, Event.HIDDEN),
        ({"unseen": 0.9, "may_park": False}, False, False, Event.HIDDEN),
        ({"unseen": 0.9}, True, False, None),
        ({"unseen": 0.9, "has_arm": False}, False, False, None),
    ],
)
def test_an_object_that_is_not_seen_is_uncovered_once(facts, aside, late, outcome) -> None:
    cell = Cell(**facts)
    deadline = START + (-0.1 if late else 1.0)
    at = in_state(Looking, Task(is_observed=False), deadline, moved_aside=aside)
    steps = steps_of(at, cell)
    assert [getattr(step, "event", None) for step in steps if isinstance(step, Go)] == (
        [outcome] if isinstance(outcome, Event) else []
    )
    assert [step.code for step in steps if isinstance(step, End)] == (
        [outcome] if outcome == ErrorCode.OBJECT_NOT_SEEN else []
    )
    if outcome is Event.HIDDEN:
        parks = cell.facts.may_park
        assert cell.sent == ["park" if parks else "clear view"]
        away = steps[0].record
        assert away.moved_aside == (not parks), "first to the park pose, then further"
        assert away.moves_until == START + PARKING_S
        assert away.deadline == START + SETTINGS.withdraw_deadline


# A computed decision


@pytest.mark.parametrize("outdated", [True, False])
def test_a_decision_for_objects_that_moved_meanwhile_is_made_again(outdated: bool) -> None:
    task = Task(is_outdated=outdated)
    look = in_state(Looking, task, START - 0.1)
    at = Planning(task=cast(Any, task), look=look, deadline=START + 1.0)
    decision = ObserveAgain(POSE, 0.9)
    steps = tap_cycle.decided(at, decision, ObjectState(), Cell().parts(), NOW)
    (go,) = [step for step in steps if isinstance(step, Go)]
    assert go.event is Event.OBSERVATION_REQUESTED
    assert go.record.deadline == (START + SETTINGS.observe_deadline if outdated else START - 0.1)


# Waiting for a person, for the arm and for the tapper


@pytest.mark.parametrize(
    ("facts", "late", "event"),
    [
        ({}, False, None),
        ({"lost": True}, False, Event.CELL_NOT_READY),
        ({"away": True}, False, Event.TAP_DROPPED),
        ({"others": True}, False, Event.TAP_DROPPED),
        ({}, True, ErrorCode.TAP_NOT_CONFIRMED),
    ],
)
def test_a_proposal_ends_with_the_connection_a_motion_or_its_time(facts, late, event) -> None:
    task = Task()
    look = in_state(Looking, task, moved_aside=True)
    at = in_state(Confirming, task, START + (-0.1 if late else 1.0), look=look)
    steps = steps_of(at, Cell(**facts))
    found = [step.code if isinstance(step, End) else step.event for step in steps]
    assert found == ([] if event is None else [event])
    if event is Event.CELL_NOT_READY:
        assert steps[0].record.moved_aside, "the arm is not moved aside again"


@pytest.mark.parametrize(
    ("facts", "late", "event"),
    [
        ({}, False, None),
        ({"in_position": True}, False, Event.IN_POSITION),
        ({"away": True, "in_position": True}, False, Event.GIVEN_UP),
        ({"others": True}, False, Event.GIVEN_UP),
        ({"reach": (ErrorCode.ARM_OUT_OF_REACH, "out of reach")}, False, Event.GIVEN_UP),
        ({"outcome": TapperState.FIRED, "in_position": True}, False, Event.OUTCOME_REPORTED),
        ({"lost": True}, False, Event.CELL_NOT_READY),
        ({"unhomed": UNHOMED}, False, ErrorCode.ARM_NOT_HOMED),
        ({}, True, ErrorCode.ARM_TIMEOUT),
    ],
)
def test_the_way_to_the_strike_pose_ends_in_one_way(facts, late, event) -> None:
    cell, task = Cell(**facts), Task()
    at = in_state(Placing, task, START + (-0.1 if late else 1.0))
    steps = steps_of(at, cell)
    found = [step.code if isinstance(step, End) else step.event for step in steps]
    assert found == ([] if event is None else [event])
    if event is Event.IN_POSITION:
        assert steps[0].record.shot is at.shot
        assert steps[0].record.deadline == START + SETTINGS.fire_deadline
    if event is Event.GIVEN_UP:
        assert cell.sent == ["withdraw"] and len(cell.withdrawals) == 1
        reach = "reach" in facts
        assert at.shot.outcome == (TapperState.NOT_FIRED if reach else TapperState.UNKNOWN)
        assert bool(task.skipped) == reach and task.not_fired == reach
    if event is Event.CELL_NOT_READY:
        assert cell.sent == ["withdraw"] and at.shot.outcome == TapperState.UNKNOWN


@pytest.mark.parametrize(
    ("facts", "late", "event"),
    [
        ({}, False, None),
        ({"outcome": TapperState.FIRED, "away": True}, False, Event.OUTCOME_REPORTED),
        ({"away": True}, False, None),
        ({"others": True}, False, None),
        ({"lost": True}, False, Event.GIVEN_UP),
        ({}, True, Event.GIVEN_UP),
    ],
)
def test_a_shot_ends_with_its_outcome_or_its_time(facts, late, event) -> None:
    cell = Cell(**facts)
    at = in_state(Firing, Task(), START + (-0.1 if late else 1.0))
    steps = steps_of(at, cell)
    assert [step.event for step in steps] == ([] if event is None else [event])
    moved = event is None and bool(facts)
    assert cell.withdrawals == (["an object was moved"] if moved else [])
    assert ("withdraw" in cell.sent) == (moved or event is not None)
    if event is Event.GIVEN_UP:
        assert at.shot.outcome == TapperState.UNKNOWN and steps[0].record.shot is at.shot


@pytest.mark.parametrize("withdrawn", [True, False])
@pytest.mark.parametrize("has_arm", [True, False])
@pytest.mark.parametrize("outcome", [TapperState.FIRED, TapperState.UNKNOWN])
def test_after_a_shot_the_planner_waits_for_the_arm(outcome, has_arm, withdrawn) -> None:
    task = Task(late=2, not_fired=1)
    at = in_state(Firing, task, shot=shot(outcome))
    cell = Cell(outcome=outcome, has_arm=has_arm, withdrawn_tap=withdrawn)
    (go,) = steps_of(at, cell)
    settling = go.record
    assert (task.late, task.not_fired) == (0, 0)
    assert settling.deadline == START + SETTINGS.withdraw_deadline
    struck = outcome == TapperState.FIRED and not has_arm
    assert settling.struck_at == (START + 0.03 if struck else math.inf)


@pytest.mark.parametrize(
    ("error", "withdrawn", "late", "not_fired", "skips", "reason"),
    [
        ((ErrorCode.NONE, ""), True, 0, 0, False, None),
        ((ErrorCode.NONE, ""), False, 0, 1, False, "another"),
        ((ErrorCode.CAMERA_SILENT, "late"), True, 1, 0, False, None),
        ((ErrorCode.OBJECT_MOVED, "moved"), False, 0, 1, False, None),
        ((ErrorCode.OBJECT_NOT_SEEN, "hidden"), False, 0, 1, True, None),
    ],
)
@pytest.mark.parametrize("has_arm", [True, False])
def test_a_tap_that_was_not_fired_counts_by_its_cause(
    error, withdrawn, late, not_fired, skips, reason, has_arm
):
    """Only an arm may hide the object from its own strike pose."""
    outcome, skips = TapperState.NOT_FIRED, skips and has_arm
    cell = Cell(outcome=outcome, error=error, withdrawn_tap=withdrawn, has_arm=has_arm)
    task = Task()
    (go,) = steps_of(in_state(Firing, task, shot=shot(outcome)), cell)
    assert go.event is Event.OUTCOME_REPORTED
    assert (task.late, task.not_fired, bool(task.skipped)) == (late, not_fired, skips)
    assert bool(cell.withdrawals) == (reason is not None)
    task = Task(not_fired=SETTINGS.attempts - 1, late=SETTINGS.late_attempts - 1)
    (step,) = steps_of(in_state(Firing, task, shot=shot(outcome)), cell)
    assert isinstance(step, End) == bool(late or not_fired)


def test_the_outcome_that_the_tapper_reported_outlasts_giving_up() -> None:
    for facts in ({"away": True}, {"reach": (ErrorCode.ARM_OUT_OF_REACH, "out of reach")}):
        at = in_state(Placing, Task(), shot=shot(TapperState.FIRED))
        (go,) = steps_of(at, Cell(**facts))
        assert go.event is Event.GIVEN_UP and at.shot.outcome == TapperState.FIRED


class Several(ArrangementTask):
    """An arrangement whose other objects move as told."""

    def __init__(self, moved: bool) -> None:
        self.moved, self.obstacles = moved, ()

    def others_moved(self, *_: Any) -> bool:
        return self.moved


@pytest.mark.parametrize(
    ("moved", "unknown", "disturbs"), [(False, (), False), (True, (), True), (False, ("a",), True)]
)
def test_an_arrangement_is_disturbed_by_other_and_by_unknown_objects(moved, unknown, disturbs):
    parts = Cell().parts()
    parts.goals.objects = SimpleNamespace(unknown=unknown)  # type: ignore[misc, assignment]
    assert disturbed(Several(moved), shot(), parts, NOW) == disturbs


# Settling


@pytest.mark.parametrize(
    ("facts", "moves_until", "late", "event"),
    [
        ({}, START - 0.1, False, Event.WITHDRAWN),
        ({}, START + 0.1, False, None),
        ({"withdrawn": False}, START - 0.1, False, None),
        ({"withdrawn": False}, START - 0.1, True, ErrorCode.ARM_TIMEOUT),
        ({"withdrawn": False, "lost": True}, START - 0.1, False, Event.CELL_NOT_READY),
    ],
)
def test_a_withdrawn_arm_begins_a_new_observation(facts, moves_until, late, event) -> None:
    last = shot()
    at = in_state(
        Settling, Task(), START + (-0.1 if late else 1.0), shot=last, moves_until=moves_until,
        struck_at=START - 0.5,
    )  # fmt: skip
    steps = steps_of(at, Cell(**facts))
    found = [step.code if isinstance(step, End) else step.event for step in steps]
    assert found == ([] if event is None else [event])
    if event is Event.WITHDRAWN:
        look = steps[0].record
        assert (look.shot, look.since, look.struck_at) == (last, START, START - 0.5)
    if event is Event.CELL_NOT_READY:
        assert steps[0].record.shot is last


@pytest.mark.parametrize("has_arm", [True, False])
def test_a_timeout_names_the_device_that_is_late(has_arm: bool) -> None:
    at = in_state(Settling, Task(), START - 0.1)
    (end,) = steps_of(at, Cell(withdrawn=False, has_arm=has_arm))
    assert ("arm did not withdraw" in end.sentence) == has_arm
    assert ("check the arm" if has_arm else "check the tapper") in end.sentence
    logs = tap_cycle.advance(in_state(Firing, Task(), START - 0.1), Cell().parts(), NOW)
    assert any(isinstance(step, Log) for step in logs)
