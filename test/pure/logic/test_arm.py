"""The state machine of the arm, step by step in virtual time."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_permit import CELL, TAP, Pair, at, jobs, messages

from tapping_cell.hardware.arm_settings import ArmReading
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.motion import Waypoint
from tapping_cell.hardware.scara import Joints, TipPose
from tapping_cell.logic import arm as arms
from tapping_cell.logic import arm_jobs, arm_states, permit
from tapping_cell.logic import tapper as tappers
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import (
    AbandonJob,
    Answer,
    AskStops,
    Content,
    Effect,
    Job,
    JobEnded,
    KeepStop,
    Publish,
    RunJob,
    StopLevels,
    StopWire,
)
from tapping_cell.logic.host import (
    Activated,
    Configured,
    Deactivated,
    LostEvent,
    ShutDown,
    UnansweredRequest,
    Unreachable,
)
from tapping_cell.logic.standing_still import DISCHARGED_S, LONGEST_WAIT_S
from tapping_cell.messages import (
    ArmState,
    Bool,
    ErrorCode,
    HoldStill,
    JointTrajectory,
    JointTrajectoryPoint,
    PoseStamped,
    TapCommand,
    TapperState,
    Trigger,
)

START = 1000.0
PARK = Joints(*CELL.file.arm.park)


def in_position() -> Pair:
    pair = Pair()
    pair.begin()
    return pair


def read(pair: Pair, joints: Joints, steady: float, **changed: bool) -> list[ArmState]:
    """Process a position report of the arm; return the published states."""
    made = pair.arm.on_tick(at(steady))
    (number,) = jobs(made)
    reading = replace(Reading(True, joints, False, steady), **changed)
    made = pair.arm.on_job(JobEnded(number, reading), at(steady))
    return messages(made, "arm_state")


def test_an_arm_pushed_off_its_position_is_a_fault() -> None:
    pair = in_position()
    place = Joints(*CELL.file.arm.park)
    pushed = place._replace(shoulder=place.shoulder + 0.01)
    assert read(pair, place, START + 1.0) is not None
    read(pair, pushed, START + 1.1)
    assert pair.arm.state is arm_states.State.IN_POSITION
    read(pair, place, START + 1.2)
    read(pair, pushed, START + 1.3)
    read(pair, pushed, START + 1.4)
    assert pair.arm.state is arm_states.State.FAULT
    assert pair.arm.error[0] == ErrorCode.ARM_POSITION_MISMATCH


@pytest.mark.parametrize(
    ("joints", "changed"),
    [
        *(({joint: sign * 0.01}, {}) for joint in Joints._fields for sign in (1, -1)),
        ({}, {"moving": True}),
        ({}, {"homed": False}),
    ],
)
def test_an_arm_that_may_have_moved_promises_nothing_and_a_second_such_reading_is_a_fault(
    joints: dict[str, float], changed: dict[str, bool]
) -> None:
    pair = Pair()
    call = pair.begin()
    off = PARK._replace(**{name: getattr(PARK, name) + by for name, by in joints.items()})

    def is_granted(steady: float) -> bool:
        made = pair.arm.on_request("hold_still", call.request, 1, at(steady))
        return bool(next(e.response.granted for e in made if isinstance(e, Answer)))

    read(pair, off, START + 1.0, **changed)
    assert not is_granted(START + 1.01)
    assert pair.arm.state is arm_states.State.IN_POSITION
    read(pair, PARK, START + 1.1)
    assert is_granted(START + 1.11)
    for later in (1.2, 1.3):
        read(pair, off, START + later, **changed)
    assert pair.arm.error[0] == ErrorCode.ARM_POSITION_MISMATCH


@pytest.mark.parametrize(("share", "stays"), [(0.99, True), (1.01, False)])
@pytest.mark.parametrize("joint", Joints._fields)
def test_the_arm_stays_at_the_strike_pose_within_twice_the_tolerance_of_its_settling(
    joint: str, share: float, stays: bool
) -> None:
    pair = in_position()
    arm = CELL.arm
    limit = 2 * (arm.tolerance_quill if joint == "quill" else arm.tolerance_angle)
    near = PARK._replace(**{joint: getattr(PARK, joint) + share * limit})
    for steady in (1.0, 1.1):
        read(pair, near, START + steady)
    assert (pair.arm.state is arm_states.State.IN_POSITION) == stays


def test_an_arm_whose_tap_expires_on_its_way_is_not_in_position() -> None:
    pair = Pair()
    here = Reading(True, PARK, False, START)
    pair.arm.on_lifecycle(Configured(CELL, here), at(START - 10.0))
    pair.arm.on_lifecycle(Activated(), at(START - 10.0))
    tap = pair.command(TapCommand.TAP, at(START))
    (place,) = jobs(pair.arm.on_message("tap_command", tap, at(START)))
    made = pair.arm.on_job(JobEnded(place, MotionEnd(False, here)), at(START + 1.0))
    assert withdraws(made) and pair.arm.state is arm_states.State.WITHDRAWING


@pytest.mark.parametrize("again", [False, True])
def test_an_arm_that_still_hides_the_object_parks_after_its_withdrawal(again: bool) -> None:
    pair = Pair()
    here = Reading(True, PARK, False, START)
    pair.arm.on_lifecycle(Configured(CELL, here), at(START - 10.0))
    pair.arm.on_lifecycle(Activated(), at(START - 10.0))
    camera = PoseStamped()
    camera.pose.position.z = 1.0
    pair.arm.on_message("camera/pose", camera, at(START - 1.0))
    tap = pair.command(TapCommand.TAP, at(START))
    (place,) = jobs(pair.arm.on_message("tap_command", tap, at(START)))
    pair.arm.on_job(JobEnded(place, MotionEnd(True, here)), at(START))
    withdraw = pair.command(TapCommand.WITHDRAW, at(START))
    (first,) = jobs(pair.arm.on_message("tap_command", withdraw, at(START)))
    if again:
        assert not jobs(pair.arm.on_message("tap_command", withdraw, at(START)))
    made = pair.arm.on_job(JobEnded(first, MotionEnd(True, here)), at(START + 0.5))
    assert withdraws(made) == again
    assert (pair.arm.state is arm_states.State.IDLE) != again
    if again:
        (second,) = jobs(made)
        pair.arm.on_job(JobEnded(second, MotionEnd(True, here)), at(START + 1.0))
        assert pair.arm.state is arm_states.State.IDLE


def test_a_withdrawal_while_the_arm_is_being_placed_abandons_the_motion() -> None:
    pair = Pair()
    here = Reading(True, PARK, False, START)
    pair.arm.on_lifecycle(Configured(CELL, here), at(START - 10.0))
    pair.arm.on_lifecycle(Activated(), at(START - 10.0))
    tap = pair.command(TapCommand.TAP, at(START))
    (place,) = jobs(pair.arm.on_message("tap_command", tap, at(START)))
    withdraw = pair.command(TapCommand.WITHDRAW, at(START))
    assert AbandonJob(place) in pair.arm.on_message("tap_command", withdraw, at(START + 0.1))


@pytest.mark.parametrize("expired", [True, False])
def test_the_job_that_places_the_arm_settles_there_and_ends_at_the_expiry(expired: bool) -> None:
    moved: list[Joints] = []
    settled: list[Joints | None] = []
    tip = CELL.arm.geometry().forward(PARK._replace(shoulder=PARK.shoulder + 0.3))
    goal = TipPose(tip.x, tip.y, CELL.arm.strike_height, tip.yaw)

    def still(joints: Joints) -> ArmReading:
        return ArmReading(joints, False, "", True, START)

    def move(joints: Joints, speed: float, **_: object) -> ArmReading:
        moved.append(joints)
        return still(joints)

    def settle(joints: Joints | None) -> ArmReading:
        settled.append(joints)
        return still(joints or PARK)

    driver = SimpleNamespace(
        homed=True,
        geometry=CELL.arm.geometry(),
        read_joints=lambda: PARK,
        read=lambda: still(moved[-1]),
        move_to=move,
        settle=settle,
    )
    context: Any = SimpleNamespace(
        driver=driver,
        now=lambda: at(START + len(moved)),
        sleep=None,
        abandoned=lambda: False,
        post=lambda reading: None,
    )
    expiry = at(START + (0.5 if expired else 100.0)).ros
    end = arm_jobs.place(context, goal, CELL.arm.motion(), expiry, START)
    assert end.complete is not expired
    assert len(moved) == 1 if expired else len(moved) > 1
    assert settled == ([] if expired else [moved[-1]])


def test_the_arms_state_is_as_old_as_its_reading() -> None:
    pair = in_position()
    read(pair, PARK, START + 1.0)
    for later in (1.02, 1.04):
        (state,) = messages(pair.arm.on_tick(at(START + later)), "arm_state")
        assert state.header.stamp == to_stamp(at(START + 1.0).ros)


def test_the_time_of_the_last_stop_is_published() -> None:
    arm = in_position().arm
    for later in (1.0, 2.0):
        made = arm.on_request("~/stop", Trigger.Request(), 1, at(START + later))
        made = [*made, *arm.on_tick(at(START + later + 0.1))]
        state = messages(made, "arm_state")[-1]
        assert state.last_stop == to_stamp(at(START + 1.0).ros)


def test_a_request_that_its_handler_has_answered_is_answered_once() -> None:
    arm = in_position().arm
    arm._answer(7, True, "for this test")
    lost = UnansweredRequest("~/home", Trigger.Request(), 7)
    made = arm.on_defect(RuntimeError("for this test"), at(START + 1.0), lost)
    assert [effect.response.success for effect in made if isinstance(effect, Answer)] == [True]


def test_a_fault_during_a_move_after_a_withdrawal_can_be_cleared() -> None:
    """The state must not remain WITHDRAWING: clear_fault and home must be accepted."""
    pair = Pair()
    now = at(START)
    joints = Joints(*CELL.file.arm.park)
    pair.begin()
    arm = pair.arm
    made = arm.on_message("tap_command", pair.command(TapCommand.WITHDRAW, now), now)
    (withdraw,) = [e.job for e in made if isinstance(e, RunJob) and e.job.name == "withdraw"]
    fault = HardwareFault(FaultReason.TIMEOUT, "a move was not finished in time")
    arm.on_job(JobEnded(withdraw.number, fault=fault), at(START + 2.0))
    assert arm.state is arm_states.State.FAULT
    (clear,) = jobs(arm.on_request("~/clear_fault", Trigger.Request(), 1, at(START + 3.0)))
    cleared = Reading(False, joints, False, START + 3.0)
    arm.on_job(JobEnded(clear, cleared), at(START + 3.1))
    assert arm.state is arm_states.State.NOT_HOMED
    assert jobs(arm.on_request("~/home", Trigger.Request(), 2, at(START + 4.0)))


@pytest.mark.parametrize("fault", [False, True])
def test_a_late_withdrawal_after_a_stop_or_fault_moves_nothing(fault: bool) -> None:
    """The arm was cleared and homed. The withdrawal is of the tap before the stop."""
    pair = Pair()
    arm = pair.arm
    camera = PoseStamped()
    camera.pose.position.z = 0.6
    arm.on_message("camera/pose", camera, at(START - 20.0))
    pair.begin()
    withdrawal = pair.command(TapCommand.WITHDRAW, at(START))
    (number,) = jobs(arm.on_message("tap_command", withdrawal, at(START + 1.0)))
    here = Reading(True, PARK, False, START + 2.0)
    arm.on_job(JobEnded(number, MotionEnd(True, here)), at(START + 2.0))
    assert arm.state is arm_states.State.IDLE
    if fault:
        arm.on_defect(RuntimeError("for this test"), at(START + 2.5))
    else:
        arm.on_request("~/stop", Trigger.Request(), 1, at(START + 2.5))
    made = arm.on_request("~/clear_fault", Trigger.Request(), 2, at(START + 3.0))
    if not fault:
        (asked,) = (effect for effect in made if isinstance(effect, AskStops))
        made = arm.on_answer(asked.token, StopLevels(False, (), ()), at(START + 3.5))
    (clear,) = jobs(made)
    arm.on_job(JobEnded(clear, Reading(False, PARK, False, START + 4.0)), at(START + 4.0))
    (home,) = jobs(arm.on_request("~/home", Trigger.Request(), 3, at(START + 5.0)))
    arm.on_job(JobEnded(home, replace(here, stamp=START + 9.0)), at(START + 9.0))
    assert arm.state is arm_states.State.IDLE
    assert not withdraws(arm.on_message("tap_command", withdrawal, at(START + 10.0)))
    assert arm.state is arm_states.State.IDLE


@pytest.mark.parametrize("activated_first", [False, True])
def test_a_fault_outlasts_a_deactivation_until_it_is_cleared(activated_first: bool) -> None:
    pair = in_position()
    arm = pair.arm
    pushed = PARK._replace(shoulder=PARK.shoulder + 0.01)
    read(pair, PARK, START + 1.0)
    read(pair, pushed, START + 1.1)
    read(pair, pushed, START + 1.2)
    fault = arm.error
    assert fault[0] == ErrorCode.ARM_POSITION_MISMATCH
    arm.on_lifecycle(Deactivated(), at(START + 2.0))
    assert (arm.state, arm.error) == (arm_states.State.FAULT, fault)
    if activated_first:
        arm.on_lifecycle(Activated(), at(START + 3.0))
        assert (arm.state, arm.error) == (arm_states.State.FAULT, fault)
    (clear,) = jobs(arm.on_request("~/clear_fault", Trigger.Request(), 1, at(START + 4.0)))
    arm.on_job(JobEnded(clear, Reading(False, PARK, False, START + 4.5)), at(START + 4.5))
    if not activated_first:
        assert arm.state is arm_states.State.INACTIVE
        arm.on_lifecycle(Activated(), at(START + 5.0))
    assert arm.state is arm_states.State.NOT_HOMED


def test_an_unreachable_strike_pose_is_not_a_fault() -> None:
    pair = in_position()
    arm, here = pair.arm, Reading(True, Joints(*CELL.file.arm.park), False, START)
    (number,) = jobs(
        arm.on_message("tap_command", pair.command(TapCommand.WITHDRAW, at(START)), at(START))
    )
    arm.on_job(JobEnded(number, here), at(START + 1.0))
    assert arm.state is arm_states.State.IDLE
    command = pair.command(TapCommand.TAP, at(START))
    command.tap_id = TAP + 1
    (place,) = jobs(arm.on_message("tap_command", command, at(START + 2.0)))
    fault = HardwareFault(FaultReason.UNREACHABLE, "joint elbow would need 170 deg")
    (withdraw,) = jobs(arm.on_job(JobEnded(place, fault=fault), at(START + 2.1)))
    assert arm.error == (ErrorCode.ARM_OUT_OF_REACH, "joint elbow would need 170 deg")
    arm.on_job(JobEnded(withdraw, here), at(START + 3.0))
    assert arm.state is arm_states.State.IDLE


@given(st.sampled_from([0, TAP - 1, TAP + 1]))
def test_a_withdrawal_of_another_tap_does_nothing(tap_id: int) -> None:
    pair = in_position()
    command = pair.command(TapCommand.WITHDRAW, at(START))
    command.tap_id = tap_id
    assert jobs(pair.arm.on_message("tap_command", command, at(START + 1.0))) == []
    assert pair.arm.state is arm_states.State.IN_POSITION


def test_a_stop_preempts_any_activity() -> None:
    """The end of a job that was interrupted by a stop has no effect."""
    pair = in_position()
    arm = pair.arm
    command = pair.command(TapCommand.WITHDRAW, at(START))
    (number,) = jobs(arm.on_message("tap_command", command, at(START)))
    arm.on_message("emergency_stop", Bool(data=True), at(START + 1.1))
    assert arm.state is arm_states.State.STOPPED
    here = Reading(True, Joints(*CELL.file.arm.park), False, START)
    arm.on_job(JobEnded(number, here), at(START + 1.2))
    assert arm.state is arm_states.State.STOPPED
    assert jobs(arm.on_tick(at(START + 2.0))) == []


@pytest.mark.parametrize("stopped_again", [True, False])
def test_a_stop_before_the_job_that_clears_the_last_stop_ends_this_job(stopped_again: bool) -> None:
    """The job is queued behind another job, such as a slow connect."""
    pair = in_position()
    arm, now = pair.arm, at(START + 1.0)
    arm.on_request("~/stop", Trigger.Request(), 1, now)
    made = arm.on_request("~/clear_fault", Trigger.Request(), 2, now)
    (asked,) = (effect.token for effect in made if isinstance(effect, AskStops))
    made = arm.on_answer(asked, StopLevels(False, (), ()), now)
    (job,) = (effect.job for effect in made if isinstance(effect, RunJob))
    if stopped_again:
        arm.on_request("~/stop", Trigger.Request(), 3, now)
    cleared: list[bool] = []
    context = Clockwork(pair, [])
    context.driver.clear_fault = lambda: cleared.append(True)
    job.run(context)
    assert bool(cleared) is not stopped_again


def test_a_program_error_during_a_read_ends_a_motion_that_was_begun_meanwhile() -> None:
    pair = Pair()
    arm = pair.arm
    here = Reading(True, PARK, False, START - 10.0)
    arm.on_lifecycle(Configured(CELL, here), at(START - 10.0))
    arm.on_lifecycle(Activated(), at(START - 10.0))
    (read,) = jobs(arm.on_tick(at(START)))
    command = pair.command(TapCommand.TAP, at(START))
    (place,) = jobs(arm.on_message("tap_command", command, at(START)))
    made = arm.on_job(JobEnded(read, fault=ValueError("a defect")), at(START + 0.1))
    assert any(isinstance(effect, StopWire) for effect in made)
    assert AbandonJob(place) in made
    assert (arm.state, arm.error[0]) == (arm_states.State.FAULT, ErrorCode.INTERNAL)


def test_a_program_error_does_not_end_the_job_that_sends_a_stop() -> None:
    """The job sends a stop that has found the port closed."""
    arm = in_position().arm
    made = arm.on_request("~/stop", Trigger.Request(), 1, at(START + 1.0))
    (send,) = jobs(made)
    made = arm.on_defect(ValueError("a defect"), at(START + 1.1))
    assert AbandonJob(send) not in made
    assert any(isinstance(effect, StopWire) for effect in made)


def test_a_stop_that_a_program_error_interrupts_is_completed(monkeypatch):
    arm = in_position().arm
    with monkeypatch.context() as broken:
        broken.setattr(arm, "_supersede_job", raise_error)
        with pytest.raises(ValueError, match="defect"):
            arm.on_request("~/stop", Trigger.Request(), 1, at(START + 1.0))
    arm.on_defect(ValueError("a defect"), at(START + 1.0))
    assert arm.stopped and arm.state is arm_states.State.STOPPED


@pytest.mark.parametrize(
    "stop", [UnansweredRequest("~/stop", Trigger.Request(), 1), Bool(data=True)]
)
def test_a_stop_whose_handler_raises_is_latched_and_stored(stop: LostEvent) -> None:
    arm = in_position().arm
    made = arm.on_defect(ValueError("a defect"), at(START + 1.0), stop)
    assert arm.stopped and arm.state is arm_states.State.STOPPED
    assert any(isinstance(effect, KeepStop) for effect in made)


def test_a_request_to_clear_is_answered_once_if_a_program_error_occurs_meanwhile() -> None:
    arm = in_position().arm
    arm.on_request("~/stop", Trigger.Request(), 1, at(START + 1.0))
    made = arm.on_request("~/clear_fault", Trigger.Request(), 2, at(START + 2.0))
    (asked,) = (effect.token for effect in made if isinstance(effect, AskStops))
    made = arm.on_defect(ValueError("a defect"), at(START + 2.1))
    (answer,) = (effect for effect in made if isinstance(effect, Answer))
    assert answer.token == 2 and not answer.response.success
    made = arm.on_answer(asked, StopLevels(False, (), ()), at(START + 2.3))
    assert not any(isinstance(effect, Answer) for effect in made)
    assert arm.state is arm_states.State.STOPPED


@pytest.mark.parametrize("broken", ["_begin_clear", "_answer", "_urgent_content"])
def test_a_stop_can_be_cleared_again_if_a_program_error_interrupts_its_clearing(
    broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = in_position().arm

    def clear(token: int, now: float) -> int:
        made = arm.on_request("~/clear_fault", Trigger.Request(), token, at(START + now))
        return next(effect.token for effect in made if isinstance(effect, AskStops))

    arm.on_request("~/stop", Trigger.Request(), 1, at(START + 1.0))
    asked = clear(2, 2.0)
    with monkeypatch.context() as defect:
        defect.setattr(arm, broken, raise_error)
        with pytest.raises(ValueError, match="defect"):
            arm.on_answer(asked, StopLevels(False, (), ()), at(START + 2.3))
    made = arm.on_defect(ValueError("a defect"), at(START + 2.3))
    assert arm.error[0] == ErrorCode.INTERNAL
    (stored,) = (effect for effect in made if isinstance(effect, KeepStop))
    (told,) = (
        effect.message
        for effect in made
        if isinstance(effect, Publish) and effect.topic == "~/stop_state"
    )
    assert arm.stopped == told.stopped == (stored.content is not None)
    assert arm.state in (arm_states.State.STOPPED, arm_states.State.FAULT)
    made = arm.on_request("~/clear_fault", Trigger.Request(), 3, at(START + 3.0))
    assert arm.state is arm_states.State.CLEARING and jobs(made)


def raise_error(*_: object) -> None:
    raise ValueError("a defect")


def test_a_stop_while_the_last_stop_is_being_cleared_is_sent_again_afterwards() -> None:
    """The job may have cleared the controller's stop just after the new stop was sent."""
    pair = in_position()
    arm, now = pair.arm, at(START + 1.0)
    arm.on_request("~/stop", Trigger.Request(), 1, now)
    made = arm.on_request("~/clear_fault", Trigger.Request(), 2, now)
    (asked,) = (effect.token for effect in made if isinstance(effect, AskStops))
    (clear,) = jobs(arm.on_answer(asked, StopLevels(False, (), ()), now))
    arm.on_request("~/stop", Trigger.Request(), 3, now)
    made = arm.on_job(JobEnded(clear, Reading(False, PARK, False, START + 1.1)), at(START + 1.1))
    assert any(isinstance(effect, StopWire) for effect in made)
    assert arm.state is arm_states.State.STOPPED


