"""Duties of the node that chooses the taps (``tap_planner``)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tapping_cell.conformance.stage import Duty, Stage, Steps, check_rate
from tapping_cell.logic.clock import to_nanoseconds
from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.logic.poses import covariance_to_message, from_message, to_message
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    ObjectStates,
    PlanState,
    PoseStamped,
    TapCommand,
    TapperState,
)
from tapping_cell.se2 import Pose

NODE = "tap_planner"
STATES = "plan_state"
LISTENS = (STATES, "tap_command")
"""Topics of the node that the checks need."""
PLAYS = ("arm_state", "tapper_state", "object_states", "goal_pose")
"""Topics that the checks publish."""
START, GOAL = Pose(-0.02, 0.01, 0.2), Pose(0.01, 0.02, 0.3)
PLACING_S, FIRING_S, LEAVING_S = 0.5, 0.3, 0.4
"""Durations of the played devices, s."""
GOAL_S = 90.0
"""Maximum duration of a goal."""
SCATTER_M, SCATTER_RAD = 1e-5, 1e-4


@dataclass(slots=True)
class _Cell:
    """Played arm, tapper, camera and object."""

    stage: Stage
    pose: Pose = START
    visible: bool = True
    handled: int = 0
    tap: TapCommand | None = None
    placed_at: float = math.inf
    fired_at: float = math.inf
    idle_at: float = math.inf
    outcome: int = TapperState.NONE
    too_early: list[str] = field(default_factory=list)

    def update(self) -> None:
        """Process the commands since the last call, and let the devices work."""
        now, commands = self.stage.now(), self.stage.received("tap_command")
        for at, command in commands[self.handled :]:
            if command.request == TapCommand.TAP:
                if self.tap is not None:
                    self.too_early.append(f"tap {command.tap_id} before {self.tap.tap_id} ended")
                self.tap, self.outcome = command, TapperState.NONE
                self.placed_at, self.fired_at = at + PLACING_S, at + PLACING_S + FIRING_S
                self.idle_at = math.inf
            elif self.tap is not None and command.tap_id == self.tap.tap_id:
                self.idle_at = min(self.idle_at, at + LEAVING_S)
                if self.outcome == TapperState.NONE:
                    self.outcome, self.fired_at = TapperState.NOT_FIRED, math.inf
        self.handled = len(commands)
        if self.tap is not None and now >= self.fired_at and self.outcome == TapperState.NONE:
            self.outcome, self.pose = TapperState.FIRED, from_message(self.tap.predicted_pose)
        if now >= self.idle_at:
            self.tap, self.idle_at = None, math.inf

    def arm(self) -> ArmState:
        self.update()
        state = ArmState.IDLE
        if self.tap is not None:
            state = ArmState.IN_POSITION
            if self.stage.now() < self.placed_at:
                state = ArmState.MOVING
            elif math.isfinite(self.idle_at):
                state = ArmState.WITHDRAWING
        return ArmState(
            header=self.stage.header(),
            state=state,
            tap_id=self.tap.tap_id if self.tap is not None else 0,
            homed=True,
            clear_of_camera=state == ArmState.IDLE,
            tip_pose=self.tap.strike_pose if self.tap is not None else to_message(Pose(-0.3, 0, 0)),
        )

    def tapper(self) -> TapperState:
        last = [c for _, c in self.stage.received("tap_command") if c.request == TapCommand.TAP]
        charged = self.tap is not None and self.outcome == TapperState.NONE
        return TapperState(
            header=self.stage.header(""),
            state=TapperState.CHARGED
            if charged and self.stage.now() > self.placed_at
            else TapperState.SAFE,
            tap_id=last[-1].tap_id if last else 0,
            outcome=self.outcome if last else TapperState.NONE,
            interlock_closed=True,
        )

    def seen(self) -> ObjectStates:
        state = self.stage.object_state(self.pose, self.visible)
        if self.visible:
            state.at_rest_since = self.stage.stamp(-0.2)
            state.references_used = [marker.id for marker in self.stage.cell.references.markers]
            scatter = np.diag([SCATTER_M, SCATTER_M, SCATTER_RAD]) ** 2
            state.pose.covariance = covariance_to_message(scatter)
        return ObjectStates(header=state.header, objects=[state])


def begin(stage: Stage) -> Steps:
    """Play the other nodes until the planner has no goal."""
    _play(stage)
    stage.emergency_stop(False)
    if not (yield from stage.until(lambda: stage.last(STATES), 5.0)):
        return "it publishes no plan_state"

    def idle() -> bool:
        return stage.last(STATES).state in (PlanState.IDLE, *FINAL_STATES)

    if not (yield from stage.until(idle, GOAL_S)):
        return f"it does not end its goal: state {stage.last(STATES).state}"
    yield from stage.pause(2.0)
    return ""


def _play(stage: Stage) -> _Cell:
    cell = _Cell(stage, handled=len(stage.received("tap_command")))
    stage.play("arm_state", cell.arm, 0.03)
    stage.play("tapper_state", cell.tapper, 0.03)
    stage.play("object_states", cell.seen, 0.03)
    return cell


def _send(stage: Stage, goal: Pose = GOAL, frame: str = "table") -> float:
    """Send a goal; return its time."""
    stage.publish("goal_pose", PoseStamped(header=stage.header(frame), pose=to_message(goal)))
    return stage.now()


def _taps(stage: Stage, since: float) -> list[TapCommand]:
    found = stage.received("tap_command", since)
    return [command for _, command in found if command.request == TapCommand.TAP]


def _ended(stage: Stage, since: float) -> bool:
    return any(state.state in FINAL_STATES for _, state in stage.received(STATES, since))


def _end(stage: Stage, since: float) -> PlanState:
    found = [state for _, state in stage.received(STATES, since) if state.state in FINAL_STATES]
    return found[-1]  # type: ignore[no-any-return]


def _reports(stage: Stage) -> Steps:
    """Publishes `plan_state` at least every 1.5 s, and every 0.45 s during a tap."""
    if found := (yield from check_rate(stage, STATES, 1.5, 0.45)):
        return found
    sent = _send(stage)
    if not (yield from stage.until(lambda: _taps(stage, sent), 20.0)):
        return "it commanded no tap"
    begun = stage.now()
    yield from stage.pause(PLACING_S)
    gap = stage.gap(STATES, begun)
    return f"no plan_state for {gap:.2f} s during a tap (limit 0.45 s)" if gap > 0.45 else ""


def _reaches(stage: Stage) -> Steps:
    """Reaches a goal, reports REACHED only for a measured pose within tolerance, commands one tap
    at a time, and counts them."""
    cell = _play(stage)
    sent = _send(stage)
    if not (yield from stage.until(lambda: _ended(stage, sent), GOAL_S)):
        return f"the goal had no end within {GOAL_S:.0f} s"
    end = _end(stage, sent)
    if end.state != PlanState.REACHED:
        return f"the goal failed: error {end.error_code} '{end.error_msg}'"
    off, turned = cell.pose.distance_to(GOAL), abs(cell.pose.rotation_to(GOAL))
    if off > end.position_tolerance or turned > end.angle_tolerance:
        return f"REACHED with the object {1e3 * off:.2f} mm from the goal"
    if cell.too_early:
        return cell.too_early[0]
    if end.taps != len(_taps(stage, sent)):
        return f"it reports {end.taps} taps, but commanded {len(_taps(stage, sent))}"
    return ""


def _commands(stage: Stage) -> Steps:
    """Every TAP has an id above all earlier ones, the frame `table`, an `expiry`, finite numbers,
    and is followed by its WITHDRAW."""
    _play(stage)
    last = max((c.tap_id for _, c in stage.received("tap_command")), default=0)
    sent = _send(stage)
    yield from stage.until(lambda: _ended(stage, sent), GOAL_S)
    yield from stage.pause(0.5)
    commands = [command for _, command in stage.received("tap_command", sent)]
    if not _taps(stage, sent):
        return "it commanded no tap"
    for command in _taps(stage, sent):
        if command.tap_id <= last:
            return f"the id {command.tap_id} is not above {last}"
        last = command.tap_id
        stamp, expiry = map(to_nanoseconds, (command.header.stamp, command.expiry))
        if command.header.frame_id != "table" or not 0 < stamp < expiry:
            return f"tap {last}: frame '{command.header.frame_id}', stamp {stamp}, expiry {expiry}"
        poses = map(
            from_message, (command.strike_pose, command.object_pose, command.predicted_pose)
        )
        numbers = [command.striker_speed, *(value for pose in poses for value in pose)]
        if not all(map(math.isfinite, numbers)) or command.striker_speed <= 0.0:
            return f"tap {last} has numbers that are not finite, or no speed"
        if not any(
            each.request == TapCommand.WITHDRAW and each.tap_id == last for each in commands
        ):
            return f"tap {last} was not followed by its WITHDRAW"
    return ""


def _refuses(stage: Stage) -> Steps:
    """Refuses a goal in an unknown frame, with numbers that are not finite, or off the table, with
    an error."""
    _play(stage)
    for goal, frame, what in (
        (GOAL, "map", "in the frame 'map'"),
        (Pose(math.nan, 0.0, 0.0), "table", "that is not a number"),
        (Pose(30.0, 0.0, 0.0), "table", "30 m away"),
    ):
        sent = _send(stage, goal, frame)
        yield from stage.pause(1.5)
        if _taps(stage, sent):
            return f"it commanded a tap for a goal {what}"
        if not any(state.error_code for _, state in stage.received(STATES, sent)):
            return f"it reported no error for a goal {what}"
    return ""


def _hidden(stage: Stage) -> Steps:
    """Taps nothing while the object is not seen, and ends the goal with an error."""
    cell = _play(stage)
    cell.visible = False
    yield from stage.pause(1.0)
    sent = _send(stage)
    if not (yield from stage.until(lambda: _ended(stage, sent), GOAL_S)):
        return f"the goal had no end within {GOAL_S:.0f} s although the object was hidden"
    if _taps(stage, sent):
        return "it commanded a tap although the object was hidden"
    return "" if _end(stage, sent).error_code else "the goal ended without an error"


def _stops(stage: Stage) -> Steps:
    """Ends the goal within 2 s after `emergency_stop`, and commands no further tap."""
    _play(stage)
    sent = _send(stage)
    if not (yield from stage.until(lambda: _taps(stage, sent), 20.0)):
        return "it commanded no tap"
    stage.emergency_stop(True)
    stopped = stage.now()
    if not (yield from stage.until(lambda: _ended(stage, stopped), 2.0)):
        return "the goal did not end within 2 s after emergency_stop"
    yield from stage.pause(2.0)
    stage.emergency_stop(False)
    yield from stage.pause(2.0)
    return "it commanded a tap after emergency_stop" if _taps(stage, stopped) else ""


def _one_authority(stage: Stage) -> Steps:
    """Commands nothing while two nodes publish `object_states`; the goal ends with error 205."""
    cell = _play(stage)
    stage.contest("object_states", cell.seen)
    yield from stage.pause(1.5)
    sent = _send(stage)
    ended = yield from stage.until(lambda: _ended(stage, sent), GOAL_S)
    stage.end_contest()
    if _taps(stage, sent):
        return "it commanded a tap while two nodes published object_states"
    if not ended:
        return f"the goal had no end within {GOAL_S:.0f} s with two publishers of object_states"
    code = _end(stage, sent).error_code
    conflict = ErrorCode.CONFIGURATION_CONFLICT
    return "" if code == conflict else f"the goal ended with the error {code}, not 205"


DUTIES = (
    Duty("P1", _reports),
    Duty("P2", _reaches),
    Duty("P3", _commands),
    Duty("P4", _refuses),
    Duty("P5", _hidden),
    Duty("P6", _one_authority),
    Duty("P7", _stops),
)
