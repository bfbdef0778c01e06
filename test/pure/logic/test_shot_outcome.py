"""The outcome of a shot when two replies from the board contradict each other, or when a stop, a
defect or a shutdown of the node occurs during the shot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_permit import CELL, START, TAP, Pair, at, board, jobs, messages

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, FireResult
from tapping_cell.hardware.tapper_protocol import Reply
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import tapper_jobs
from tapping_cell.logic.effects import Answer, Effect, JobContext, JobEnded, StopWire
from tapping_cell.logic.host import Configured, ShutDown
from tapping_cell.logic.tapper import TapperLogic
from tapping_cell.logic.tapper_jobs import FireEnd, Status
from tapping_cell.messages import ErrorCode, TapCommand, TapperState

SHOT = 7
STOPPED = HardwareFault(FaultReason.STOPPED, "a stop is latched")
PROGRAM_ERROR = ValueError("a defect")


class Line:
    """A driver with given replies, one of which may be forged."""

    def __init__(self, reported: FireOutcome, last_fired: int) -> None:
        self.counters = SimpleNamespace(fired=0)
        self.last_reply: Reply | None = None
        self._reported, self._last_fired = reported, last_fired

    def fire(self, shot: int, window: float, allowed: Callable[[float], bool]) -> FireResult:
        return FireResult(self._reported, shot)

    def status(self) -> Reply:
        return replace(board(BoardState.SAFE, SHOT), last_fired=self._last_fired)


@given(st.sampled_from(FireOutcome), st.sampled_from([0, SHOT - 1, SHOT]))
def test_an_outcome_that_the_board_does_not_confirm_is_unknown(reported, last_fired):
    context = cast(JobContext, SimpleNamespace(driver=Line(reported, last_fired)))
    end = tapper_jobs.fire(context, SHOT, lambda release_by, now: None, post_replies=False)
    agrees = (reported is FireOutcome.FIRED) == (last_fired == SHOT)
    assert end.outcome is (reported if agrees else FireOutcome.UNKNOWN)
    assert agrees or reported is FireOutcome.UNKNOWN or "contradict" in end.sentence


@given(st.booleans(), st.booleans())
def test_a_shot_is_fired_only_if_its_last_check_allows_it_and_its_job_goes_on(refused, abandoned):
    asked: list[bool] = []
    now = at(START)
    refusal = (ErrorCode.ARM_SILENT, "for this test")
    line = Line(FireOutcome.NOT_FIRED, 0)
    line.fire = lambda shot, window, allowed: (  # type: ignore[method-assign]
        asked.append(allowed(START + 0.1)) or FireResult(FireOutcome.NOT_FIRED, shot)
    )
    context = SimpleNamespace(
        driver=line, ask=lambda query: query(now), abandoned=lambda: abandoned
    )
    check = lambda release_by, _: refusal if refused else None  # noqa: E731
    end = tapper_jobs.fire(cast(JobContext, context), SHOT, check, post_replies=False)
    assert asked == [not (refused or abandoned)]
    assert end.refusal == (refusal if refused else None)


def charged() -> tuple[TapperLogic, Callable[[], list[Effect]]]:
    """Return a tapper that waits for the arm's answer to ``hold_still``, and a function that lets
    the tapper receive this answer."""
    pair = Pair()
    call = pair.begin()
    made = pair.arm.on_request("hold_still", call.request, 1, at(START + 0.002))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    answered = at(START + 0.004)
    return pair.tapper, lambda: pair.tapper.on_answer(call.token, answer.response, answered)


def firing() -> tuple[TapperLogic, int]:
    """Return a tapper that fires, and the number of the job of its shot."""
    tapper, receive_answer = charged()
    (fire,) = jobs(receive_answer())
    return tapper, fire


def idle() -> TapperLogic:
    pair = Pair()
    pair.configure_tapper(at(START))
    return pair.tapper


def reported(tapper: TapperLogic, steady: float) -> TapperState:
    (state,) = messages(tapper.on_tick(at(steady)), "tapper_state")
    return state


def stop(tapper: TapperLogic) -> None:
    tapper.on_request("~/stop", None, 1, at(START + 0.01))


def defect(tapper: TapperLogic) -> None:
    tapper.on_defect(PROGRAM_ERROR, at(START + 0.01))


FIRED = FireEnd(TAP, FireOutcome.FIRED, "", None, None, None, None)
each_end = pytest.mark.parametrize(
    ("end", "outcome"),
    [
        ({"fault": STOPPED}, TapperState.NOT_FIRED),
        ({"fault": PROGRAM_ERROR}, TapperState.UNKNOWN),
        ({"result": FIRED}, TapperState.FIRED),
    ],
    ids=["stopped", "program error", "fired"],
)
"""Each way in which the job of a shot can end, with the outcome of the shot."""


@pytest.mark.parametrize("interruptions", [(stop,), (stop, stop), (defect,), (stop, defect)])
@each_end
def test_a_shot_that_is_interrupted_gets_its_true_outcome(interruptions, end, outcome):
    tapper, fire = firing()
    for interrupt in interruptions:
        interrupt(tapper)
    assert reported(tapper, START + 0.02).outcome == TapperState.NONE
    tapper.on_job(JobEnded(fire, **end), at(START + 0.1))
    assert reported(tapper, START + 0.11).outcome == outcome


def test_a_shot_whose_job_ends_by_a_program_error_may_have_been_fired() -> None:
    tapper, fire = firing()
    tapper.on_job(JobEnded(fire, fault=PROGRAM_ERROR), at(START + 0.1))
    state = reported(tapper, START + 0.11)
    assert (state.state, state.outcome) == (TapperState.FAULT, TapperState.UNKNOWN)
    assert state.error_code == ErrorCode.INTERNAL


@each_end
def test_a_shot_whose_end_meets_a_program_error_gets_its_true_outcome(end, outcome):
    tapper, fire = firing()
    made = tapper.on_defect(PROGRAM_ERROR, at(START + 0.1), JobEnded(fire, **end))
    assert any(isinstance(effect, StopWire) for effect in made)
    state = reported(tapper, START + 0.11)
    assert (state.state, state.outcome) == (TapperState.FAULT, outcome)
    assert state.error_code == ErrorCode.INTERNAL


@pytest.mark.parametrize("fails", ["_begin", "_drain"])
def test_a_tap_whose_shot_was_not_begun_because_of_a_program_error_was_not_fired(
    monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    """The program error occurs before or after the job of the shot was created."""
    tapper, receive_answer = charged()
    with monkeypatch.context() as broken:
        broken.setattr(tapper, fails, raise_error)
        with pytest.raises(ValueError, match="defect"):
            receive_answer()
    assert not jobs(tapper.on_defect(PROGRAM_ERROR, at(START + 0.004)))
    assert reported(tapper, START + 0.01).outcome == TapperState.NOT_FIRED


def test_a_program_error_before_charging_ends_the_tap() -> None:
    pair = Pair()
    pair.configure_tapper(at(START))
    pair.tapper.on_message("tap_command", pair.command(TapCommand.TAP, at(START)), at(START))
    defect(pair.tapper)
    state = reported(pair.tapper, START + 0.02)
    assert (state.tap_id, state.outcome) == (TAP, TapperState.NOT_FIRED)


def raise_error(*_: object) -> None:
    raise PROGRAM_ERROR


@pytest.mark.parametrize("stopped", [False, True])
def test_a_shot_during_which_the_node_is_closed_may_have_been_fired(stopped: bool) -> None:
    """The outcome of the shot replaces UNKNOWN if the host still reports the end of the shot."""
    tapper, fire = firing()
    if stopped:
        stop(tapper)
    tapper.on_lifecycle(ShutDown(), at(START + 0.02))
    assert reported(tapper, START + 0.03).outcome == TapperState.UNKNOWN
    tapper.on_job(JobEnded(fire, FIRED), at(START + 0.1))
    assert reported(tapper, START + 0.11).outcome == TapperState.FIRED


def test_a_refused_tap_does_not_hide_the_outcome_of_the_shot_under_way() -> None:
    tapper, fire = firing()
    stop(tapper)
    other = replace(Pair().command(TapCommand.TAP, at(START)), tap_id=TAP + 1)
    tapper.on_message("tap_command", other, at(START + 0.02))
    assert reported(tapper, START + 0.03).tap_id == TAP
    tapper.on_job(JobEnded(fire, FIRED), at(START + 0.1))
    state = reported(tapper, START + 0.11)
    assert (state.tap_id, state.outcome) == (TAP, TapperState.FIRED)
    # With the outcome known, a refused tap is reported again.
    tapper.on_message("tap_command", replace(other, tap_id=TAP + 2), at(START + 0.2))
    state = reported(tapper, START + 0.21)
    assert (state.tap_id, state.outcome) == (TAP + 2, TapperState.NOT_FIRED)


def test_a_read_that_ends_after_a_defect_does_not_replace_its_report() -> None:
    tapper = idle()
    (read,) = jobs(tapper.on_tick(at(START + 1.0)))
    defect(tapper)
    tapper.on_job(JobEnded(read, fault=STOPPED), at(START + 1.1))
    state = reported(tapper, START + 1.2)
    assert (state.state, state.error_code) == (TapperState.FAULT, ErrorCode.INTERNAL)


@pytest.mark.parametrize("latched", [True, False])
def test_a_node_can_be_configured_again_after_a_stop_at_the_board(latched: bool) -> None:
    """``latched``: whether the board still reports its stop when the node is configured again."""
    tapper = idle()
    (read,) = jobs(tapper.on_tick(at(START + 1.0)))
    pressed = replace(board(BoardState.STOPPED), stop_latched=True)
    tapper.on_job(JobEnded(read, Status(pressed, 0)), at(START + 1.0))
    tapper.on_lifecycle(ShutDown(), at(START + 1.1))
    assert reported(tapper, START + 1.2).state == TapperState.DISCONNECTED
    answer = pressed if latched else board(BoardState.SAFE)
    tapper.on_lifecycle(Configured(CELL, answer), at(START + 1.3))
    state = reported(tapper, START + 1.4)
    assert state.state == (TapperState.STOPPED if latched else TapperState.SAFE)
    assert state.error_code == (ErrorCode.TAPPER_STOPPED if latched else ErrorCode.NONE)