def withdraws(made: Sequence[Effect]) -> bool:
    return any(isinstance(e, RunJob) and e.job.name == "withdraw" for e in made)


def leaving_with_a_charged_striker() -> Pair:
    """Return an arm whose tap is withdrawn while the tapper still reports a charged striker."""
    pair = in_position()
    report(pair, TapperState.CHARGED, START + 1.0)
    command = pair.command(TapCommand.WITHDRAW, at(START + 1.0))
    assert not withdraws(pair.arm.on_message("tap_command", command, at(START + 1.0)))
    return pair


def report(pair: Pair, state: int, steady: float) -> Sequence[Effect]:
    message = TapperState(state=state, tap_id=TAP)
    return pair.arm.on_message("tapper_state", message, at(steady))


@pytest.mark.parametrize("outcome", [TapperState.FIRED, TapperState.NOT_FIRED])
def test_the_arm_leaves_when_its_promise_is_over_and_the_striker_at_rest(outcome: int) -> None:
    pair = in_position()
    request = HoldStill.Request(tap_id=TAP, duration=0.26)
    pair.arm.on_request("hold_still", request, 1, at(START))
    report(pair, TapperState.FIRING, START)
    command = pair.command(TapCommand.WITHDRAW, at(START))
    assert not withdraws(pair.arm.on_message("tap_command", command, at(START + 0.1)))
    assert not withdraws(pair.arm.on_tick(at(START + 0.3)))
    over = TapperState(state=TapperState.SAFE, tap_id=TAP, outcome=outcome)
    assert withdraws(pair.arm.on_message("tapper_state", over, at(START + 0.35)))


