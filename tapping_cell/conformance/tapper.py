"""Duties of the node that charges and fires the striker (``tapper_trigger``), carried by an arm."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tapping_cell.conformance.stage import OBJECT, SHOWN_S, Duty, Stage, Steps, check_rate
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.standing_still import CHARGED
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    TapCommand,
    TapperState,
)
from tapping_cell.messages import Pose as PoseMessage
from tapping_cell.se2 import Pose

NODE = "tapper_trigger"
STATES = "tapper_state"
LISTENS = (STATES,)
"""Topics of the node that the checks need."""
PLAYS = ("tap_command", "arm_state", "plan_state", "object_states")
"""Topics that the checks publish."""
NOTICED_S = 0.8
"""Time after which a tapper must have noticed that a condition does not hold any more."""
CHARGING_S = 10.0
"""Maximum duration of charging."""


@dataclass(slots=True)
class _Others:
    """What the played arm and the played camera report."""

    state: int = ArmState.IDLE
    tap_id: int = 0
    tip: PoseMessage | None = None
    object: Pose = OBJECT
    visible: bool = True

    def serve(self, command: TapCommand, state: int) -> None:
        """Let the arm be at the strike pose of a tap, in this state."""
        self.state, self.tap_id, self.tip = state, command.tap_id, command.strike_pose


def begin(stage: Stage) -> Steps:
    """Play the other nodes, and bring the tapper to SAFE."""
    stage.promises = True
    _play(stage)
    if not (yield from stage.until(lambda: stage.last(STATES), 5.0)):
        return "it publishes no tapper_state"
    stage.emergency_stop(False)
    end = stage.now() + 30.0
    while (state := stage.last(STATES)).state != TapperState.SAFE or _waits(state):
        if stage.now() > end:
            return f"it does not become safe: state {state.state}, '{state.error_msg}'"
        if state.state in (TapperState.STOPPED, TapperState.FAULT):
            yield from stage.ask("~/clear_fault")
        else:
            stage.withdraw(state.tap_id)
        yield from stage.pause(0.3)
    yield from stage.pause(1.0)
    return ""


def _waits(state: TapperState) -> bool:
    return bool(state.tap_id and state.outcome == TapperState.NONE)


def _play(stage: Stage) -> _Others:
    """Play arm, planner and camera; return what they report, which a check may change."""
    others = _Others()
    away = to_message(Pose(-3.0 * stage.extent, 0.0, 0.0), stage.cell.strike_height)

    def arm() -> ArmState:
        return ArmState(
            header=stage.header(),
            state=others.state,
            tap_id=others.tap_id,
            homed=True,
            tip_pose=others.tip or away,
        )

    stage.play("arm_state", arm)
    stage.play_planner()
    stage.play("object_states", lambda: stage.object_states(others.object, others.visible))
    return others


def _placed(stage: Stage, others: _Others, valid: float = 30.0) -> TapCommand:
    """Send a command, and let the played arm be in position for it."""
    command = stage.send(stage.tap(valid=valid))
    others.serve(command, ArmState.IN_POSITION)
    return command


def _outcome(stage: Stage, tap_id: int) -> int:
    state = stage.last(STATES)
    return int(state.outcome) if state.tap_id == tap_id else TapperState.NONE


def _shots(stage: Stage) -> int:
    return int(stage.last(STATES).shots_fired)


def _spoiled(stage: Stage, spoil: Callable[[_Others, TapCommand], object], what: str) -> Steps:
    """Check that a tap whose conditions are spoiled while the striker is charged is not fired, ends
    as NOT_FIRED and leaves the striker discharged."""
    others, shots = _play(stage), _shots(stage)
    stage.promises = False
    command = stage.send(stage.tap())
    others.serve(command, ArmState.MOVING)
    if not (yield from stage.until(lambda: _state(stage) == TapperState.CHARGED, CHARGING_S)):
        return f"it did not charge while the arm lowered the striker: {_error(stage)}"
    yield from stage.pause(0.2)  # the tapper has received all states since the command
    spoil(others, command)
    yield from stage.pause(NOTICED_S)
    stage.promises = True
    if others.state == ArmState.MOVING:
        others.state = ArmState.IN_POSITION
    if not (yield from stage.until(lambda: _outcome(stage, command.tap_id), CHARGING_S)):
        return f"the tap had no outcome {CHARGING_S:.0f} s after {what}"
    if _outcome(stage, command.tap_id) != TapperState.NOT_FIRED or _shots(stage) != shots:
        return f"it fired although {what}"
    if not (yield from stage.until(lambda: _state(stage) not in CHARGED, CHARGING_S)):
        return f"the striker stayed charged although {what}"
    return ""


def _state(stage: Stage) -> int:
    return int(stage.last(STATES).state)


def _error(stage: Stage) -> str:
    state = stage.last(STATES)
    return f"error {state.error_code} '{state.error_msg}'"


def _reports(stage: Stage) -> Steps:
    """Publishes `tapper_state` at least every 0.3 s, stamped with the time of the board's reply."""
    return (yield from check_rate(stage, STATES, 0.3, 1.0))


