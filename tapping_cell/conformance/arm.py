"""Duties of the node that moves the striker (``scara_arm``)."""

from __future__ import annotations

import math

from tapping_cell.conformance.stage import PATIENCE_S, SHOWN_S, Duty, Stage, Steps, check_rate, far
from tapping_cell.logic.permit import longest_hold
from tapping_cell.logic.poses import to_message
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    HoldStill,
    TapCommand,
    TapperState,
)
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.se2 import Pose

NODE = "scara_arm"
STATES = "arm_state"
LISTENS = (STATES,)
"""Topics of the node that the checks need."""
PLAYS = ("tap_command", "tapper_state", "plan_state", "object_states")
"""Topics that the checks publish."""
PLACED_M, PLACED_RAD = 0.002, 0.05
"""Maximum difference between the strike pose and the tip that was read back."""
STILL_M, STILL_RAD = 0.0005, 0.01
"""Maximum change of the tip that was read back while the arm stands still."""


def begin(stage: Stage) -> Steps:
    """Play the other nodes, and bring the arm to IDLE."""
    stage.play("tapper_state", lambda: TapperState(header=stage.header(""), state=TapperState.SAFE))
    stage.play_planner()
    stage.play("object_states", stage.object_states)
    if not (yield from stage.until(lambda: stage.last(STATES), 5.0)):
        return "it publishes no arm_state"
    stage.emergency_stop(False)
    end = stage.now() + 2.0 * PATIENCE_S
    while _state(stage) != ArmState.IDLE:
        state = stage.last(STATES)
        if stage.now() > end:
            return f"it does not become idle: state {state.state}, '{state.error_msg}'"
        if state.state in (ArmState.STOPPED, ArmState.FAULT):
            yield from stage.ask("~/clear_fault")
        elif state.state == ArmState.NOT_HOMED:
            yield from stage.ask("~/home", patience=PATIENCE_S)
        elif state.state == ArmState.IN_POSITION:
            stage.withdraw(state.tap_id)
        yield from stage.pause(0.3)
    return ""


def _state(stage: Stage) -> int:
    return int(stage.last(STATES).state)


def _tip(stage: Stage) -> PoseMessage:
    return stage.last(STATES).tip_pose  # type: ignore[no-any-return]


def _place(stage: Stage, command: TapCommand) -> Steps:
    """Send a command and wait until the arm is in position for it."""
    stage.send(command)

    def placed() -> bool:
        state = stage.last(STATES)
        return bool(state.state == ArmState.IN_POSITION and state.tap_id == command.tap_id)

    if (yield from stage.until(placed, PATIENCE_S)):
        return ""
    state = stage.last(STATES)
    return f"it did not reach the strike pose: state {state.state}, '{state.error_msg}'"


def _stands(stage: Stage, duration: float) -> Steps:
    """Check that the arm stands still for a duration in s."""
    begun, tip = stage.now(), _tip(stage)
    yield from stage.pause(duration)
    for at, state in stage.received(STATES, begun):
        if far(state.tip_pose, tip, STILL_M, STILL_RAD):
            return f"the arm moved {at - begun:.2f} s later"
    return ""


def _refuses(stage: Stage, command: TapCommand, what: str) -> Steps:
    """Check that the arm refuses a command with an error, and does not move."""
    begun = stage.now()
    stage.send(command)
    moved = yield from _stands(stage, 1.5)
    if moved:
        return f"it accepted {what}: {moved}"
    shown = [s for at, s in stage.received(STATES, begun) if at < begun + SHOWN_S]
    if not any(state.error_code and state.error_msg for state in shown):
        return f"it reported no error within {SHOWN_S:.1f} s after {what}"
    return ""


def _reports(stage: Stage) -> Steps:
    """Publishes `arm_state` at least every 0.3 s, in `table`, stamped with the time of the
    read-back."""
    found = yield from check_rate(stage, STATES, 0.3, 0.3)
    frame = stage.last(STATES).header.frame_id
    return found or ("" if frame == "table" else f"its frame is '{frame}', not 'table'")