def test_a_report_received_after_the_outcome_is_ignored() -> None:
    pair = in_position()
    report(pair, TapperState.FIRING, START)
    over = TapperState(state=TapperState.SAFE, tap_id=TAP, outcome=TapperState.FIRED)
    pair.arm.on_message("tapper_state", over, at(START + 0.01))
    report(pair, TapperState.FIRING, START + 0.02)
    command = pair.command(TapCommand.WITHDRAW, at(START + 0.1))
    assert withdraws(pair.arm.on_message("tap_command", command, at(START + 0.1)))


@given(
    st.floats(0.0, DISCHARGED_S - 0.01),
    st.sampled_from([TapperState.SAFE, TapperState.FAULT, TapperState.DISCONNECTED]),
    st.sampled_from([TapperState.NONE, TapperState.FIRED, TapperState.NOT_FIRED]),
    st.booleans(),
)
def test_only_the_tapper_itself_at_rest_lets_the_arm_leave_sooner(
    wait: float, state: int, outcome: int, contested: bool
) -> None:
    """While two nodes publish tapper_state, or the board's state is not known, the arm waits until
    the board has discharged by itself."""
    pair = leaving_with_a_charged_striker()
    if contested:
        pair.arm.on_conflict("2 nodes publish tapper_state", at(START + 1.0))
    message = TapperState(state=state, tap_id=TAP, outcome=outcome)
    made = pair.arm.on_message("tapper_state", message, at(START + 1.0 + wait))
    at_rest = state == TapperState.SAFE and outcome != TapperState.NONE and not contested
    assert withdraws(made) == at_rest
    if not at_rest:
        assert not withdraws(pair.arm.on_tick(at(START + 1.0 + wait)))
        assert withdraws(pair.arm.on_tick(at(START + 1.0 + DISCHARGED_S + 0.01)))


