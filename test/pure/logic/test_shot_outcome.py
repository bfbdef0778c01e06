"""The outcome of a shot when two replies from the board contradict each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

from hypothesis import given
from hypothesis import strategies as st
from test_permit import board

from tapping_cell.hardware.tapper import FireOutcome, FireResult
from tapping_cell.hardware.tapper_protocol import Reply
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import tapper_jobs
from tapping_cell.logic.effects import JobContext

SHOT = 7


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
def test_an_outcome_that_the_board_does_not_confirm_is_unknown(
    reported: FireOutcome, last_fired: int
) -> None:
    context = cast(JobContext, SimpleNamespace(driver=Line(reported, last_fired)))
    end = tapper_jobs.fire(context, SHOT, lambda release_by, now: None, post_replies=False)
    agrees = (reported is FireOutcome.FIRED) == (last_fired == SHOT)
    assert end.outcome is (reported if agrees else FireOutcome.UNKNOWN)
    assert agrees or reported is FireOutcome.UNKNOWN or "contradict" in end.sentence