def _reaches(stage: Stage) -> Steps:
    """Moves the tip to `strike_pose`; IN_POSITION with the tap's id means that the tip was read
    back within 2 mm and 0.05 rad. After WITHDRAW it becomes IDLE with `clear_of_camera`."""
    for heading in (0.0, 1.2):
        command = stage.tap(heading)
        if failed := (yield from _place(stage, command)):
            return failed
        if far(_tip(stage), command.strike_pose, PLACED_M, PLACED_RAD):
            return f"IN_POSITION with its tip away from the strike pose: {_tip(stage)}"
        stage.withdraw(command.tap_id)

        def left() -> bool:
            state = stage.last(STATES)
            return bool(state.state == ArmState.IDLE and state.clear_of_camera)

        if not (yield from stage.until(left)):
            return "after WITHDRAW it did not become IDLE with clear_of_camera"
    return ""


def _keeps_promise(stage: Stage) -> Steps:
    """Grants `hold_still` in position, and begins no motion until the promise ends, even if the tap
    is withdrawn."""
    command = stage.tap()
    if failed := (yield from _place(stage, command)):
        return failed
    yield from stage.pause(0.5)
    request = HoldStill.Request(tap_id=command.tap_id, duration=longest_hold(stage.cell))
    asked = stage.now()
    answer = yield from stage.ask("hold_still", request)
    if answer is None or not answer.granted:
        return f"hold_still was not granted in position: {answer}"
    tip, answered = _tip(stage), stage.now()
    stage.withdraw(command.tap_id)
    if not (yield from stage.until(lambda: far(_tip(stage), tip, STILL_M, STILL_RAD))):
        return "it did not leave the strike pose after WITHDRAW"
    moved = next(
        at for at, s in stage.received(STATES, asked) if far(s.tip_pose, tip, STILL_M, STILL_RAD)
    )
    if moved < answered + answer.duration - 0.005:
        early = answered + answer.duration - moved
        return f"it moved {early:.3f} s before the end of its promise"
    return ""


def _refuses_promise(stage: Stage) -> Steps:
    """Refuses `hold_still` for another tap and when it is not in position."""
    command = stage.tap()
    if failed := (yield from _place(stage, command)):
        return failed
    for tap_id, where in ((command.tap_id + 1, "for another tap"), (0, "for the id 0")):
        request = HoldStill.Request(tap_id=tap_id, duration=longest_hold(stage.cell))
        answer = yield from stage.ask("hold_still", request)
        if answer is None or answer.granted or not answer.error_code:
            return f"hold_still {where} was not refused with an error: {answer}"
    stage.withdraw(command.tap_id)
    yield from stage.until(lambda: _state(stage) == ArmState.IDLE)
    request = HoldStill.Request(tap_id=command.tap_id, duration=longest_hold(stage.cell))
    answer = yield from stage.ask("hold_still", request)
    if answer is None or answer.granted:
        return "hold_still was granted while the arm was not in position"
    return ""


def _waits_for_discharge(stage: Stage) -> Steps:
    """Does not leave the strike pose while `tapper_state` reports a charged striker, for up to
    3 s.
    """
    command = stage.tap()
    if failed := (yield from _place(stage, command)):
        return failed
    charged = TapperState.CHARGED

    def state() -> TapperState:
        return TapperState(header=stage.header(""), state=charged, tap_id=command.tap_id)

    stage.play("tapper_state", state)
    yield from stage.pause(0.5)
    stage.withdraw(command.tap_id)
    if moved := (yield from _stands(stage, 1.0)):
        return f"with a charged striker, {moved}"
    charged = TapperState.SAFE
    if not (yield from stage.until(lambda: _state(stage) == ArmState.IDLE)):
        return "it did not leave after the striker was discharged"
    return ""