@pytest.mark.parametrize(("age", "moves"), [(0.0, True), (2.9, True), (3.1, False)])
def test_an_old_withdrawal_moves_nothing(age: float, moves: bool) -> None:
    pair = in_position()
    command = pair.command(TapCommand.WITHDRAW, at(START + 1.0))
    command.header.stamp = to_stamp(at(START + 1.0 - age).ros)
    made = pair.arm.on_message("tap_command", command, at(START + 1.0))
    assert withdraws(made) == moves


@given(st.floats(0.0, DISCHARGED_S - 0.01))
def test_an_arm_that_was_deactivated_homes_only_when_the_striker_is_discharged(wait):
    pair = in_position()
    report(pair, TapperState.CHARGED, START + 1.0)
    pair.arm.on_lifecycle(Deactivated(), at(START + 1.0))
    pair.arm.on_lifecycle(Activated(), at(START + 1.0 + wait))
    made = pair.arm.on_request("~/home", Trigger.Request(), 3, at(START + 1.0 + wait))
    (job,) = (e.job for e in made if isinstance(e, RunJob))
    assert isinstance(job.run, partial)
    assert job.run.keywords["not_before"] == START + 1.0 + DISCHARGED_S


@pytest.mark.parametrize("name", ["withdraw", "home", "follow", "place"])
def test_an_arm_whose_motion_was_abandoned_does_not_report_that_it_is_out_of_view(name):
    """The arm is activated again before the abandoned job has ended."""
    pair, job = moving(name)
    arm = pair.arm
    arm.on_lifecycle(Deactivated(), at(START + 1.0))
    arm.on_lifecycle(Activated(), at(START + 1.1))
    assert messages(arm.on_tick(at(START + 1.2)), "arm_state")[-1].state != ArmState.IDLE
    halfway = MotionEnd(False, Reading(True, PARK, False, START + 1.3))
    (state,) = messages(arm.on_job(JobEnded(job.number, halfway), at(START + 1.3)), "arm_state")
    assert (state.state, state.tap_id) == (ArmState.IDLE, 0)
    assert not state.clear_of_camera


