"""The striker is never fired while the arm may move, regardless of delays and freezes.

The state machines of arm and tapper run together in virtual time. Each of the two can be frozen for
any time between two steps. The board fires within its time window or not at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from logic_parts import board_reply as board

from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.scara import Joints
from tapping_cell.hardware.tapper import CLOCK_TOLERANCE, FireOutcome
from tapping_cell.hardware.tapper_protocol import LONGEST_PULSE
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import arm as arms
from tapping_cell.logic import permit, standing_still
from tapping_cell.logic import tapper as tappers
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import (
    AbandonJob,
    Answer,
    Call,
    Effect,
    Job,
    JobEnded,
    Publish,
    RunJob,
)
from tapping_cell.logic.host import Activated, Configured, Deactivated, ShutDown
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.tapper_jobs import WINDOW_S, ChargeEnd, FireEnd, Status
from tapping_cell.messages import ArmState, ErrorCode, HoldStill, TapCommand, TapperState
from tapping_cell.se2 import Pose

CELL = load_cell()
TAP = 100
_TIP = CELL.arm.geometry().forward(CELL.file.arm.park)
STRIKE, HEIGHT = CELL.arm_base @ Pose(_TIP.x, _TIP.y, _TIP.yaw), _TIP.z
"""The strike pose of all taps here and its height; the arm reaches it with the joints of its park
pose."""
START = 1000.0
STROKE = CELL.file.tapper.stroke
SPEED = 0.3
CURVE = CELL.file.tapper.curve()


def at(steady: float) -> Now:
    return Now(steady, round(1e9 * (1e9 + steady)))


@dataclass
class Pair:
    """Arm and tapper, brought to the point at which the tapper requests the arm to stand still."""

    arm: arms.ArmLogic = field(default_factory=lambda: arms.ArmLogic(arms.ArmOptions()))
    tapper: tappers.TapperLogic = field(
        default_factory=lambda: tappers.TapperLogic(tappers.TapperOptions())
    )

    speed: float = SPEED

    def command(self, request: int, now: Now) -> TapCommand:
        message = TapCommand(request=request, tap_id=TAP, striker_speed=self.speed)
        message.header.frame_id = "table"
        message.strike_pose = to_message(STRIKE, HEIGHT)
        message.expiry = to_stamp(now.ros + 20 * 10**9)
        return message

    def begin(self) -> Call:
        now = at(START)
        charge = self.begin_charging()
        status = Status(board(BoardState.CHARGED, TAP), 0)
        made = self.tapper.on_job(JobEnded(charge, ChargeEnd(status, True, None)), now)
        (call,) = [effect for effect in made if isinstance(effect, Call)]
        return call

    def configure_tapper(self, now: Now) -> None:
        self.tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), now)
        self.tapper.on_lifecycle(Activated(), now)

    def begin_charging(self) -> int:
        """Return the number of the tapper's job that charges the striker."""
        now = at(START)
        joints = Joints(*CELL.file.arm.park)
        here = Reading(True, joints, False, now.steady)
        # When the arm node starts, it assumes that its previous process may have promised to stand
        # still. Start the node 10 s earlier, so that such a promise has expired.
        early = at(START - 10.0)
        self.arm.on_lifecycle(Configured(CELL, here), early)
        self.arm.on_lifecycle(Activated(), early)
        self.configure_tapper(early)
        tap = self.command(TapCommand.TAP, now)
        self.tapper.on_message("tap_command", tap, now)
        (place,) = jobs(self.arm.on_message("tap_command", tap, now))
        placed = MotionEnd(True, Reading(True, joints, False, now.steady))
        arm_state = messages(self.arm.on_job(JobEnded(place, placed), now), "arm_state")[-1]
        assert arm_state.state == ArmState.IN_POSITION
        (charge,) = jobs(self.tapper.on_message("arm_state", arm_state, now))
        self.arm_state = arm_state
        return charge


def jobs(effects: list[Effect]) -> list[int]:
    return [effect.job.number for effect in effects if isinstance(effect, RunJob)]