def _once(stage: Stage) -> Steps:
    """Executes each id once, and no id below the last one."""
    command = stage.tap()
    if failed := (yield from _place(stage, command)):
        return failed
    stage.withdraw(command.tap_id)
    yield from stage.until(lambda: _state(stage) == ArmState.IDLE)
    older = stage.tap(tap_id=command.tap_id - 1)
    for again, what in ((command, "the same command again"), (older, "an older id")):
        stage.send(again)
        if moved := (yield from _stands(stage, 1.5)):
            return f"after {what}, {moved}"
    return ""


def _expires(stage: Stage) -> Steps:
    """Begins no tap after its `expiry`, and says so within 0.5 s."""
    return (yield from _refuses(stage, stage.tap(valid=-0.2), "an expired command"))


def _invalid(stage: Stage) -> Steps:
    """Refuses another frame than `table`, numbers that are not finite, and a pose out of reach,
    with an error within 0.5 s."""
    far_away = to_message(Pose(30.0, 0.0, 0.0), stage.cell.strike_height)
    infinite = to_message(Pose(math.nan, 0.0, 0.0), stage.cell.strike_height)
    for command, what in (
        (stage.tap(header=stage.header("map")), "a command in the frame 'map'"),
        (stage.tap(strike_pose=infinite), "a strike pose that is not a number"),
        (stage.tap(strike_pose=far_away), "a strike pose 30 m away"),
    ):
        if found := (yield from _refuses(stage, command, what)):
            return found
        yield from stage.until(lambda: _state(stage) == ArmState.IDLE)
    return ""


def _old_withdrawal(stage: Stage) -> Steps:
    """Ignores a WITHDRAW that is older than 3 s."""
    command = stage.tap()
    if failed := (yield from _place(stage, command)):
        return failed
    stage.withdraw(command.tap_id, age=4.0)
    moved = yield from _stands(stage, 1.0)
    return f"after a WITHDRAW of 4 s ago, {moved}" if moved else ""


def _stops(stage: Stage) -> Steps:
    """Is STOPPED within 0.5 s after `emergency_stop`, and stays so until `~/clear_fault`."""
    command, parked = stage.tap(), _tip(stage)
    stage.send(command)
    if not (yield from stage.until(lambda: far(_tip(stage), parked, STILL_M, STILL_RAD))):
        return "it did not move after a command"
    stage.emergency_stop(True)
    if not (yield from stage.until(lambda: _state(stage) == ArmState.STOPPED, SHOWN_S)):
        return f"not STOPPED within {SHOWN_S:.1f} s after emergency_stop"
    yield from stage.pause(0.5)
    stage.emergency_stop(False)
    moved = yield from _stands(stage, 1.5)
    if moved or _state(stage) != ArmState.STOPPED:
        return "the stop ended without clear_fault" + (f"; {moved}" if moved else "")
    stage.send(stage.tap())
    moved = yield from _stands(stage, 1.0)
    return f"while stopped, {moved}" if moved else ""


def _one_authority(stage: Stage) -> Steps:
    """Moves nothing while two nodes publish `tap_command`, and reports error 205."""
    own = stage.tap()
    stage.contest("tap_command", lambda: own)
    moved = yield from _stands(stage, 2.0)
    named = stage.last(STATES).error_code == ErrorCode.CONFIGURATION_CONFLICT
    stage.end_contest()
    if moved:
        return f"with two publishers of tap_command, {moved}"
    if not named:
        return f"error {stage.last(STATES).error_code}, not 205, with two publishers of tap_command"
    return ""


DUTIES = (
    Duty("A1", _reports),
    Duty("A2", _reaches),
    Duty("A3", _keeps_promise),
    Duty("A4", _refuses_promise),
    Duty("A5", _waits_for_discharge),
    Duty("A6", _once),
    Duty("A7", _expires),
    Duty("A8", _invalid),
    Duty("A9", _old_withdrawal),
    Duty("A10", _one_authority),
    Duty("A11", _stops),
)