def moving(name: str) -> tuple[Pair, Job]:
    """Return an arm that runs the job ``name``, and this job. Before the job, the arm is out of the
    camera's view unless the job itself ends a tap."""
    pair = in_position()
    arm, now = pair.arm, at(START + 0.5)
    made = arm.on_message("tap_command", pair.command(TapCommand.WITHDRAW, now), now)
    if name != "withdraw":
        arm.on_job(JobEnded(*jobs(made), MotionEnd(True, Reading(True, PARK, False, START))), now)
        assert arm.state is arm_states.State.IDLE
    if name == "home":
        made = arm.on_request("~/home", Trigger.Request(), 1, now)
    elif name == "follow":
        trajectory = JointTrajectory(joint_names=list(Joints._fields))
        trajectory.points = [JointTrajectoryPoint(positions=list(PARK))]
        made = arm.on_message("joint_trajectory", trajectory, now)
    elif name == "place":
        tap = replace(pair.command(TapCommand.TAP, now), tap_id=TAP + 1)
        made = arm.on_message("tap_command", tap, now)
    (job,) = (e.job for e in made if isinstance(e, RunJob))
    assert job.name == name
    return pair, job


def test_an_unreachable_strike_pose_of_a_withdrawn_tap_is_not_a_fault() -> None:
    pair, job = moving("place")
    arm = pair.arm
    withdrawal = replace(pair.command(TapCommand.WITHDRAW, at(START)), tap_id=arm._tap_id)
    arm.on_message("tap_command", withdrawal, at(START + 1.0))
    fault = HardwareFault(FaultReason.UNREACHABLE, "joint elbow would need 170 deg")
    assert withdraws(arm.on_job(JobEnded(job.number, fault=fault), at(START + 1.1)))
    assert arm.state is arm_states.State.WITHDRAWING


