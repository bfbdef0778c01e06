"""The cycle of one tap of the tapper: when it charges, asks the arm, fires and gives up."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, cast

import pytest
from logic_parts import at, board_reply

from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import tapper_jobs
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import Abandon, Run
from tapping_cell.logic.effects import Call
from tapping_cell.logic.permit import BEFORE_FLIGHT_S, RELEASE_S
from tapping_cell.logic.tapper_cycle import HOLD_ATTEMPTS, TapperCycle, not_fired
from tapping_cell.logic.tapper_jobs import ChargeEnd, Status
from tapping_cell.logic.tapper_states import (
    Charged,
    Charging,
    Discharging,
    Event,
    Firing,
    Over,
    Tap,
    Waiting,
)
from tapping_cell.logic.transitions import Go
from tapping_cell.messages import ErrorCode, HoldStill, TapperState
from tapping_cell.se2 import Pose

START = 100.0
FLIGHT = 0.03
POSE = Pose(0.05, -0.02, 1.0)
TAP = Tap(7, 2, 0.5, at(START + 1.0).ros, POSE, Pose(0.1, 0.0, 0.0), FLIGHT)
WHY, OTHER = (ErrorCode.OBJECT_MOVED, "moved"), (ErrorCode.ARM_SILENT, "silent")


class Peers:
    """What the tapper knows of arm and camera."""

    def __init__(self) -> None:
        self.clock: Any = None
        self.firing: Any = None
        self.waits_for: Any = None
        self.asked: list[tuple[Any, ...]] = []

    def clock_error(self, now: Now) -> Any:
        return self.clock

    def check_firing(self, *asked: Any) -> Any:
        self.asked.append(asked[:3])
        return self.firing

    def obstacle(self, *asked: Any) -> Any:
        self.asked.append(asked[:3])
        return self.waits_for


class Cell:
    """A cycle whose checks answer as told."""

    def __init__(self) -> None:
        self.peers = Peers()
        self.charging: Any = None
        self.cycle = TapperCycle(
            cast(Any, self.peers), lambda now: self.charging, lambda by, now: None, True
        )


def jobs(steps: list[Any]) -> list[str]:
    return [step.name for step in steps if isinstance(step, Run)]


def records(steps: list[Any]) -> list[Any]:
    return [step.record for step in steps if isinstance(step, Go)]


WAITING, CHARGING = Waiting(tap=TAP), Charging(tap=TAP)
CHARGED = Charged(tap=TAP, charged_at=START)
FIRING, DISCHARGING = Firing(tap=TAP, still_until=START + 1.0), Discharging(tap=TAP, given_up=WHY)


def test_a_tap_is_charged_as_soon_as_nothing_forbids_it() -> None:
    cell = Cell()
    go, run = cell.cycle.proceed(WAITING, at(START))
    assert (go.event, go.record) == (Event.ARM_READY, CHARGING)
    job = cast(partial, run.job)
    assert run.name == "charge" and job.func is tapper_jobs.charge
    words = {name: job.keywords[name] for name in ("shot", "energy", "channel", "post_replies")}
    assert words == {"shot": 7, "energy": 0.5, "channel": 2, "post_replies": True}
    assert not list(cell.cycle.proceed(None, at(START)))
    for record in (CHARGING, FIRING, DISCHARGING):
        assert not list(cell.cycle.proceed(record, at(START)))


def test_clocks_that_differ_end_the_tap_at_once() -> None:
    cell = Cell()
    cell.peers.clock = OTHER
    (over,) = cell.cycle.proceed(WAITING, at(START))
    assert over == Over(Event.GIVEN_UP, TapperState.NOT_FIRED, OTHER)


def test_the_reason_of_a_wait_is_shown_and_ends_the_tap_if_it_lasts() -> None:
    cell = Cell()
    cell.charging = cell.peers.waits_for = WHY
    (noted,) = records(list(cell.cycle.proceed(WAITING, at(START))))
    assert noted == replace(WAITING, obstacle=WHY, obstacle_since=START)
    assert cell.peers.asked == [(7, TAP.planned, TAP.strike)]
    assert cell.cycle.shown_obstacle(noted, at(START + 0.29)) is None
    assert cell.cycle.shown_obstacle(noted, at(START + 0.31)) == WHY
    assert cell.cycle.shown_obstacle(replace(CHARGED), at(START + 9.0)) is None
    # Another reason does not begin the wait anew.
    cell.peers.waits_for = OTHER
    (later,) = records(list(cell.cycle.proceed(noted, at(START + 3.9))))
    assert later == replace(noted, obstacle=OTHER)
    (over,) = cell.cycle.proceed(noted, at(START + 4.1))
    assert over == Over(Event.GIVEN_UP, TapperState.NOT_FIRED, OTHER)
    # The arm's way to its strike pose is no obstacle, however long it takes.
    cell.peers.waits_for = None
    (free,) = records(list(cell.cycle.proceed(noted, at(START + 60.0))))
    assert free == WAITING


@pytest.mark.parametrize("reason", [None, WHY])
@pytest.mark.parametrize(("later", "ends"), [(0.99, False), (1.01, True)])
def test_a_tap_expires_only_before_it_is_charged(later: float, ends: bool, reason: Any) -> None:
    cell = Cell()
    cell.peers.firing = reason
    steps = list(cell.cycle.check_expiry(WAITING, at(START + later)))
    assert len(steps) == ends
    if ends:
        code, sentence = steps[0].error
        assert code == ErrorCode.TAPPER_COMMAND_EXPIRED
        assert ("moved" in sentence) == (reason is not None)
    for record in (None, CHARGING, CHARGED, FIRING):
        assert not list(cell.cycle.check_expiry(record, at(START + 9.0)))


@pytest.mark.parametrize("before", [None, OTHER])
def test_a_tap_that_is_given_up_is_not_released(before: Any) -> None:
    give_up = Cell().cycle.give_up
    first = before or WHY
    (over,) = give_up(replace(WAITING, given_up=before), WHY)
    assert over == Over(Event.GIVEN_UP, TapperState.NOT_FIRED, WHY)
    go, abandon = give_up(replace(CHARGING, given_up=before), WHY)
    assert go == Go(Event.GIVEN_UP, Discharging(tap=TAP, given_up=first))
    assert isinstance(abandon, Abandon)
    go, run = give_up(replace(CHARGED, given_up=before), WHY)
    assert go == Go(Event.GIVEN_UP, Discharging(tap=TAP, given_up=WHY))
    assert (run.name, run.job) == ("discharge", tapper_jobs.discharge)
    go, abandon = give_up(replace(FIRING, given_up=before), WHY)
    assert go == Go(None, replace(FIRING, given_up=first)) and isinstance(abandon, Abandon)
    (go,) = give_up(replace(DISCHARGING, given_up=before), WHY)
    assert go == Go(None, replace(DISCHARGING, given_up=first))


def ended(charged: bool, refusal: Any = None) -> ChargeEnd:
    state = BoardState.CHARGED if charged else BoardState.SAFE
    return ChargeEnd(Status(board_reply(state, 7), 0), charged, refusal)


def test_a_tap_given_up_at_the_end_of_charging_is_discharged() -> None:
    steps = list(Cell().cycle.charge_ended(DISCHARGING, ended(True), at(START)))
    assert jobs(steps) == ["discharge"] and not records(steps)


@pytest.mark.parametrize("record", [CHARGING, DISCHARGING])
def test_a_charge_that_was_refused_ends_the_tap_with_the_first_reason(record: Any) -> None:
    (over,) = Cell().cycle.charge_ended(record, ended(False, OTHER), at(START))
    first = record.given_up or OTHER
    assert over == Over(Event.ENDED, TapperState.NOT_FIRED, first)


def asked_arm(steps: list[Any]) -> Call:
    (call,) = [step for step in steps if isinstance(step, Call)]
    return call


def test_a_charged_tapper_asks_the_arm_that_is_in_position_to_stand_still() -> None:
    cell = Cell()
    steps = list(cell.cycle.charge_ended(CHARGING, ended(True), at(START)))
    charged, asked = records(steps)
    assert charged == CHARGED and not jobs(steps)
    assert asked == replace(CHARGED, attempts=1, asked_at=START)
    call = asked_arm(steps)
    assert (call.service, call.timeout) == ("hold_still", 0.2)
    request = cast(HoldStill.Request, call.request)
    assert (request.tap_id, request.duration) == (7, BEFORE_FLIGHT_S + FLIGHT)
    assert not list(cell.cycle.proceed(asked, at(START + 0.1))), "it is asked once"


@pytest.mark.parametrize(
    ("charging", "later", "code"),
    [
        (None, 2.99, None),
        (None, 3.01, ErrorCode.TAPPER_ARM_NOT_IN_POSITION),
        (WHY, 0.1, ErrorCode.OBJECT_MOVED),
        (WHY, 3.5, ErrorCode.OBJECT_MOVED),
    ],
)
def test_a_charged_tapper_waits_for_the_arm_but_not_long(charging, later, code) -> None:
    cell = Cell()
    cell.peers.firing = OTHER
    cell.charging = charging
    steps = list(cell.cycle.proceed(CHARGED, at(START + later)))
    assert jobs(steps) == (["discharge"] if code else [])
    assert [record.given_up[0] for record in records(steps)] == ([code] if code else [])
    assert cell.peers.asked == [(7, TAP.planned, TAP.strike)]


def test_a_tapper_at_a_fixed_mount_asks_nobody() -> None:
    cell = Cell()
    cell.cycle.is_fixed = True
    steps = list(cell.cycle.charge_ended(CHARGING, ended(True), at(START)))
    assert jobs(steps) == ["fire"]
    assert records(steps)[-1] == Firing(tap=TAP, still_until=math.inf)


ASKED = replace(CHARGED, attempts=1, asked_at=START)
TOKEN = ("hold", 7, 1)
GRANTED = HoldStill.Response(granted=True, duration=BEFORE_FLIGHT_S + FLIGHT)
UNTIL = START + BEFORE_FLIGHT_S + FLIGHT


@pytest.mark.parametrize(
    ("later", "granted", "fires"),
    [
        (0.0, GRANTED.duration, True),
        (BEFORE_FLIGHT_S - RELEASE_S - 1e-6, GRANTED.duration, True),
        (BEFORE_FLIGHT_S - RELEASE_S + 1e-6, GRANTED.duration, False),
        (0.0, GRANTED.duration + 1.0, True),
        (0.0, GRANTED.duration - 0.05, True),
        (0.0, GRANTED.duration - 0.08, False),
        (0.0, math.nan, False),
    ],
)
def test_it_fires_only_while_enough_of_the_promise_is_left(later, granted, fires) -> None:
    answer = HoldStill.Response(granted=True, duration=granted)
    steps = list(Cell().cycle.answered(ASKED, TOKEN, answer, at(START + later)))
    assert jobs(steps) == (["fire"] if fires else [])
    if fires:
        (firing,) = records(steps)
        less = max(0.0, GRANTED.duration - granted)
        assert isinstance(firing, Firing) and firing.still_until == pytest.approx(UNTIL - less)
        assert [step.event for step in steps if isinstance(step, Go)] == [Event.HELD]
        (run,) = [step for step in steps if isinstance(step, Run)]
        words = cast(partial, run.job).keywords
        assert (words["shot"], words["post_replies"]) == (7, True)
    else:
        assert records(steps) == [replace(ASKED, attempts=2, asked_at=START + later)]
        assert asked_arm(steps).token == ("hold", 7, 2)


@pytest.mark.parametrize("record", [None, WAITING, CHARGING, FIRING, DISCHARGING])
def test_an_answer_in_another_state_fires_nothing(record: Any) -> None:
    assert not list(Cell().cycle.answered(record, TOKEN, GRANTED, at(START)))


@pytest.mark.parametrize("token", [("hold", 7, 0), ("hold", 6, 1), ("home", 7, 1)])
def test_an_answer_to_another_call_fires_nothing(token: Any) -> None:
    assert not list(Cell().cycle.answered(ASKED, token, GRANTED, at(START)))


def test_an_arm_that_refuses_ends_the_tap_and_a_silent_one_after_some_calls() -> None:
    refused = HoldStill.Response(granted=False, error_code=OTHER[0], error_msg=OTHER[1])
    steps = list(Cell().cycle.answered(ASKED, TOKEN, refused, at(START)))
    assert jobs(steps) == ["discharge"] and records(steps)[0].given_up == OTHER
    for later in (0.2, 0.0):
        for attempts in range(1, HOLD_ATTEMPTS + 1):
            record, token = replace(ASKED, attempts=attempts), ("hold", 7, attempts)
            steps = list(Cell().cycle.answered(record, token, None, at(START + later)))
            assert jobs(steps) == (["discharge"] if attempts == HOLD_ATTEMPTS else [])
    assert records(steps)[0].given_up[0] == ErrorCode.ARM_SILENT
    assert "in 5 attempts" in records(steps)[0].given_up[1]


@pytest.mark.parametrize("why", [None, (0, "unused"), WHY, (ErrorCode.TAPPER_SPENT, "spent")])
def test_only_a_spent_number_may_have_been_fired(why: Any) -> None:
    over = not_fired(why)
    spent = why is not None and why[0] == ErrorCode.TAPPER_SPENT
    assert over.outcome == (TapperState.UNKNOWN if spent else TapperState.NOT_FIRED)
    assert over.error == (why if why and why[0] else (0, "")) and over.event is Event.ENDED
