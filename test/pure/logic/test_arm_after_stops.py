"""What an arm forgets and keeps after a stop, a fault or a lost connection."""

from __future__ import annotations

from typing import Any, cast

import pytest
from test_permit import CELL, START, at, jobs, messages

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.scara import Joints
from tapping_cell.logic.arm import ArmLogic, ArmOptions
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.arm_states import State, Withdrawing
from tapping_cell.logic.effects import Answer, JobEnded, RunJob
from tapping_cell.logic.enabling import TOPIC
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.messages import ArmState, Bool, ErrorCode, TapCommand, Trigger

PARKED = Joints(*CELL.file.arm.park)
MOVED = PARKED._replace(tool=PARKED.tool + 0.1)


def idle(set_up: bool = False) -> ArmLogic:
    arm = ArmLogic(ArmOptions(set_up=set_up))
    arm.on_lifecycle(Configured(CELL, Reading(True, PARKED, False, START)), at(START))
    arm.on_lifecycle(Activated(), at(START))
    assert arm.state is State.IDLE
    return arm


def reported(arm: ArmLogic, steady: float = START) -> ArmState:
    return messages(list(arm.on_tick(at(steady))), "arm_state")[-1]


@pytest.mark.parametrize("tap_id", [0, 7])
def test_a_withdrawal_of_a_tap_that_never_began_moves_nothing(tap_id: int) -> None:
    command = TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id)
    arm = idle()
    assert not jobs(list(arm.on_message("tap_command", command, at(START))))
    assert arm.state is State.IDLE


@pytest.mark.parametrize("result", [Reading(True, MOVED, False, START), None, "motion"])
@pytest.mark.parametrize("stopped", [True, False])
def test_a_reading_of_a_superseded_job_counts_unless_the_arm_was_stopped(result: Any, stopped):
    arm = idle()
    if stopped:
        arm.on_message("emergency_stop", Bool(data=True), at(START))
    if result == "motion":
        result = MotionEnd(False, Reading(True, MOVED, False, START))
    before = arm._readings.last
    arm.on_job(JobEnded(99, result), at(START))
    kept = arm._readings.last
    if stopped or result is None:
        assert kept is before
    else:
        assert kept is not None and kept.joints == MOVED


def test_a_stop_is_reported_with_its_cause_and_forgets_the_position() -> None:
    arm = idle()
    assert reported(arm).homed
    arm.on_message("emergency_stop", Bool(data=True), at(START))
    state = reported(arm)
    assert (state.state, state.error_code) == (ArmState.STOPPED, ErrorCode.ARM_STOPPED)
    assert not state.homed and arm._readings.last is None


@pytest.mark.parametrize(
    ("reason", "state"),
    [
        (FaultReason.TIMEOUT, State.FAULT),
        (FaultReason.DISCONNECTED, State.DISCONNECTED),
    ],
)
def test_a_fault_forgets_the_position_and_ends_a_deactivation(reason, state) -> None:
    arm = idle()
    arm._deactivating = True
    arm._job, arm._job_name = 99, "withdraw"
    arm._machine._state = State.WITHDRAWING
    arm.on_job(JobEnded(99, None, HardwareFault(reason, "the fault")), at(START))
    assert arm.state is state and not reported(arm).homed
    assert arm.error[1] == "the fault" and not arm._deactivating


def test_a_lost_arm_is_connected_20_times_a_second_and_one_at_a_time() -> None:
    arm = idle()
    arm._machine._state = State.DISCONNECTED
    began = []
    for step in range(5):
        effects = arm.on_tick(at(START + 0.025 * step))
        names = [effect.job.name for effect in effects if isinstance(effect, RunJob)]
        began.append(names == ["connect"])
        if names:
            arm._job = None
    assert began == [True, False, True, False, True]
    arm.on_tick(at(START + 1.0))
    assert not jobs(list(arm.on_tick(at(START + 2.0)))), "the last attempt has not ended"


@pytest.mark.parametrize("set_up", [True, False])
@pytest.mark.parametrize("held", [True, False])
def test_a_held_key_is_reported_in_set_up_mode_only(set_up: bool, held: bool) -> None:
    arm = idle(set_up)
    arm.on_message(TOPIC, Bool(data=held), at(START))
    assert arm._is_key_held(at(START)) == (set_up and held)


@pytest.mark.parametrize("held", [True, False])
@pytest.mark.parametrize("scene", ["a scene", None])
def test_a_second_withdrawal_parks_an_arm_that_may_move_and_hides_the_object(scene, held) -> None:
    arm = idle(set_up=True)
    arm.on_message(TOPIC, Bool(data=held), at(START + 9.0))
    arm._last_tap_id = 7
    arm._last_withdrawal = Withdrawing(tap_id=7, scene=scene)
    command = TapCommand(request=TapCommand.WITHDRAW, tap_id=7)
    moves = bool(jobs(list(arm.on_message("tap_command", command, at(START + 9.0)))))
    assert moves == (held and scene is not None)
    arm = idle(set_up=True)
    arm.on_message(TOPIC, Bool(data=held), at(START + 9.0))
    arm._last_tap_id = 7
    assert not jobs(list(arm.on_message("tap_command", command, at(START + 9.0))))


def test_every_request_to_home_is_answered() -> None:
    arm = idle()
    for state, success in ((State.IDLE, True), (State.PLACING, False), (State.FAULT, False)):
        arm._machine._state = state
        effects = arm.on_request("~/home", Trigger.Request(), cast(Any, 5), at(START + 9.0))
        (answer,) = [effect for effect in effects if isinstance(effect, Answer)]
        assert cast(Trigger.Response, answer.response).success == success


def test_an_arm_without_a_known_position_is_not_jogged() -> None:
    arm = idle(set_up=True)
    arm.on_message(TOPIC, Bool(data=True), at(START + 9.0))
    arm._readings.take_in(Reading(True, PARKED, False, START + 9.0), at(START + 9.0))
    assert arm._jog_refusal(at(START + 9.0)) is None
    arm._readings.take_in(Reading(False, PARKED, False, START + 9.0), at(START + 9.0))
    refusal = arm._jog_refusal(at(START + 9.0))
    assert refusal is not None and refusal[0] == ErrorCode.ARM_TIMEOUT


def test_a_stop_ends_a_deactivation() -> None:
    arm = idle()
    arm._deactivating = True
    arm.on_message("emergency_stop", Bool(data=True), at(START))
    assert not arm._deactivating
