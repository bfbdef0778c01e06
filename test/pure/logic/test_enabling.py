"""Set-up mode: motion, charging and firing need an enabling device that is held at that moment."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from test_permit import CELL, START, Pair, at, board, jobs, messages

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.scara import Joints
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import arm as arms
from tapping_cell.logic import arm_states, enabling
from tapping_cell.logic import tapper as tappers
from tapping_cell.logic.arm_jobs import Reading
from tapping_cell.logic.clock import to_stamp
from tapping_cell.logic.effects import Answer, JobEnded, RunJob, StopWire
from tapping_cell.logic.enabling import HEARTBEAT_S, EnablingDevice
from tapping_cell.logic.host import Activated, Configured, Unreachable
from tapping_cell.logic.tapper_jobs import Status
from tapping_cell.logic.tapper_states import State
from tapping_cell.messages import Bool, ErrorCode, TapCommand, TapperState, Trigger

HELD, RELEASED = Bool(data=True), Bool(data=False)
PARKED = Joints(*CELL.file.arm.park)


def set_up_pair() -> Pair:
    """Return arm and tapper in set-up mode."""
    return Pair(
        arms.ArmLogic(arms.ArmOptions(set_up=True)),
        tappers.TapperLogic(tappers.TapperOptions(set_up=True)),
    )


def idle_arm() -> arms.ArmLogic:
    arm = arms.ArmLogic(arms.ArmOptions(set_up=True))
    arm.on_lifecycle(Configured(CELL, Reading(True, PARKED, False, START)), at(START))
    arm.on_lifecycle(Activated(), at(START))
    return arm


def working(steady: float = START) -> Pair:
    """Return a pair with the arm in position, the striker charged, and the page's enabling button
    held."""
    pair = set_up_pair()
    for machine in (pair.arm, pair.tapper):
        machine.on_message(enabling.TOPIC, HELD, at(steady))
    pair.begin()
    return pair


@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.floats(0, 1)), max_size=30))
def test_a_device_counts_as_held_only_within_the_heartbeat_timeout(received):
    device, now = EnablingDevice(), START
    last = {True: -1.0, False: -1.0}
    for is_key, held, pause in received:
        now += pause
        (device.on_key if is_key else device.on_switch)(held, at(now))
        last[is_key] = now if held else -1.0
        for later in (0.0, 0.17, 0.354):
            wanted = now + later - max(last.values()) <= 0.35  # docs/safety.md
            assert device.held(at(now + later)) == wanted


@pytest.mark.parametrize("set_up", [True, False])
@pytest.mark.parametrize("held", [True, False])
def test_a_restarted_node_ends_a_move_of_the_last_process_unless_a_device_is_held(set_up, held):
    """While the arm moves, the node cannot connect. Its next attempt begins with a stop."""
    arm = arms.ArmLogic(arms.ArmOptions(set_up=set_up))
    stops: list[bool] = []
    driver: Any = SimpleNamespace(stop_when_opened=lambda: stops.append(True))
    arm.before_connect(driver)
    assert not stops, "the first attempt leaves an arm alone that another program moves"
    arm.on_message(enabling.TOPIC, HELD if held else RELEASED, at(START))
    moving = HardwareFault(FaultReason.TIMEOUT, "the arm is still moving")
    arm.on_lifecycle(Unreachable(moving), at(START + 0.1))
    arm.before_connect(driver)
    assert bool(stops) is (set_up and not held)


@pytest.mark.parametrize("what", ["tap", "trajectory", "home"])
def test_no_motion_starts_while_no_device_is_held(what: str) -> None:
    arm, now = idle_arm(), at(START)
    if what == "tap":
        made = arm.on_message("tap_command", Pair().command(TapCommand.TAP, now), now)
    elif what == "home":
        made = arm.on_request("~/home", Trigger.Request(), 1, now)
        (answer,) = [effect for effect in made if isinstance(effect, Answer)]
        assert not answer.response.success and "enabling device" in answer.response.message
    else:
        from tapping_cell.messages import Duration, JointTrajectory, JointTrajectoryPoint

        point = JointTrajectoryPoint(positions=list(PARKED), time_from_start=Duration(sec=1))
        message = JointTrajectory(joint_names=list(Joints._fields), points=[point])
        made = arm.on_message("joint_trajectory", message, now)
    assert not jobs(made) and arm.state is arm_states.State.IDLE
    if what != "home":
        assert arm.error[0] == ErrorCode.ENABLING_RELEASED


@pytest.mark.parametrize("set_up", [True, False])
def test_the_arm_moves_slowly_and_homes_only_on_request_in_set_up_mode(set_up: bool) -> None:
    arm = arms.ArmLogic(arms.ArmOptions(set_up=set_up, home_on_activate=True))
    now = at(START)
    arm.on_lifecycle(Configured(CELL, Reading(True, PARKED, False, START)), now)
    assert bool(jobs(arm.on_lifecycle(Activated(), now))) is not set_up
    factor = arms.SET_UP_SPEED if set_up else 1.0
    assert (arms.SET_UP_SPEED < 0.5) and arm._cycle.motion() == replace(
        CELL.arm.motion(),
        travel_speed=factor * CELL.arm.motion().travel_speed,
        near_speed=factor * CELL.arm.motion().near_speed,
    )


def test_a_trajectory_is_followed_slowly_in_set_up_mode() -> None:
    from tapping_cell.messages import Duration, JointTrajectory, JointTrajectoryPoint

    arm = idle_arm()
    arm.on_message(enabling.TOPIC, HELD, at(START))
    point = JointTrajectoryPoint(positions=list(PARKED), time_from_start=Duration(sec=1))
    message = JointTrajectory(joint_names=list(Joints._fields), points=[point])
    made = arm.on_message("joint_trajectory", message, at(START + 0.01))
    (follow,) = [effect.job.run for effect in made if isinstance(effect, RunJob)]
    assert follow.keywords["targets"] and follow.keywords["scale"] == arms.SET_UP_SPEED


@pytest.mark.parametrize("end", ["let go", "silence", "another node"])
def test_a_moving_arm_stops_when_the_key_is_released(end: str) -> None:
    pair = working()
    arm, now = pair.arm, at(START + 1.1 * HEARTBEAT_S)
    assert arm.state is arm_states.State.IN_POSITION
    if end == "let go":
        made = arm.on_message(enabling.TOPIC, RELEASED, at(START + 0.01))
    elif end == "silence":
        made = arm.on_tick(now)
    else:
        made = arm.on_message("tapper_state", TapperState(), now)
    assert isinstance(made[0], StopWire) and arm.state is arm_states.State.STOPPED
    assert arm.error[0] == ErrorCode.ENABLING_RELEASED
    (stop,) = messages(made, "stop_state") or messages(made, "~/stop_state")
    assert stop.stopped and enabling.SOURCE in stop.sources
    # Holding the key again does not restart the arm; a person must clear the stop first.
    made = arm.on_message(enabling.TOPIC, HELD, at(START + 1.0))
    assert not jobs(made) and arm.state is arm_states.State.STOPPED


def test_releasing_the_key_does_not_stop_an_idle_arm() -> None:
    arm = idle_arm()
    arm.on_message(enabling.TOPIC, HELD, at(START))
    arm.on_message(enabling.TOPIC, RELEASED, at(START + 0.1))
    arm.on_tick(at(START + 5.0))
    assert arm.state is arm_states.State.IDLE


def report(published: float, held: bool = True) -> TapperState:
    """Return a report of the tapper's node that was published at this steady time, s."""
    made = TapperState(enabling_switch=held)
    made.header.stamp = to_stamp(at(published).ros)
    return made


