"""What the tapper's node concludes from the replies of its boards."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from logic_parts import board_reply

from tapping_cell.hardware.tapper_protocol import Mode, State
from tapping_cell.logic.tapper_board import LastTap, TapperBoard, why_not_charged
from tapping_cell.logic.tapper_jobs import Status
from tapping_cell.messages import ErrorCode, TapperState

NAMES = ("north", "east", "south")
MOVING = (State.RELEASING, State.DISCHARGING)
SHOT = 7


def fixed() -> TapperBoard:
    return TapperBoard(channels={name: number for number, name in enumerate(NAMES)}, is_fixed=True)


def status(state: State, at_mounts: int = 0b111, channels: int = 3, closed: bool = True) -> Status:
    reply = replace(
        board_reply(state, SHOT), channels=channels, at_mounts=at_mounts, interlock_closed=closed
    )
    return Status(reply, fired=5)


@given(st.sampled_from(State), st.integers(0, 0b111))
def test_a_striker_whose_switch_is_open_is_away(state: State, at_mounts: int) -> None:
    """A board that moves its strikers may report open switches only for a moment."""
    board = fixed()
    board.take_in(status(state, at_mounts))
    away = tuple(name for number, name in enumerate(NAMES) if not at_mounts >> number & 1)
    assert board.mounts.fitted
    assert board.mounts.away == (away if state not in MOVING or at_mounts == 0 else ())
    assert board.mounts.proven == (state not in (State.UNHOMED, State.HOMING))
    assert board.mounts_proven == board.mounts.proven


def test_while_strikers_move_the_last_ones_that_were_away_remain() -> None:
    board = fixed()
    board.take_in(status(State.SAFE, 0b110))
    for state in MOVING:
        board.take_in(status(state, 0b111))
        assert board.mounts.away == ("north",)
    board.take_in(status(State.SAFE, 0b111))
    assert board.mounts.away == ()


@pytest.mark.parametrize(
    ("channels", "at_mounts", "fitted"), [(1, 0, False), (1, 1, True), (2, 0, True), (2, 3, True)]
)
def test_mounts_have_switches_if_there_are_several_or_one_is_closed(channels, at_mounts, fitted):
    board = fixed()
    board.take_in(status(State.SAFE, at_mounts, channels))
    assert board.mounts.fitted == fitted and board.mounts_proven == fitted
    assert bool(board.mounts.away) == (fitted and at_mounts != 0b111)


def test_an_arm_needs_no_proof_of_its_mount() -> None:
    board = TapperBoard(channels={"tapper": 0})
    board.take_in(status(State.SAFE, 0, 1))
    assert board.mounts_proven and not board.wants_proof and board.mounts.away == ()


@given(st.sampled_from(State), st.sampled_from([0b111, 0b101]), st.booleans())
def test_strikers_are_proven_only_at_their_mounts_behind_a_closed_guard(state, at_mounts, closed):
    board = fixed()
    board.take_in(status(state, at_mounts, closed=closed))
    unproven = state in (State.UNHOMED, State.HOMING)
    assert board.wants_proof == (unproven and at_mounts == 0b111 and closed)


def test_counters_and_numbers_are_those_of_the_last_reply() -> None:
    board = fixed()
    board.take_in(Status(replace(board_reply(State.SAFE, SHOT), shot=9, boot=4), fired=5))
    assert (board.used, board.boot_number, board.shots_fired) == (9, 4, 5)
    assert board.interlock_closed
    board.take_in(status(State.SAFE, closed=False))
    assert not board.interlock_closed


@pytest.mark.parametrize(
    ("last_fired", "speed", "noted"),
    [(SHOT, 0.5, 0.5), (SHOT, None, math.nan), (SHOT - 1, 0.5, math.nan)],
)
def test_a_measured_speed_belongs_to_the_shot_that_was_fired_last(last_fired, speed, noted):
    last = LastTap(measured_speed=0.1)
    last.begin(SHOT, TapperState.NONE)
    assert math.isnan(last.measured_speed) and last.fire_job is None
    last.note_speed(replace(board_reply(State.SAFE), last_fired=last_fired, speed=speed))
    assert last.measured_speed == noted or (math.isnan(noted) and math.isnan(last.measured_speed))


@pytest.mark.parametrize(
    ("tap_id", "outcome", "awaits"),
    [
        (0, TapperState.NONE, False),
        (SHOT, TapperState.NONE, True),
        (SHOT, TapperState.FIRED, False),
        (SHOT, TapperState.UNKNOWN, False),
    ],
)
def test_a_tap_without_an_outcome_is_awaited(tap_id: int, outcome: int, awaits: bool) -> None:
    last = LastTap(fire_job=3)
    last.begin(tap_id, outcome)
    assert last.awaits_outcome() == awaits and last.fire_job is None


def test_a_lost_charge_is_explained_by_guard_switch_or_silence() -> None:
    reply = board_reply(State.SAFE)
    switch, _ = why_not_charged(replace(reply, mode=Mode.SETUP, energy=9.0))
    assert switch == ErrorCode.ENABLING_RELEASED
    guard, _ = why_not_charged(replace(reply, interlock_closed=False))
    silence, sentence = why_not_charged(reply)
    assert (guard, silence) == (ErrorCode.TAPPER_INTERLOCK_OPEN, ErrorCode.TAPPER_FAULT)
    assert "0.5 s" in sentence and "SAFE" in sentence
