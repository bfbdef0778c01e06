"""State machine of the tapper: charges and fires once per tap, only while the arm stands still.

A tapper at a fixed mount needs no arm: the machine charges immediately, fires when the striker is
charged, and returns to rest when the board detects the striker back at its mount. The cycle of one
tap is in ``tapper_cycle``, the data of each of its states in ``tapper_states``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import LINE_LOST, FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome
from tapping_cell.hardware.tapper_protocol import Reply
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import enabling, tap_commands, tapper_cycle, tapper_jobs
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.device import Abandon, DeviceLogic, Run, patience_after
from tapping_cell.logic.effects import JobEnded, LogLevel, Message, Publish, Token
from tapping_cell.logic.enabling import EnablingDevice
from tapping_cell.logic.error_codes import of_tapper
from tapping_cell.logic.host import Configured
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.tapper_board import LastTap, TapperBoard, why_not_charged
from tapping_cell.logic.tapper_commands import ReceivedCommands
from tapping_cell.logic.tapper_cycle import TapperCycle
from tapping_cell.logic.tapper_jobs import ChargeEnd, FireEnd, Status
from tapping_cell.logic.tapper_peers import PeerLimits, TapperPeers
from tapping_cell.logic.tapper_states import (
    TABLE,
    WIRE,
    Charged,
    Charging,
    Discharging,
    Event,
    Firing,
    Over,
    S,
    Serving,
    State,
    Steps,
    Waiting,
)
from tapping_cell.logic.transitions import Go, StateMachine
from tapping_cell.messages import ErrorCode, TapCommand, TapperState

READ_PERIOD_S = 0.1
PROVE_PERIOD_S = 0.5
"""Time between two attempts to verify that the strikers are at their mounts."""
LOST_BOARD = (*LINE_LOST, FaultReason.TIMEOUT, FaultReason.PROTOCOL, FaultReason.BOARD_RESET)
"""Faults after which the node opens a new session with the board."""
OF_THE_TAP = (
    FaultReason.INTERLOCK,
    FaultReason.REJECTED,
    FaultReason.SHOT_SPENT,
    FaultReason.OUT_OF_RANGE,
    FaultReason.NOT_ENABLED,
    FaultReason.OTHER_ACTIVE,
)
"""Faults that end only the present tap. The next tap is accepted once the board has discharged."""
STOPPED_BOARD = (FaultReason.STOPPED, FaultReason.NEEDS_PERSON)
OUTCOMES = {
    FireOutcome.FIRED: TapperState.FIRED,
    FireOutcome.NOT_FIRED: TapperState.NOT_FIRED,
    FireOutcome.UNKNOWN: TapperState.UNKNOWN,
}
LATCHED = (
    ErrorCode.TAPPER_STOPPED,
    "the tapper's stop is latched; make the cell safe, press the clear button at the tapper, then"
    " clear the stop within 10 s (Clear on the page, or python -m tapping_cell clear)",
)


@dataclass(frozen=True, slots=True)
class TapperOptions:
    """Parameters of the node that the machine needs."""

    state_rate: float = 20.0
    """Rate at which ``tapper_state`` is published, Hz."""
    limits: PeerLimits = field(default_factory=PeerLimits)
    set_up: bool = False
    """Set-up mode: charges and fires only while an enabling device is held."""


class TapperLogic(DeviceLogic[State, Event]):
    """See the module's docstring. Only jobs (``tapper_jobs``) of this machine charge and fire."""

    stopped_state = S.STOPPED
    repeats_stop = True
    stop_error = (
        ErrorCode.TAPPER_STOPPED,
        "the tapper was stopped; make the cell safe, press the clear button at the tapper, then"
        " clear the stop within 10 s (Clear on the page, or python -m tapping_cell clear)",
    )

    def __init__(self, options: TapperOptions) -> None:
        super().__init__(StateMachine(TABLE, S.DISCONNECTED), 1.0 / options.state_rate)
        self._error = (ErrorCode.TAPPER_NOT_CONNECTED, "the tapper is not connected yet")
        self._set_up = options.set_up
        self._enabling = EnablingDevice()
        self._board = TapperBoard()
        self._prove_at = -math.inf
        self._peers = TapperPeers(options.limits)
        self._received = ReceivedCommands()
        self._last = LastTap()
        self._cycle = TapperCycle(
            self._peers, self.check_charging, self.check_firing, post_replies=self._set_up
        )
        self._serving: Serving | None = None
        """Record of the tap under way."""

    # Queries by the running job, without side effects

    def check_charging(self, now: Now) -> CodedError | None:
        """Return why charging must not begin or continue, or None if charging is allowed."""
        if self._serving is None:
            return ErrorCode.NONE, "the tap is over"
        tap = self._serving.tap
        if (reason := self._serving.given_up or self._conflict) is not None:
            return reason
        if self._stops.stopped or not self._active:
            return ErrorCode.NONE, "the tapper was stopped or deactivated"
        if not self._enabled(now):
            return enabling.RELEASED
        if now.ros > tap.expiry:
            return ErrorCode.TAPPER_COMMAND_EXPIRED, "the tap's expiry passed during charging"
        return self._peers.check_charging(tap.tap_id, tap.planned, tap.strike, now)

    def check_firing(self, release_by: float, now: Now) -> CodedError | None:
        """Make the last check before FIRE: return why firing is forbidden, or None if it is
        allowed.

        ``release_by``: latest end of the release pulse, in s of the steady clock.
        """
        reason = self.check_charging(now)
        if reason is not None:
            return reason
        at = self._serving
        assert at is not None
        reason = self._peers.check_firing(at.tap.tap_id, at.tap.planned, at.tap.strike, now)
        if reason is not None:
            return reason
        if not isinstance(at, Firing) or self.state is not S.FIRING:
            return ErrorCode.NONE, "the tap is over"
        end = max(release_by, now.steady) + at.tap.flight
        if end > at.still_until:
            return (
                ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
                f"the shot could end {end - at.still_until:.3f} s after the time for which the arm"
                " stands still",
            )
        return None

    def _enabled(self, now: Now) -> bool:
        """Return whether set-up mode allows charging now; outside this mode, it is allowed."""
        return not self._set_up or self._enabling.held(now)

    # Messages

    def _handle_message(self, topic: str, message: Message, now: Now) -> None:
        if topic == "tap_command":
            self._tap_command(message, now)
        elif topic == "arm_state":
            self._peers.on_arm_state(message, now)
            self._carry_out(self._cycle.proceed(self._serving, now))
        elif topic == "plan_state":
            self._peers.on_plan_state(message, now)
            gone = self._peers.abandonment_error()
            if gone is not None:
                self._give_up(gone)
        elif topic == "object_states":
            self._peers.on_object_states(message, now)
        elif topic == enabling.TOPIC:
            self._enabling.on_key(message.data, now)
            self._watch_enabling(now)

    def _handle_request(self, service: str, request: Message, token: Token, now: Now) -> None:
        raise AssertionError(f"the tapper has no service {service}")

    def _handle_answer(self, token: Token, response: Message | None, now: Now) -> None:
        self._carry_out(self._cycle.answered(self._serving, token, response, now))

    def _watch_enabling(self, now: Now) -> None:
        """In set-up mode, end the tap under way if no enabling device is held."""
        if not self._enabled(now):
            self._give_up(enabling.RELEASED)

    def _tap_command(self, command: TapCommand, now: Now) -> None:
        if command.request == TapCommand.WITHDRAW:
            if self._serving is not None and command.tap_id == self._serving.tap.tap_id:
                self._give_up((ErrorCode.NONE, ""))
            else:
                self._received.note_withdrawn(command.tap_id)
            return
        if command.request == TapCommand.CLEAR_VIEW:
            return  # this command is only for the arm
        refusal = self._refusal(command, now)
        if refusal is not None:
            self._refuse(command, refusal, now)
            return
        tapper = tap_commands.named_tapper(command.tapper, self._board.names)
        assert tapper is not None
        self._go(Go(Event.TAP, Waiting(tap=self._board.tap(command, tapper))))
        self._last.tapper = tapper
        self._received.last_tap_id = command.tap_id
        self._peers.begin_tap(command.object_id, command.strike_pose.position.z)
        self._error = (ErrorCode.NONE, "")
        self._last.begin(command.tap_id, TapperState.NONE)
        if self._board.is_fixed:
            self._carry_out(self._cycle.proceed(self._serving, now))

    def _end_contested(self, why: CodedError) -> None:
        self._give_up(why)

    def _refusal(self, command: TapCommand, now: Now) -> CodedError | None:
        """Return why a tap command is refused, or None if it is accepted."""
        if not self._active or not self._configured:
            return ErrorCode.NOT_ACTIVE, "the node is not active; activate it first"
        if self._conflict is not None:
            return self._conflict
        if self.state is not S.SAFE:
            why = (
                f"is not at rest: {self._error[1]}"
                if self._serving is None
                else f"serves tap {self._last.tap_id}"
            )
            return ErrorCode.TAPPER_BUSY, f"the tapper {why}"
        tapper = tap_commands.named_tapper(command.tapper, self._board.names)
        if tapper is None:
            return tap_commands.unknown_tapper(command.tapper, self._board.names)
        if self._board.is_fixed and (reason := self._board.mounts.check()) is not None:
            return reason
        if not self._enabled(now):
            return enabling.RELEASED
        if (reason := self._peers.clock_error(now)) is not None:
            return reason
        if (reason := self._peers.object_error(command.object_id)) is not None:
            return reason
        if tap_commands.expired(command, now):
            return ErrorCode.TAPPER_COMMAND_EXPIRED, tap_commands.expiry_message(command, now)
        if (reason := self._board.speed_error(tapper, command.striker_speed)) is not None:
            return reason
        return self._received.refusal(command, self._board.used, now)

    def _refuse(self, command: TapCommand, refusal: CodedError, now: Now) -> None:
        self._log(LogLevel.ERROR, f"tap {command.tap_id} refused: {refusal[1]}")
        used = self._board.used
        if not self._received.note_refused(command, used, self._last.awaits_outcome(), now):
            return
        if used is not None:
            # Before the board is read, no outcome is published: the tap may have been fired by this
            # node before a restart, or by another node that uses the board.
            spent = command.tap_id <= used
            outcome = TapperState.UNKNOWN if spent else TapperState.NOT_FIRED
            self._last.begin(command.tap_id, outcome)
        if self.state is S.SAFE:
            self._error = refusal

    # The cycle of a tap

    def _carry_out(self, steps: Steps) -> None:
        """Carry out the steps of the cycle."""
        for step in steps:
            if isinstance(step, Go):
                self._go(step)
            elif isinstance(step, Run):
                self._begin(step)
            elif isinstance(step, Abandon):
                self._abandon()
            elif isinstance(step, Over):
                self._machine.move(step.event, S.SAFE)
                self._serving = None
                self._last.outcome, self._error = step.outcome, step.error
            else:
                self._effects.append(step)

    def _go(self, step: Go[Event, Serving]) -> None:
        if isinstance(step.record, Discharging):
            self._last.fire_job = None  # only a tap that no job may have fired is discharged
        if step.event is not None:
            self._machine.move(step.event, step.record.state)
        self._serving = step.record

    def _begin(self, step: Run) -> None:
        self._run(step.name, step.job)
        if isinstance(self._serving, Firing):
            self._last.fire_job = self._job

    def _give_up(self, why: CodedError) -> None:
        """End the tap under way, if any."""
        if self._serving is not None:
            self._carry_out(self._cycle.give_up(self._serving, why))

    # Jobs

    def _on_job_report(self, name: str, content: Any, now: Now) -> None:
        assert isinstance(content, Reply), f"the job {name} may report only replies of the board"
        self._on_switch(content, now)

    def _job_done(self, name: str, result: Any, now: Now) -> None:
        if isinstance(result, FireEnd):
            self._fired(result, now)
        elif isinstance(result, ChargeEnd):
            self._take_in(result.status)
            assert self._serving is not None
            self._carry_out(self._cycle.charge_ended(self._serving, result, now))
        else:
            assert isinstance(result, Status)
            self._take_in(result)
            self._on_switch(result.reply, now)
            if name == "discharge":
                why = None if self._serving is None else self._serving.given_up
                self._carry_out(iter((tapper_cycle.not_fired(why),)))
            elif name == "connect":
                self._board_ready(result.reply, Event.CONNECTED)
            elif name == "clear":
                self._board_ready(result.reply, Event.CLEARED)
            elif name == "prove":
                self._check_mounts()
            elif name == "return":
                self._on_return_ended(result.reply)
                self._check_stop(result.reply)

    def _fired(self, end: FireEnd, now: Now) -> None:
        """Handle the end of a shot: its outcome, then the state of the board."""
        given_up = None if self._serving is None else self._serving.given_up
        self._serving = None
        self._last.outcome = OUTCOMES[end.outcome]
        refused = end.outcome is FireOutcome.NOT_FIRED
        refusal = given_up or end.refusal
        if refused and refusal is not None:
            self._error = (refusal[0], refusal[1] if refusal[0] else "")
        elif refused:
            code = ErrorCode.TAPPER_FAULT if end.refused is None else of_tapper(end.refused)
            self._error = (code, end.sentence)
        elif end.outcome is FireOutcome.UNKNOWN:
            self._error = (ErrorCode.TAPPER_OUTCOME_UNKNOWN, end.sentence)
        if end.fault is not None:
            error = self._error
            self._fail_with(end.fault)
            if error[0]:
                self._error = error
            return
        assert end.status is not None
        self._take_in(end.status)
        if self._board.is_fixed and end.outcome is not FireOutcome.NOT_FIRED:
            self._machine.move(Event.RELEASED, S.RETURNING)
            self._run("return", tapper_jobs.wait_for_return)
        else:
            self._machine.move(Event.ENDED, S.SAFE)
        self._check_stop(end.status.reply)

    def _job_failed(self, name: str, fault: HardwareFault, now: Now) -> None:
        if name == "connect":
            self.patience = patience_after(self.patience, fault)
        if name == "prove" and fault.reason is FaultReason.INTERLOCK:
            return  # the guard was opened; the mounts are checked again when it is closed
        # A job raises only faults that occurred before FIRE was sent, so the tap was not fired.
        at = self._serving
        if fault.reason in OF_THE_TAP and isinstance(at, Charging | Charged | Firing):
            self._log(LogLevel.ERROR, fault.sentence)
            self._carry_out(self._cycle.discharge(at, (of_tapper(fault), fault.sentence)))
            return
        if fault.reason in OF_THE_TAP and name == "charge" and isinstance(at, Discharging):
            # The tap had already been given up, and the board refused to continue charging. For
            # example, the board discharged while this process was suspended.
            self._run("discharge", tapper_jobs.discharge)
            return
        if at is not None:
            self._serving = None
            self._last.outcome = TapperState.NOT_FIRED
        if name == "connect" and fault.reason is FaultReason.UNKNOWN_FIRMWARE:
            # Not only another firmware but also a board that is silent for a short time causes this
            # fault, so connecting is tried again.
            self._fail_to(S.DISCONNECTED)
            self._set_error(of_tapper(fault), fault.sentence)
            return
        self._fail_with(fault)

    def _fail_with(self, fault: HardwareFault) -> None:
        """Change to the state that corresponds to a fault, and report the fault."""
        if fault.reason in LOST_BOARD:
            self._fail_to(S.DISCONNECTED)
        else:
            self._fail_to(S.STOPPED if fault.reason in STOPPED_BOARD else S.FAULT)
        self._set_error(of_tapper(fault), fault.sentence)

    def _job_superseded(self, event: JobEnded, now: Now) -> None:
        # The fire job may end after a stop, a fault or a reconnection. The outcome that it returns
        # is still valid, also if the node was closed meanwhile and reported UNKNOWN.
        if isinstance(event.result, FireEnd) and event.result.shot == self._last.tap_id:
            self._last.outcome = OUTCOMES[event.result.outcome]
        elif event.job == self._last.fire_job and self._last.awaits_outcome():
            # A HardwareFault occurred before FIRE was sent. Any other exception is a defect of this
            # program, which may have occurred after FIRE was sent.
            before = isinstance(event.fault, HardwareFault)
            self._last.outcome = TapperState.NOT_FIRED if before else TapperState.UNKNOWN

    def _read_done(self, result: Any, now: Now) -> None:
        self._take_in(result)
        self._on_switch(result.reply, now)
        self._check_stop(result.reply)
        if self.state is S.SAFE:
            self._check_mounts()
        elif isinstance(self._serving, Charged) and result.reply.state is not BoardState.CHARGED:
            why = why_not_charged(result.reply)
            self._carry_out(self._cycle.discharge(self._serving, why))

    def _on_return_ended(self, reply: Reply) -> None:
        """Handle the end of the wait for a released striker: it has returned or is overdue."""
        if reply.state is BoardState.SAFE:
            self._machine.move(Event.RETURNED, S.SAFE)
        elif not reply.stop_latched:
            away = ", ".join(self._board.mounts.away) or self._last.tapper
            self._fail_to(S.FAULT)
            self._set_error(
                ErrorCode.TAPPER_STRIKER_AWAY,
                f"according to the switch at its mount, the striker of {away} did not leave or did"
                " not return; free the striker, check its return spring and the switch, then clear"
                " the fault",
            )

    def _check_mounts(self) -> None:
        """While at rest, report an error of the mounts, or clear the error when its cause is
        gone."""
        if not self._board.is_fixed:
            return
        reason = self._board.mounts.check()
        of_mounts = (ErrorCode.TAPPER_STRIKER_AWAY, ErrorCode.TAPPER_MOUNT_NOT_PROVEN)
        if reason is not None:
            self._set_error(*reason)
        elif self._error[0] in of_mounts:
            self._error = (ErrorCode.NONE, "")

    def _on_switch(self, reply: Reply, now: Now) -> None:
        self._enabling.on_switch(reply.enabled, now)
        self._watch_enabling(now)

    def _check_stop(self, reply: Reply) -> None:
        """Handle a stop button that was pressed at the cell."""
        if reply.stop_latched:
            self._stop_tap()
            self._machine.move(Event.FAILED, S.STOPPED)
            self._set_error(*LATCHED)

    def _take_in(self, status: Status) -> None:
        self._last.note_speed(status.reply)
        self._board.take_in(status)

    # States

    def _configured_with(self, event: Configured, now: Now) -> None:
        assert isinstance(event.cell, Cell)
        self._board.configure(event.cell)
        self._cycle.is_fixed = self._board.is_fixed
        if self._board.is_fixed:
            self._peers.use_mounts(self._board.mounts)

    def _connected(self, answer: Any, now: Now) -> None:
        assert isinstance(answer, Reply)
        self._take_in(Status(answer, 0))
        self._board_ready(answer, Event.CONNECTED)

    def _board_ready(self, reply: Reply, event: Event) -> None:
        self.patience = patience_after(self.patience, None)
        if reply.stop_latched and event is Event.CONNECTED:
            self._machine.move(event, S.STOPPED)
            self._set_error(*LATCHED)
            return
        self._machine.move(event, S.SAFE)
        unknown = self._error[0] == ErrorCode.TAPPER_OUTCOME_UNKNOWN
        if not unknown or event is Event.CLEARED:
            self._error = (ErrorCode.NONE, "")

    def _activated(self, now: Now) -> None:
        """Do nothing: the tapper begins nothing without a command."""

    def _deactivated(self, now: Now) -> None:
        self._give_up((ErrorCode.NOT_ACTIVE, "the node was deactivated"))

    def _code_of(self, fault: HardwareFault) -> int:
        return of_tapper(fault)

    def _closed(self) -> None:
        self._stop_tap()
        if self._last.awaits_outcome():
            # The host may not report the end of the shot any more.
            self._last.outcome = TapperState.UNKNOWN
        # After a failed attempt to connect, the reason for the failure remains.
        if not self._stops.stopped and self.state is not S.DISCONNECTED:
            self._machine.move(Event.CLOSED, S.DISCONNECTED)
            self._error = (ErrorCode.TAPPER_NOT_CONNECTED, "the tapper is not connected")

    def _stop_tap(self) -> None:
        """End the tap. If a shot is under way, its outcome is reported when the job ends."""
        if self._last.awaits_outcome() and self._last.fire_job is None:
            self._last.outcome = TapperState.NOT_FIRED
        self._serving = None
        self._supersede_job()

    def _stop(self, now: Now) -> None:
        self._stop_tap()
        self._machine.move(Event.STOP, S.STOPPED)
        self._set_error(*self.stop_error)

    def _fail(self, now: Now) -> None:
        self._stop_tap()
        if self.state is not S.STOPPED:
            self._fail_to(S.FAULT)

    def _fail_to(self, target: State) -> None:
        self._supersede_job()
        self._machine.move(Event.FAILED, target)

    def _healthy(self) -> bool:
        return self._serving is not None or self.state in (S.SAFE, S.RETURNING)

    def _begin_clear(self, now: Now) -> None:
        if self.state is not S.CLEARING:
            self._machine.move(Event.CLEAR, S.CLEARING)
            self._run("clear", partial(tapper_jobs.clear, is_stopped=lambda now: self.stopped))
            self._clear_job = self._job

    def _time_passed(self, now: Now) -> None:
        self._watch_enabling(now)
        if self.state is S.DISCONNECTED:
            if self._job is None and now.steady >= self._read_at + READ_PERIOD_S:
                self._read_at = now.steady
                self._run("connect", partial(tapper_jobs.connect, patience=self.patience))
        elif self.state not in (S.STOPPED, S.FAULT):
            self._prove_when_due(now)
            self._read_when_due(READ_PERIOD_S, tapper_jobs.read, now)
        self._carry_out(self._cycle.proceed(self._serving, now))
        self._carry_out(self._cycle.check_expiry(self._serving, now))

    def _prove_when_due(self, now: Now) -> None:
        """Have the board verify its strikers' positions, if it has mount switches and has not yet
        done so."""
        idle = self._job is None and self._reading is None and self.state is S.SAFE
        if self._board.wants_proof and idle and now.steady >= self._prove_at + PROVE_PERIOD_S:
            self._prove_at = now.steady
            self._run("prove", tapper_jobs.prove)

    # Reports

    def _shown_error(self, now: Now) -> CodedError:
        shown = super()._shown_error(now)
        obstacle = self._cycle.shown_obstacle(self._serving, now)
        return obstacle if obstacle is not None and not shown[0] else shown

    def _report(self, now: Now) -> Publish:
        code, sentence = self._shown_error(now)
        board, last = self._board, self._last
        message = TapperState(
            state=WIRE[self.state],
            tappers=list(board.names),
            tapper=last.tapper,
            fixed_mounts=board.is_fixed,
            away=list(board.mounts.away) if board.is_fixed else [],
            mounts_proven=board.mounts_proven,
            tap_id=last.tap_id,
            outcome=last.outcome,
            measured_speed=last.measured_speed,
            shots_fired=board.shots_fired,
            boot_number=board.boot_number,
            interlock_closed=board.interlock_closed,
            set_up=self._set_up,
            enabling_switch=self._enabling.switch_held(now),
            last_stop=self._last_stop,
            error_code=code,
            error_msg=sentence,
        )
        message.header.stamp = to_stamp(now.ros)
        return Publish("tapper_state", message)

    def _urgent_content(self, now: Now) -> tuple[object, ...]:
        state, code = WIRE[self.state], self._shown_error(now)[0]
        last = self._last
        return state, last.tap_id, last.outcome, code, self._board.mounts_proven
