"""All boards of a cell as one device: at most one board is charged at any time, regardless of what
the other boards reply."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import pytest
from hardware_faults import expect_fault
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome, FireResult, TapperCounters, TapperDriver
from tapping_cell.hardware.tapper_boards import (
    CHANNELS_PER_BOARD,
    OTHERS_ASKED_S,
    TapperBoards,
    cell_channel,
    numbered,
)
from tapping_cell.hardware.tapper_protocol import Mode, Reply, Result, State


def reply(
    state: State = State.SAFE,
    shot: int = 0,
    interlock: bool = True,
    stopped: bool = False,
    channels: int = 4,
    at_mounts: int = 0b1111,
) -> Reply:
    return Reply(
        1, 1, Result.OK, state, shot, 0.0, interlock, stopped, 0, None, 1, 0, Mode.RUN, False,
        channels=channels, at_mounts=at_mounts,
    )  # fmt: skip


class Board:
    """Driver of one board with scripted replies that records the calls."""

    def __init__(self, answer: Reply) -> None:
        self.answer, self.calls = answer, list[str]()
        self.port, self.version, self.counters = "port", "2.1", TapperCounters()
        self.last_reply: Reply | None = answer
        self.fault: HardwareFault | None = None

    def _note(self, call: str) -> Reply:
        self.calls.append(call)
        if self.fault is not None:
            raise self.fault
        return self.answer

    def status(self) -> Reply:
        return self._note("status")

    def discharge(self) -> Reply:
        return self._note("discharge")

    def clear(self, timeout: float) -> Reply:
        return self._note("clear")

    def close(self) -> None:
        self.calls.append("close")

    def connect(self, timeout: float) -> Reply:
        return self._note("connect")

    def charge(self, shot: int, energy: float, *_: object) -> Reply:
        return self._note("charge")

    def fire(self, shot: int, *_: object) -> FireResult:
        self._note("fire")
        return FireResult(FireOutcome.FIRED, shot)

    def now(self) -> float:
        return 0.0

    def stop(self) -> bool:
        self.calls.append("stop")
        return self.port != "lost"


def device(*boards: Board) -> TapperBoards:
    return TapperBoards([cast(TapperDriver, board) for board in boards])


replies = st.builds(
    reply, st.sampled_from(State), st.integers(0, 200), st.booleans(), st.booleans()
)


@given(st.lists(replies, min_size=1, max_size=3), st.integers(0, 3))
def test_a_board_is_charged_and_fired_only_while_all_others_are_at_rest(others, place):
    board = min(place, len(others))
    boards = [Board(one) for one in [*others[:board], reply(), *others[board:]]]
    rest = all(
        one.state is State.SAFE and one.interlock_closed and not one.stop_latched for one in others
    )
    new = all(one.shot < 100 for one in others)
    cell = device(*boards)
    if rest and new:
        cell.charge(100, 0.1, channel=cell_channel(board, 3))
        assert boards[board].calls == ["charge"]
    else:
        with pytest.raises(HardwareFault) as met:
            cell.charge(100, 0.1, channel=cell_channel(board, 3))
        assert "charge" not in boards[board].calls
        if rest:
            assert met.value.reason is FaultReason.SHOT_SPENT
    cell._charged = board
    if rest:
        assert cell.fire(100, 0.04, lambda _: True).outcome is FireOutcome.FIRED
    else:
        with pytest.raises(HardwareFault):
            cell.fire(100, 0.04, lambda _: True)
        assert "fire" not in boards[board].calls
        assert boards[board].calls[-1] == "discharge"
    assert not any(
        {"charge", "fire"} & set(one.calls) for one in boards if one is not boards[board]
    )


class SlowBoard(Board):
    """A board whose driver is delayed by ``delay`` s before the last check."""

    def __init__(self, delay: float) -> None:
        super().__init__(reply())
        self.time, self.delay = 0.0, delay

    def now(self) -> float:
        return self.time

    def fire(self, shot: int, *arguments: object) -> FireResult:
        _, still_allowed = cast(tuple[float, Callable[[float], bool]], arguments)
        self.time += self.delay
        outcome = FireOutcome.FIRED if still_allowed(0.0) else FireOutcome.NOT_FIRED
        return FireResult(outcome, shot)


@pytest.mark.parametrize("late", [True, False])
@pytest.mark.parametrize("allowed", [True, False])
def test_replies_of_the_other_boards_that_are_too_old_are_named_as_the_cause(late, allowed):
    cell = device(SlowBoard(OTHERS_ASKED_S + (0.05 if late else -0.05)), Board(reply()))
    result = cell.fire(100, 0.04, lambda _: allowed)
    assert (result.outcome is FireOutcome.FIRED) == (allowed and not late)
    if late:
        assert result.fault is not None and result.fault.reason is FaultReason.TIMEOUT
        assert "0.150 s old" in result.sentence and "limit 0.100 s" in result.sentence
    else:
        assert result.fault is None


@given(st.lists(replies, min_size=1, max_size=4))
def test_the_merged_reply_hides_no_fault_of_any_board(answers: list[Reply]) -> None:
    merged = device(*map(Board, answers)).status()
    assert merged.interlock_closed == all(one.interlock_closed for one in answers)
    assert merged.stop_latched == any(one.stop_latched for one in answers)
    assert (merged.state is State.SAFE) == all(one.state is State.SAFE for one in answers)
    assert merged.shot == max(one.shot for one in answers)
    for board, one in enumerate(answers):
        for channel in range(4):
            bit = merged.at_mounts >> cell_channel(board, channel) & 1
            assert bit == one.at_mounts >> channel & 1


def test_one_board_without_switches_leaves_all_mounts_unverified() -> None:
    merged = device(Board(reply()), Board(reply(channels=1, at_mounts=0))).status()
    assert (merged.channels, merged.at_mounts) == (1, 0)


def test_a_fault_of_one_board_does_not_block_discharge_clear_or_stop_of_the_others() -> None:
    boards = [Board(reply()), Board(reply())]
    boards[0].fault = HardwareFault(FaultReason.TIMEOUT, "no answer")
    boards[0].port = "lost"
    cell = device(*boards)
    for act in (cell.discharge, cell.clear):
        with pytest.raises(HardwareFault, match="no answer"):
            act()
    assert not cell.stop()
    assert boards[0].calls == boards[1].calls == ["discharge", "clear", "stop"]


def test_an_unreachable_board_closes_all_boards() -> None:
    boards = [Board(reply()), Board(reply())]
    boards[1].fault = HardwareFault(FaultReason.PORT_MISSING, "not there")
    with pytest.raises(HardwareFault, match="not there"):
        device(*boards).connect()
    assert [board.calls[-1] for board in boards] == ["close", "close"]


def test_a_channel_of_a_board_that_does_not_exist_is_refused() -> None:
    with expect_fault(FaultReason.SETTINGS_MISMATCH):
        device(Board(reply())).charge(1, 0.1, channel=CHANNELS_PER_BOARD)


def test_the_ports_of_further_boards_are_numbered() -> None:
    assert [numbered("tapper", board) for board in range(3)] == ["tapper", "tapper_1", "tapper_2"]
    assert numbered("", 1) == ""
