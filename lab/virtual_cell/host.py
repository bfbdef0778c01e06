"""Process in virtual time; runs one state machine of ``logic`` as the machine's ROS node does.

A process can be killed at any event, and restarted with the files that it has stored. It can also
be frozen: messages received during the freeze are handled after the freeze.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from typing import Any

from lab.virtual_cell.network import Network
from lab.virtual_cell.planted_exception import PlantedError, PlantedException
from lab.virtual_cell.scheduler import Fiber, Scheduler, Timer
from lab.virtual_cell.serial_line import SerialLine
from tapping_cell.configuration.cell import Cell
from tapping_cell.hardware.faults import HardwareFault
from tapping_cell.logic.clock import Now
from tapping_cell.logic.device import DeviceLogic
from tapping_cell.logic.effects import (
    AbandonJob,
    Answer,
    AskStops,
    Call,
    Content,
    Effect,
    Feedback,
    Job,
    JobEnded,
    JobProgress,
    KeepGoal,
    KeepStop,
    Log,
    Publish,
    RunJob,
    StopLevels,
    StopWire,
    TouchGoal,
)
from tapping_cell.logic.host import (
    Activated,
    Configured,
    Deactivated,
    LifecycleEvent,
    Logic,
    LostEvent,
    ShutDown,
    UnansweredRequest,
    Unreachable,
)
from tapping_cell.messages import Bool

START_S = (0.4, 2.5)
"""Range of the time from the start of a process to its first attempt to configure."""
COMPUTING_S = (0.0, 0.5)
"""Range of the duration of a job that only computes."""
SHARE_OF_SLOW_COMPUTATIONS, SLOW_COMPUTING_S = 0.1, (0.5, 5.0)
"""Fraction of these jobs that take longer, and the range of their duration, s."""
RETRY_S = 1.0
"""Time between two attempts to configure."""
ANSWER_S = 1.0
"""Time within which every request of a service is answered, s."""
ACTIONS = frozenset({"position_object", "arrange_objects", "single_tap"})
"""Requests that are answered at the end of a goal."""


def copy_of(value: Any) -> Any:
    """Return a deep copy of a message."""
    kind: type = type(value)
    if kind is list:
        return [copy_of(item) for item in value] if value and _parts(type(value[0])) else value[:]
    parts = _parts(kind)
    if parts is None:
        return value
    made: Any = object.__new__(kind)
    plain, others = parts
    for name in plain:
        _set(made, name, getattr(value, name))
    for name in others:
        _set(made, name, copy_of(getattr(value, name)))
    return made


def _parts(kind: type) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Return the names of the fields of a message class in two groups: fields of plain types, and
    other fields. Return None for a class that is not a message."""
    if kind not in _PARTS:
        known = fields(kind) if is_dataclass(kind) else ()
        plain = tuple(item.name for item in known if item.type in _PLAIN)
        others = tuple(item.name for item in known if item.type not in _PLAIN)
        _PARTS[kind] = (plain, others) if is_dataclass(kind) else None
    return _PARTS[kind]


_set = object.__setattr__
"""Sets a field, even of a frozen dataclass."""
_PARTS: dict[type, tuple[tuple[str, ...], tuple[str, ...]] | None] = {}
_PLAIN = frozenset(("int", "float", "str", "bool", "bytes"))
"""Types of the fields that need no deep copy, as annotated in ``tapping_cell.messages``."""


@dataclass(slots=True)
class HostClock:
    """Steady clock and ROS clock of one computer. At t s from the start of the run, the computer's
    ROS time is ``epoch`` + (1 + ``drift``) t + ``offset``, in s."""

    scheduler: Scheduler
    offset: float = 0.0
    drift: float = 0.0
    steady_offset: float = 0.0
    epoch: float = 1_800_000_000.0

    def now(self) -> Now:
        """Return the time of both clocks, steady and ROS."""
        passed = self.scheduler.now
        ros = self.epoch + passed * (1.0 + self.drift) + self.offset
        return Now(passed + self.steady_offset, round(ros * 1e9))