def messages(effects: list[Effect], topic: str) -> list:
    return [e.message for e in effects if isinstance(e, Publish) and e.topic == topic]


delay = st.floats(0.0, 0.4)
short = st.one_of(st.just(0.0), st.floats(0.0, 0.02), delay)


@settings(max_examples=4 * settings.default.max_examples)
@given(
    to_arm=short,
    to_tapper=short,
    to_check=short,
    to_release=st.floats(0.0, 1.0),
    withdrawn_after=delay,
    speed=st.floats(CURVE.slowest, CURVE.fastest),
)
def test_no_release_falls_into_a_motion_of_the_arm(
    to_arm, to_tapper, to_check, to_release, withdrawn_after, speed
):
    pair = Pair(speed=speed)
    call = pair.begin()
    asked = START
    handled = asked + to_arm
    # Each delay can have any value, because arm, network and tapper may be frozen or slow.
    (answer,) = [
        effect
        for effect in pair.arm.on_request("hold_still", call.request, 1, at(handled))
        if isinstance(effect, Answer)
    ]
    withdrawn = handled + withdrawn_after
    moves = max(withdrawn, not_before(pair, withdrawn))
    if not answer.response.granted:
        return
    received = handled + to_tapper
    made = pair.tapper.on_answer(call.token, answer.response, at(received))
    if not jobs(made):
        return
    sampled = received + to_check
    # The arm keeps publishing. The planner's state and the images are never sent, so their timeouts
    # do not apply. Therefore, only the permit can cause a refusal.
    pair.arm_state.header.stamp = to_stamp(at(sampled).ros)
    pair.tapper.on_message("arm_state", pair.arm_state, at(sampled))
    release_by = sampled + (WINDOW_S + LONGEST_PULSE) * 1.01
    if pair.tapper.check_firing(release_by, at(sampled)) is not None:
        return
    # The board fires up to its deadline, but not after it.
    over = sampled + min(to_release, WINDOW_S) + LONGEST_PULSE
    assert over + STROKE / speed < moves


def test_a_prompt_answer_permits_the_shot() -> None:
    """With prompt answers, the shot is fired. Without this check, the previous test could pass
    because no shot is ever fired."""
    pair = Pair()
    call = pair.begin()
    made = pair.arm.on_request("hold_still", call.request, 1, at(START + 0.002))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert answer.response.granted
    assert jobs(pair.tapper.on_answer(call.token, answer.response, at(START + 0.004)))
    release_by = START + 0.008 + (WINDOW_S + LONGEST_PULSE) * 1.01
    assert pair.tapper.check_firing(release_by, at(START + 0.008)) is None
    assert pair.tapper.check_firing(release_by + 0.2, at(START + 0.008)) is not None


@pytest.mark.parametrize("share", [0.5, 1.0, 2.0, -1.0, float("nan"), float("inf")])
def test_a_shot_must_end_within_the_time_that_the_arm_has_granted(share: float) -> None:
    """The arm grants ``share`` times the requested time, but half of it is too short."""
    pair = Pair()
    call = pair.begin()
    asked = call.request.duration
    made = pair.arm.on_request("hold_still", call.request, 1, at(START))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    answer.response.duration = share * asked
    made = pair.tapper.on_answer(call.token, answer.response, at(START + 0.001))
    assert bool(jobs(made)) == (share >= 1.0)
    if share >= 1.0:
        last = START + asked - permit.flight(STROKE, SPEED)
        assert pair.tapper.check_firing(last - 1e-6, at(START + 0.002)) is None
        assert pair.tapper.check_firing(last + 1e-6, at(START + 0.002)) is not None


def test_a_slightly_shorter_grant_ends_the_permit_earlier() -> None:
    pair = Pair()
    call = pair.begin()
    made = pair.arm.on_request("hold_still", call.request, 1, at(START))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    answer.response.duration -= 0.02
    assert jobs(pair.tapper.on_answer(call.token, answer.response, at(START + 0.001)))
    last = START + answer.response.duration - permit.flight(STROKE, SPEED)
    assert pair.tapper.check_firing(last - 1e-6, at(START + 0.002)) is None
    assert pair.tapper.check_firing(last + 1e-6, at(START + 0.002)) is not None


