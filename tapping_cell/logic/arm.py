"""State machine of the arm: homes the arm before any motion, and keeps the arm still while a shot
may be fired.

The machine does not report that the arm is in position until the joints have been read back. The
tapper calls ``hold_still`` before it fires. By granting this request, the arm promises to begin no
motion for the requested time. docs/safety.md shows why no shot is then fired while the arm moves.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.arm import ArmDriver
from tapping_cell.hardware.arm_settings import HomingStrategy
from tapping_cell.hardware.faults import LINE_LOST, FaultReason, HardwareFault
from tapping_cell.hardware.motion import check_limits
from tapping_cell.hardware.scara import Joints, ScaraGeometry, TipPose
from tapping_cell.logic import arm_jobs, enabling, jogging, tap_commands
from tapping_cell.logic.arm_cycle import SET_UP_SPEED, ArmCycle
from tapping_cell.logic.arm_jobs import MotionEnd, Reading
from tapping_cell.logic.arm_readings import ArmReadings
from tapping_cell.logic.arm_states import (
    AT_WORK,
    HEALTHY,
    TABLE,
    WIRE,
    Event,
    InPosition,
    Leaving,
    Placing,
    S,
    Serving,
    State,
    Tap,
    Withdrawing,
)
from tapping_cell.logic.arm_trajectory import trajectory_targets
from tapping_cell.logic.clock import Now, to_nanoseconds, to_stamp
from tapping_cell.logic.device import (
    LONGEST_TIMEOUT_S,
    MUTE,
    Abandon,
    DeviceLogic,
    Run,
    patience_after,
)
from tapping_cell.logic.effects import (
    Answer,
    Effect,
    JobEnded,
    LogLevel,
    Message,
    Publish,
    StopWire,
    Token,
)
from tapping_cell.logic.enabling import EnablingDevice
from tapping_cell.logic.error_codes import of_arm
from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.logic.host import Configured
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.standing_still import StandingStill
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.transitions import Go, StateMachine
from tapping_cell.logic.withdrawal import Scene
from tapping_cell.messages import (
    ArmState,
    ErrorCode,
    HoldStill,
    Jog,
    JointTrajectory,
    PlanState,
    TapCommand,
    TapperState,
)

READ_PERIOD_S = 0.05
"""Period of the read-back while the arm stands: a strike pose is confirmed 20 times a second."""
FRESH_READING_S = 0.25
"""Maximum age of the last read-back, s; if it is older, the arm does not promise to stand still."""
DEVIATIONS = 2
"""Number of consecutive readings away from the strike pose that are a fault; a single one may be
garbled."""
UNHOMED = (FaultReason.NOT_HOMED, FaultReason.HOMING_FAILED)


@dataclass(frozen=True, slots=True)
class ArmOptions:
    """Parameters of the node that the machine needs."""

    home_on_activate: bool = False
    state_rate: float = 20.0
    """Rate at which ``arm_state`` is published, Hz."""
    set_up: bool = False
    """Set-up mode: the arm moves slowly, and only while an enabling device is held."""
    withdraw_until_seen: bool = True
    """If True, the arm withdraws only until the camera sees the object, not to the park pose."""


class ArmLogic(DeviceLogic[State, Event]):
    """See the module's docstring. The arm is moved only by jobs (``arm_jobs``) of this machine."""

    stopped_state = S.STOPPED
    stop_error = (
        ErrorCode.ARM_STOPPED,
        "the arm was stopped; make the cell safe, clear the stop, then home the arm",
    )

    def __init__(self, options: ArmOptions) -> None:
        super().__init__(StateMachine(TABLE, S.DISCONNECTED), 1.0 / options.state_rate)
        self._cell: Cell
        self._geometry: ScaraGeometry
        self._options = options
        self._error = (ErrorCode.ARM_NOT_CONNECTED, "the arm is not connected yet")
        self._readings = ArmReadings()
        self._still = StandingStill()
        self._cycle = ArmCycle(self._still, options.set_up)
        self._serving: Serving | None = None
        """Record of the present state; None in a state without one."""
        self._last_withdrawal: Withdrawing | None = None
        """Last withdrawal; None once the arm was moved again."""
        self._last_tap_id = 0
        self._last_command_id = 0
        """Id of the last command, a TAP or a CLEAR_VIEW."""
        self._deactivating = False
        """Whether a job abandoned at the deactivation still runs."""
        self._camera: tuple[float, float, float] | None = None
        self._enabling = EnablingDevice()
        self._goal_active = False
        """Whether the planner's last report is of a goal under way."""
        self._locked = False
        """Whether the last attempt to connect found the controller in a state, such as sleep, in
        which it refuses queries."""
        self._clear_requested = False
        """Whether a person has requested the end of this state."""
        self._is_released = False
        """Whether no enabling device was held at the end of the last attempt to connect, although
        set-up mode requires one."""

    # Messages and requests

    def _handle_message(self, topic: str, message: Message, now: Now) -> None:
        if topic == "tap_command":
            self._tap_command(message, now)
        elif topic == "tapper_state":
            self._enabling.on_reported_switch(message.enabling_switch, message.header.stamp, now)
            self._on_tapper_state(message, now)
            self._watch_enabling(now)
        elif topic == "joint_trajectory":
            self._trajectory(message, now)
        elif topic == "plan_state":
            self._goal_active = message.state not in (PlanState.IDLE, *FINAL_STATES)
        elif topic == enabling.TOPIC:
            self._enabling.on_key(message.data, now)
            self._watch_enabling(now)
        elif topic == "camera/pose":
            place = message.pose.position
            self._camera = (place.x, place.y, place.z)

    def _handle_request(self, service: str, request: Message, token: Token, now: Now) -> None:
        if service == "~/home":
            self._home(token, now)
        elif service == "~/jog":
            code, sentence = self._jog(request, now) or (ErrorCode.NONE, "")
            accepted = code == ErrorCode.NONE
            self._effects.append(
                Answer(token, Jog.Response(accepted=accepted, error_code=code, error_msg=sentence))
            )
        elif service == "hold_still":
            self._effects.append(Answer(token, self._hold_still(request, now)))

    def _failure(self, service: str, sentence: str) -> Message:
        if service == "hold_still":
            return HoldStill.Response(error_code=ErrorCode.INTERNAL, error_msg=sentence)
        if service == "~/jog":
            return Jog.Response(error_code=ErrorCode.INTERNAL, error_msg=sentence)
        return super()._failure(service, sentence)

    def _handle_answer(self, token: Token, response: Message | None, now: Now) -> None:
        raise AssertionError(f"the arm has no pending request {token!r}")

    def _tap_command(self, command: TapCommand, now: Now) -> None:
        if command.request == TapCommand.WITHDRAW:
            if late := tap_commands.late_withdrawal(command, now):
                self._log(LogLevel.WARNING, f"withdrawal of tap {command.tap_id} ignored: {late}")
                return
            at = self._serving
            ours = command.tap_id != 0 and command.tap_id == self._tap_id
            if ours and isinstance(at, Placing | InPosition):
                self._give_up(at, now)
            elif command.tap_id != 0 and command.tap_id == self._last_tap_id:
                self._withdraw_again(now)
            return
        refusal = self._refusal(command, now)
        if refusal is not None:
            code, sentence = refusal
            self._refuse(code, f"tap {command.tap_id} refused: {sentence}")
            return
        self._error = (ErrorCode.NONE, "")
        self._last_command_id = command.tap_id
        if command.request == TapCommand.CLEAR_VIEW:
            self._carry_out(self._cycle.clear_view(self._camera, now))
            return
        self._last_tap_id = command.tap_id
        tip = self._cell.arm_base.inverse() @ from_message(command.strike_pose)
        tap = Tap(
            tap_id=command.tap_id,
            expiry=to_nanoseconds(command.expiry),
            strike=TipPose(tip.x, tip.y, self._cell.arm.strike_height, tip.theta),
            scene=self._scene_of(command),
        )
        self._carry_out(self._cycle.begin(tap, now))

    def _scene_of(self, command: TapCommand) -> Scene | None:
        """Return the scene that the camera must see after a tap; None if the camera's position or a
        pose is not known, or if the arm always withdraws to its park pose."""
        if self._camera is None or not self._options.withdraw_until_seen:
            return None
        poses = (command.object_pose, command.predicted_pose, command.strike_pose)
        before, predicted, strike = (from_message(pose) for pose in poses)
        numbers = (*self._camera, *before, *predicted, *strike)
        if not all(map(math.isfinite, numbers)):
            return None
        return Scene(self._camera, before, predicted, strike)

    def _withdraw_again(self, now: Now) -> None:
        """Move the arm to its park pose, because the arm hides the object even after the
        withdrawal."""
        if self.state is S.IDLE:
            hides = self._last_withdrawal is not None and self._last_withdrawal.scene is not None
            if hides and self._active and self._enabled(now):
                self._carry_out(self._cycle.park(0, now))
        else:
            self._carry_out(self._cycle.withdraw_again(self._serving))

    def _refusal(self, command: TapCommand, now: Now) -> CodedError | None:
        """Return why a tap command is refused, or None if it is accepted."""
        if not self._active:
            return ErrorCode.NOT_ACTIVE, "the node is not active; activate it first"
        if self._conflict is not None:
            return self._conflict
        if self.state is not S.IDLE:
            return ErrorCode.ARM_BUSY, f"the arm is not idle ({self._error[1] or 'it is busy'})"
        if not self._enabled(now):
            return enabling.RELEASED
        if tap_commands.expired(command, now):
            return ErrorCode.ARM_COMMAND_EXPIRED, tap_commands.expiry_message(command, now)
        return tap_commands.refusal(command, now, self._last_command_id)

    def _refuse(self, code: int, sentence: str) -> None:
        """Report why a command is refused. If the arm is idle, its state contains the reason until
        the next command."""
        if self.state is S.IDLE:
            self._set_error(code, sentence)
        else:
            self._log(LogLevel.ERROR, sentence)

    def _trajectory(self, message: JointTrajectory, now: Now) -> None:
        if not self._active or self.state is not S.IDLE:
            code = ErrorCode.ARM_BUSY if self._active else ErrorCode.NOT_ACTIVE
            reason = self._error[1] or "busy"
            self._refuse(code, f"trajectory refused: the arm is not idle ({reason})")
            return
        if not self._enabled(now):
            code, reason = enabling.RELEASED
            self._refuse(code, f"trajectory refused: {reason}")
            return
        try:
            targets = trajectory_targets(message)
            for target, _ in targets:
                check_limits(self._geometry, target)
        except (ValueError, HardwareFault) as error:
            self._refuse(ErrorCode.TRAJECTORY_INVALID, f"trajectory refused: {error}")
            return
        self._machine.move(Event.TRAJECTORY, S.FOLLOWING)
        self._error = (ErrorCode.NONE, "")
        self._follow(targets, SET_UP_SPEED if self._options.set_up else 1.0, now)

    def _follow(self, targets: Sequence[tuple[Joints, float]], scale: float, now: Now) -> None:
        job = partial(arm_jobs.follow, targets=targets, scale=scale)
        self._carry_out([self._cycle.when_free("follow", job, now)])

    def _home(self, token: Token, now: Now) -> None:
        if not self._active:
            self._answer(token, False, "the node is not active; activate it first")
        elif self.state not in (S.NOT_HOMED, S.IDLE):
            reason = self._error[1] or "busy"
            self._answer(token, False, f"the arm cannot home now: {reason}")
        elif not self._enabled(now):
            self._answer(token, False, enabling.RELEASED[1])
        else:
            self._begin_homing(now)
            self._answer(token, True, "homing has started; arm_state reports its end")

    def _begin_homing(self, now: Now) -> None:
        self._machine.move(Event.HOME, S.HOMING)
        self._error = (ErrorCode.NONE, "")
        strategy = HomingStrategy(self._cell.arm.homing)
        home = partial(arm_jobs.home, strategy=strategy, motion=self._cycle.motion())
        self._carry_out([self._cycle.when_free("home", home, now)])

    # Set-up mode

    def _jog(self, request: Jog.Request, now: Now) -> CodedError | None:
        """Begin a manual motion, or return why it is refused."""
        if (error := self._jog_refusal(now)) is not None:
            return error
        if request.kind == Jog.Request.PARK:
            self._error = (ErrorCode.NONE, "")
            self._carry_out(self._cycle.park(0, now))
            return None
        reading = self._readings.of_homed_arm
        assert reading is not None
        goal = jogging.target(self._cell, reading.joints, request)
        if not isinstance(goal, Joints):
            return goal
        self._machine.move(Event.JOG, S.FOLLOWING)
        self._error = (ErrorCode.NONE, "")
        self._follow([(goal, 0.0)], self._cycle.motion().near_speed, now)
        return None

    def _jog_refusal(self, now: Now) -> CodedError | None:
        """Return why the arm begins no manual motion now, or None."""
        if not self._active:
            return INACTIVE_ERROR
        if self._conflict is not None:
            return self._conflict
        if not self._options.set_up:
            return (
                ErrorCode.NOT_IN_SET_UP,
                "the arm is jogged in set-up mode only; start the cell with  python -m"
                " tapping_cell up --set-up",
            )
        if self.state is S.NOT_HOMED:
            return self._error
        if self.state is not S.IDLE:
            reason = self._error[1] or f"its state is {self.state.value}"
            return ErrorCode.ARM_BUSY, f"the arm is not idle ({reason}); wait, then jog again"
        if self._goal_active:
            return (
                ErrorCode.PLANNER_BUSY,
                "a goal or a single tap is under way; wait for its end, or cancel it",
            )
        if not self._enabled(now):
            return enabling.RELEASED
        if (left := self._still.free_at(now) - now.steady) > 0:
            return (
                ErrorCode.ARM_BUSY,
                f"the arm must stand still for another {left:.1f} s, because the striker may be"
                " charged; jog again afterwards",
            )
        age = self._readings.age(now)
        if self._readings.of_homed_arm is None or age > jogging.OLDEST_READING_S:
            return (
                ErrorCode.ARM_TIMEOUT,
                f"the last measured position is {age:.2f} s old (limit"
                f" {jogging.OLDEST_READING_S:g} s); jog again; if this repeats, check the line",
            )
        return None

    def _enabled(self, now: Now) -> bool:
        """Return whether set-up mode allows the arm to begin to move."""
        return not self._options.set_up or self._enabling.held(now)

    def _watch_enabling(self, now: Now) -> None:
        """Stop the arm if it is at work and no enabling device is held."""
        if self._enabled(now) or self.state not in AT_WORK:
            return
        self._effects.append(StopWire())
        if self._stops.press(enabling.SOURCE):
            self._keep_stops(now)
        self._stop(now)
        self._set_error(*enabling.STOPPED)

    # Standing still for the tapper

    def _hold_still(self, request: HoldStill.Request, now: Now) -> HoldStill.Response:
        error = self._hold_still_refusal(request, now)
        if error is not None:
            code, sentence = error
            return HoldStill.Response(error_code=code, error_msg=sentence)
        return self._still.promise(request, now)

    def _hold_still_refusal(self, request: HoldStill.Request, now: Now) -> CodedError | None:
        """Return why the arm refuses to promise to stand still, or None."""
        if (error := self._still.duration_error(request) or self._conflict) is not None:
            return error
        at = self._serving
        if not self._active or not isinstance(at, InPosition) or request.tap_id != at.tap_id:
            return (
                ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
                f"the arm is not in position for tap {request.tap_id}: its state is"
                f" {self.state.value} and the tap that it serves is {self._tap_id} (0: none)",
            )
        if (error := self._still.repetition_error(request)) is not None:
            return error
        age = self._readings.age(now)
        if age > FRESH_READING_S or at.deviating or now.ros > at.tap.expiry:
            return (
                ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
                "the arm cannot confirm that it is at the strike pose: its last measured position"
                f" ({age:.2f} s old, limit {FRESH_READING_S:.2f} s) is too old or deviates from the"
                " strike pose, or the tap has expired",
            )
        return None

    def _on_tapper_state(self, message: TapperState, now: Now) -> None:
        is_trusted = self._conflict is None
        if self._still.on_tapper_state(message, self._last_tap_id, is_trusted, now):
            self._leave_when_free(now)

    # The cycle of a tap

    @property
    def _tap_id(self) -> int:
        """Id of the tap under way; 0 if there is none."""
        return 0 if self._serving is None else self._serving.tap_id

    def _carry_out(self, steps: Iterable[Go[Event, Serving] | Run | Abandon]) -> None:
        """Carry out the steps of the cycle. Every job of a step moves the arm."""
        for step in steps:
            if isinstance(step, Go):
                if step.event is not None:
                    self._machine.move(step.event, step.record.state)
                self._serving = step.record
            elif isinstance(step, Run):
                self._last_withdrawal = None
                self._run(step.name, step.job)
            else:
                self._abandon()

    def _go(self, event: Event, target: State) -> None:
        """Go to a state in which no tap is under way."""
        self._machine.move(event, target)
        self._serving = None

    def _give_up(self, at: Placing | InPosition, now: Now) -> None:
        self._carry_out(self._cycle.give_up(at, now))
        self._leave_when_free(now)

    def _leave_when_free(self, now: Now) -> None:
        if self._job is None:
            self._carry_out(self._cycle.leave_when_free(self._serving, now))

    # Jobs

    def _on_job_report(self, name: str, content: Any, now: Now) -> None:
        self._readings.take_in(content, now)

    def _job_done(self, name: str, result: Any, now: Now) -> None:
        if name == "send stop":
            return
        at = self._serving
        self._readings.take_in(result.reading if isinstance(result, MotionEnd) else result, now)
        if self._deactivating:
            self._finish_deactivation(now)
        elif name == "connect":
            self._enter_standby(Event.CONNECTED)
            if not self._active:
                self._finish_deactivation(now)
        elif name == "clear":
            self._enter_standby(Event.CLEARED)
        elif isinstance(at, Leaving):
            self._leave_when_free(now)
        elif isinstance(at, Placing):
            self._carry_out(self._cycle.placed(at, result, now))
            self._leave_when_free(now)
        elif name == "follow":
            self._go(Event.FOLLOWED, S.IDLE)
        elif isinstance(at, Withdrawing) and at.then_park:
            self._carry_out(self._cycle.park(at.tap_id, now))
        else:
            self._go(Event.HOMED if name == "home" else Event.WITHDRAWN, S.IDLE)
            self._last_withdrawal = at if isinstance(at, Withdrawing) else TO_PARK_POSE

    def _job_failed(self, name: str, fault: HardwareFault, now: Now) -> None:
        tried = self.patience
        if name == "connect":
            self.patience = patience_after(self.patience, fault)
        if self.state is S.INACTIVE and fault.reason not in LINE_LOST:
            self._readings.last = None  # the position is known again after the next reading
            return
        if name == "connect" and fault.reason in MUTE and tried < LONGEST_TIMEOUT_S:
            # The board may still be starting, because opening a port restarts many boards.
            self._fail_to(S.DISCONNECTED)
            self._set_error(of_arm(fault), fault.sentence)
            return
        if name == "place" and fault.reason is FaultReason.UNREACHABLE:
            # No motion command was sent, so the arm has not moved and there is no fault to clear.
            self._set_error(of_arm(fault), fault.sentence)
            if self._deactivating:
                self._finish_deactivation(now)
            elif isinstance(self._serving, Placing):
                self._give_up(self._serving, now)
            else:
                self._leave_when_free(now)
            return
        if fault.reason in LINE_LOST:
            target = S.DISCONNECTED
        else:
            target = S.NOT_HOMED if fault.reason in UNHOMED else S.FAULT
        self._fail_to(target)
        self._set_error(of_arm(fault), fault.sentence)

    def _job_superseded(self, event: JobEnded, now: Now) -> None:
        result = event.result
        reading = result.reading if isinstance(result, MotionEnd) else result
        if isinstance(reading, Reading) and not self._stops.stopped:
            self._readings.take_in(reading, now)

    def _read_done(self, result: Any, now: Now) -> None:
        self._readings.take_in(result, now)
        if not isinstance(self._serving, InPosition):
            return
        self._serving = self._cycle.checked(self._serving, result)
        if self._serving.deviating >= DEVIATIONS:
            self._fail_to(S.FAULT)
            self._set_error(
                ErrorCode.ARM_POSITION_MISMATCH,
                "the arm does not stay at the strike pose; check what pushes it, then call "
                "clear_fault and home",
            )

    # States

    def _code_of(self, fault: HardwareFault) -> int:
        return of_arm(fault)

    def _configured_with(self, event: Configured, now: Now) -> None:
        self._is_released = False
        self._cell = event.cell
        self._geometry = event.cell.arm.geometry()
        self._readings.configure(event.cell)
        self._still.configure(event.cell, now)
        self._cycle.configure(event.cell)

    def _closed(self) -> None:
        self._deactivating = False
        self._readings.last = None
        # After a failed attempt to connect, the reason for the failure remains.
        if self.state not in (S.STOPPED, S.DISCONNECTED):
            self._go(Event.CLOSED, S.DISCONNECTED)
            self._error = (ErrorCode.ARM_NOT_CONNECTED, "the arm is not connected")

    def before_connect(self, driver: ArmDriver) -> None:
        """Stop the arm first if a stop was received before the port is open, or if no enabling
        device was held at the end of the last attempt. Reset the controller if a person has cleared
        the state in which it refuses queries."""
        if self._stops.stopped or self._is_released:
            # The arm may still complete a move that an earlier process of this node has commanded.
            driver.stop_when_opened()
        if self._clear_requested:
            self._clear_requested = False
            driver.clear_fault(self.patience)

    def _unreachable(self, fault: HardwareFault, now: Now) -> None:
        self._locked = fault.reason is FaultReason.REJECTED
        self._is_released = not self._enabled(now)

    def _clears_at_next_attempt(self) -> bool:
        self._clear_requested = self._locked
        return self._locked

    def _connected(self, answer: Any, now: Now) -> None:
        self._readings.last = None
        if isinstance(answer, Reading):
            self._readings.take_in(answer, now)
        self._enter_standby(Event.CONNECTED)

    def _enter_standby(self, event: Event) -> None:
        """Go to the state in which the arm stands after it was connected, cleared or activated."""
        self.patience = patience_after(self.patience, None)
        if not self._active and event is not Event.CONNECTED:
            self._go(event, S.INACTIVE)
            self._error = INACTIVE_ERROR
        elif self._readings.of_homed_arm is not None:
            self._go(event, S.IDLE)
            self._error = (ErrorCode.NONE, "")
        else:
            self._go(event, S.NOT_HOMED)
            self._error = (
                ErrorCode.ARM_NOT_HOMED,
                "the arm is not homed; make sure that its path is free, then home the arm",
            )

    def _activated(self, now: Now) -> None:
        # During a deactivation, the end of the abandoned job activates the arm.
        if self._deactivating or self.state not in (S.NOT_HOMED, S.IDLE, S.INACTIVE):
            return
        self._enter_standby(Event.ACTIVATED)
        alone = self._options.home_on_activate and not self._options.set_up
        if alone and self._cell.arm.homes_alone:
            self._begin_homing(now)

    def _deactivated(self, now: Now) -> None:
        if self._stops.stopped or self.state is S.FAULT:
            return
        if self._job is not None:
            # The arm stops at the end of the waypoint move in progress.
            self._abandon()
            self._deactivating = True
        else:
            self._finish_deactivation(now)

    def _finish_deactivation(self, now: Now) -> None:
        self._deactivating = False
        self._go(Event.DEACTIVATED, S.INACTIVE)
        self._error = INACTIVE_ERROR
        if self._active:
            self._activated(now)

    def _stop(self, now: Now) -> None:
        self._supersede_job()
        self._deactivating = False
        self._forget_position()
        self._go(Event.STOP, S.STOPPED)
        self._set_error(*self.stop_error)
        if self._configured:
            self._run("send stop", partial(arm_jobs.send_stop, patience=self.patience))

    def _fail(self, now: Now) -> None:
        if self.state is not S.STOPPED:
            self._fail_to(S.FAULT)

    def _fail_to(self, target: State) -> None:
        self._supersede_job()
        self._deactivating = False
        self._forget_position()
        self._go(Event.FAILED, target)

    def _forget_position(self) -> None:
        self._readings.last = None
        if self._last_withdrawal is not None:
            # A late withdrawal must not move the arm after the stop or fault was cleared.
            self._last_withdrawal = TO_PARK_POSE

    def _healthy(self) -> bool:
        return self.state in HEALTHY

    def _begin_clear(self, now: Now) -> None:
        if self.state is S.CLEARING:
            return
        self._machine.move(Event.CLEAR, S.CLEARING)
        self._run("clear", partial(arm_jobs.clear, is_stopped=lambda now: self.stopped))
        self._clear_job = self._job

    def _time_passed(self, now: Now) -> None:
        self._watch_enabling(now)
        if self.state is S.DISCONNECTED:
            if self._job is None and now.steady >= self._read_at + READ_PERIOD_S:
                self._read_at = now.steady
                self._run("connect", partial(arm_jobs.connect, patience=self.patience))
        elif self.state not in (S.STOPPED, S.FAULT):
            self._read_when_due(READ_PERIOD_S, arm_jobs.read, now)
        self._carry_out(self._cycle.check_expiry(self._serving, now))
        self._leave_when_free(now)

    # Reports

    def _report(self, now: Now) -> Publish:
        reading = self._readings.of_homed_arm
        code, sentence = self._shown_error(now)
        message = ArmState(
            state=WIRE[self.state],
            tap_id=self._tap_id,
            homed=reading is not None,
            clear_of_camera=self._last_withdrawal is not None,
            set_up=self._options.set_up,
            enabled=self._is_key_held(now),
            last_stop=self._last_stop,
            error_code=code,
            error_msg=sentence,
        )
        message.header.frame_id = "table"
        message.header.stamp = self._readings.stamp if reading is not None else to_stamp(now.ros)
        if reading is not None:
            message.tip_pose = self._readings.tip_pose(reading)
        return Publish("arm_state", message)

    def _is_key_held(self, now: Now) -> bool:
        return self._options.set_up and self._enabling.held(now)

    def _drain(self, now: Now) -> Sequence[Effect]:
        joints = self._readings.new_joints()
        if joints is not None:
            self._effects.append(Publish("joint_states", joints))
        return super()._drain(now)

    def _urgent_content(self, now: Now) -> tuple[object, ...]:
        # While the arm moves to a strike pose, each new read-back is published immediately.
        state = self.state
        read = self._readings.stamp if state is S.PLACING else None
        return WIRE[state], self._tap_id, self._is_key_held(now), self._shown_error(now), read


TO_PARK_POSE = Withdrawing(tap_id=0, scene=None)
"""Withdrawal to the park pose."""
INACTIVE_ERROR = (ErrorCode.NOT_ACTIVE, "the arm's node is not active; activate it")
