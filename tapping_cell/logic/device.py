"""Base class of the state machines of arm and tapper: jobs, stops, faults and lifecycle."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar, Generic, TypeVar

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic import stops
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import (
    AbandonJob,
    Answer,
    AskStops,
    Content,
    Effect,
    Job,
    JobContext,
    JobEnded,
    JobProgress,
    KeepStop,
    Log,
    LogLevel,
    Message,
    Publish,
    RunJob,
    StopLevels,
    StopWire,
    Token,
)
from tapping_cell.logic.host import (
    Activated,
    Configured,
    Deactivated,
    LifecycleEvent,
    LostEvent,
    UnansweredRequest,
    Unreachable,
)
from tapping_cell.logic.tap_commands import CodedError
from tapping_cell.logic.transitions import StateMachine
from tapping_cell.messages import Bool, ErrorCode, StopState, Time, Trigger

FIRST_TIMEOUT_S = 1.0
"""Timeout of the first attempt to open a port and receive a reply."""
LONGEST_TIMEOUT_S = 6.0
"""Maximum timeout of an attempt to connect. The timeout is doubled after each attempt without a
reply, because opening a port restarts many boards, and some of them take seconds to restart."""
MUTE = (
    FaultReason.UNKNOWN_FIRMWARE,
    FaultReason.TIMEOUT,
    FaultReason.PROTOCOL,
    FaultReason.NEEDS_PERSON,
)
STOP_AGAIN_S = 1.0
"""Minimum time between two transmissions of a latched stop to a device with ``repeats_stop``, s. It
limits the load on the line if a publisher of ``emergency_stop`` repeats its level."""
CONTINUE = (ErrorCode.NONE, "")
NOT_STARTED = HardwareFault(FaultReason.STOPPED, "not started because of an internal error")
"""Result of a job that the host did not receive, because the handler that began it raised."""

State = TypeVar("State", bound=Enum)
Event = TypeVar("Event", bound=Enum)


@dataclass(frozen=True, slots=True)
class Run:
    """Step of the cycle of a tap: start a job, and abandon the job under way."""

    name: str
    job: Callable[[JobContext], object]


@dataclass(frozen=True, slots=True)
class Abandon:
    """Step of the cycle of a tap: abandon the job under way. Its end is still awaited."""


def patience_after(patience: float, fault: HardwareFault | None) -> float:
    """Return the timeout in s of the next ``connect``. ``patience``: timeout of the last
    ``connect``; ``fault``: its fault, None if it succeeded."""
    if fault is not None and fault.reason in MUTE:
        return min(2 * patience, LONGEST_TIMEOUT_S)
    return FIRST_TIMEOUT_S


class DeviceLogic(ABC, Generic[State, Event]):
    """Common part of the state machines of the devices.

    One job at a time executes a command. A job that only reads the device's state may be queued as
    well; its result is discarded if a command's job was started in the meantime. If a stop, a fault
    or a new connection occurs during a job, the end of this job does not change the state.
    """

    stop_error: CodedError
    stopped_state: State
    repeats_stop: ClassVar[bool] = False
    """Whether a latched stop is sent to the device again if ``emergency_stop`` is asserted again. A
    device that loses its power also loses its latch."""

    def __init__(self, machine: StateMachine[State, Event], tick_period: float) -> None:
        self.tick_period = tick_period
        self.patience = FIRST_TIMEOUT_S
        self._machine = machine
        self._stops = stops.StopLatch()
        self._stop_sent_at = -math.inf
        """Time at which a stop of ``emergency_stop`` was last sent to the device, s."""
        self._active = False
        self._configured = False
        self._error: CodedError = CONTINUE
        self._conflict: CodedError | None = None
        """Why nothing begins: several nodes do the work of one node of the cell."""
        self._effects: list[Effect] = []
        self._jobs = 0
        self._job: int | None = None
        self._job_name = ""
        self._reading: int | None = None
        self._clear_job: int | None = None
        """Last job that clears a stop or a fault."""
        self._resets: set[Token] = set()
        """Requests to clear that wait for the levels of the publishers of ``emergency_stop``."""
        self._handed_out = 0
        """Number of the last job that the host has received."""
        self._read_at = -1.0
        self._published: tuple[object, ...] | None = None
        self._was_stopped = False
        self._last_stop = Time()
        """ROS time at which the stopped state was last entered; 0: never."""

    # Public properties

    @property
    def state(self) -> State:
        """Present state."""
        return self._machine.state

    @property
    def active(self) -> bool:
        """Whether the machine may act."""
        return self._active

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return self._stops.stopped

    @property
    def error(self) -> CodedError:
        """Error code and message; (0, "") if there is no error."""
        return self._error

    # Methods that a device implements

    @abstractmethod
    def _handle_message(self, topic: str, message: Message, now: Now) -> None: ...

    @abstractmethod
    def _handle_request(self, service: str, request: Message, token: Token, now: Now) -> None: ...

    @abstractmethod
    def _handle_answer(self, token: Token, response: Message | None, now: Now) -> None: ...

    @abstractmethod
    def _on_job_report(self, name: str, content: Any, now: Now) -> None: ...

    @abstractmethod
    def _job_done(self, name: str, result: Any, now: Now) -> None: ...

    @abstractmethod
    def _job_failed(self, name: str, fault: HardwareFault, now: Now) -> None: ...

    @abstractmethod
    def _read_done(self, result: Any, now: Now) -> None: ...

    @abstractmethod
    def _job_superseded(self, event: JobEnded, now: Now) -> None:
        """Handle the end of a job during which a stop, a fault or a new connection occurred. Keep
        the part of the job's result that is still valid."""

    @abstractmethod
    def _configured_with(self, event: Configured, now: Now) -> None:
        """Store the cell of the configuration; this is called before any other configuration
        step."""

    @abstractmethod
    def _closed(self) -> None:
        """Handle the closing of the port: discard the device's state, but keep a stop latched."""

    @abstractmethod
    def _code_of(self, fault: HardwareFault) -> int:
        """Return the error code of a fault of this device."""

    @abstractmethod
    def _connected(self, answer: Any, now: Now) -> None:
        """Handle the opening of the port: adopt the state of the device."""

    @abstractmethod
    def _activated(self, now: Now) -> None: ...

    @abstractmethod
    def _deactivated(self, now: Now) -> None: ...

    @abstractmethod
    def _stop(self, now: Now) -> None:
        """Go to the stopped state, from any state."""

    def _end_contested(self, why: CodedError) -> None:
        """End what must not continue during a conflict between nodes."""

    @abstractmethod
    def _fail(self, now: Now) -> None:
        """Go to the faulted state, from any state."""

    @abstractmethod
    def _begin_clear(self, now: Now) -> None:
        """Run the job that ends a stop or a fault."""

    @abstractmethod
    def _healthy(self) -> bool:
        """Return whether there is no fault or stop to clear."""

    @abstractmethod
    def _time_passed(self, now: Now) -> None: ...

    @abstractmethod
    def _report(self, now: Now) -> Publish:
        """Return the effect that publishes the state."""

    def before_connect(self, driver: Any) -> None:
        """Prepare the device for the next attempt to configure the node. Called in the thread that
        connects; raises HardwareFault."""

    def _unreachable(self, fault: HardwareFault, now: Now) -> None:
        """Process the fault that made an attempt to configure the node fail."""

    def _clears_at_next_attempt(self) -> bool:
        """Handle a request to clear before the node is configured; return whether it is granted."""
        return False

    def recall_stop(self, content: Content | None) -> None:
        """Restore the stop that an earlier process of this node has stored last, if any. Call this
        method before the first event, because a new stop replaces the stored one."""
        self._stops.recall(content)

    # Handlers of the protocol ``Logic``

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """Handle a lifecycle event of the node."""
        if isinstance(event, Configured):
            self._configured = True
            self._configured_with(event, now)
            if self._stops.stopped:
                self._effects.append(StopWire())
                self._stop(now)
            else:
                self._connected(event.connected, now)
            self._publish_stops(now)
        elif isinstance(event, Unreachable):
            self.patience = patience_after(self.patience, event.fault)
            self._unreachable(event.fault, now)
            if self.state is not self.stopped_state:
                self._error = (self._code_of(event.fault), event.fault.sentence)
        elif isinstance(event, Activated):
            self._active = True
            if not self._stops.stopped:
                self._activated(now)
        elif isinstance(event, Deactivated):
            self._active = False
            self._deactivated(now)
        else:
            self._active = self._configured = False
            self._supersede_job()
            self._reading = None
            self._closed()
        return self._drain(now)

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """Handle a message."""
        if topic == stops.TOPIC:
            new = not self._stops.stopped and message.data
            again = self.repeats_stop and now.steady - self._stop_sent_at >= STOP_AGAIN_S
            if message.data and (new or again):
                # The stop is sent before anything else.
                self._stop_sent_at = now.steady
                self._effects.append(StopWire())
            if self._stops.receive(bool(message.data)):
                self._keep_stops(now)
            if new:
                self._log(LogLevel.ERROR, "emergency stop: latched until clear_fault")
                self._stop(now)
        else:
            self._handle_message(topic, message, now)
        return self._drain(now)

    def on_request(
        self, service: str, request: Message, token: Token, now: Now
    ) -> Sequence[Effect]:
        """Handle a service request."""
        if service == "~/stop":
            self._effects.append(StopWire())
            if self._stops.press():
                self._keep_stops(now)
            self._stop(now)
            self._answer(token, True, "stopped; clear_fault ends the stop")
        elif service == "~/clear_fault":
            self._clear(token, now)
        else:
            self._handle_request(service, request, token, now)
        return self._drain(now)

    def on_answer(self, token: Token, response: Message | None, now: Now) -> Sequence[Effect]:
        """Handle the answer to a call."""
        if isinstance(token, tuple) and token[0] == "reset":
            self._levels_received(token[1], token[2], response, now)
        else:
            self._handle_answer(token, response, now)
        return self._drain(now)

    def on_conflict(self, sentence: str, now: Now) -> Sequence[Effect]:
        """Handle the beginning, a change or the end of a conflict between nodes."""
        self._conflict = (ErrorCode.CONFIGURATION_CONFLICT, sentence) if sentence else None
        if self._conflict is not None:
            self._log(LogLevel.ERROR, sentence)
            self._end_contested(self._conflict)
        return self._drain(now)

    def on_job(self, event: JobProgress | JobEnded, now: Now) -> Sequence[Effect]:
        """Handle the progress or the end of a job."""
        if isinstance(event, JobProgress):
            if event.job == self._job:
                self._on_job_report(self._job_name, event.content, now)
        elif event.job == self._reading:
            self._reading = None
            is_defect = not isinstance(event.fault, HardwareFault | None)
            if (self._job is None or is_defect) and not self._stops.stopped:
                self._handle_job_end(event, "read", now)
        elif event.job == self._job:
            self._job = None
            self._handle_job_end(event, self._job_name, now)
        else:
            if event.job == self._clear_job and self._stops.stopped:
                # This job may have cleared the device's stop just after the new stop was sent.
                self._effects.append(StopWire())
            self._job_superseded(event, now)
        return self._drain(now)

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Handle the timer and publish the state."""
        if self._configured:
            self._time_passed(now)
        self._published = None
        return self._drain(now)

    def on_defect(
        self, error: Exception, now: Now, lost: LostEvent | None = None
    ) -> Sequence[Effect]:
        """Stop the device and report INTERNAL after a handler has raised ``error``."""
        if isinstance(lost, Activated | Deactivated):
            self._active = isinstance(lost, Activated)
        unstarted = range(self._handed_out + 1, self._jobs + 1)
        # Requests that the handler has already answered receive no other answer.
        self._effects = [e for e in self._effects if isinstance(e, Answer | AbandonJob)]
        self._effects.append(StopWire())
        self._latch_lost_stop(lost)
        self._stops.forget_refusal()
        self._keep_stops(now)  # the handler may have latched or reset a stop
        self._defect(error, now)
        for job in unstarted:
            self._job_superseded(JobEnded(job, fault=NOT_STARTED), now)
        unanswered = dict.fromkeys(self._resets, "~/clear_fault")
        self._resets.clear()
        if isinstance(lost, JobEnded):
            self._job_superseded(lost, now)
        elif isinstance(lost, UnansweredRequest):
            unanswered[lost.token] = lost.service
        for effect in self._effects:
            if isinstance(effect, Answer):
                unanswered.pop(effect.token, None)
        for token, service in unanswered.items():
            self._effects.append(Answer(token, self._failure(service, self._error[1])))
        return self._drain(now)

    # Helpers for the devices

    def _latch_lost_stop(self, lost: LostEvent | None) -> None:
        """Latch the stop that a handler received before it raised, if any."""
        if isinstance(lost, Bool) and lost.data:
            self._stops.receive(True)
        elif isinstance(lost, UnansweredRequest) and lost.service == "~/stop":
            self._stops.press()

    def _handle_job_end(self, event: JobEnded, name: str, now: Now) -> None:
        fault = event.fault
        if fault is None:
            if name == "read":
                self._read_done(event.result, now)
            else:
                self._job_done(name, event.result, now)
        elif isinstance(fault, HardwareFault):
            self._job_failed(name, fault, now)
        else:
            self._effects.append(StopWire())
            self._defect(fault, now)
            self._job_superseded(event, now)

    def _defect(self, error: Exception, now: Now) -> None:
        self._reading = None  # its end must not replace the report of the defect
        unstarted = self._job is not None and self._job > self._handed_out
        if self._stops.stopped and (self.state is not self.stopped_state or unstarted):
            self._stop(now)  # the exception has interrupted the stop
        elif self._configured:
            self._fail(now)
        self._set_error(
            ErrorCode.INTERNAL,
            f"internal error ({error!r}): report it with the log, then restart the node",
        )

    def _run(self, name: str, run: Callable[[JobContext], object]) -> None:
        """Start a job, and abandon the job under way."""
        self._abandon()
        self._jobs += 1
        self._job, self._job_name = self._jobs, name
        self._effects.append(RunJob(Job(self._jobs, name, run)))

    def _read_when_due(self, period: float, run: Callable[[JobContext], object], now: Now) -> None:
        # A tick that comes a little early must not postpone the reading to the next one.
        due = self._read_at + period - 0.5 * self.tick_period
        if self._job is None and self._reading is None and now.steady >= due:
            self._read_at = now.steady
            self._jobs += 1
            self._reading = self._jobs
            self._effects.append(RunJob(Job(self._jobs, "read", run)))

    def _abandon(self) -> None:
        """Request that the job under way ends after its current step."""
        if self._job is not None:
            self._effects.append(AbandonJob(self._job))

    def _supersede_job(self) -> None:
        """Abandon the job under way, so that its end does not change the state."""
        self._abandon()
        self._job = None

    def _shown_error(self, now: Now) -> CodedError:
        """Return the error for the published state: the device's own, or why nothing begins."""
        # The error of a refused tap may name an earlier conflict.
        own = self._error[0] not in (ErrorCode.NONE, ErrorCode.CONFIGURATION_CONFLICT)
        return self._error if own or self._conflict is None else self._conflict

    def _set_error(self, code: int, sentence: str) -> None:
        """Set a fault or refusal as the error in the published state, and log it once."""
        if sentence and self._error[1] != sentence:
            self._log(LogLevel.ERROR, sentence)
        self._error = (code, sentence)

    def _log(self, level: LogLevel, sentence: str) -> None:
        self._effects.append(Log(level, sentence))

    def _failure(self, service: str, sentence: str) -> Message:
        """Return the answer to a request of a service whose handler raised."""
        return Trigger.Response(success=False, message=sentence)

    def _answer(self, token: Token, success: bool, sentence: str) -> None:
        self._effects.append(Answer(token, Trigger.Response(success=success, message=sentence)))
        self._resets.discard(token)

    def _drain(self, now: Now) -> Sequence[Effect]:
        """Return the collected effects, and the state message if the state changed."""
        stopped = self.state is self.stopped_state
        if stopped and not self._was_stopped:
            self._last_stop = to_stamp(now.ros)
        self._was_stopped = stopped
        content = self._urgent_content(now)
        if content != self._published:
            self._published = content
            self._effects.append(self._report(now))
        self._handed_out = self._jobs
        effects, self._effects = self._effects, []
        return effects

    @abstractmethod
    def _urgent_content(self, now: Now) -> tuple[object, ...]:
        """Return the part of the state message whose changes are published immediately."""

    # Stops

    def _keep_stops(self, now: Now) -> None:
        """Store and publish the latched stops."""
        self._effects.append(KeepStop(self._stops.content()))
        self._publish_stops(now)

    def _publish_stops(self, now: Now) -> None:
        message = StopState(
            stopped=self._stops.stopped,
            sources=list(self._stops.sources),
            error_msg=self._stops.advice(),
        )
        message.header.stamp = to_stamp(now.ros)
        self._effects.append(Publish("~/stop_state", message))

    def _clear(self, token: Token, now: Now) -> None:
        if not self._configured and self._clears_at_next_attempt():
            self._answer(token, True, "clearing has started; the node's state reports its result")
        elif not self._configured:
            self._answer(token, False, self._error[1])
        elif self._stops.stopped:
            self._resets.add(token)
            self._effects.append(AskStops(("reset", token, self._stops.begin_reset(now))))
        elif self._healthy():
            self._answer(token, True, "there is no fault to clear")
        else:
            self._clear_granted(token, now)

    def _levels_received(
        self, token: Token, reset: stops.ResetRequest, levels: StopLevels | None, now: Now
    ) -> None:
        if token not in self._resets:
            return  # answered after an internal error
        if not self._configured or not self._stops.stopped:
            self._answer(token, False, "the node's state changed meanwhile; call the service again")
            return
        refusal = self._stops.try_reset(reset, levels, now)
        if refusal:
            self._log(LogLevel.WARNING, refusal)
            self._answer(token, False, refusal)
            return
        self._keep_stops(now)
        self._clear_granted(token, now)

    def _clear_granted(self, token: Token, now: Now) -> None:
        self._begin_clear(now)
        self._answer(token, True, "clearing has started; the node's state reports its result")