def test_the_constants_cover_the_documented_times() -> None:
    """docs/safety.md: a striker may be slower than predicted, and the board's clock may be off."""
    assert permit.flight(STROKE, SPEED) == pytest.approx(1.1 * STROKE / SPEED)
    assert permit.hold(0.5) == pytest.approx(0.67)
    assert permit.RELEASE_S >= (WINDOW_S + LONGEST_PULSE) * (1 + CLOCK_TOLERANCE)
    assert permit.BEFORE_FLIGHT_S > permit.RELEASE_S


def test_the_arm_can_be_asked_to_stand_still_for_the_slowest_tapper_of_the_cell() -> None:
    slow, fast = (
        SimpleNamespace(stroke=0.02, curve=lambda slowest=slowest: SimpleNamespace(slowest=slowest))
        for slowest in (0.02, 0.2)
    )
    for sections in ({"a": slow, "b": fast}, {"a": fast, "b": slow}):
        cell: Any = SimpleNamespace(tapper_sections=sections)
        assert permit.longest_hold(cell) == pytest.approx(0.17 + 1.1 * 0.02 / 0.02)


@given(st.floats(0.0, 0.3), st.floats(CURVE.slowest, CURVE.fastest))
def test_an_answer_that_leaves_too_little_time_is_requested_again(
    late: float, speed: float
) -> None:
    pair = Pair(speed=speed)
    call = pair.begin()
    response = HoldStill.Response(granted=True, duration=call.request.duration)
    made = pair.tapper.on_answer(call.token, response, at(START + late))
    is_late = late > permit.BEFORE_FLIGHT_S - permit.RELEASE_S
    assert [effect for effect in made if isinstance(effect, Call)] or not is_late
    assert bool(jobs(made)) != is_late


@pytest.mark.parametrize("state", [ArmState.MOVING, ArmState.FAULT, ArmState.WITHDRAWING])
def test_the_last_check_refuses_an_arm_that_reports_another_state_despite_its_promise(state):
    pair = Pair()
    call = pair.begin()
    made = pair.arm.on_request("hold_still", call.request, 1, at(START + 0.002))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    pair.tapper.on_answer(call.token, answer.response, at(START + 0.004))
    pair.tapper.on_message("arm_state", replace(pair.arm_state, state=state), at(START + 0.006))
    release_by = START + 0.008 + (WINDOW_S + LONGEST_PULSE) * 1.01
    reason = pair.tapper.check_firing(release_by, at(START + 0.008))
    assert reason is not None and reason[0] == ErrorCode.TAPPER_ARM_NOT_IN_POSITION


def test_the_arm_withdraws_by_itself_when_its_tap_has_expired() -> None:
    """The tap expires 20 s after START; nobody withdraws it."""
    pair = Pair()
    pair.begin()
    assert not withdrawing(pair.arm.on_tick(at(START + 19.9)))
    made = [effect for later in (20.1, 20.2) for effect in pair.arm.on_tick(at(START + later))]
    assert len(withdrawing(made)) == 1


@pytest.mark.parametrize("late", [0.0, 0.2, 30.0])
def test_the_arm_promises_only_on_a_fresh_reading_and_before_the_tap_expires(late: float) -> None:
    """The reading is taken at START, and the tap expires 20 s later."""
    pair = Pair()
    call = pair.begin()
    made = pair.arm.on_request("hold_still", call.request, 1, at(START + late))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert answer.response.granted == (late <= arms.FRESH_READING_S)