def test_an_arm_that_reconnects_while_its_node_is_inactive_accepts_no_goal() -> None:
    arm, here = in_position().arm, Reading(True, Joints(*CELL.file.arm.park), False, START)
    arm.on_lifecycle(Deactivated(), at(START + 1.0))
    (read,) = jobs(arm.on_tick(at(START + 2.0)))
    unplugged = HardwareFault(FaultReason.DISCONNECTED, "unplugged")
    arm.on_job(JobEnded(read, fault=unplugged), at(START + 2.0))
    assert arm.state is arm_states.State.DISCONNECTED
    (connect,) = jobs(arm.on_tick(at(START + 3.0)))
    arm.on_job(JobEnded(connect, here), at(START + 3.0))
    assert (arm.state, arm.error[0]) == (arm_states.State.INACTIVE, ErrorCode.NOT_ACTIVE)
    arm.on_lifecycle(Activated(), at(START + 4.0))
    assert arm.state is arm_states.State.IDLE


def test_an_arm_whose_controller_is_silent_does_not_count_as_homed_when_it_is_activated() -> None:
    arm = in_position().arm
    arm.on_lifecycle(Deactivated(), at(START + 1.0))
    (read,) = jobs(arm.on_tick(at(START + 2.0)))
    arm.on_job(JobEnded(read, fault=HardwareFault(FaultReason.TIMEOUT, "")), at(START + 2.0))
    arm.on_lifecycle(Activated(), at(START + 2.01))
    assert arm.state is arm_states.State.NOT_HOMED