def begins_a_tap(arm: arms.ArmLogic, time: float) -> bool:
    command = Pair().command(TapCommand.TAP, at(time))
    return bool(jobs(arm.on_message("tap_command", command, at(time))))


def test_the_foot_switch_enables_as_the_key_does() -> None:
    arm = idle_arm()
    arm.on_message("tapper_state", report(START), at(START))
    assert begins_a_tap(arm, START) and arm.state is arm_states.State.PLACING


def test_a_report_of_the_switch_without_a_stamp_does_not_enable() -> None:
    arm = idle_arm()
    arm.on_message("tapper_state", TapperState(enabling_switch=True), at(START))
    assert not begins_a_tap(arm, START)


@given(st.floats(0.0, 3.0))
def test_a_late_report_of_the_switch_counts_from_its_stamp(delay: float) -> None:
    assume(abs(delay - HEARTBEAT_S) > 1e-6)
    arm = idle_arm()
    arm.on_message("tapper_state", report(START), at(START))
    now = START + 3.0
    arm.on_message("tapper_state", report(now - delay), at(now))
    assert begins_a_tap(arm, now) == (delay <= HEARTBEAT_S)


@pytest.mark.parametrize("old", [True, False])
def test_a_repeated_report_of_the_switch_changes_nothing_unless_it_was_released(old: bool) -> None:
    arm = idle_arm()
    arm.on_message("tapper_state", report(START, held=old), at(START))
    arm.on_message("tapper_state", report(START + 3.0), at(START + 3.0))
    arm.on_message("tapper_state", report(START, held=old), at(START + 3.1))
    assert begins_a_tap(arm, START + 3.1) == old


