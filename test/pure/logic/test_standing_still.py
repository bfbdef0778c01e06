"""The arm's promise to stand still, and its wait for a charged striker."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from logic_parts import at

from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic import permit
from tapping_cell.logic.standing_still import DISCHARGED_S, LONGEST_WAIT_S, StandingStill
from tapping_cell.messages import ErrorCode, HoldStill, TapperState

CELL = load_cell()
LONGEST = permit.longest_hold(CELL)
TAP = 7
START = 100.0


def standing() -> StandingStill:
    made = StandingStill()
    made.configure(CELL, at(START - permit.LONGEST_HOLD_S))
    return made


def tapper(state: int, outcome: int = TapperState.NONE, tap_id: int = TAP) -> TapperState:
    return TapperState(state=state, outcome=outcome, tap_id=tap_id)


def test_after_a_restart_the_longest_promise_of_an_earlier_process_is_kept() -> None:
    made = StandingStill()
    made.configure(CELL, at(START))
    assert made.free_at(at(START)) == START + permit.LONGEST_HOLD_S
    made.configure(CELL, at(START - 50.0))
    assert made.free_at(at(START)) == START + permit.LONGEST_HOLD_S, "a promise is never shortened"


@pytest.mark.parametrize(
    ("duration", "granted"),
    [(-0.1, 0), (0.0, 0), (1e-6, 1), (LONGEST, 1), (LONGEST + 1e-6, 0), (math.nan, 0)],
)
def test_a_promise_has_a_positive_and_limited_duration(duration: float, granted: int) -> None:
    error = standing().duration_error(HoldStill.Request(tap_id=TAP, duration=duration))
    assert (error is None) == bool(granted)
    assert error is None or error[0] == ErrorCode.COMMAND_INVALID


@given(st.lists(st.tuples(st.floats(0.0, 5.0), st.floats(0.01, LONGEST)), min_size=1, max_size=5))
def test_the_arm_stands_still_until_the_last_of_its_promises_ends(promises):
    made = standing()
    for since, duration in promises:
        request = HoldStill.Request(tap_id=TAP, duration=duration)
        response = made.promise(request, at(START + since))
        assert response.granted and response.duration == duration
    end = max(START + since + duration for since, duration in promises)
    assert made.until == pytest.approx(end)
    assert made.free_at(at(START)) == pytest.approx(end)


@pytest.mark.parametrize("state", [TapperState.CHARGING, TapperState.CHARGED, TapperState.FIRING])
def test_the_arm_waits_for_a_charged_striker_but_not_for_ever(state: int) -> None:
    made = standing()
    assert not made.on_tapper_state(tapper(state), TAP, True, at(START))
    assert made.free_at(at(START)) == START + DISCHARGED_S
    assert made.waits_for_striker(START, at(START + DISCHARGED_S - 0.01))
    assert not made.waits_for_striker(START, at(START + DISCHARGED_S + 0.01))
    # A tapper that reports a charged striker for ever delays a motion only so long.
    later = START + 10.0
    made.on_tapper_state(tapper(state), TAP, True, at(later))
    assert not made.waits_for_striker(later - LONGEST_WAIT_S - 0.01, at(later))
    assert made.waits_for_striker(later - LONGEST_WAIT_S + 0.01, at(later))
    assert made.free_at(at(later - 5.0)) == later - 5.0 + LONGEST_WAIT_S


@pytest.mark.parametrize("outcome", [TapperState.FIRED, TapperState.NOT_FIRED])
@pytest.mark.parametrize("trusted", [True, False])
def test_a_safe_tapper_that_reports_the_outcome_ends_the_wait(outcome: int, trusted: bool) -> None:
    made = standing()
    made.on_tapper_state(tapper(TapperState.CHARGED), TAP, True, at(START))
    ended = made.on_tapper_state(tapper(TapperState.SAFE, outcome), TAP, trusted, at(START))
    assert ended == trusted
    assert made.waits_for_striker(START, at(START + 0.1)) == (not trusted)
    # The tap is over: no promise for it, and no further message about it counts.
    error = made.repetition_error(HoldStill.Request(tap_id=TAP, duration=0.1))
    assert error is not None and error[0] == ErrorCode.COMMAND_REPEATED
    assert made.repetition_error(HoldStill.Request(tap_id=TAP + 1, duration=0.1)) is None
    made.on_tapper_state(tapper(TapperState.CHARGED), TAP, True, at(START + 50.0))
    assert not made.waits_for_striker(START + 50.0, at(START + 50.0))


@pytest.mark.parametrize(
    "message",
    [
        tapper(TapperState.SAFE),
        tapper(TapperState.SAFE, TapperState.UNKNOWN),
        tapper(TapperState.SAFE, TapperState.FIRED, TAP - 1),
        tapper(TapperState.SAFE, TapperState.FIRED, 0),
        tapper(TapperState.FAULT, TapperState.FIRED),
    ],
)
def test_no_other_message_ends_the_wait(message: TapperState) -> None:
    made = standing()
    made.on_tapper_state(tapper(TapperState.CHARGED), TAP, True, at(START))
    assert not made.on_tapper_state(message, TAP, True, at(START))
    assert made.waits_for_striker(START, at(START + 0.1))


@pytest.mark.parametrize("tap_id", [0, TAP - 1])
def test_a_striker_charged_for_another_tap_does_not_delay_the_arm(tap_id: int) -> None:
    made = standing()
    made.on_tapper_state(tapper(TapperState.CHARGED, tap_id=tap_id), TAP, True, at(START))
    assert not made.waits_for_striker(START, at(START))


def test_without_a_tap_a_charged_striker_does_not_delay_the_arm() -> None:
    made = standing()
    for _ in range(2):
        made.on_tapper_state(tapper(TapperState.CHARGED, tap_id=0), 0, True, at(START))
        assert not made.waits_for_striker(START, at(START))
        made.on_tapper_state(tapper(TapperState.SAFE, TapperState.FIRED), TAP, True, at(START))
