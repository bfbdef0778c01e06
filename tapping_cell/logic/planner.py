"""State machine of the planner: accepts a goal and commands taps until the object is at this goal.

The cycle of one tap is in ``tap_cycle``, the data of each state in ``planner_states``. This module
receives events, and begins and ends goals. Every wait has a deadline and every goal a time limit.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

from tapping_cell.logic import goal_requests, tap_counts, tap_cycle, tap_decision, tap_steps
from tapping_cell.logic.cell_monitor import CodedError
from tapping_cell.logic.clock import NANOSECONDS, Now, to_nanoseconds
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.effects import (
    Answer,
    Effect,
    JobEnded,
    JobProgress,
    KeepGoal,
    Log,
    LogLevel,
    Message,
    Publish,
    RunJob,
    Token,
    TouchGoal,
)
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.goal_requests import failure, internal_error
from tapping_cell.logic.goal_validation import Refused
from tapping_cell.logic.host import (
    Activated,
    Configured,
    Deactivated,
    LifecycleEvent,
    LostEvent,
    UnansweredRequest,
)
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S
from tapping_cell.logic.planner_inputs import PlannerInputs
from tapping_cell.logic.planner_reports import PlanReports, Subject, no_arrangement
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.planner_states import (
    TABLE,
    Confirming,
    End,
    Event,
    Firing,
    Placing,
    Planning,
    Record,
    Resting,
    State,
    WaitingForCell,
    Working,
    failed,
    shot_of,
)
from tapping_cell.logic.resumption import KeptGoal, Resumption
from tapping_cell.logic.tap_sender import TapSender
from tapping_cell.logic.task import Task
from tapping_cell.logic.transitions import Go, check
from tapping_cell.messages import (
    ArrangeObjects,
    ConfirmTap,
    ErrorCode,
    PlanState,
    PositionObject,
    SetBool,
    SingleTap,
    TapCommand,
    Trigger,
)

TICK_S = 0.1
EMERGENCY_STOP = (
    ErrorCode.EMERGENCY_STOP,
    "emergency stop: make the cell safe, clear the faults, then send the goal again",
)
REPORT_PERIOD_S = 0.5
"""Time between two reports while nothing changes. While a tap is under way, the planner reports at
every tick, because the tapper discharges the striker if these reports end."""


class PlannerLogic:
    """See the module's docstring."""

    tick_period = TICK_S

    goals: GoalHandling
    """Goal handling of the present configuration (``connected`` of the event ``Configured``)."""

    def __init__(self, settings: PlannerSettings) -> None:
        self._settings = settings
        self._record: Record = Resting()
        self._inputs = PlannerInputs(settings.silence_limit)
        self._monitor = self._inputs.monitor
        self._sender = TapSender(self._monitor)
        self._confirmations = Confirmations(settings.ask)
        self._reports = PlanReports(self._monitor, self._confirmations)
        self._resumption = Resumption(settings.resume_within, self._monitor, self._confirmations)
        self._parts: tap_steps.PlannerParts | None = None
        """The parts that the cycle of a tap uses; None before the planner is configured."""
        self._jobs = itertools.count(1)
        self._active = False
        self._commanded = 0
        """Id of the last tap whose command the host has received."""
        self._effects: list[Effect] = []

    @property
    def state(self) -> State:
        """Present state."""
        return self._record.state

    @property
    def last(self) -> PlanState:
        """Last published report."""
        return self._reports.last

    @property
    def _task(self) -> Task | None:
        return self._record.task if isinstance(self._record, Working) else None

    # Handlers of the protocol ``Logic``

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """Handle a lifecycle event of the node."""
        if isinstance(event, Configured):
            self._configure(event, now)
        elif isinstance(event, Activated):
            self._active = True
            # A planner that crashed may have left an arrangement as active.
            self._effects.append(Publish("arrangement_state", no_arrangement(now)))
            self._report_again(now)
        else:
            # The node is deactivated or shut down. The remaining lifecycle event, Unreachable, does
            # not occur, because the planner has no device.
            self._active = False
            self._resumption.take()
            self._end(failed(ErrorCode.NOT_ACTIVE, "the planner was deactivated"), now)
            if not isinstance(event, Deactivated):
                # After an orderly shutdown, the goal is not resumed.
                self._effects.append(KeepGoal(None))
        return self._drain()

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """Handle a message."""
        if topic == "goal_pose":
            self._on_goal(Request(message), None, now)
            return self._drain()
        stop = self._inputs.receive(topic, message, now)
        shot = shot_of(self._record)
        if shot is not None and topic == "arm_state":
            tap_counts.note_position(shot, self._monitor)
        elif shot is not None and topic == "tapper_state":
            tap_counts.note_outcome(shot, self._monitor, self._confirmations, now)
        elif topic == "emergency_stop" and message.data:
            self._resumption.note_stop(EMERGENCY_STOP)
            self._end(failed(*EMERGENCY_STOP), now)
        # A stop or a fault ends the goal in every state, so that a person who clears it does not
        # start a motion. It may have been cleared already if this process was suspended.
        stop = self._monitor.fault() or stop
        self._resumption.note_stop(stop)
        if stop is not None:
            self._end(failed(*stop), now)
        self._advance(now)
        return self._drain()

    def on_request(
        self, service: str, request: Message, token: Token, now: Now
    ) -> Sequence[Effect]:
        """Handle an action goal, its cancellation, the service that ends the present goal, the
        answer to a proposed tap, or a change of the parameter ``ask`` (whether a person confirms
        every tap)."""
        if service == "cancel":
            if self._task is not None and self._task.token == token:
                self._cancel(now)
        elif service == "~/cancel":
            self._effects.append(Answer(token, self._cancel_any(now)))
        elif service == "confirm_tap":
            self._effects.append(Answer(token, self._on_confirmation(request, now)))
        elif service == "ask":
            self._change_ask(request.data, now)
            self._effects.append(Answer(token, SetBool.Response(success=True)))
        elif isinstance(request, PositionObject.Goal):
            self._on_goal(goal_requests.to_request(request, token), token, now)
        else:
            self._on_goal(request, token, now)
        return self._drain()

    def on_answer(self, token: Token, response: Message | None, now: Now) -> Sequence[Effect]:
        """Do nothing: the planner calls no service."""
        return ()

    def on_conflict(self, sentence: str, now: Now) -> Sequence[Effect]:
        """Handle the beginning, a change or the end of a conflict between nodes: during a conflict,
        the cell is not ready."""
        self._monitor.conflict = sentence
        if sentence:
            self._log(LogLevel.ERROR, sentence)
        return self._drain()

    def on_job(self, event: JobProgress | JobEnded, now: Now) -> Sequence[Effect]:
        """Act on the decision that a job has computed."""
        at, seen = self._record, self._monitor.object
        is_awaited = isinstance(at, Planning) and at.job == event.job
        if not is_awaited or seen is None or not isinstance(event, JobEnded):
            return ()  # the decision is no longer awaited, for example because the goal has ended
        if event.fault is not None:
            raise event.fault
        assert isinstance(at, Planning) and self._parts is not None
        self._carry_out(tap_cycle.decided(at, event.result, seen, self._parts, now), now)
        return self._drain()

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Check the deadlines and publish the periodic report."""
        self._advance(now)
        if self._active:
            self._effects.extend(self._sender.repeat_withdrawal(now))
            is_new = self._shown_error()[0] != self.last.error_code
            is_due = is_new or self._reports.quiet_for(now) > REPORT_PERIOD_S
            if is_due or isinstance(self._record, Placing | Firing):
                if self._task is not None:
                    self._effects.append(TouchGoal())
                self._report_again(now, draw=is_due)
        return self._drain()

    def on_defect(
        self, error: Exception, now: Now, lost: LostEvent | None = None
    ) -> Sequence[Effect]:
        """End the tap and the goal after a handler has raised ``error``."""
        # What the handler has already decided still takes effect, for example a withdrawal or an
        # answer, because it is not repeated. Only nothing new begins.
        self._effects = [effect for effect in self._effects if not _begins(effect)]
        if isinstance(lost, Activated | Deactivated):
            self._active = isinstance(lost, Activated)
        sentence, task, shot = internal_error(error), self._task, shot_of(self._record)
        if task is not None and shot is not None and shot.tap_id != self._commanded:
            self._record = WaitingForCell(task=task)  # the tap's command was not published
        if task is not None:
            self._end(failed(ErrorCode.INTERNAL, sentence), now)
        else:
            # The handler may have ended a goal that is still stored, or it was cancelling the goal
            # of a planner that crashed.
            self._resumption.take()
            self._effects.append(KeepGoal(None))
            if self._parts is not None:
                self._report_again(now)
        if isinstance(lost, UnansweredRequest):
            answered = [effect.token for effect in self._effects if isinstance(effect, Answer)]
            if lost.token not in answered:
                response = failure(type(lost.request), ErrorCode.INTERNAL, sentence)
                self._effects.append(Answer(lost.token, response))
        return self._drain()

    # The beginning of a goal

    def _configure(self, event: Configured, now: Now) -> None:
        assert isinstance(event.connected, GoalHandling)
        self.goals = event.connected
        self._inputs.configure(self.goals)
        self._parts = tap_steps.PlannerParts(
            self._settings,
            self._monitor,
            self.goals,
            self._sender,
            self._confirmations,
            self._resumption,
            self._jobs,
        )
        if event.kept_goal is not None:
            self._effects.extend(self._resumption.load(event.kept_goal, event.kept_goal_age, now))

    def _on_goal(
        self,
        asked: Request | SingleTap.Goal | ArrangeObjects.Goal,
        token: Token | None,
        now: Now,
    ) -> None:
        """Begin the task of a request, or refuse the request."""
        refused: Refused | None = goal_requests.NOT_ACTIVE
        if self._active:
            refused = goal_requests.refusal(asked, self._task, self._monitor)
        task = self._accept(asked, token, now, refused)
        if task is not None:
            self._begin(task, now)
            if isinstance(asked, Request):
                task.sent = to_nanoseconds(asked.message.header.stamp) or task.sent

    def _accept(
        self,
        asked: Request | SingleTap.Goal | ArrangeObjects.Goal,
        token: Token | None,
        now: Now,
        refused: Refused | None = None,
    ) -> Task | None:
        """Return the task for a request; refuse the request if it is not possible or already
        ``refused``."""
        task: Task | Refused | None = refused
        if task is None:
            task, defect = goal_requests.accept(
                asked, token, self.goals, self._task, self._monitor, now
            )
            if defect:
                self._log(LogLevel.ERROR, defect)
        if isinstance(task, Task):
            return task
        self._effects.extend(goal_requests.refuse(task, asked, token, now))
        if token is None:
            self._report(now, task.code, task.sentence)
        return None

    def _begin(self, task: Task, now: Now) -> None:
        replaced = "a newer goal replaced this one"
        self._end(End(State.CANCELED, ErrorCode.GOAL_REPLACED, replaced), now)
        self._resumption.take()  # a goal that arrives before the resumption is newer
        self._confirmations.begin(task.is_resumed)
        self._monitor.watch(task.object_id)
        self._effects.extend(self._resumption.keep(task, now, is_tapping=False))
        task.sent = now.ros - round(SKEW_LIMIT_S * NANOSECONDS)
        self._log(LogLevel.INFO, task.description())
        deadline = now.steady + self._settings.ready_deadline
        self._go(Go(Event.GOAL_ACCEPTED, WaitingForCell(task=task, deadline=deadline)), now)

    def _resume(self, kept: KeptGoal, now: Now) -> None:
        """Resume the goal of a planner that crashed. If a stop or a fault has been reported since
        the start of this planner, end the goal, as the planner that crashed would have done."""
        outdated = self._resumption.expiry_message(kept, now)
        if outdated:
            self._log(LogLevel.WARNING, outdated)
            return
        task = self._accept(kept.remaining(now), None, now)
        if task is None:
            return
        task.is_resumed, task.earlier_taps = True, kept.request.earlier_taps
        self._resumption.note_earlier_stops(kept)
        self._log(LogLevel.WARNING, "resuming the goal of a planner that crashed")
        self._begin(task, now)
        self._effects.extend(self._sender.withdraw_orphan(now))
        if self._resumption.stop is not None:
            self._end(failed(*self._resumption.stop), now)

    # The goal under way

    def _advance(self, now: Now) -> None:
        """Do what follows from the messages received so far and the time."""
        if not self._active:
            return
        kept = self._resumption.take()
        if kept is not None:
            self._resume(kept, now)
        at = self._record
        if isinstance(at, Working) and self._parts is not None:
            self._carry_out(tap_cycle.advance(at, self._parts, now), now)

    def _carry_out(self, steps: Iterable[Effect | Go[Event, Working] | End], now: Now) -> None:
        """Carry out the steps of the cycle."""
        for step in steps:
            if isinstance(step, Go):
                self._go(step, now)
            elif isinstance(step, End):
                self._end(step, now)
            else:
                self._effects.append(step)

    def _go(self, step: Go[Event, Working], now: Now) -> None:
        """Go to another state and report it."""
        if step.event is not None:
            check(TABLE, self.state, step.event, step.record.state)
        self._record = step.record
        if step.event is not None:
            self._report(now)

    def _on_confirmation(self, asked: ConfirmTap.Request, now: Now) -> ConfirmTap.Response:
        """Handle a person's answer. The answer is valid only for the tap that is proposed now."""
        if self._task is not None:
            self._advance(now)  # first handle received messages and expired deadlines
        at = self._record
        if not isinstance(at, Confirming) or at.proposed.tap_id != asked.tap_id:
            return tap_decision.not_awaited(asked.tap_id, at)
        assert self._parts is not None
        response, steps = tap_decision.answered(at, asked.confirm, self._parts, now)
        self._carry_out(steps, now)
        return response

    def _change_ask(self, ask: bool, now: Now) -> None:
        """Set whether a person confirms the taps that are planned from now on. A tap that was
        already proposed still waits for its answer."""
        self._confirmations.change(ask)
        if self._task is not None:
            is_tapping = shot_of(self._record) is not None
            self._effects.extend(self._resumption.keep(self._task, now, is_tapping=is_tapping))
        if self._active:
            self._report_again(now)

    # The end of a goal

    def _cancel(self, now: Now) -> None:
        self._end(End(State.CANCELED, ErrorCode.GOAL_CANCELED, "the goal was canceled"), now)

    def _cancel_any(self, now: Now) -> Trigger.Response:
        """End the present goal, whoever sent it. The goal of a planner that crashed has no action
        client; it may be under way, or not resumed yet."""
        crashed = self._resumption.take()
        if self._task is not None:
            self._cancel(now)
        else:
            # Before the node is configured, the stored goal is still on disk.
            self._effects.append(KeepGoal(None))
            if self._parts is not None and crashed is None:
                return Trigger.Response(success=False, message="there is no goal to cancel")
        return Trigger.Response(success=True, message="goal canceled")

    def _end(self, how: End, now: Now) -> None:
        """End the tap and the goal, if any; if it is an action goal, send its result."""
        at = self._record
        if not isinstance(at, Working):
            return
        task, shot = at.task, shot_of(at)
        self._effects.extend(tap_steps.end_tap(at, self._sender, now))
        check(TABLE, at.state, how.event, how.state)
        self._confirmations.forget()
        self._monitor.watch(task.object_id)  # the result contains the pose of this object
        if shot is not None:
            task.record_unobserved(shot)
        task.end(how.code, how.sentence)
        subject = Subject(how.state, task, shot)
        self._effects.extend(self._make_report(subject, now, how.code, how.sentence))
        if task.token is not None:
            result = task.result(how.code, how.sentence, self.last, self._monitor.object)
            self._effects.append(Answer(task.token, result))
        self._record = Resting(how.state)
        self._monitor.watch("")
        self._effects.extend(self._sender.park(now))
        self._effects.append(KeepGoal(None))
        if how.code:
            self._log(LogLevel.ERROR, f"goal ended ({how.code}): {how.sentence}")
        else:
            self._log(LogLevel.INFO, f"goal done after {task.taps} taps")
        self.goals.learn(task)
        try:
            self.goals.keep_learnt(task)
        except OSError as error:
            self._log(LogLevel.WARNING, f"the learnt gains of the object were not saved: {error}")

    # Reports

    def _report(
        self, now: Now, code: int = ErrorCode.NONE, sentence: str = "", draw: bool = True
    ) -> None:
        """Publish the state with its error code and message; ``draw``: also publish the markers."""
        at = self._record
        subject = Subject(at.state, self._task, shot_of(at))
        if isinstance(at, Confirming):
            subject = Subject(at.state, at.task, at.proposed, at.answer_by)
        self._effects.extend(self._make_report(subject, now, code, sentence, draw))

    def _report_again(self, now: Now, draw: bool = True) -> None:
        """Publish the state again."""
        self._report(now, *self._shown_error(), draw)

    def _shown_error(self) -> CodedError:
        """Return what the cell lacks while a goal waits for it, otherwise the last error."""
        at = self._record
        if isinstance(at, WaitingForCell) and at.missing is not None:
            return at.missing
        return self.last.error_code, self.last.error_msg

    def _make_report(
        self, subject: Subject, now: Now, code: int, sentence: str, draw: bool = True
    ) -> Iterable[Effect]:
        goals = None if self._parts is None else self.goals
        return self._reports.report(subject, goals, now, code, sentence, draw)

    def _log(self, level: LogLevel, sentence: str) -> None:
        self._effects.append(Log(level, sentence))

    def _drain(self) -> Sequence[Effect]:
        shot = shot_of(self._record)
        if shot is not None:
            self._commanded = shot.tap_id
        effects, self._effects = self._effects, []
        return effects


def _begins(effect: Effect) -> bool:
    """Return whether the effect begins a motion, a tap or a computation."""
    if isinstance(effect, Publish) and effect.topic == "tap_command":
        return bool(effect.message.request != TapCommand.WITHDRAW)
    return isinstance(effect, RunJob)