@pytest.mark.parametrize(
    ("outcome", "published"),
    [
        (FireOutcome.FIRED, TapperState.FIRED),
        (FireOutcome.NOT_FIRED, TapperState.NOT_FIRED),
        (FireOutcome.UNKNOWN, TapperState.UNKNOWN),
    ],
)
def test_the_outcome_of_a_shot_is_published_and_the_promise_ends_by_itself(outcome, published):
    pair = Pair()
    call = pair.begin()
    made = pair.arm.on_request("hold_still", call.request, 1, at(START))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    (fire,) = jobs(pair.tapper.on_answer(call.token, answer.response, at(START + 0.001)))
    status = Status(board(BoardState.SAFE, TAP), 0)
    end = JobEnded(fire, FireEnd(TAP, outcome, "", None, None, status, None))
    made = pair.tapper.on_job(end, at(START + 0.05))
    state = messages(made, "tapper_state")[-1]
    assert state.outcome == published
    pair.arm.on_message("tapper_state", state, at(START + 0.05))
    full = START + permit.hold(permit.flight(STROKE, SPEED))
    assert not_before(pair, START + 0.05) == full


@pytest.mark.parametrize("fires", [True, False])
@pytest.mark.parametrize("end", ["withdrawn", "deactivated"])
def test_a_tap_that_is_given_up_is_neither_charged_further_nor_fired(fires, end):
    pair = Pair()
    if fires:
        call = pair.begin()
        made = pair.arm.on_request("hold_still", call.request, 1, at(START))
        (answer,) = [effect for effect in made if isinstance(effect, Answer)]
        (job,) = jobs(pair.tapper.on_answer(call.token, answer.response, at(START + 0.001)))
    else:
        job = pair.begin_charging()
    now, release_by = at(START + 0.002), START + 0.08
    assert pair.tapper.check_charging(now) is None
    assert (pair.tapper.check_firing(release_by, now) is None) == fires
    if end == "withdrawn":
        made = pair.tapper.on_message("tap_command", pair.command(TapCommand.WITHDRAW, now), now)
    else:
        made = pair.tapper.on_lifecycle(Deactivated(), now)
    assert AbandonJob(job) in made
    assert pair.tapper.check_charging(now) is not None
    assert pair.tapper.check_firing(release_by, now) is not None


def test_the_tapper_requests_a_promise_five_times_at_most() -> None:
    pair = Pair()
    call = pair.begin()
    for attempt in range(1, 6):
        made = pair.tapper.on_answer(call.token, None, at(START + 0.2 * attempt))
        calls = [effect for effect in made if isinstance(effect, Call)]
        assert len(calls) == (attempt < 5)
        call = calls[0] if calls else call
    assert [effect.job.name for effect in made if isinstance(effect, RunJob)] == ["discharge"]


def test_the_arm_promises_nothing_after_the_outcome_of_the_tap() -> None:
    pair = Pair()
    call = pair.begin()
    outcome = TapperState(state=TapperState.SAFE, tap_id=TAP, outcome=TapperState.FIRED)
    pair.arm.on_message("tapper_state", outcome, at(START + 0.1))
    made = pair.arm.on_request("hold_still", call.request, 1, at(START + 0.2))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert not answer.response.granted
    assert answer.response.error_code == ErrorCode.COMMAND_REPEATED


@pytest.mark.parametrize("late", [-0.05, 0.05])
def test_the_arm_promises_nothing_for_a_tap_that_has_just_expired(late: float) -> None:
    """The arm has not withdrawn yet, and its reading is fresh. The tap expires 20 s after START."""
    pair = Pair()
    call = pair.begin()
    (reading,) = jobs(pair.arm.on_tick(at(START + 19.9)))
    here = Reading(True, Joints(*CELL.file.arm.park), False, START + 19.9)
    pair.arm.on_job(JobEnded(reading, here), at(START + 19.91))
    made = pair.arm.on_request("hold_still", call.request, 1, at(START + 20.0 + late))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert answer.response.granted == (late < 0)