def _waits_for_arm(stage: Stage) -> Steps:
    """Charges only while `arm_state` shows the tip at or above the strike pose of this tap, and
    otherwise reports what it waits for."""
    others = _play(stage)
    command = stage.send(stage.tap())
    accepted = stage.now()
    others.state, others.tap_id = ArmState.MOVING, command.tap_id
    if not (yield from stage.throughout(lambda: _state(stage) not in CHARGED, 1.5)):
        return "it charged while the arm was not above the strike pose"
    others.state, others.tip = ArmState.IN_POSITION, command.strike_pose
    others.tap_id = command.tap_id + 1
    if not (yield from stage.throughout(lambda: _state(stage) not in CHARGED, 1.5)):
        return "it charged while the arm was in position for another tap"
    if not any(state.error_code for _, state in stage.received(STATES, accepted)):
        return "it did not report what it waits for"
    return ""


def _fires_once(stage: Stage) -> Steps:
    """Fires a valid tap once, reports FIRED, and never fires an id again or one below it."""
    others, shots = _play(stage), _shots(stage)
    command = _placed(stage, others)
    fired = TapperState.FIRED
    if not (yield from stage.until(lambda: _outcome(stage, command.tap_id), CHARGING_S)):
        return f"the tap had no outcome within {CHARGING_S:.0f} s: {_error(stage)}"
    if _outcome(stage, command.tap_id) != fired:
        return f"outcome {_outcome(stage, command.tap_id)} instead of FIRED: {_error(stage)}"
    for again, what in (
        (command, "the same command"),
        (stage.tap(tap_id=command.tap_id - 1), "an older id"),
    ):
        stage.send(again)
        others.tap_id = again.tap_id
        yield from stage.pause(2.0)
        if _shots(stage) != shots + 1:
            return f"{_shots(stage) - shots} shots after {what} was sent again, instead of 1"
    return ""


def _needs_promise(stage: Stage) -> Steps:
    """Fires only after `hold_still` was granted."""
    others, shots = _play(stage), _shots(stage)
    stage.promises = False
    command = _placed(stage, others, valid=8.0)
    yield from stage.until(lambda: _outcome(stage, command.tap_id), 12.0)
    if _outcome(stage, command.tap_id) != TapperState.NOT_FIRED or _shots(stage) != shots:
        return f"outcome {_outcome(stage, command.tap_id)} although hold_still was refused"
    return ""


def _expires(stage: Stage) -> Steps:
    """Does not fire a tap after its `expiry`; its outcome is NOT_FIRED."""
    others, shots = _play(stage), _shots(stage)
    command = stage.send(stage.tap(valid=1.0))
    others.state, others.tap_id = ArmState.MOVING, command.tap_id
    yield from stage.pause(1.2)
    others.serve(command, ArmState.IN_POSITION)
    yield from stage.pause(2.0)
    if _shots(stage) != shots or _outcome(stage, command.tap_id) != TapperState.NOT_FIRED:
        return f"outcome {_outcome(stage, command.tap_id)} instead of NOT_FIRED after its expiry"
    return ""


