"""What the machines of the two serial devices share: jobs, stops, faults, life cycle."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any, Generic, TypeVar

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.logic import stops
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import (
    AbandonJob,
    Answer,
    AskStops,
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
    Unreachable,
)
from tapping_cell.logic.tap_commands import Trouble
from tapping_cell.logic.transitions import StateMachine
from tapping_cell.messages import ErrorCode, StopState, Trigger

FIRST_PATIENCE_S = 1.0
"""First wait for a port, and for whoever is there to answer."""
LONGEST_PATIENCE_S = 6.0
"""Opening a port restarts many boards, and some take seconds: each further try of a port that is
there but mute waits longer, up to this."""
MUTE = (FaultReason.UNKNOWN_FIRMWARE, FaultReason.TIMEOUT, FaultReason.NEEDS_PERSON)
LOST = (FaultReason.DISCONNECTED, FaultReason.PORT_MISSING, FaultReason.PORT_BUSY)
CONTINUE = (ErrorCode.NONE, "")

State = TypeVar("State", bound=Enum)
Event = TypeVar("Event", bound=Enum)


def patience_after(patience: float, fault: HardwareFault | None) -> float:
    """How long the next ``connect`` may wait, after one with this patience."""
    if fault is not None and fault.reason in MUTE:
        return min(2 * patience, LONGEST_PATIENCE_S)
    return FIRST_PATIENCE_S


class DeviceLogic(ABC, Generic[State, Event]):
    """The common half of a device's machine.

    One job at a time does what was commanded; an idle read may run besides, and what it tells
    counts only while no other job was begun since. A job that a stop, a fault or a new life of the
    line overtook ends without changing the state.
    """

    stop_trouble: Trouble

    def __init__(self, machine: StateMachine[State, Event], tick_period: float) -> None:
        self.tick_period = tick_period
        self.patience = FIRST_PATIENCE_S
        self._machine = machine
        self._stops = stops.StopLatch()
        self._active = False
        self._configured = False
        self._trouble: Trouble = CONTINUE
        self._effects: list[Effect] = []
        self._jobs = 0
        self._job: int | None = None
        self._job_name = ""
        self._reading: int | None = None
        self._read_at = -1.0
        self._published: Message | None = None

    # What a host and a person may read

    @property
    def state(self) -> State:
        """The machine's state."""
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
    def trouble(self) -> Trouble:
        """Error code and sentence; (0, "") while all is well."""
        return self._trouble

    # What a device gives

    @abstractmethod
    def _handle_message(self, topic: str, message: Message, now: Now) -> None: ...

    @abstractmethod
    def _handle_request(self, service: str, request: Message, token: Token, now: Now) -> None: ...

    @abstractmethod
    def _handle_answer(self, token: Token, response: Message | None, now: Now) -> None: ...

    @abstractmethod
    def _job_told(self, name: str, content: Any, now: Now) -> None: ...

    @abstractmethod
    def _job_done(self, name: str, result: Any, now: Now) -> None: ...

    @abstractmethod
    def _job_failed(self, name: str, fault: HardwareFault, now: Now) -> None: ...

    @abstractmethod
    def _read_done(self, result: Any, now: Now) -> None: ...

    @abstractmethod
    def _overtaken(self, event: JobEnded, now: Now) -> None:
        """A job ended that something else overtook: keep what stays true of it."""

    @abstractmethod
    def _configured_with(self, event: Configured, now: Now) -> None:
        """Take the cell, before anything else."""

    @abstractmethod
    def _closed(self) -> None:
        """The port was closed: nothing is known any more but a stop."""

    @abstractmethod
    def _code_of(self, fault: HardwareFault) -> int:
        """The code of a fault of this device."""

    @abstractmethod
    def _connected(self, answer: Any, now: Now) -> None:
        """The port is open: take up the state of the device."""

    @abstractmethod
    def _activated(self, now: Now) -> None: ...

    @abstractmethod
    def _deactivated(self, now: Now) -> None: ...

    @abstractmethod
    def _stop(self, now: Now) -> None:
        """Go to the stopped state, from any state."""

    @abstractmethod
    def _fail(self, now: Now) -> None:
        """Go to the faulted state, from any state."""

    @abstractmethod
    def _begin_clear(self, now: Now) -> None:
        """Run the job that ends a stop or a fault."""

    @abstractmethod
    def _healthy(self) -> bool:
        """Whether there is nothing to clear."""

    @abstractmethod
    def _time_passed(self, now: Now) -> None: ...

    @abstractmethod
    def _report(self, now: Now) -> Publish:
        """The state's message."""

    # The contract

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """The node's life cycle."""
        if isinstance(event, Configured):
            self._configured = True
            self._configured_with(event, now)
            self._stops.recall(event.kept_stop)
            if self._stops.stopped:
                self._effects.append(StopWire())
                self._stop(now)
            else:
                self._connected(event.connected, now)
            self._publish_stops(now)
        elif isinstance(event, Unreachable):
            self.patience = patience_after(self.patience, event.fault)
            if not self._stops.stopped:
                self._trouble = (self._code_of(event.fault), event.fault.sentence)
        elif isinstance(event, Activated):
            self._active = True
            if not self._stops.stopped:
                self._activated(now)
        elif isinstance(event, Deactivated):
            self._active = False
            self._deactivated(now)
        else:
            self._active = self._configured = False
            self._overtake()
            self._reading = None
            self._closed()
        return self._drain(now)

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """A message."""
        if topic == stops.TOPIC:
            new = not self._stops.stopped and message.data
            if new:
                # Nothing goes before the stop on the wire.
                self._effects.append(StopWire())
            if self._stops.hear(bool(message.data)):
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
        """A service request."""
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
        """An answer."""
        if isinstance(token, tuple) and token[0] == "reset":
            self._levels_told(token[1], response, now)
        else:
            self._handle_answer(token, response, now)
        return self._drain(now)

    def on_job(self, event: JobProgress | JobEnded, now: Now) -> Sequence[Effect]:
        """A job."""
        if isinstance(event, JobProgress):
            if event.job == self._job:
                self._job_told(self._job_name, event.content, now)
        elif event.job == self._reading:
            self._reading = None
            if self._job is None and not self._stops.stopped:
                self._end(event, "read", now)
        elif event.job == self._job:
            self._job = None
            self._end(event, self._job_name, now)
        else:
            self._overtaken(event, now)
        return self._drain(now)

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Time has passed."""
        if self._configured:
            self._time_passed(now)
        self._published = None
        return self._drain(now)

    def on_defect(self, error: Exception, now: Now) -> Sequence[Effect]:
        """A handler raised."""
        self._effects.clear()
        self._effects.append(StopWire())
        self._defect(error, now)
        return self._drain(now)

    # For the devices

    def _end(self, event: JobEnded, name: str, now: Now) -> None:
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

    def _defect(self, error: Exception, now: Now) -> None:
        self._abandon()
        self._job = None
        self._fail(now)
        self._say(
            ErrorCode.INTERNAL,
            f"a defect of this program ({error!r}): please report it with the log, then start the"
            " node again",
        )

    def _run(self, name: str, run: Callable[[JobContext], object]) -> None:
        """Begin the one job."""
        self._abandon()
        self._jobs += 1
        self._job, self._job_name = self._jobs, name
        self._effects.append(RunJob(Job(self._jobs, name, run)))

    def _read_when_due(self, period: float, run: Callable[[JobContext], object], now: Now) -> None:
        if self._job is None and self._reading is None and now.steady >= self._read_at + period:
            self._read_at = now.steady
            self._jobs += 1
            self._reading = self._jobs
            self._effects.append(RunJob(Job(self._jobs, "read", run)))

    def _abandon(self) -> None:
        """Have the job under way end between two of its steps."""
        if self._job is not None:
            self._effects.append(AbandonJob(self._job))

    def _overtake(self) -> None:
        """Abandon the job under way, whose end will not change the state any more."""
        self._abandon()
        self._job = None

    def _say(self, code: int, sentence: str) -> None:
        """Keep a fault or refusal in the state, and log it once."""
        if sentence and self._trouble[1] != sentence:
            self._log(LogLevel.ERROR, sentence)
        self._trouble = (code, sentence)

    def _log(self, level: LogLevel, sentence: str) -> None:
        self._effects.append(Log(level, sentence))

    def _answer(self, token: Token, success: bool, sentence: str) -> None:
        self._effects.append(Answer(token, Trigger.Response(success=success, message=sentence)))

    def _drain(self, now: Now) -> Sequence[Effect]:
        """The effects so far, and the state where it changed."""
        report = self._report(now)
        if self._comparable(report.message) != self._published:
            self._published = self._comparable(report.message)
            self._effects.append(report)
        effects, self._effects = self._effects, []
        return effects

    @abstractmethod
    def _comparable(self, message: Message) -> Message:
        """The part of the state's message whose change is published at once."""

    # Stops

    def _keep_stops(self, now: Now) -> None:
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
        if not self._configured:
            self._answer(token, False, self._trouble[1])
        elif self._stops.stopped:
            self._stops.begin_reset()
            self._effects.append(AskStops(("reset", token)))
        elif self._healthy():
            self._answer(token, True, "there is no fault to clear")
        else:
            self._clear_granted(token, now)

    def _levels_told(self, token: Token, levels: StopLevels | None, now: Now) -> None:
        if not self._configured or not self._stops.stopped:
            self._answer(token, False, "the node's state changed meanwhile; call it again")
            return
        refusal = self._stops.try_reset(levels, now)
        if refusal:
            self._log(LogLevel.WARNING, refusal)
            self._answer(token, False, refusal)
            return
        self._effects.append(KeepStop(None))
        self._publish_stops(now)
        self._clear_granted(token, now)

    def _clear_granted(self, token: Token, now: Now) -> None:
        self._begin_clear(now)
        self._answer(token, True, "clearing; the node's state tells the result")