def test_a_board_that_is_still_starting_is_given_the_longest_timeout() -> None:
    arm = in_position().arm
    (read,) = jobs(arm.on_tick(at(START + 2.0)))
    arm.on_job(JobEnded(read, fault=HardwareFault(FaultReason.DISCONNECTED, "")), at(START + 2.0))
    now, tried = START + 2.0, []
    while arm.state is arm_states.State.DISCONNECTED:
        now += 10.0
        (connect,) = jobs(arm.on_tick(at(now)))
        tried.append(arm.patience)
        fault = HardwareFault(FaultReason.UNKNOWN_FIRMWARE, "nothing answers")
        arm.on_job(JobEnded(connect, fault=fault), at(now))
        assert arm.error[1] == "nothing answers"
    assert arm.state is arm_states.State.FAULT and tried == [1.0, 2.0, 4.0, 6.0]


@pytest.mark.parametrize("kind", [arms.ArmLogic, tappers.TapperLogic])
def test_the_reason_for_a_failed_attempt_to_connect_remains(kind: type) -> None:
    """The node closes the port and then tries again."""
    device = kind(arms.ArmOptions() if kind is arms.ArmLogic else tappers.TapperOptions())
    fault = HardwareFault(FaultReason.UNKNOWN_FIRMWARE, "not the expected firmware")
    for event in (Unreachable(fault), ShutDown()):
        device.on_lifecycle(event, at(START))
    assert device.error[1] == "not the expected firmware"


@pytest.mark.parametrize("broken", ["_answer", "_urgent_content"])
def test_a_stop_is_sent_again_if_a_program_error_interrupts_its_handler(broken, monkeypatch):
    """The port may be away, so that only the job can send the stop later."""
    arm = in_position().arm
    with monkeypatch.context() as defect:
        defect.setattr(arm, broken, raise_error)
        with pytest.raises(ValueError, match="defect"):
            arm.on_request("~/stop", Trigger.Request(), 1, at(START + 1.0))
    made = arm.on_defect(ValueError("a defect"), at(START + 1.0))
    assert [e.job.name for e in made if isinstance(e, RunJob)] == ["send stop"]
    assert arm.error[0] == ErrorCode.INTERNAL


def test_an_arm_deactivated_before_an_unreachable_strike_pose_is_found_does_not_withdraw() -> None:
    pair, job = moving("place")
    arm = pair.arm
    arm.on_lifecycle(Deactivated(), at(START + 1.0))
    fault = HardwareFault(FaultReason.UNREACHABLE, "joint elbow would need 170 deg")
    assert not withdraws(arm.on_job(JobEnded(job.number, fault=fault), at(START + 1.1)))
    assert arm.state is arm_states.State.INACTIVE
    assert not withdraws(arm.on_tick(at(START + 1.2)))


class Clockwork:
    """Context of a job in virtual time. A report that the striker is charged arrives at each of the
    given times, s."""

    def __init__(self, pair: Pair, reports: Sequence[float]) -> None:
        self._pair, self._reports = pair, list(reports)
        self._time = START + 1.0
        self.pass_time(0.0)
        here = ArmReading(PARK, False, "", True, START)
        self.driver = SimpleNamespace(
            geometry=CELL.arm.geometry(),
            homed=True,
            read_joints=lambda: self.pass_time(0.005),
            read=lambda: here,
            settle=lambda goal: here,
            home=lambda strategy: self._begin(here),
            move_to=lambda *where, **how: self._begin(here),
        )
        self.began = math.inf
        """Time at which the motion began, s."""

    def pass_time(self, duration: float) -> Joints:
        self._time += duration
        while self._reports and self._reports[0] <= self._time:
            report(self._pair, TapperState.CHARGED, self._reports.pop(0))
        return PARK

    def _begin(self, here: ArmReading) -> ArmReading:
        self.began = min(self.began, self._time)
        return here

    def now(self) -> Now:
        return at(self._time)

    def sleep(self, duration: float) -> None:
        self.pass_time(duration)

    def abandoned(self) -> bool:
        """Return whether the motion has begun: the rest of the motion does not matter here."""
        return self.began < math.inf

    def post(self, content: object) -> None:
        """Discard the progress message."""

    def ask(self, query: Callable[[Now], Any]) -> Any:
        return query(self.now())