@given(st.floats(0.0, 1.0))
def test_the_last_check_before_firing_requires_a_held_key(late: float) -> None:
    pair = working()
    now = at(START + late)
    reason = pair.tapper.check_firing(now.steady, now)
    assert reason is not None
    held = now.steady - START <= HEARTBEAT_S
    assert (reason[0] == ErrorCode.ENABLING_RELEASED) != held


def test_a_charged_tapper_discharges_when_the_key_is_released() -> None:
    pair = working()
    tapper = pair.tapper
    made = tapper.on_message(enabling.TOPIC, RELEASED, at(START + 0.05))
    (discharge,) = jobs(made)
    assert tapper.state is State.DISCHARGING
    status = Status(board(BoardState.SAFE), 0)
    reported = messages(tapper.on_job(JobEnded(discharge, status), at(START + 0.1)), "tapper_state")
    assert reported[-1].outcome == TapperState.NOT_FIRED
    assert reported[-1].error_code == ErrorCode.ENABLING_RELEASED


def test_a_tap_without_a_held_device_is_refused_and_not_fired() -> None:
    tapper, now = tappers.TapperLogic(tappers.TapperOptions(set_up=True)), at(START)
    tapper.on_lifecycle(Configured(CELL, board(BoardState.SAFE)), now)
    tapper.on_lifecycle(Activated(), now)
    made = tapper.on_message("tap_command", Pair().command(TapCommand.TAP, now), now)
    (reported,) = messages(made, "tapper_state")
    assert (reported.outcome, reported.error_code) == (
        TapperState.NOT_FIRED,
        ErrorCode.ENABLING_RELEASED,
    )


def test_the_board_reports_its_switch() -> None:
    tapper, now = tappers.TapperLogic(tappers.TapperOptions(set_up=True)), at(START)
    held = replace(board(BoardState.SAFE), enabled=True)
    tapper.on_lifecycle(Configured(CELL, held), now)
    tapper.on_lifecycle(Activated(), now)
    (read,) = jobs(tapper.on_tick(at(START + 0.2)))
    made = tapper.on_job(JobEnded(read, Status(held, 0)), at(START + 0.2))
    made = [*made, *tapper.on_tick(at(START + 0.25))]
    assert messages(made, "tapper_state")[-1].enabling_switch
    tap = Pair().command(TapCommand.TAP, now)
    tapper.on_message("tap_command", tap, at(START + 0.3))
    assert tapper.state is State.WAITING


def test_without_set_up_mode_no_device_is_required() -> None:
    pair = Pair()
    pair.begin()
    for machine in (pair.arm, pair.tapper):
        machine.on_message(enabling.TOPIC, RELEASED, at(START + 0.1))
        machine.on_tick(at(START + 0.1))
    assert pair.arm.state is arm_states.State.IN_POSITION
    assert pair.tapper.state is State.CHARGED


@pytest.mark.parametrize("event", ["stop", "silence"])
def test_a_switch_that_the_board_no_longer_reports_counts_as_released(event: str) -> None:
    """A stopped tapper's board is not read, so its switch is not known."""
    tapper, now = tappers.TapperLogic(tappers.TapperOptions(set_up=True)), at(START)
    held = replace(board(BoardState.SAFE), enabled=True)
    tapper.on_lifecycle(Configured(CELL, held), now)
    tapper.on_lifecycle(Activated(), now)
    (read,) = jobs(tapper.on_tick(at(START + 0.2)))
    tapper.on_job(JobEnded(read, Status(held, 0)), at(START + 0.2))
    if event == "stop":
        tapper.on_message("emergency_stop", Bool(data=True), at(START + 0.25))
    made = tapper.on_tick(at(START + 0.2 + 1.1 * HEARTBEAT_S))
    assert not messages(made, "tapper_state")[-1].enabling_switch