@pytest.mark.parametrize("end", ["stop", "defect", "closed"])
def test_the_end_of_a_job_that_a_stop_overtook_changes_nothing(end: str) -> None:
    pair = Pair()
    charge = pair.begin_charging()
    tapper, now = pair.tapper, at(START + 0.1)
    made = {
        "stop": lambda: tapper.on_request("~/stop", None, 1, now),
        "defect": lambda: tapper.on_defect(RuntimeError("for this test"), now),
        "closed": lambda: tapper.on_lifecycle(ShutDown(), now),
    }[end]()
    assert AbandonJob(charge) in made
    state = tapper.state
    ended = JobEnded(charge, ChargeEnd(Status(board(BoardState.CHARGED, TAP), 0), True, None))
    made = tapper.on_job(ended, at(START + 0.2))
    assert tapper.state is state
    assert not [effect for effect in made if isinstance(effect, Call | RunJob)]


def test_a_tap_withdrawn_at_the_end_of_charging_discharges_the_striker() -> None:
    pair = Pair()
    charge = pair.begin_charging()
    now = at(START + 0.1)
    pair.tapper.on_message("tap_command", pair.command(TapCommand.WITHDRAW, now), now)
    status = Status(board(BoardState.CHARGED, TAP), 0)
    made = pair.tapper.on_job(JobEnded(charge, ChargeEnd(status, True, None)), now)
    (discharge,) = [effect.job for effect in made if isinstance(effect, RunJob)]
    assert discharge.name == "discharge"
    done = JobEnded(discharge.number, Status(board(BoardState.SAFE, TAP), 0))
    state = messages(pair.tapper.on_job(done, at(START + 0.2)), "tapper_state")[-1]
    assert (state.state, state.outcome) == (TapperState.SAFE, TapperState.NOT_FIRED)


def test_a_stop_button_at_the_cell_stops_the_tapper_until_it_is_cleared() -> None:
    tapper = tappers.TapperLogic(tappers.TapperOptions())
    tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), at(START))
    tapper.on_lifecycle(Activated(), at(START))
    (read,) = jobs(tapper.on_tick(at(START + 1.0)))
    pressed = Status(replace(board(BoardState.SAFE), stop_latched=True), 0)
    state = messages(tapper.on_job(JobEnded(read, pressed), at(START + 1.0)), "tapper_state")[-1]
    assert state.state == TapperState.STOPPED
    tap = Pair().command(TapCommand.TAP, at(START + 1.1))
    assert not jobs(tapper.on_message("tap_command", tap, at(START + 1.1)))


def test_an_answer_to_an_earlier_request_is_no_promise() -> None:
    """The tapper asks twice, because the first answer is late; the late answer does not count."""
    pair = Pair()
    first = pair.begin()
    made = pair.arm.on_request("hold_still", first.request, 1, at(START))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    again = pair.tapper.on_answer(first.token, None, at(START + 0.3))
    (second,) = [effect for effect in again if isinstance(effect, Call)]
    assert second.token != first.token
    assert not jobs(pair.tapper.on_answer(first.token, answer.response, at(START + 0.31)))
    made = pair.arm.on_request("hold_still", second.request, 2, at(START + 0.31))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert jobs(pair.tapper.on_answer(second.token, answer.response, at(START + 0.32)))


@given(
    asked=st.lists(
        st.tuples(
            st.sampled_from((TAP, TAP - 1, 0)),
            st.sampled_from((-0.1, 0.0, 0.01, 0.1, math.nan)),
            st.floats(0.0, 0.01),
        ),
        max_size=8,
    ),
    first=st.booleans(),
    outcome=st.sampled_from((TapperState.NONE, TapperState.NOT_FIRED, TapperState.FIRED)),
)
def test_nothing_shortens_the_promise(asked, first, outcome):
    """Neither other requests to stand still nor a reported outcome end the arm's promise early."""
    pair = Pair()
    call = pair.begin()
    now = START
    if first:
        pair.arm.on_request("hold_still", call.request, 1, at(now))
        granted = now
    for tap_id, duration, later in asked:
        now += later
        request = HoldStill.Request(tap_id=tap_id, duration=duration)
        pair.arm.on_request("hold_still", request, 2, at(now))
    if not first:
        granted = now
        pair.arm.on_request("hold_still", call.request, 1, at(now))
    message = TapperState(state=TapperState.SAFE, tap_id=TAP, outcome=outcome)
    pair.arm.on_message("tapper_state", message, at(now))
    assert not_before(pair, now) >= granted + permit.hold(permit.flight(STROKE, SPEED))


