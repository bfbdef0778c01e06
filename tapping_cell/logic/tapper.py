"""State machine of the tapper: charges and fires once per tap, only while the arm stands still.

A tapper at a fixed mount needs no arm: the machine charges immediately, fires when the striker is
charged, and returns to rest when the board detects the striker back at its mount."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any

from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.energy import EnergyCurve
from tapping_cell.hardware.faults import LINE_LOST, FaultReason, HardwareFault
from tapping_cell.hardware.tapper import FireOutcome
from tapping_cell.hardware.tapper_protocol import Reply
from tapping_cell.hardware.tapper_protocol import State as BoardState
from tapping_cell.logic import enabling, permit, tap_commands, tapper_jobs
from tapping_cell.logic.clock import Now, to_nanoseconds, to_stamp
from tapping_cell.logic.device import DeviceLogic, patience_after
from tapping_cell.logic.effects import (
    Call,
    JobEnded,
    LogLevel,
    Message,
    Publish,
    Token,
)
from tapping_cell.logic.enabling import EnablingDevice
from tapping_cell.logic.error_codes import of_tapper
from tapping_cell.logic.host import Configured
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.tapper_jobs import ChargeEnd, FireEnd, Status
from tapping_cell.logic.tapper_peers import Mounts, PeerLimits, TapperPeers
from tapping_cell.logic.transitions import StateMachine, table
from tapping_cell.messages import ErrorCode, HoldStill, TapCommand, TapperState
from tapping_cell.se2 import Pose

READ_PERIOD_S = 0.1
HOLD_TIMEOUT_S = 0.2
"""Timeout of one call of ``hold_still``, after which the tapper repeats the call."""
HOLD_ATTEMPTS = 5
PROVE_PERIOD_S = 0.5
"""Time between two attempts to verify that the strikers are at their mounts."""
REFUSED_KEPT = 32
"""Number of refused commands and of withdrawals that are kept, so that later copies of the commands
are recognised."""
SHOWN_AFTER_S = 0.3
"""Time after which ``tapper_state`` contains the reason why an accepted tap waits."""
LONGEST_WAIT_S = 4.0
"""Time after which a tap is given up that waits for anything but the arm's way to its strike
pose."""
LONGEST_CHARGED_S = 3.0
"""Maximum time from the end of charging until the arm is in position. After this time the striker
is discharged."""


class State(Enum):
    """States of the tapper."""

    DISCONNECTED = "Disconnected"
    SAFE = "Safe"
    WAITING = "Waiting"
    """A tap is accepted and the arm is moving to its strike pose."""
    CHARGING = "Charging"
    CHARGED = "Charged"
    """The arm is still lowering the striker, or ``hold_still`` was called."""
    FIRING = "Firing"
    RETURNING = "Returning"
    """A striker at a fixed mount was released and has not returned yet."""
    DISCHARGING = "Discharging"
    FAULT = "Fault"
    STOPPED = "Stopped"
    CLEARING = "Clearing"


class Event(Enum):
    """Events of the tapper."""

    CONNECTED = "connected"
    TAP = "tap"
    ARM_READY = "arm above or at the strike pose"
    CHARGED = "charged"
    HELD = "arm holds still"
    FIXED = "mount is fixed"
    RELEASED = "released from a fixed mount"
    RETURNED = "striker is back"
    GIVEN_UP = "given up"
    ENDED = "ended"
    FAILED = "failed"
    STOP = "stop"
    CLEAR = "clear_fault"
    CLEARED = "cleared"
    CLOSED = "closed"


S = State
UNSTOPPED = tuple(state for state in State if state is not S.STOPPED)
TABLE = table(
    [
        ((S.DISCONNECTED,), Event.CONNECTED, (S.SAFE, S.STOPPED)),
        ((S.SAFE,), Event.TAP, (S.WAITING,)),
        ((S.WAITING,), Event.ARM_READY, (S.CHARGING,)),
        ((S.CHARGING,), Event.CHARGED, (S.CHARGED,)),
        ((S.CHARGED,), Event.HELD, (S.FIRING,)),
        ((S.CHARGED,), Event.FIXED, (S.FIRING,)),
        ((S.FIRING,), Event.RELEASED, (S.RETURNING,)),
        ((S.RETURNING,), Event.RETURNED, (S.SAFE,)),
        ((S.WAITING,), Event.GIVEN_UP, (S.SAFE,)),
        ((S.CHARGING, S.CHARGED, S.FIRING), Event.GIVEN_UP, (S.DISCHARGING,)),
        ((S.CHARGING, S.FIRING, S.DISCHARGING), Event.ENDED, (S.SAFE,)),
        (UNSTOPPED, Event.FAILED, (S.FAULT, S.DISCONNECTED, S.STOPPED)),
        (tuple(State), Event.STOP, (S.STOPPED,)),
        ((S.FAULT, S.STOPPED, S.DISCONNECTED), Event.CLEAR, (S.CLEARING,)),
        ((S.CLEARING,), Event.CLEARED, (S.SAFE,)),
        (tuple(State), Event.CLOSED, (S.DISCONNECTED,)),
    ]
)
WIRE = {
    S.DISCONNECTED: TapperState.DISCONNECTED,
    S.SAFE: TapperState.SAFE,
    S.WAITING: TapperState.SAFE,
    S.CHARGING: TapperState.CHARGING,
    S.CHARGED: TapperState.CHARGED,
    S.FIRING: TapperState.FIRING,
    S.RETURNING: TapperState.FIRING,
    S.DISCHARGING: TapperState.CHARGED,
    S.FAULT: TapperState.FAULT,
    S.STOPPED: TapperState.STOPPED,
    S.CLEARING: TapperState.STOPPED,
}
"""Value of ``tapper_state`` for each state."""
SERVING = frozenset({S.WAITING, S.CHARGING, S.CHARGED, S.FIRING, S.DISCHARGING})
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


@dataclass(frozen=True, slots=True)
class Tap:
    """The tap under way."""

    tap_id: int
    channel: int
    """Channel of the striking tapper, counted across the boards."""
    energy: float
    """J."""
    expiry: int
    """ROS time, ns."""
    planned: Pose
    """Pose of the object for which the tap was planned."""
    strike: Pose
    """Pose of the tip for the strike. An arm moves it there; a fixed tapper is always there."""
    flight: float
    """Time from the release of the striker to the end of its stroke, s; the arm stands still during
    this time."""


@dataclass(frozen=True, slots=True)
class Permit:
    """The arm's promise to stand still for a tap until ``until``, in s of this computer's steady
    clock."""

    tap_id: int
    until: float


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
        self._curves: Mapping[str, EnergyCurve] = {}
        self._strokes: Mapping[str, float] = {}
        self._channels: Mapping[str, int] = {}
        """Channel number of each tapper, counted across the boards."""
        self._mounts = Mounts()
        self._prove_at = -math.inf
        self._peers = TapperPeers(options.limits)
        self._error = (ErrorCode.TAPPER_NOT_CONNECTED, "the tapper is not connected yet")
        self._tap: Tap | None = None
        self._given_up: CodedError | None = None
        self._obstacle: CodedError | None = None
        """Why the accepted tap waits, apart from the arm's way to its strike pose."""
        self._obstacle_since = math.inf
        self._permit: Permit | None = None
        self._asked_at = -math.inf
        self._attempts = 0
        self._charged_at = -math.inf
        self._last_tap_id = 0
        self._refused: deque[tuple[int, int]] = deque(maxlen=REFUSED_KEPT)
        """Ids and stamps (ns) of the last commands that were refused while the outcome of another
        tap was not known. A copy that arrives later, perhaps after the withdrawal, is also
        refused."""
        self._withdrawn: deque[int] = deque(maxlen=REFUSED_KEPT)
        """Ids of the last taps that were withdrawn but not under way, perhaps because this process
        was started after their commands. A copy of such a command is refused."""
        self._used: int | None = None
        """Greatest shot number for which the board has charged, including charges before this node
        was started; None until the board has been read."""
        self._fixed = False
        self._reported = TapperState(measured_speed=math.nan)
        self._fire_job: int | None = None
        """Job that may fire the last tap; None: no job may have fired it."""
        self._set_up = options.set_up
        self._enabling = EnablingDevice()

    # Queries by the running job, without side effects

    def check_charging(self, now: Now) -> CodedError | None:
        """Return why charging must not begin or continue, or None if charging is allowed."""
        tap = self._tap
        if tap is None:
            return ErrorCode.NONE, "the tap is over"
        if (reason := self._given_up or self._conflict) is not None:
            return reason
        if self._stops.stopped or not self._active:
            return ErrorCode.NONE, "the tapper was stopped or deactivated"
        if self._set_up and not self._enabling.held(now):
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
        promise, tap = self._permit, self._tap
        assert tap is not None
        reason = self._peers.check_firing(tap.tap_id, tap.planned, tap.strike, now)
        if reason is not None:
            return reason
        if self.state is not S.FIRING:
            return ErrorCode.NONE, "the tap is over"
        if self._fixed:
            return None  # a fixed tapper cannot move
        if promise is None or promise.tap_id != tap.tap_id:
            return ErrorCode.TAPPER_ARM_NOT_IN_POSITION, "the arm has not granted hold_still"
        end = max(release_by, now.steady) + tap.flight
        if end > promise.until:
            return (
                ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
                f"the shot could end {end - promise.until:.3f} s after the time for which the arm"
                " stands still",
            )
        return None

    # Messages

    def _handle_message(self, topic: str, message: Message, now: Now) -> None:
        if topic == "tap_command":
            self._tap_command(message, now)
        elif topic == "arm_state":
            self._peers.on_arm_state(message, now)
            self._charge_when_ready(now)
            self._ask_when_in_position(now)
        elif topic == "plan_state":
            self._peers.on_plan_state(message, now)
            gone = self._peers.given_up()
            if gone is not None and self.state in SERVING:
                self._give_up(gone)
        elif topic == "object_state":
            self._peers.on_object_state(message, now)
        elif topic == "object_states":
            self._peers.on_object_states(message, now)
        elif topic == enabling.TOPIC:
            self._enabling.on_key(message.data, now)
            self._watch_enabling(now)

    def _handle_request(self, service: str, request: Message, token: Token, now: Now) -> None:
        raise AssertionError(f"the tapper has no service {service}")

    def _watch_enabling(self, now: Now) -> None:
        """In set-up mode, end the tap under way if no enabling device is held."""
        if self._set_up and self.state in SERVING and not self._enabling.held(now):
            self._give_up(enabling.RELEASED)

    def _tap_command(self, command: TapCommand, now: Now) -> None:
        if command.request == TapCommand.WITHDRAW:
            tap = self._tap
            if tap is not None and command.tap_id == tap.tap_id:
                self._give_up((ErrorCode.NONE, ""))
            else:
                self._withdrawn.append(command.tap_id)
            return
        if command.request == TapCommand.CLEAR_VIEW:
            return  # this command is only for the arm
        refusal = self._refusal(command, now)
        if refusal is not None:
            self._refuse(command, refusal, now)
            return
        tapper = tap_commands.named_tapper(command.tapper, tuple(self._channels))
        assert tapper is not None
        self._machine.move(Event.TAP, S.WAITING)
        self._reported.tapper = tapper
        self._last_tap_id = command.tap_id
        self._tap = Tap(
            command.tap_id,
            self._channels[tapper],
            self._curves[tapper].energy_for(command.striker_speed),
            to_nanoseconds(command.expiry),
            from_message(command.object_pose),
            from_message(command.strike_pose),
            permit.flight(self._strokes[tapper], command.striker_speed),
        )
        self._given_up = self._permit = None
        self._obstacle_since = math.inf
        self._attempts = 0
        self._peers.begin_tap(command.object_id, command.strike_pose.position.z)
        self._error = (ErrorCode.NONE, "")
        self._set_tap(command.tap_id, TapperState.NONE)
        if self._fixed:
            self._charge_when_ready(now)

    def _end_contested(self, why: CodedError) -> None:
        if self.state in SERVING:
            self._give_up(why)

    def _set_tap(self, tap_id: int, outcome: int) -> None:
        self._fire_job = None
        self._reported.tap_id, self._reported.outcome = tap_id, outcome
        self._reported.measured_speed = math.nan

    def _awaits_outcome(self) -> bool:
        """Return whether a tap was accepted whose outcome is not known yet."""
        return self._reported.tap_id != 0 and self._reported.outcome == TapperState.NONE

    def _refusal(self, command: TapCommand, now: Now) -> CodedError | None:
        """Return why a tap command is refused, or None if it is accepted."""
        if not self._active or not self._configured:
            return ErrorCode.NOT_ACTIVE, "the node is not active; activate it first"
        if self._conflict is not None:
            return self._conflict
        if self.state is not S.SAFE:
            serving = self.state in SERVING
            why = (
                f"serves tap {self._reported.tap_id}"
                if serving
                else f"is not at rest: {self._error[1]}"
            )
            return ErrorCode.TAPPER_BUSY, f"the tapper {why}"
        names = tuple(self._channels)
        tapper = tap_commands.named_tapper(command.tapper, names)
        if tapper is None:
            return tap_commands.unknown_tapper(command.tapper, names)
        if self._fixed and (reason := self._mounts.check()) is not None:
            return reason
        if self._set_up and not self._enabling.held(now):
            return enabling.RELEASED
        if (reason := self._peers.clocks_differ(now)) is not None:
            return reason
        if (reason := self._peers.unknown_object(command.object_id)) is not None:
            return reason
        if tap_commands.expired(command, now):
            return ErrorCode.TAPPER_COMMAND_EXPIRED, tap_commands.overdue(command, now)
        speed, curve = command.striker_speed, self._curves[tapper]
        if math.isfinite(speed) and not curve.slowest <= speed <= curve.fastest:
            return (
                ErrorCode.TAPPER_SPEED_OUT_OF_RANGE,
                f"a striker speed of {1000 * speed:.1f} mm/s is outside the tapper's "
                f"{1000 * curve.slowest:.1f} to {1000 * curve.fastest:.1f} mm/s",
            )
        if _id_and_stamp(command) in self._refused:
            return (
                ErrorCode.COMMAND_REPEATED,
                "this command was refused before; send a new tap with a greater id",
            )
        if command.tap_id in self._withdrawn:
            return (
                ErrorCode.COMMAND_REPEATED,
                "this tap was withdrawn before its command arrived; send a new tap with a greater"
                " id",
            )
        return tap_commands.refusal(command, now, max(self._last_tap_id, self._used or 0))

    def _refuse(self, command: TapCommand, refusal: CodedError, now: Now) -> None:
        code, sentence = refusal
        self._log(LogLevel.ERROR, f"tap {command.tap_id} refused: {sentence}")
        # Until the outcome of the last accepted tap is known, possibly after a stop, the published
        # state refers only to that tap, so the refused tap is not recorded. An id above the
        # largest valid id is not recorded either, because it would become the last id. The largest
        # valid id does not depend on refused taps, so that these cannot raise it.
        new = self._last_tap_id < command.tap_id <= tap_commands.largest_id(self._used or 0, now)
        if new and self._awaits_outcome():
            self._refused.append(_id_and_stamp(command))
        elif new:
            self._last_tap_id = command.tap_id
            if self._used is not None:
                # Before the board is read, no outcome is published: the tap may have been fired by
                # this node before a restart, or by another node that uses the board.
                spent = command.tap_id <= self._used
                outcome = TapperState.UNKNOWN if spent else TapperState.NOT_FIRED
                self._set_tap(command.tap_id, outcome)
            if self.state is S.SAFE:
                self._error = refusal

    def _charge_when_ready(self, now: Now) -> None:
        tap = self._tap
        if self.state is not S.WAITING or tap is None:
            return
        if (differ := self._peers.clocks_differ(now)) is not None:
            self._give_up(differ)  # waiting would not remove the difference
            return
        if self.check_charging(now) is not None:
            self._note_obstacle(tap, now)
            return
        self._machine.move(Event.ARM_READY, S.CHARGING)
        self._run(
            "charge",
            partial(
                tapper_jobs.charge,
                shot=tap.tap_id,
                energy=tap.energy,
                channel=tap.channel,
                check=self.check_charging,
                post_replies=self._set_up,
            ),
        )

    def _note_obstacle(self, tap: Tap, now: Now) -> None:
        """Note why the tap waits, and give it up if the reason lasts."""
        self._obstacle = self._peers.obstacle(tap.tap_id, tap.planned, tap.strike, now)
        if self._obstacle is None:
            self._obstacle_since = math.inf
            return
        self._obstacle_since = min(self._obstacle_since, now.steady)
        if now.steady > self._obstacle_since + LONGEST_WAIT_S:
            self._give_up(self._obstacle)

    def _shown_error(self, now: Now) -> CodedError:
        waits = self.state is S.WAITING and now.steady > self._obstacle_since + SHOWN_AFTER_S
        shown = super()._shown_error(now)
        return self._obstacle if waits and self._obstacle is not None and not shown[0] else shown

    def _give_up(self, why: CodedError) -> None:
        """End the tap under way. The striker is not released, unless its release has already
        begun."""
        if self._given_up is None:
            self._given_up = why
        if self.state is S.WAITING:
            self._machine.move(Event.GIVEN_UP, S.SAFE)
            self._tap = None
            self._reported.outcome = TapperState.NOT_FIRED
            self._error = why
        elif self.state is S.CHARGING:
            self._machine.move(Event.GIVEN_UP, S.DISCHARGING)
            self._abandon()
        elif self.state is S.CHARGED:
            self._discharge(why)
        elif self.state is S.FIRING:
            self._abandon()

    # The arm's promise to stand still

    def _ask_when_in_position(self, now: Now) -> None:
        """Call ``hold_still`` once the arm is in position, or discharge if the tap must end."""
        tap = self._tap
        if self.state is not S.CHARGED or tap is None or self._attempts > 0:
            return
        if self._fixed:
            self._attempts += 1
            self._machine.move(Event.FIXED, S.FIRING)
            self._begin_shot(tap)
            return
        if self._peers.check_firing(tap.tap_id, tap.planned, tap.strike, now) is None:
            self._ask_arm(now)
            return
        why = self.check_charging(now)
        if why is None and now.steady > self._charged_at + LONGEST_CHARGED_S:
            why = (
                ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
                f"the arm was not in position {LONGEST_CHARGED_S:.0f} s after the tapper was"
                " charged",
            )
        if why is not None:
            self._discharge(why)

    def _begin_shot(self, tap: Tap) -> None:
        self._run(
            "fire",
            partial(
                tapper_jobs.fire,
                shot=tap.tap_id,
                check=self.check_firing,
                post_replies=self._set_up,
            ),
        )
        self._fire_job = self._job

    def _ask_arm(self, now: Now) -> None:
        assert self._tap is not None
        self._attempts += 1
        self._asked_at = now.steady
        duration = permit.hold(self._tap.flight)
        request = HoldStill.Request(tap_id=self._tap.tap_id, duration=duration)
        token = ("hold", self._tap.tap_id, self._attempts)
        self._effects.append(Call("hold_still", request, token, HOLD_TIMEOUT_S))

    def _handle_answer(self, token: Token, response: Message | None, now: Now) -> None:
        tap = self._tap
        if self.state is not S.CHARGED or tap is None:
            return
        if token != ("hold", tap.tap_id, self._attempts):
            return
        # Count the hold time from the moment at which hold_still was requested. The arm counts it
        # from the later moment at which it handles the request, so the arm stands still for longer.
        until = self._asked_at + permit.hold(tap.flight)
        if response is not None and response.granted:
            until -= permit.shortfall(tap.flight, response.duration)
        late = response is None or now.steady > until - permit.RELEASE_S - tap.flight
        if response is not None and not response.granted:
            self._discharge((response.error_code, response.error_msg))
        elif not late:
            self._permit = Permit(tap.tap_id, until)
            self._machine.move(Event.HELD, S.FIRING)
            self._begin_shot(tap)
        elif self._attempts < HOLD_ATTEMPTS:
            self._ask_arm(now)
        else:
            self._discharge(
                (
                    ErrorCode.ARM_SILENT,
                    "the arm did not answer hold_still in time, or granted too short a time, in"
                    f" {HOLD_ATTEMPTS} attempts; check scara_arm and the network",
                )
            )

    def _discharge(self, why: CodedError) -> None:
        self._given_up = why
        self._fire_job = None
        self._machine.move(Event.GIVEN_UP, S.DISCHARGING)
        self._run("discharge", tapper_jobs.discharge)

    # Jobs

    def _on_job_report(self, name: str, content: Any, now: Now) -> None:
        assert isinstance(content, Reply), f"the job {name} may report only replies of the board"
        self._on_switch(content, now)

    def _job_done(self, name: str, result: Any, now: Now) -> None:
        if isinstance(result, FireEnd):
            self._fired(result, now)
        elif isinstance(result, ChargeEnd):
            self._charge_ended(result, now)
        else:
            assert isinstance(result, Status)
            self._take_in(result)
            self._on_switch(result.reply, now)
            if name == "discharge":
                self._not_fired(self._given_up)
            elif name == "connect":
                self._board_ready(result.reply, Event.CONNECTED)
            elif name == "clear":
                self._board_ready(result.reply, Event.CLEARED)
            elif name == "prove":
                self._see_mounts()
            elif name == "return":
                self._see_return(result.reply)
                self._see_stop(result.reply)

    def _charge_ended(self, end: ChargeEnd, now: Now) -> None:
        self._take_in(end.status)
        if end.charged and self.state is S.DISCHARGING:
            # The tap was given up at the moment when charging ended.
            self._run("discharge", tapper_jobs.discharge)
        elif not end.charged:
            self._not_fired(self._given_up or end.refusal)
        else:
            self._machine.move(Event.CHARGED, S.CHARGED)
            self._charged_at = now.steady
            self._ask_when_in_position(now)

    def _not_fired(self, why: CodedError | None) -> None:
        """Handle the end of a tap that was not fired; the tapper is at rest."""
        self._machine.move(Event.ENDED, S.SAFE)
        self._tap = None
        # If the board has already used the shot's number, the shot may have been fired before this
        # node restarted.
        spent = why is not None and why[0] == ErrorCode.TAPPER_SPENT
        self._reported.outcome = TapperState.UNKNOWN if spent else TapperState.NOT_FIRED
        code, sentence = why or (ErrorCode.NONE, "")
        self._error = (code, sentence if code else "")

    def _fired(self, end: FireEnd, now: Now) -> None:
        """Handle the end of a shot: its outcome, then the state of the board."""
        self._tap = None
        self._reported.outcome = OUTCOMES[end.outcome]
        refused = end.outcome is FireOutcome.NOT_FIRED
        refusal = self._given_up or end.refusal
        if refused and refusal is not None:
            self._error = (refusal[0], refusal[1] if refusal[0] else "")
        elif refused:
            code = ErrorCode.TAPPER_FAULT if end.refused is None else of_tapper(end.refused)
            self._error = (code, end.sentence)
        elif end.outcome is FireOutcome.UNKNOWN:
            self._error = (ErrorCode.TAPPER_OUTCOME_UNKNOWN, end.sentence)
        if end.fault is not None:
            error = self._error
            self._meet(end.fault)
            if error[0]:
                self._error = error
            return
        assert end.status is not None
        self._take_in(end.status)
        if self._fixed and end.outcome is not FireOutcome.NOT_FIRED:
            self._machine.move(Event.RELEASED, S.RETURNING)
            self._run("return", tapper_jobs.wait_for_return)
        else:
            self._machine.move(Event.ENDED, S.SAFE)
        self._see_stop(end.status.reply)

    def _job_failed(self, name: str, fault: HardwareFault, now: Now) -> None:
        if name == "connect":
            self.patience = patience_after(self.patience, fault)
        if name == "prove" and fault.reason is FaultReason.INTERLOCK:
            return  # the guard was opened; the mounts are checked again when it is closed
        # A job raises only faults that occurred before FIRE was sent, so the tap was not fired.
        if fault.reason in OF_THE_TAP and self.state in (S.CHARGING, S.CHARGED, S.FIRING):
            self._log(LogLevel.ERROR, fault.sentence)
            self._discharge((of_tapper(fault), fault.sentence))
            return
        if fault.reason in OF_THE_TAP and name == "charge" and self.state is S.DISCHARGING:
            # The tap had already been given up, and the board refused to continue charging. For
            # example, the board discharged while this process was suspended.
            self._run("discharge", tapper_jobs.discharge)
            return
        if self._tap is not None:
            self._tap = None
            self._reported.outcome = TapperState.NOT_FIRED
        if name == "connect" and fault.reason is FaultReason.UNKNOWN_FIRMWARE:
            # Not only another firmware but also a board that is silent for a short time causes this
            # fault, so connecting is tried again.
            self._fail_to(S.DISCONNECTED)
            self._set_error(of_tapper(fault), fault.sentence)
            return
        self._meet(fault)

    def _meet(self, fault: HardwareFault) -> None:
        """Change to the state that corresponds to a fault, and report the fault."""
        if fault.reason in LOST_BOARD:
            self._fail_to(S.DISCONNECTED)
        else:
            self._fail_to(S.STOPPED if fault.reason in STOPPED_BOARD else S.FAULT)
        self._set_error(of_tapper(fault), fault.sentence)

    def _overtaken(self, event: JobEnded, now: Now) -> None:
        # The fire job may end after a stop, a fault or a reconnection. The outcome that it returns
        # is still valid, also if the node was closed meanwhile and reported UNKNOWN.
        if isinstance(event.result, FireEnd) and event.result.shot == self._reported.tap_id:
            self._reported.outcome = OUTCOMES[event.result.outcome]
        elif event.job == self._fire_job and self._awaits_outcome():
            # A HardwareFault occurred before FIRE was sent. Any other exception is a defect of this
            # program, which may have occurred after FIRE was sent.
            before = isinstance(event.fault, HardwareFault)
            self._reported.outcome = TapperState.NOT_FIRED if before else TapperState.UNKNOWN

    def _read_done(self, result: Any, now: Now) -> None:
        self._take_in(result)
        self._on_switch(result.reply, now)
        self._see_stop(result.reply)
        if self.state is S.SAFE:
            self._see_mounts()
        elif self.state is S.CHARGED and result.reply.state is not BoardState.CHARGED:
            self._discharge(_why_not_charged(result.reply))

    def _see_return(self, reply: Reply) -> None:
        """Handle the end of the wait for a released striker: it has returned or is overdue."""
        if reply.state is BoardState.SAFE:
            self._machine.move(Event.RETURNED, S.SAFE)
        elif not reply.stop_latched:
            struck = self._reported.tapper
            self._fail_to(S.FAULT)
            self._set_error(
                ErrorCode.TAPPER_STRIKER_AWAY,
                "according to the switch at its mount, the striker of"
                f" {', '.join(self._mounts.away) or struck} did not leave or did not return; free"
                " the striker, check its return spring and the switch, then clear the fault",
            )

    def _see_mounts(self) -> None:
        """While at rest, report an error of the mounts, or clear the error when its cause is
        gone."""
        if not self._fixed:
            return
        reason = self._mounts.check()
        of_mounts = (ErrorCode.TAPPER_STRIKER_AWAY, ErrorCode.TAPPER_MOUNT_NOT_PROVEN)
        if reason is not None:
            self._set_error(*reason)
        elif self._error[0] in of_mounts:
            self._error = (ErrorCode.NONE, "")

    def _on_switch(self, reply: Reply, now: Now) -> None:
        self._enabling.on_switch(reply.enabled, now)
        self._watch_enabling(now)

    def _see_stop(self, reply: Reply) -> None:
        """Handle a stop button that was pressed at the cell."""
        if reply.stop_latched:
            self._stop_tap()
            self._machine.move(Event.FAILED, S.STOPPED)
            self._set_error(*LATCHED)

    def _take_in(self, status: Status) -> None:
        reply = status.reply
        ours = reply.last_fired == self._reported.tap_id and reply.speed is not None
        self._reported.measured_speed = (
            reply.speed if ours and reply.speed is not None else math.nan
        )
        self._used = reply.shot
        self._reported.shots_fired = status.fired
        self._reported.boot_number = reply.boot
        self._reported.interlock_closed = reply.interlock_closed
        switches = reply.at_mounts
        self._mounts.fitted = reply.channels > 1 or switches > 0
        self._mounts.proven = reply.state not in (BoardState.UNHOMED, BoardState.HOMING)
        resting = reply.state not in (BoardState.RELEASING, BoardState.DISCHARGING)
        if resting or not switches:
            self._mounts.away = tuple(
                name
                for name, channel in self._channels.items()
                if self._mounts.fitted and not switches >> channel & 1
            )

    # States

    def _configured_with(self, event: Configured, now: Now) -> None:
        assert isinstance(event.cell, Cell)
        cell = event.cell
        self._channels = cell.tapper_channels
        self._curves = {name: part.curve() for name, part in cell.tapper_sections.items()}
        self._strokes = {name: part.stroke for name, part in cell.tapper_sections.items()}
        self._fixed = cell.file.fixed_tappers is not None
        if self._fixed:
            self._peers.use_mounts(self._mounts)

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
        if self.state in SERVING:
            self._give_up((ErrorCode.NOT_ACTIVE, "the node was deactivated"))

    def _code_of(self, fault: HardwareFault) -> int:
        return of_tapper(fault)

    def _closed(self) -> None:
        self._stop_tap()
        if self._awaits_outcome():
            # The host may not report the end of the shot any more.
            self._reported.outcome = TapperState.UNKNOWN
        # After a failed attempt to connect, the reason for the failure remains.
        if not self._stops.stopped and self.state is not S.DISCONNECTED:
            self._machine.move(Event.CLOSED, S.DISCONNECTED)
            self._error = (ErrorCode.TAPPER_NOT_CONNECTED, "the tapper is not connected")

    def _stop_tap(self) -> None:
        """End the tap. If a shot is under way, its outcome is reported when the job ends."""
        if self._awaits_outcome() and self._fire_job is None:
            self._reported.outcome = TapperState.NOT_FIRED
        self._tap = self._permit = None
        self._overtake()

    def _stop(self, now: Now) -> None:
        self._stop_tap()
        self._machine.move(Event.STOP, S.STOPPED)
        self._set_error(*self.stop_error)

    def _fail(self, now: Now) -> None:
        self._stop_tap()
        if self.state is not S.STOPPED:
            self._fail_to(S.FAULT)

    def _fail_to(self, target: State) -> None:
        self._overtake()
        self._machine.move(Event.FAILED, target)

    def _healthy(self) -> bool:
        return self.state in SERVING or self.state in (S.SAFE, S.RETURNING)

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
        self._charge_when_ready(now)
        self._ask_when_in_position(now)
        tap = self._tap
        if self.state is S.WAITING and tap is not None and now.ros > tap.expiry:
            reason = self._peers.check_firing(tap.tap_id, tap.planned, tap.strike, now)
            why = f": {reason[1]}" if reason is not None else ""
            self._give_up(
                (
                    ErrorCode.TAPPER_COMMAND_EXPIRED,
                    f"the tap's expiry passed before it could be fired{why}",
                )
            )

    def _prove_when_due(self, now: Now) -> None:
        """Have the board verify its strikers' positions, if it has mount switches and has not yet
        done so."""
        mounts = self._mounts
        wanted = self._fixed and mounts.fitted and not mounts.proven and not mounts.away
        wanted = wanted and self._reported.interlock_closed and self.state is S.SAFE
        idle = self._job is None and self._reading is None
        if wanted and idle and now.steady >= self._prove_at + PROVE_PERIOD_S:
            self._prove_at = now.steady
            self._run("prove", tapper_jobs.prove)

    # Reports

    def _report(self, now: Now) -> Publish:
        code, sentence = self._shown_error(now)
        reported = self._reported
        message = TapperState(
            state=WIRE[self.state],
            tappers=list(self._channels),
            tapper=reported.tapper,
            fixed_mounts=self._fixed,
            away=list(self._mounts.away) if self._fixed else [],
            mounts_proven=self._mounts_proven(),
            tap_id=reported.tap_id,
            outcome=reported.outcome,
            measured_speed=reported.measured_speed,
            shots_fired=reported.shots_fired,
            boot_number=reported.boot_number,
            interlock_closed=reported.interlock_closed,
            set_up=self._set_up,
            enabling_switch=self._enabling.switch_held(now),
            last_stop=self._last_stop,
            error_code=code,
            error_msg=sentence,
        )
        message.header.stamp = to_stamp(now.ros)
        return Publish("tapper_state", message)

    def _mounts_proven(self) -> bool:
        return not self._fixed or (self._mounts.fitted and self._mounts.proven)

    def _urgent_content(self, now: Now) -> tuple[object, ...]:
        reported = self._reported
        state, code = WIRE[self.state], self._shown_error(now)[0]
        return state, reported.tap_id, reported.outcome, code, self._mounts_proven()


def _why_not_charged(reply: Reply) -> CodedError:
    """Return why a board that was charged now reports a state other than charged."""
    if not reply.interlock_closed:
        return (
            ErrorCode.TAPPER_INTERLOCK_OPEN,
            "the guard was opened while the tapper was charged, so the tapper discharged itself;"
            " close the guard",
        )
    if reply.lacks_switch:
        return (
            ErrorCode.ENABLING_RELEASED,
            "the enabling switch was released while the tapper was charged; without it the tapper"
            " keeps at most its set-up energy, so it discharged itself; hold the switch",
        )
    return (
        ErrorCode.TAPPER_FAULT,
        f"the tapper was charged, but its board is now in state {reply.state.value}: it discharged"
        " itself because it received no request for 0.5 s, the guard was opened or the enabling"
        " switch of set-up mode released briefly, or its supply failed",
    )


def _id_and_stamp(command: TapCommand) -> tuple[int, int]:
    return command.tap_id, to_nanoseconds(command.header.stamp)