def _object_moved(stage: Stage) -> Steps:
    """Does not fire if the object is 10 mm from the pose for which the tap was planned."""

    def spoil(others: _Others, _: TapCommand) -> None:
        others.object = Pose(0.01, 0.0, 0.0)

    return (yield from _spoiled(stage, spoil, "the object had moved by 10 mm"))


def _object_hidden(stage: Stage) -> Steps:
    """Does not fire if the object is hidden by something other than the arm."""

    def spoil(others: _Others, _: TapCommand) -> None:
        others.visible = False

    return (yield from _spoiled(stage, spoil, "the object was hidden"))


def _ends(topic: str) -> Callable[[Stage], Steps]:
    """Return the check of a tapper while a topic ends."""

    def check(stage: Stage) -> Steps:
        return _spoiled(stage, lambda *_: stage.silence(topic), f"{topic} had ended")

    check.__doc__ = f"Does not fire and discharges if `{topic}` ends."
    return check


def _arm_leaves(stage: Stage) -> Steps:
    """Does not fire and discharges if the arm leaves its strike pose."""

    def spoil(others: _Others, _: TapCommand) -> None:
        others.state = ArmState.WITHDRAWING

    return (yield from _spoiled(stage, spoil, "the arm had left its strike pose"))


def _withdrawn(stage: Stage) -> Steps:
    """Does not fire and discharges after WITHDRAW."""

    def spoil(_: _Others, command: TapCommand) -> None:
        stage.withdraw(command.tap_id)

    return (yield from _spoiled(stage, spoil, "the tap was withdrawn"))


def _stops(stage: Stage) -> Steps:
    """Is STOPPED within 0.5 s after `emergency_stop`, and stays so until `~/clear_fault`."""
    others, shots = _play(stage), _shots(stage)
    stage.promises = False
    command = _placed(stage, others)
    yield from stage.until(lambda: _state(stage) in CHARGED, CHARGING_S)
    stage.emergency_stop(True)
    if not (yield from stage.until(lambda: _state(stage) == TapperState.STOPPED, SHOWN_S)):
        return f"not STOPPED within {SHOWN_S:.1f} s after emergency_stop"
    stage.promises = True
    stage.emergency_stop(False)
    stage.send(stage.tap(tap_id=command.tap_id))
    yield from stage.pause(2.0)
    if _state(stage) != TapperState.STOPPED:
        return "the stop ended without clear_fault"
    if _shots(stage) != shots:
        return "it fired while it was stopped"
    return ""


def _one_authority(stage: Stage) -> Steps:
    """Charges nothing while two nodes publish `arm_state`, and reports error 205."""
    others, shots = _play(stage), _shots(stage)
    stage.contest("arm_state", lambda: ArmState(header=stage.header(), state=ArmState.IDLE))
    yield from stage.pause(1.0)
    _placed(stage, others)
    charged = not (yield from stage.throughout(lambda: _state(stage) not in CHARGED, 2.0))
    named = stage.last(STATES).error_code == ErrorCode.CONFIGURATION_CONFLICT
    stage.end_contest()
    if charged or _shots(stage) != shots:
        return "it charged while two nodes published arm_state"
    if not named:
        return f"{_error(stage)}, not 205, with two publishers of arm_state"
    return ""


DUTIES = (
    Duty("T1", _reports),
    Duty("T2", _waits_for_arm),
    Duty("T3", _fires_once),
    Duty("T4", _needs_promise),
    Duty("T5", _expires),
    Duty("T6", _object_moved),
    Duty("T7", _object_hidden),
    Duty("T8", _ends("arm_state")),
    Duty("T9", _ends("plan_state")),
    Duty("T10", _ends("object_states")),
    Duty("T11", _arm_leaves),
    Duty("T12", _withdrawn),
    Duty("T13", _one_authority),
    Duty("T14", _stops),
)