@pytest.mark.parametrize("way", ["discharged", "stopped", "contested", "not known"])
def test_the_arm_waits_for_a_charged_striker_until_the_board_is_at_rest(way: str) -> None:
    pair = Pair()
    pair.begin()
    now = START + 0.1
    report = partial(TapperState, tap_id=TAP)
    pair.arm.on_message("tapper_state", report(state=TapperState.CHARGED), at(now))
    if way == "contested":
        pair.arm.on_conflict("2 nodes publish tapper_state", at(now))
    end = report(
        state=TapperState.STOPPED if way == "stopped" else TapperState.SAFE,
        outcome=TapperState.UNKNOWN if way == "not known" else TapperState.NOT_FIRED,
    )
    pair.arm.on_message("tapper_state", end, at(now))
    waits = 0.0 if way == "discharged" else standing_still.DISCHARGED_S
    assert leaves_at(pair, now) == pytest.approx(now + waits, abs=0.03)


def test_nothing_is_promised_charged_or_fired_while_two_nodes_do_one_nodes_work() -> None:
    pair = Pair()
    call = pair.begin()
    pair.arm.on_conflict("2 nodes publish tap_command", at(START))
    made = pair.arm.on_request("hold_still", call.request, 1, at(START))
    (answer,) = [effect for effect in made if isinstance(effect, Answer)]
    assert not answer.response.granted
    assert answer.response.error_code == ErrorCode.CONFIGURATION_CONFLICT
    made = pair.tapper.on_conflict("2 nodes publish arm_state (/a, /b)", at(START))
    (discharge,) = [effect.job for effect in made if isinstance(effect, RunJob)]
    assert discharge.name == "discharge"
    safe = Status(board(BoardState.SAFE, TAP), 0)
    made = pair.tapper.on_job(JobEnded(discharge.number, safe), at(START + 0.1))
    state = messages(made, "tapper_state")[-1]
    assert (state.outcome, state.error_code) == (
        TapperState.NOT_FIRED,
        ErrorCode.CONFIGURATION_CONFLICT,
    )
    assert "/a, /b" in state.error_msg
    again = replace(pair.command(TapCommand.TAP, at(START + 0.2)), tap_id=TAP + 1)
    for machine in (pair.arm, pair.tapper):
        made = machine.on_message("tap_command", again, at(START + 0.2))
        assert not [effect for effect in made if isinstance(effect, RunJob)]
    made = pair.tapper.on_conflict("", at(START + 1.0))
    later = replace(again, tap_id=TAP + 2)
    pair.tapper.on_message("tap_command", later, at(START + 1.1))
    assert pair.tapper.state is tappers.State.WAITING


def leaves_at(pair: Pair, time: float) -> float:
    """Command the arm to withdraw at ``time``, and return when the job of this motion begins."""
    return begin_withdrawal(pair, time)[1]


def not_before(pair: Pair, time: float) -> float:
    """Command the arm to withdraw at ``time``, and return the earliest time at which this motion
    may begin."""
    return float(begin_withdrawal(pair, time)[0].run.keywords["not_before"])


def begin_withdrawal(pair: Pair, time: float) -> tuple[Job, float]:
    withdraw = pair.command(TapCommand.WITHDRAW, at(time))
    made = list(pair.arm.on_message("tap_command", withdraw, at(time)))
    while not (withdrawals := withdrawing(made)):
        time += 0.02
        assert time < START + 2.0
        made += pair.arm.on_tick(at(time))
    (job,) = withdrawals
    return job, time


def withdrawing(effects: list[Effect]) -> list[Job]:
    jobs = [effect.job for effect in effects if isinstance(effect, RunJob)]
    return [job for job in jobs if job.name == "withdraw"]