class UnhandledDefectError(Exception):
    """A state machine raised while it handled an internal error; the ROS host would end."""


@dataclass(slots=True)
class Disk:
    """Data that a process has stored on disk and that remain when the process ends."""

    goal: Content | None = None
    goal_touched: int = 0
    """Computer's time of the last change or touch of the stored goal, ns."""
    stop: Content | None = None
    full: bool = False


@dataclass(slots=True)
class Program:
    """Program of a process: a state machine, optionally with a driver on serial lines.

    ``connect(driver, patience, now)`` configures the node. ``topics`` are the topics that the
    program subscribes to, ``services`` the services that the program offers.
    """

    make: Callable[[], tuple[Logic, Any]]
    connect: Callable[[Any, float, Now], Any]
    cell: Cell
    topics: Sequence[str]
    services: Sequence[str]
    lines: tuple[SerialLine, ...] = ()


@dataclass(slots=True)
class PlannedFreeze:
    """A freeze of a process before a write of its driver."""

    writes: int
    """Number of writes before the freeze."""
    duration: float
    """Duration of the freeze, s."""
    job: str = ""
    """Name of the job whose writes are counted; empty: any job."""
    on_begin: Callable[[], None] = lambda: None
    """Called when the freeze begins."""


class Process:
    """A process that runs one program on one computer. Times are in s from the start of the run."""

    def __init__(
        self,
        name: str,
        program: Program,
        scheduler: Scheduler,
        network: Network,
        clock: HostClock,
        draw: Callable[[float, float], float],
    ) -> None:
        self.name = name
        self.disk = Disk()
        self.alive = False
        self.active = False
        self.frozen_until = 0.0
        self.freeze_before_write: PlannedFreeze | None = None
        self.freeze_after_check: float = 0.0
        """Duration of a freeze after the running job has next asked the state machine, s; 0: no
        freeze."""
        self.activation_delay: float = 0.0
        """Time from the next configuration of the node to its activation, s."""
        self.on_handled: Callable[[str, str, Any], None] = lambda process, topic, message: None
        """Called for every message after the state machine has handled it."""
        self.on_asked: Callable[[str, str, Any], None] = lambda process, job, answer: None
        """Called with process, job and answer whenever the state machine has answered its running
        job."""
        self.on_lifecycle: Callable[[str, bool], None] = lambda process, active: None
        """Called after the state machine has handled its activation (True) or deactivation."""
        self.on_requested: Callable[[str, str, Any], None] = lambda process, service, token: None
        """Called with process, service and token when the process receives a request, before the
        state machine handles it."""
        self.on_log: Callable[[str, str], None] = lambda process, sentence: None
        self.planted: PlantedException | None = None
        """Exception that one of the next handlers or jobs raises, if any."""
        self.on_planted: Callable[[str, str], None] = lambda process, place: None
        """Called with process and line of code when this exception was raised."""
        self.freezes = 0
        self.defects: list[str] = []
        self.logic: Any = None
        self._program = program
        self._scheduler = scheduler
        self._network = network
        self._clock = clock
        self._draw = draw
        self._driver: Any = None
        self._worker: Fiber | None = None
        self._jobs: deque[Job] = deque()
        self._running: Job | None = None
        self._abandoned: set[int] = set()
        self._inbox: deque[tuple[str, Callable[[], None]]] = deque()
        """Handlers of messages and requests received while the process was frozen, each with its
        topic (empty for other events)."""
        self._answers: dict[Any, Callable[[Any], None]] = {}
        self._handled: dict[Any, tuple[str, float]] = {}
        """Service of each request that has no answer yet, and the time at which the state machine
        handled the request."""
        self._tick: Timer | None = None
        self._life = 0
        self.started_at = math.inf
        """Time of the last start of the process, s."""
        self._connected = self._configured = False
        self._connecting = False
        """Whether the node tries to connect to its device and therefore handles no timer."""
        self._conflict = ""
        self._stop_publishers: set[str] = set()
        for line in program.lines:
            line.before_write = self._before_write

    # Life cycle of the process

    @property
    def lines(self) -> tuple[SerialLine, ...]:
        """Serial lines of the process's driver."""
        return self._program.lines

    @property
    def starts(self) -> int:
        """Sum of the number of starts and the number of kills of the process so far."""
        return self._life

    @property
    def configured(self) -> bool:
        """Whether the node has connected to its device, if it has one, since its start."""
        return self._configured

    @property
    def runs_since(self) -> float:
        """Time since which the process has run without a freeze, s; inf while it does not run."""
        if not self.alive or self._scheduler.now < self.frozen_until:
            return math.inf
        return max(self.started_at, self.frozen_until)

    def unanswered(self) -> list[str]:
        """Return the services of the requests that should have been answered by now."""
        if not self.alive:
            return []
        latest = self._scheduler.now - ANSWER_S
        return [
            service
            for service, handled in self._handled.values()
            if max(handled, self.frozen_until) < latest
        ]

    def start(self) -> None:
        """Start the process."""
        self._life += 1
        life = self._life
        self.planted = None
        self.alive, self.active, self.frozen_until = True, False, 0.0
        self._connected = self._configured = self._connecting = False
        self.logic, self._driver = self._program.make()
        if isinstance(self.logic, DeviceLogic):
            self.logic.recall_stop(self.disk.stop)
        self._jobs.clear()
        self._abandoned.clear()
        self._inbox.clear()
        self._answers.clear()
        self._handled.clear()
        self._running = None
        self._stop_publishers.clear()
        self._conflict = ""
        for topic in self._program.topics:
            self._network.subscribe(self.name, topic, self._deliver)
        for service in self._program.services:
            self._network.serve(self.name, service, self._serve(service))
        delay = self._draw(*START_S)
        self.started_at = self._scheduler.now + delay
        self._tick = self._scheduler.after(delay, lambda: self._on_tick(life))
        if not self._program.lines:
            self._scheduler.after(delay, lambda: self._configure(life))
            return
        worker = Fiber(self._scheduler, self.name, lambda: self._work(delay))
        self._worker = worker
        for line in self._program.lines:
            line.fiber = worker
        worker.start()

    def kill(self) -> None:
        """Kill the process as SIGKILL does: it publishes nothing more, and its port is closed."""
        self._end(killed=True)

    def _end(self, killed: bool) -> None:
        if not self.alive:
            return
        self._life += 1
        self.alive = self.active = False
        self._network.leave(self.name, killed)
        if self._tick is not None:
            self._tick.cancel()
        if self._worker is not None:
            self._worker.kill()
            self._worker = None
        for line in self._program.lines:
            line.close()
            line.release()
            line.fiber = None

    def freeze(self, duration: float) -> None:
        """Freeze the process as SIGSTOP does, until SIGCONT after ``duration`` s."""
        if not self.alive:
            return
        self.freezes += 1
        self.frozen_until = max(self.frozen_until, self._scheduler.now + duration)
        if self._worker is not None:
            self._worker.freeze(self.frozen_until)
        self._scheduler.at(self.frozen_until, self._thaw)

    def lifecycle(self, event: LifecycleEvent) -> None:
        """Activate or deactivate the node, as an external life cycle request does. A node that is
        not configured refuses both."""
        if not self.alive:
            return

        def handle() -> None:
            if not self._configured or isinstance(event, Activated) == self.active:
                return
            self.active = isinstance(event, Activated)
            self._handle(self.logic.on_lifecycle, event, received=event)
            self.on_lifecycle(self.name, self.active)

        self._when_awake(handle)

    def shut_down(self) -> None:
        """Shut the process down as SIGTERM does."""
        if self.alive:
            self._handle(self.logic.on_lifecycle, Deactivated())
            self._handle(self.logic.on_lifecycle, ShutDown())
        self._end(killed=False)

    def request(
        self,
        service: str,
        request: Any,
        token: Any,
        answer: Callable[[Any], None],
        waits: bool = True,
    ) -> None:
        """Send a service request, an action goal or its cancellation to the state machine.

        ``answer`` receives the response or result. ``waits`` is False for a cancellation, because a
        cancellation has no answer.
        """
        if waits:
            self._answers[token] = answer
        unanswered = UnansweredRequest(service, request, token) if waits else None

        def handle() -> None:
            self.on_requested(self.name, service, token)
            if waits and service not in ACTIONS:
                self._handled[token] = service, self._scheduler.now
            self._handle(self.logic.on_request, service, request, token, received=unanswered)

        self._when_awake(handle)

    # Received messages

    def _deliver(self, topic: str, message: Any) -> None:
        if not self.alive:
            return
        if self._scheduler.now >= self.frozen_until:
            self._take(topic, message)
            return
        self._inbox.append((topic, lambda: self._take(topic, message)))
        waiting = [place for place, (name, _) in enumerate(self._inbox) if name == topic]
        if len(waiting) > self._network.depth(topic):
            del self._inbox[waiting[0]]

    def _take(self, topic: str, message: Any) -> None:
        if topic == "emergency_stop" and isinstance(message, Bool) and message.data:
            self._stop_publishers |= self._present_publishers()
        self._note_conflict(self._network.conflict())
        stop = message if topic == "emergency_stop" else None
        self._handle(self.logic.on_message, topic, message, received=stop)
        self.on_handled(self.name, topic, message)

    def _note_conflict(self, conflict: str) -> None:
        """Notify the state machine of the beginning or the end of a conflict between nodes."""
        if conflict != self._conflict:
            self._conflict = conflict
            self._handle(self.logic.on_conflict, conflict)

    def _is_contested(self, service: str) -> bool:
        """Return whether a wrong or a second node works in the cell or offers the service."""
        self._note_conflict(self._network.conflict() or self._network.impostor(service))
        return bool(self._conflict)

    def _serve(self, service: str) -> Callable[[Any, Callable[[Any], None]], None]:
        def handle(request: Any, answer: Callable[[Any], None]) -> None:
            if self.alive:
                self.request(service, request, object(), answer)

        return handle

    def _when_awake(self, action: Callable[[], None], topic: str = "") -> None:
        if self._scheduler.now < self.frozen_until:
            self._inbox.append((topic, action))
        else:
            action()

    def _thaw(self) -> None:
        if not self.alive or self._scheduler.now < self.frozen_until:
            return
        waiting, self._inbox = self._inbox, deque()
        for topic, action in waiting:
            self._when_awake(action, topic)

    # The machine and its effects

    def _handle(
        self,
        call: Callable[..., Sequence[Effect]],
        *arguments: Any,
        received: LostEvent | None = None,
    ) -> None:
        """Call a handler of the state machine with these arguments and the time, and carry out the
        effects that it returns. ``received``: the event that the handler receives, if it must not
        be lost."""
        if not self.alive:
            return
        try:
            effects = self._call(call, *arguments, self._clock.now())
        except Exception as error:  # a defect: handle it as the ROS host does
            self._raised(error, self.name)
            try:
                effects = self.logic.on_defect(error, self._clock.now(), received)
            except Exception as second:
                raise UnhandledDefectError(f"{self.name}: {second!r} after {error!r}") from second
        self._carry_out(effects)

    def _call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Call a handler or a job, which may raise the planted exception."""
        planted = self.planted
        if planted is None:
            return call(*arguments)
        result = planted.run(call, *arguments)
        if planted.place:  # the state machine itself has caught the exception
            self._planted_raised(planted.place)
        return result

    def _planted_raised(self, place: str) -> None:
        self.planted = None
        self.on_planted(self.name, place)

    def _raised(self, error: Exception, where: str) -> None:
        """Process an exception of a handler or a job."""
        if isinstance(error, PlantedError):
            self._planted_raised(str(error))
        else:
            self.defects.append(f"{where}: {error!r}")

    def _carry_out(self, effects: Sequence[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Publish):
                self._network.publish(self.name, effect.topic, copy_of(effect.message))
            elif isinstance(effect, RunJob):
                self._queue(effect.job)
            elif isinstance(effect, AbandonJob):
                self._abandoned.add(effect.job)
            elif isinstance(effect, StopWire):
                # Before the port is open, the ROS host has no driver that could be stopped.
                if self._connected:
                    self._driver.stop()
            elif isinstance(effect, Log):
                self.on_log(self.name, effect.sentence)
            elif isinstance(effect, Answer):
                self._handled.pop(effect.token, None)
                answer = self._answers.pop(effect.token, None)
                if answer is None:
                    self.defects.append(f"{self.name} answered a request twice")
                else:
                    answer(effect.response)
            else:
                self._carry_out_other(effect)

    def _queue(self, job: Job) -> None:
        if self._worker is None:
            # The node has no device, so the job only computes.
            life = self._life
            slow = self._draw(0.0, 1.0) < SHARE_OF_SLOW_COMPUTATIONS
            duration = self._draw(*(SLOW_COMPUTING_S if slow else COMPUTING_S))
            self._scheduler.after(duration, lambda: self._compute(job, life))
            return
        self._jobs.append(job)
        if self._running is None:
            self._worker.wake()

    def _compute(self, job: Job, life: int) -> None:
        if life != self._life:
            return
        ended = self._run(job, None)
        self._when_awake(lambda: self._handle(self.logic.on_job, ended, received=ended))

    def _run(self, job: Job, worker: Fiber | None) -> JobEnded:
        try:
            return JobEnded(job.number, result=self._call(job.run, _Context(self, job, worker)))
        except HardwareFault as fault:
            return JobEnded(job.number, fault=fault)
        except Exception as defect:
            self._raised(defect, f"{self.name}, job {job.name}")
            return JobEnded(job.number, fault=defect)

    def _carry_out_other(self, effect: Effect) -> None:
        life = self._life
        if isinstance(effect, Call):
            token = effect.token

            def answered(response: Any | None) -> None:
                if life == self._life:
                    self._when_awake(partial(handle, response))

            def handle(response: Any | None) -> None:
                # The server may have been replaced since the request was sent.
                trusted = response is not None and not self._is_contested(effect.service)
                self._handle(self.logic.on_answer, token, response if trusted else None)

            if self._is_contested(effect.service):
                self._scheduler.after(0.0, lambda: answered(None))
                return
            self._network.call(effect.service, effect.request, answered, effect.timeout)
        elif isinstance(effect, AskStops):
            self._scheduler.after(0.3, lambda: self._report_stops(effect.token, life))
        elif isinstance(effect, KeepGoal):
            self.disk.goal = None if self.disk.full else effect.content
            self.disk.goal_touched = self._clock.now().ros
        elif isinstance(effect, TouchGoal):
            self.disk.goal_touched = self._clock.now().ros
        elif isinstance(effect, KeepStop):
            if effect.content is None:
                self._stop_publishers.clear()
            self.disk.stop = effect.content
        elif isinstance(effect, Feedback):
            pass

    def _report_stops(self, token: Any, life: int) -> None:
        if life != self._life:
            return
        levels = self._network.latched("emergency_stop").values()
        present, stopped = self._present_publishers(), self._stop_publishers
        several = len(present | stopped) > 1
        silent = self._network.volatile("emergency_stop") if several else frozenset()
        names = (tuple(sorted(group)) for group in (present, stopped - present, silent))
        answer = StopLevels(any(level.data for level in levels), *names)
        self._when_awake(lambda: self._handle(self.logic.on_answer, token, answer))

    def _present_publishers(self) -> set[str]:
        topic = "emergency_stop"
        return {*self._network.latched(topic), *self._network.volatile(topic)}

    # Start of the node, and timer events

    def _configure(self, life: int) -> None:
        """Configure a node that has no device. No waiting is necessary."""
        if life == self._life:
            self._finish_start(self._program.connect(None, 0.0, self._clock.now()), life)

    def _finish_start(self, connected: Any, life: int) -> None:
        if life != self._life:
            return
        self._connected = self._driver is not None
        age = 1e-9 * (self._clock.now().ros - self.disk.goal_touched)
        event = Configured(self._program.cell, connected, self.disk.goal, age)

        def handle() -> None:
            self._handle(self.logic.on_lifecycle, event)
            self._configured = True

        self._when_awake(handle)
        delay, self.activation_delay = self.activation_delay, 0.0
        if delay > 0:
            self._scheduler.after(delay, lambda: self._activate(life))
        else:
            self._activate(life)

    def _activate(self, life: int) -> None:
        if life == self._life:
            self.lifecycle(Activated())

    def _on_tick(self, life: int) -> None:
        if life != self._life:
            return
        if self._scheduler.now < self.frozen_until:
            self._tick = self._scheduler.at(self.frozen_until, lambda: self._on_tick(life))
            return
        self._note_conflict(self._network.conflict())
        if not self._connecting:
            self._handle(self.logic.on_tick)
        period = self.logic.tick_period
        self._tick = self._scheduler.after(period, lambda: self._on_tick(life))

    # The worker

    def _work(self, delay: float) -> None:
        worker = self._worker
        assert worker is not None
        worker.wait_until(self._scheduler.now + delay)
        while True:
            try:
                self._connecting = True
                patience = self.logic.patience
                self.logic.before_connect(self._driver)
                connected = self._program.connect(self._driver, patience, self._clock.now())
                self._connecting = False
                break
            except HardwareFault as fault:
                self._connecting = False
                self._report_unreachable(fault)
                worker.wait_until(self._scheduler.now + RETRY_S)
        self._finish_start(connected, self._life)
        while True:
            if not self._jobs:
                worker.wait_until(math.inf)
                continue
            job = self._running = self._jobs.popleft()
            ended = self._run(job, worker)
            self._running = None
            self._abandoned.discard(job.number)
            self._pause(worker)
            self._report_end(ended)

    def _report_unreachable(self, fault: HardwareFault) -> None:
        self._handle(self.logic.on_lifecycle, Unreachable(fault))
        self._handle(self.logic.on_lifecycle, ShutDown())  # as the ROS node does

    def _report_end(self, event: JobEnded) -> None:
        self._handle(self.logic.on_job, event, received=event)

    def _pause(self, worker: Fiber) -> None:
        """Let the worker wait while the process is frozen."""
        while self._scheduler.now < self.frozen_until:
            worker.wait_until(self.frozen_until)

    def _before_write(self) -> None:
        plan, worker = self.freeze_before_write, self._worker
        if plan is None or worker is None:
            return
        if plan.job and (self._running is None or self._running.name != plan.job):
            return
        if plan.writes > 0:
            plan.writes -= 1
            return
        self.freeze_before_write = None
        plan.on_begin()
        self.freeze(plan.duration)
        self._pause(worker)


@dataclass(slots=True)
class _Context:
    """Interface of the process to a running job (``JobContext``)."""

    process: Process
    job: Job
    worker: Fiber | None
    driver: Any = field(init=False)

    def __post_init__(self) -> None:
        self.driver = self.process._driver

    def now(self) -> Now:
        """Return the present time."""
        return self.process._clock.now()

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s."""
        assert self.worker is not None, "only a device's job waits"
        until = self.process._scheduler.now + duration
        while self.process._scheduler.now < until:
            self.worker.wait_until(until)

    def abandoned(self) -> bool:
        """Return whether the job was abandoned."""
        return self.job.number in self.process._abandoned

    def post(self, content: object) -> None:
        """Send a progress report to the state machine."""
        event = JobProgress(self.job.number, content)
        self.process._handle(self.process.logic.on_job, event)

    def ask(self, query: Callable[[Now], Any]) -> Any:
        """Query the state machine."""
        answer = query(self.process._clock.now())
        self.process.on_asked(self.process.name, self.job.name, answer)
        duration = self.process.freeze_after_check
        if duration > 0:
            self.process.freeze_after_check = 0.0
            self.process.freeze(duration)
            assert self.worker is not None
            self.process._pause(self.worker)
        return answer
