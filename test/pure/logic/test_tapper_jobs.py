"""The blocking jobs of the tapper, with a board that answers as told."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from logic_parts import board_reply

from tapping_cell.hardware.tapper import FireOutcome, FireResult
from tapping_cell.hardware.tapper_protocol import Reply, State
from tapping_cell.logic import tapper_jobs
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import JobContext
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.tapper_jobs import ChargeEnd

SHOT = 7
CHARGED, SAFE = board_reply(State.CHARGED, SHOT - 1), board_reply(State.SAFE, SHOT - 1)
FIRST, LATER = (221, "for this test"), (222, "another reason")
CHECKS = 4
"""Number of times at which the board asks whether it may go on."""


class Board:
    """A driver that charges as long as it may."""

    def __init__(self, last: Reply | None = None, after_fire: Reply = SAFE) -> None:
        self.counters = SimpleNamespace(fired=0)
        self.last_reply = last
        self.went_on: list[bool] = []
        self.discharged = 0
        self._after_fire = after_fire

    def charge(self, shot: int, energy: float, go_on: Callable[[], bool], channel: int) -> Reply:
        self.went_on = [go_on() for _ in range(CHECKS)]
        return CHARGED if all(self.went_on) else SAFE

    def home(self, go_on: Callable[[], bool]) -> Reply:
        self.went_on = [go_on()]
        return SAFE

    def fire(self, shot: int, window: float, allowed: Callable[[float], bool]) -> FireResult:
        self.went_on = [allowed(0.0)]
        return FireResult(FireOutcome.NOT_FIRED, shot, "the board's reason")

    def status(self) -> Reply:
        return self._after_fire

    def discharge(self) -> Reply:
        self.discharged += 1
        return SAFE


class Context:
    """A host whose job is abandoned at the check with number ``abandoned_at``."""

    def __init__(self, driver: Board, abandoned_at: int = 99) -> None:
        self.driver, self.posted, self.asked = driver, [], 0  # type: ignore[var-annotated]
        self._abandoned_at = abandoned_at

    def ask(self, query: Callable[[Now], object]) -> object:
        self.asked += 1
        return query(Now(100.0, 10**18))

    def abandoned(self) -> bool:
        return self.asked > self._abandoned_at

    def post(self, content: object) -> None:
        self.posted.append(content)


def charged(context: Context, refused_at: int = 99, post: bool = False) -> ChargeEnd:
    """Charge; the check with this number and the one after it are refused."""

    def check(now: Now) -> CodedError | None:
        return {refused_at: FIRST, refused_at + 1: LATER}.get(context.asked - 1)

    return tapper_jobs.charge(cast(JobContext, context), SHOT, 1.0, 0, check, post)


@given(st.integers(0, CHECKS + 1), st.integers(0, CHECKS + 1))
def test_charging_ends_at_the_first_reason_against_it(refused_at: int, abandoned_at: int) -> None:
    context = Context(Board(), abandoned_at)
    end = charged(context, refused_at)
    # The first check is made before anything is sent to the board.
    ends_at = min(refused_at, abandoned_at)
    goes_on = [number < ends_at for number in range(1, CHECKS + 1)] if ends_at > 0 else []
    assert context.driver.went_on == goes_on
    assert end.charged == (ends_at > CHECKS)
    if refused_at <= (CHECKS if ends_at > 0 else 0):
        assert end.refusal == FIRST, "a later check does not lift or change a refusal"
    else:
        assert end.refusal is None


@pytest.mark.parametrize("last", [None, CHARGED])
@pytest.mark.parametrize("post", [True, False])
def test_the_last_reply_is_posted_before_each_check_if_asked_for(
    post: bool, last: Reply | None
) -> None:
    context = Context(Board(last))
    charged(context, post=post)
    assert context.posted == ([last] * (CHECKS + 1) if post and last else [])
    context = Context(Board(last))
    tapper_jobs.fire(cast(JobContext, context), SHOT, lambda by, now: None, post)
    assert context.posted == ([last] if post and last else [])


@pytest.mark.parametrize("abandoned_at", [-1, 99])
def test_a_board_without_an_arm_is_homed_until_the_job_is_abandoned(abandoned_at: int) -> None:
    context = Context(Board(), abandoned_at)
    tapper_jobs.prove(cast(JobContext, context))
    assert context.driver.went_on == [abandoned_at == 99]


@pytest.mark.parametrize("state", list(State))
def test_after_a_shot_only_a_striker_that_is_still_charged_is_discharged(state: State) -> None:
    context = Context(Board(after_fire=board_reply(state, SHOT - 1)))
    end = tapper_jobs.fire(cast(JobContext, context), SHOT, lambda by, now: FIRST, False)
    assert context.driver.went_on == [False] and end.refusal == FIRST
    assert context.driver.discharged == (state is State.CHARGED)
    assert end.status is not None and end.status.reply.state is not State.CHARGED
    assert (end.outcome, end.sentence) == (FireOutcome.NOT_FIRED, "the board's reason")
