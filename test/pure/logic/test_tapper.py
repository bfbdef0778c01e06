"""How the tapper ends a tap whose job fails, and what it reports afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest
from test_charging import charged_while_lowered, waiting
from test_permit import CELL, START, TAP, at, board, jobs

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic.effects import JobEnded, RunJob
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.logic.tapper import PROVE_PERIOD_S, TapperLogic, TapperOptions
from tapping_cell.logic.tapper_jobs import FireEnd, Status
from tapping_cell.logic.tapper_states import Charging, Discharging, Firing, State, Tap
from tapping_cell.messages import ErrorCode, TapperState, Trigger

FIXED = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")


def serving(kind: type, state: State) -> TapperLogic:
    """Return a tapper in a state of the tap's cycle, whose job under way is number 99."""
    tapper = waiting()
    tap = cast(Tap, tapper._serving.tap)  # type: ignore[union-attr]
    more = {"still_until": START + 1.0} if kind is Firing else {}
    tapper._serving = kind(tap=tap, **more)
    tapper._machine._state = state
    tapper._job, tapper._job_name = 99, "charge"
    return tapper


def fails(tapper: TapperLogic, name: str, reason: FaultReason) -> list[str]:
    """Let the job under way fail; return the names of the jobs that follow."""
    tapper._job_name = name
    fault = HardwareFault(reason, "the fault's sentence")
    effects = tapper.on_job(JobEnded(99, None, fault), at(START))
    return [effect.job.name for effect in effects if isinstance(effect, RunJob)]


def test_a_guard_that_is_opened_during_charging_ends_the_tap() -> None:
    tapper = serving(Charging, State.CHARGING)
    assert fails(tapper, "charge", FaultReason.INTERLOCK) == ["discharge"]
    record = tapper._serving
    assert isinstance(record, Discharging) and record.given_up is not None
    assert record.given_up == (ErrorCode.TAPPER_INTERLOCK_OPEN, "the fault's sentence")


@pytest.mark.parametrize(("name", "again"), [("charge", ["discharge"]), ("discharge", [])])
def test_a_refused_charge_of_a_tap_that_is_over_is_discharged_once(name, again) -> None:
    tapper = serving(Discharging, State.DISCHARGING)
    assert fails(tapper, name, FaultReason.INTERLOCK) == again
    assert (tapper.state is State.DISCHARGING) == (name == "charge")


@pytest.mark.parametrize(
    ("reason", "state"),
    [
        (FaultReason.TIMEOUT, State.DISCONNECTED),
        (FaultReason.STOPPED, State.STOPPED),
        (FaultReason.PROTOCOL, None),
    ],
)
def test_a_lost_board_ends_the_tap_unfired(reason: FaultReason, state: Any) -> None:
    tapper = serving(Charging, State.CHARGING)
    fails(tapper, "charge", reason)
    assert state is None or tapper.state is state
    assert tapper._serving is None and tapper._last.outcome == TapperState.NOT_FIRED
    assert tapper.error[1] == "the fault's sentence"


def test_another_firmware_is_tried_again() -> None:
    for name, state in (("connect", State.DISCONNECTED), ("clear", State.FAULT)):
        tapper = TapperLogic(TapperOptions())
        tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), at(START))
        tapper._job = 99
        patience = tapper.patience
        fails(tapper, name, FaultReason.UNKNOWN_FIRMWARE)
        assert tapper.state is state
        assert tapper.patience >= patience


@pytest.mark.parametrize("fault", [None, HardwareFault(FaultReason.TIMEOUT, "then it was lost")])
@pytest.mark.parametrize("outcome", list(FireOutcome))
def test_the_outcome_of_a_shot_is_reported_before_a_later_fault(outcome, fault) -> None:
    tapper = serving(Firing, State.FIRING)
    status = None if fault else Status(board(BoardState.SAFE, TAP), 1)
    end = FireEnd(TAP, outcome, "why", None, None, status, fault)
    tapper._job_name = "fire"
    tapper.on_job(JobEnded(99, end), at(START))
    assert tapper._last.outcome == getattr(TapperState, outcome.name)
    code, sentence = tapper.error
    if outcome is FireOutcome.UNKNOWN:
        assert (code, sentence) == (ErrorCode.TAPPER_OUTCOME_UNKNOWN, "why")
    elif outcome is FireOutcome.NOT_FIRED:
        assert (code, sentence) == (ErrorCode.TAPPER_FAULT, "why")
    else:
        assert sentence == ("then it was lost" if fault else "")
    assert tapper.state is (State.DISCONNECTED if fault else State.SAFE)


@pytest.mark.parametrize("job", ["connect", "clear"])
def test_an_unknown_outcome_is_shown_until_a_person_clears_it(job: str) -> None:
    tapper = TapperLogic(TapperOptions())
    tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), at(START))
    tapper.on_lifecycle(Activated(), at(START))
    tapper._machine._state = State.DISCONNECTED if job == "connect" else State.CLEARING
    tapper._error = (ErrorCode.TAPPER_OUTCOME_UNKNOWN, "it is unknown")
    tapper._job, tapper._job_name = 99, job
    tapper.on_job(JobEnded(99, Status(board(BoardState.SAFE), 0)), at(START))
    assert tapper.state is State.SAFE
    assert (tapper.error[0] == ErrorCode.NONE) == (job == "clear")


def test_a_tapper_that_works_has_nothing_to_clear() -> None:
    for tapper in (waiting(), charged_while_lowered()[0]):
        effects = tapper.on_request("~/clear_fault", Trigger.Request(), cast(Any, 1), at(START))
        assert "RunJob" not in [type(effect).__name__ for effect in effects]
    tapper = waiting()
    tapper._serving, tapper._machine._state = None, State.FAULT
    effects = tapper.on_request("~/clear_fault", Trigger.Request(), cast(Any, 1), at(START))
    assert [effect.job.name for effect in effects if isinstance(effect, RunJob)] == ["clear"]


def test_a_lost_board_is_connected_ten_times_a_second_and_one_at_a_time() -> None:
    tapper = TapperLogic(TapperOptions())
    tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), at(START))
    tapper._machine._state = State.DISCONNECTED
    began = []
    for step in range(5):
        now = at(START + 0.05 * step)
        began.append(len(jobs(tapper.on_tick(now))))
        if began[-1]:
            tapper._job = None
    assert began == [1, 0, 1, 0, 1]
    tapper.on_tick(at(START + 1.0))
    assert not jobs(tapper.on_tick(at(START + 2.0))), "the last attempt has not ended"


def test_the_mounts_of_fixed_tappers_are_proven_until_they_are() -> None:
    tapper = TapperLogic(TapperOptions())
    count = len(FIXED.tapper_channels)
    reply = replace(board(BoardState.UNHOMED), channels=count, at_mounts=2**count - 1)
    tapper.on_lifecycle(Configured(FIXED, reply), at(START))
    tapper.on_lifecycle(Activated(), at(START))

    def proves(steady: float) -> bool:
        effects = tapper.on_tick(at(steady))
        names = [effect.job.name for effect in effects if isinstance(effect, RunJob)]
        tapper._job = tapper._reading = None
        return "prove" in names

    assert proves(START)
    assert not proves(START + PROVE_PERIOD_S - 0.01)
    assert proves(START + PROVE_PERIOD_S + 0.01)
    tapper._board.take_in(Status(replace(reply, state=BoardState.SAFE), 0))
    assert not proves(START + 9.0)
