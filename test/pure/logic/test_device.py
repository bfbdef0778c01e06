"""What the state machines of all devices share, with a device that only records its calls."""

from __future__ import annotations

from enum import Enum
from typing import Any, ClassVar, cast

import pytest
from logic_parts import at

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import DeviceLogic, patience_after
from tapping_cell.logic.effects import (
    AbandonJob,
    Answer,
    AskStops,
    JobEnded,
    JobProgress,
    Log,
    Publish,
    RunJob,
)
from tapping_cell.logic.host import Activated, Configured, Deactivated, ShutDown, Unreachable
from tapping_cell.logic.transitions import StateMachine, table
from tapping_cell.messages import Bool, ErrorCode, StopState, Trigger

START = 100.0
TICK = 0.1


class State(Enum):
    IDLE = "idle"
    STOPPED = "stopped"


class Event(Enum):
    STOP = "stop"


TABLE = table([(tuple(State), Event.STOP, (State.STOPPED,))])


def _recorded(name: str) -> Any:
    def call(self: Any, *arguments: Any) -> Any:
        self.calls.append((name, arguments))
        return False

    return call


class Recording(DeviceLogic[State, Event]):
    """A device that has no fault to clear."""

    stop_error = (ErrorCode.EMERGENCY_STOP, "stopped")
    stopped_state = State.STOPPED
    repeats_stop: ClassVar[bool] = False

    def __init__(self) -> None:
        super().__init__(StateMachine(TABLE, State.IDLE), TICK)
        self.calls: list[tuple[str, tuple[Any, ...]]] = []

    def _stop(self, now: Now) -> None:
        self.calls.append(("_stop", (now,)))
        self._machine.move(Event.STOP, State.STOPPED)

    def _healthy(self) -> bool:
        return True

    def _code_of(self, fault: HardwareFault) -> int:
        return ErrorCode.ARM_ALARM

    def _report(self, now: Now) -> Publish:
        return Publish("state", Bool())

    def _urgent_content(self, now: Now) -> tuple[object, ...]:
        return (self.state, self._error)

    def _end_contested(self, why: Any) -> None:
        self.calls.append(("_end_contested", (why,)))

    def names(self) -> list[str]:
        """Return the calls since the last question."""
        names = [name for name, _ in self.calls]
        self.calls.clear()
        return names


ABSTRACT = {name: _recorded(name) for name in Recording.__abstractmethods__}
Device = type("Device", (Recording,), ABSTRACT)
Repeating = type("Repeating", (Recording,), {**ABSTRACT, "repeats_stop": True})


def device(kind: Any = Device) -> Recording:
    made = kind()
    made.on_lifecycle(Configured(cast(Any, None), "the answer"), at(START))
    made.on_lifecycle(Activated(), at(START))
    made.names()
    return cast(Recording, made)


def kinds(effects: Any) -> list[str]:
    return [type(effect).__name__ for effect in effects]


def run(made: Recording, name: str = "move") -> int:
    made._run(name, lambda context: None)
    (job,) = [e.job.number for e in made._drain(at(START)) if isinstance(e, RunJob)]
    return int(job)


def test_only_the_job_under_way_reports_its_progress_and_end() -> None:
    made = device()
    old = run(made)
    new = run(made, "home")
    made.on_job(JobProgress(old, "late"), at(START))
    assert not made.calls
    made.on_job(JobProgress(new, "content"), at(START))
    assert made.calls.pop() == ("_on_job_report", ("home", "content", at(START)))
    made.on_job(JobEnded(old, "result"), at(START))
    assert made.names() == ["_job_superseded"]
    made.on_job(JobEnded(new, "result"), at(START))
    assert made.calls.pop() == ("_job_done", ("home", "result", at(START)))
    made.on_job(JobEnded(new, "result"), at(START))
    assert made.names() == ["_job_superseded"], "a job ends once"


def test_a_new_job_abandons_the_one_under_way() -> None:
    made = device()
    made._run("move", lambda context: None)
    assert "AbandonJob" not in kinds(made._drain(at(START)))
    made._run("home", lambda context: None)
    effects = made._drain(at(START))
    assert [effect.job for effect in effects if isinstance(effect, AbandonJob)] == [1]


@pytest.mark.parametrize("fault", [HardwareFault(FaultReason.TIMEOUT, "late"), ValueError()])
def test_a_fault_is_handled_and_a_defect_stops_the_device(fault: Exception) -> None:
    made = device()
    effects = made.on_job(JobEnded(run(made), None, fault), at(START))
    if isinstance(fault, HardwareFault):
        assert made.names() == ["_job_failed"] and "StopWire" not in kinds(effects)
    else:
        assert made.names() == ["_fail", "_job_superseded"] and "StopWire" in kinds(effects)
        assert made.error[0] == ErrorCode.INTERNAL


@pytest.mark.parametrize("under_way", [True, False])
def test_the_port_is_closed_with_its_job_at_the_end_of_the_node(under_way: bool) -> None:
    made = device()
    job = run(made) if under_way else 0
    made._read_at = -10.0
    effects = made.on_lifecycle(ShutDown(), at(START))
    assert [e.job for e in effects if isinstance(e, AbandonJob)] == ([job] if under_way else [])
    assert made.names() == ["_closed"] and not made.active
    made.on_job(JobEnded(job, "result"), at(START))
    assert made.names() == ["_job_superseded"]
    made.on_tick(at(START + 1.0))
    assert "_time_passed" not in made.names(), "nothing begins in a node that is not configured"