def began(name: str, reports: Sequence[float]) -> float:
    """Return when the motion of a job begins. The job runs from START + 1 s on."""
    pair, job = moving(name)
    assert isinstance(job.run, partial)
    context = Clockwork(pair, reports)
    aside = PARK._replace(shoulder=PARK.shoulder + 0.1)
    keywords: dict[str, Any] = {
        "withdraw": {"plan": lambda here: (Waypoint(aside, 1.0, "aside"),)},
        "follow": {"targets": [(aside, 0.0)]},
        "home": {},
    }
    job.run(context, **keywords[name])
    return context.began


@pytest.mark.parametrize("name", ["withdraw", "follow", "home"])
@given(st.lists(st.floats(0.0, DISCHARGED_S - 0.01), max_size=3))
def test_each_report_of_a_charged_striker_during_the_wait_delays_the_motion(name, gaps):
    reports = list(accumulate(gaps, initial=START + 0.9))
    assert began(name, reports) == pytest.approx(reports[-1] + DISCHARGED_S, abs=0.011)


def test_reports_of_the_last_tap_delay_a_motion_that_clears_the_view() -> None:
    pair, withdrawal = moving("withdraw")
    arm, now = pair.arm, at(START + 1.0)
    arm.on_job(JobEnded(withdrawal.number, MotionEnd(True, Reading(True, PARK, False, START))), now)
    command = replace(pair.command(TapCommand.CLEAR_VIEW, now), tap_id=TAP + 1)
    made = arm.on_message("tap_command", command, now)
    (job,) = (effect.job for effect in made if isinstance(effect, RunJob))
    assert isinstance(job.run, partial)
    context = Clockwork(pair, [START + 1.003, START + 1.5])
    job.run(context, plan=lambda here: (Waypoint(here, 1.0, "aside"),))
    assert context.began == pytest.approx(START + 1.5 + DISCHARGED_S, abs=0.011)


@pytest.mark.parametrize("name", ["withdraw", "follow"])
def test_a_striker_charged_while_the_job_reads_the_joints_delays_the_motion(name: str) -> None:
    reports = [START + 1.003]
    assert began(name, reports) == pytest.approx(reports[-1] + DISCHARGED_S, abs=0.011)


@pytest.mark.parametrize("name", ["withdraw", "follow", "home"])
def test_reports_of_a_charged_striker_delay_a_motion_for_a_limited_time(name: str) -> None:
    reports = [START + 0.9 + 0.05 * count for count in range(200)]
    assert began(name, reports) <= START + 1.01 + LONGEST_WAIT_S


def test_a_tapper_that_always_reports_charged_holds_the_arm_for_a_limited_time() -> None:
    pair = leaving_with_a_charged_striker()
    steady = START + 1.0
    while not withdraws(pair.arm.on_tick(at(steady))):
        report(pair, TapperState.CHARGED, steady)
        steady += 0.05
        assert steady < START + 1.1 + LONGEST_WAIT_S


def test_a_restarted_arm_keeps_the_promise_made_with_another_cell_file() -> None:
    """The cell file was changed before the restart, but the striker was fired with the old cell
    file."""
    tapper = replace(CELL.file.tapper, stroke=0.1 * CELL.file.tapper.stroke)
    quick = replace(CELL, file=replace(CELL.file, tapper=tapper))
    assert permit.longest_hold(quick) < permit.longest_hold(CELL)
    arm = arms.ArmLogic(arms.ArmOptions())
    here = Reading(False, Joints(*CELL.file.arm.park), False, START)
    arm.on_lifecycle(Configured(quick, here), at(START))
    arm.on_lifecycle(Activated(), at(START))
    made = arm.on_request("~/home", Trigger.Request(), 1, at(START))
    (job,) = (e.job for e in made if isinstance(e, RunJob))
    assert isinstance(job.run, partial)
    assert job.run.keywords["not_before"] >= START + permit.longest_hold(CELL)


@pytest.mark.parametrize("restarts", [1, 2])
def test_a_stop_received_before_the_port_opens_does_not_replace_the_stored_one(restarts):
    """One publisher has asserted the stop and vanished; another one asserts and releases its stop
    while the restarted node waits for its port."""
    stored: Content | None = {"sources": ["emergency_stop"], "asserted": True}
    for _ in range(restarts):
        arm = arms.ArmLogic(arms.ArmOptions())
        arm.recall_stop(stored)
        for level in (True, False):
            made = arm.on_message("emergency_stop", Bool(data=level), at(START))
            for effect in made:
                if isinstance(effect, KeepStop):
                    stored = effect.content
    arm.on_lifecycle(Configured(CELL, Reading(True, PARK, False, START)), at(START + 1.0))
    assert arm.state is arm_states.State.STOPPED
    (ask,) = [
        e
        for e in arm.on_request("~/clear_fault", Trigger.Request(), 1, at(START + 2.0))
        if isinstance(e, AskStops)
    ]
    made = arm.on_answer(ask.token, StopLevels(False, ("panel",), ()), at(START + 2.1))
    (answer,) = [e.response for e in made if isinstance(e, Answer)]
    assert not answer.success and "restarted" in answer.message