def test_a_reading_is_requested_when_it_is_due_and_nothing_else_runs() -> None:
    made = device()

    def reads(steady: float) -> bool:
        made._read_when_due(0.5, lambda context: None, at(steady))
        return "RunJob" in kinds(made._drain(at(steady)))

    assert reads(START)
    assert not reads(START + 0.6), "the last reading has not ended"
    made.on_job(JobEnded(1, "joints"), at(START + 0.1))
    assert made.names() == ["_read_done"]
    assert not reads(START + 0.44)
    assert reads(START + 0.46), "half a tick early"
    made.on_job(JobEnded(2, "joints"), at(START + 0.5))
    job = run(made)
    assert not reads(START + 2.0), "a command is under way"
    made.on_job(JobEnded(job, None), at(START + 2.0))
    assert reads(START + 2.0)


def test_a_reading_that_ends_during_a_command_or_a_stop_is_discarded() -> None:
    for stops in (True, False):
        made = device()
        made._read_when_due(0.5, lambda context: None, at(START))
        made._drain(at(START))
        if stops:
            made.on_message("emergency_stop", Bool(data=True), at(START))
        else:
            run(made)
        made.names()
        made.on_job(JobEnded(1, "joints"), at(START))
        assert not made.names()


@pytest.mark.parametrize("kind", [Device, Repeating])
def test_a_stop_is_sent_first_and_again_to_a_device_that_may_forget_it(kind: Any) -> None:
    made = device(kind)
    effects = made.on_message("emergency_stop", Bool(data=True), at(START))
    assert kinds(effects)[0] == "StopWire" and made.names() == ["_stop"] and made.stopped
    for seconds in (0.01, 0.02):
        effects = made.on_message("emergency_stop", Bool(data=True), at(START + seconds))
        assert "StopWire" not in kinds(effects), "repeated levels do not fill the line"
    effects = made.on_message("emergency_stop", Bool(data=True), at(START + 5.0))
    assert ("StopWire" in kinds(effects)) == (kind is Repeating)
    effects = made.on_message("emergency_stop", Bool(data=False), at(START + 9.0))
    assert "StopWire" not in kinds(effects) and made.stopped and not made.names()


def test_a_conflict_ends_what_is_contested_and_is_shown() -> None:
    made = device()
    effects = made.on_conflict("two arms", at(START))
    assert made.names() == ["_end_contested"] and "Log" in kinds(effects)
    assert made._shown_error(at(START)) == (ErrorCode.CONFIGURATION_CONFLICT, "two arms")
    made._set_error(ErrorCode.ARM_ALARM, "alarm 1")
    assert made._shown_error(at(START))[0] == ErrorCode.ARM_ALARM, "its own fault comes first"
    made._set_error(ErrorCode.CONFIGURATION_CONFLICT, "an earlier conflict")
    assert made._shown_error(at(START))[1] == "two arms"
    logged = [each.sentence for each in made._drain(at(START)) if isinstance(each, Log)]
    assert logged == ["alarm 1", "an earlier conflict"]
    made._set_error(ErrorCode.CONFIGURATION_CONFLICT, "an earlier conflict")
    effects = made.on_conflict("", at(START))
    assert not made.names() and not [each for each in effects if isinstance(each, Log)]
    assert made._shown_error(at(START))[1] == "an earlier conflict"


@pytest.mark.parametrize("event", [Activated(), Deactivated()])
@pytest.mark.parametrize("stopped", [True, False])
def test_a_stopped_device_begins_nothing_when_it_is_activated(event: Any, stopped: bool) -> None:
    made = device()
    if stopped:
        made.on_message("emergency_stop", Bool(data=True), at(START))
    made.names()
    made.on_lifecycle(event, at(START))
    activates = isinstance(event, Activated)
    assert made.active == activates
    expected = ([] if stopped else ["_activated"]) if activates else ["_deactivated"]
    assert made.names() == expected


def test_a_device_that_is_configured_during_a_stop_is_stopped_first() -> None:
    made = Device()
    made.on_message("emergency_stop", Bool(data=True), at(START))
    made.names()
    effects = made.on_lifecycle(Configured(cast(Any, None), "the answer"), at(START))
    assert kinds(effects)[0] == "StopWire" and made.names() == ["_configured_with", "_stop"]
    (state,) = [e.message for e in effects if isinstance(e, Publish) and e.topic == "~/stop_state"]
    assert cast(StopState, state).stopped


def test_an_unreachable_device_is_tried_with_more_patience_and_named() -> None:
    made = Device()
    silent = HardwareFault(FaultReason.TIMEOUT, "no answer")
    before = made.patience
    made.on_lifecycle(Unreachable(silent), at(START))
    assert made.error == (ErrorCode.ARM_ALARM, "no answer")
    assert made.patience == patience_after(before, silent) >= before
    assert patience_after(8.0, None) == patience_after(0.1, None)


def answers(effects: Any) -> list[tuple[Any, bool]]:
    return [
        (each.token, cast(Trigger.Response, each.response).success)
        for each in effects
        if isinstance(each, Answer)
    ]


def test_clearing_asks_for_the_levels_of_the_stop_first() -> None:
    made = device()
    request = Trigger.Request()
    assert answers(made.on_request("~/clear_fault", request, cast(Any, 1), at(START))) == [
        (1, True)
    ], "there is nothing to clear"
    effects = made.on_request("~/stop", request, cast(Any, 2), at(START))
    assert kinds(effects)[0] == "StopWire" and answers(effects) == [(2, True)]
    effects = made.on_request("~/clear_fault", request, cast(Any, 3), at(START))
    (asked,) = [each for each in effects if isinstance(each, AskStops)]
    assert not answers(effects)
    # The node was shut down meanwhile.
    made.on_lifecycle(ShutDown(), at(START))
    effects = made.on_answer(asked.token, None, at(START))
    assert answers(effects) == [(3, False)]
    assert not answers(made.on_answer(asked.token, None, at(START))), "it is answered once"
