"""State machine of the planner: accepts a goal and commands taps until the object is at this goal.

The cycle of one tap is: observe the object at rest, decide on the tap, command it, wait until the
tapper reports the outcome, have the arm withdraw, and observe the object at rest again. If
confirmation is enabled, a person confirms each tap before it is commanded. Every wait has a
deadline and every goal a time limit. If the outcome of a tap is not known, the object is observed
again. No tap is fired twice.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from tapping_cell.logic import tap_commands
from tapping_cell.logic.arm_in_view import may_hide
from tapping_cell.logic.arrangement import ArrangementTask
from tapping_cell.logic.cell_monitor import CellMonitor, CodedError
from tapping_cell.logic.clock import NANOSECONDS, Now, to_nanoseconds, to_stamp
from tapping_cell.logic.confirmation import Confirmation
from tapping_cell.logic.effects import (
    Answer,
    Effect,
    Feedback,
    Job,
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
from tapping_cell.logic.goal_validation import REFUSALS, Refused
from tapping_cell.logic.goal_watch import FINAL_STATES
from tapping_cell.logic.host import (
    Activated,
    Configured,
    Deactivated,
    LifecycleEvent,
    LostEvent,
    UnansweredRequest,
)
from tapping_cell.logic.learnt import to_message as learnt_message
from tapping_cell.logic.peer_clock import SKEW_LIMIT_S
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.logic.task import MIN_EFFECT, Shot, SingleTapTask, Task
from tapping_cell.logic.transitions import StateMachine, table
from tapping_cell.messages import (
    ArmState,
    ArrangementState,
    ArrangeObjects,
    ConfirmTap,
    ErrorCode,
    GoalReport,
    LearntGains,
    ObjectState,
    PlanState,
    PoseStamped,
    PositionObject,
    SetBool,
    SingleTap,
    TapCommand,
    TapperState,
    Trigger,
)
from tapping_cell.planning import (
    Decision,
    Done,
    Gains,
    KeepOut,
    ObserveAgain,
    PlanningError,
    Refusal,
    RefusalReason,
    Strike,
)
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.se2 import Pose

TICK_S = 0.1
WITHDRAWN_BY_ANOTHER = (
    ErrorCode.NOT_READY,
    "another program ended the tap before it was fired; check which other nodes publish "
    "tap_command or tapper_state",
)
"""Error to report if a tap was not fired although the tapper reports no error."""
GIVEN_UP = (
    "no tap could be fired, because the object was moved each time before the tap, or because arm"
    " or tapper was restarted; see the log of tap_planner"
)
"""Error message for a goal whose taps were given up before they were fired."""
MOVED_BEFORE_TAP = "an object was moved before the tap; observing again"
EMERGENCY_STOP = (
    ErrorCode.EMERGENCY_STOP,
    "emergency stop: make the cell safe, clear the faults, then send the goal again",
)
HIDDEN_S = 0.7
"""Maximum time, s, for which the object may be unseen after the withdrawal. After this time, the
arm moves aside, because the arm may hide the object."""
PARKING_S = 0.5
"""Time within which an arm that was commanded to move aside reports that it moves."""
WITHDRAW_AGAIN_S = 1.0
"""Time after which a withdrawal is published again if the arm still serves the tap. A withdrawal
that the arm receives twice makes it move to its park pose, so this time is much longer than the
delay of a message."""
REPORT_PERIOD_S = 0.5
"""Time between two reports while nothing changes. While a tap is under way, the planner reports at
every tick, because the tapper discharges the striker if these reports end."""


class State(Enum):
    """States of the planner."""

    IDLE = "Idle"
    WAITING_FOR_CELL = "WaitingForCell"
    LOOKING = "Looking"
    PLANNING = "Planning"
    CONFIRMING = "Confirming"
    PLACING = "Placing"
    FIRING = "Firing"
    SETTLING = "Settling"
    REACHED = "Reached"
    FAILED = "Failed"
    CANCELED = "Canceled"


class Event(Enum):
    """Events of the planner."""

    GOAL_ACCEPTED = "goal accepted"
    CELL_READY = "cell ready"
    CELL_NOT_READY = "cell not ready"
    OBSERVED = "object observed at rest"
    TAP_PROPOSED = "tap proposed"
    TAP_DROPPED = "proposed tap dropped"
    TAP_COMMANDED = "tap commanded"
    IN_POSITION = "arm in position"
    OUTCOME_REPORTED = "tapper reported the outcome"
    GIVEN_UP = "tap given up"
    WITHDRAWN = "arm withdrawn"
    HIDDEN = "object hidden"
    OBSERVATION_REQUESTED = "longer observation requested"
    GOAL_MET = "goal met"
    GOAL_FAILED = "goal failed"
    GOAL_CANCELED = "goal canceled"


S = State
ENDED = (S.IDLE, S.REACHED, S.FAILED, S.CANCELED)
WORKING = (
    S.WAITING_FOR_CELL,
    S.LOOKING,
    S.PLANNING,
    S.CONFIRMING,
    S.PLACING,
    S.FIRING,
    S.SETTLING,
)
TAPPING = (S.PLACING, S.FIRING)
"""States in which the commanded tap may still be fired."""

TABLE = table(
    [
        (ENDED, Event.GOAL_ACCEPTED, (S.WAITING_FOR_CELL,)),
        ((S.WAITING_FOR_CELL,), Event.CELL_READY, (S.LOOKING,)),
        (
            (S.LOOKING, S.PLANNING, S.CONFIRMING, S.PLACING, S.SETTLING),
            Event.CELL_NOT_READY,
            (S.WAITING_FOR_CELL,),
        ),
        ((S.LOOKING,), Event.OBSERVED, (S.PLANNING,)),
        ((S.PLANNING,), Event.OBSERVATION_REQUESTED, (S.LOOKING,)),
        ((S.PLANNING,), Event.TAP_PROPOSED, (S.CONFIRMING,)),
        ((S.CONFIRMING,), Event.TAP_DROPPED, (S.LOOKING,)),
        # With a fixed tapper, no arm moves, so the planner goes to FIRING directly.
        ((S.PLANNING, S.CONFIRMING), Event.TAP_COMMANDED, (S.PLACING, S.FIRING)),
        ((S.PLACING,), Event.IN_POSITION, (S.FIRING,)),
        (TAPPING, Event.OUTCOME_REPORTED, (S.SETTLING,)),
        (TAPPING, Event.GIVEN_UP, (S.SETTLING,)),
        ((S.SETTLING,), Event.WITHDRAWN, (S.LOOKING,)),
        ((S.LOOKING,), Event.HIDDEN, (S.SETTLING,)),
        ((S.PLANNING,), Event.GOAL_MET, (S.REACHED, S.IDLE)),
        (WORKING, Event.GOAL_FAILED, (S.FAILED,)),
        (WORKING, Event.GOAL_CANCELED, (S.CANCELED,)),
    ]
)
WIRE = {state: getattr(PlanState, state.name) for state in State}
WORKING_STATES = tuple(WIRE[state] for state in WORKING)
"""Values of ``plan_state`` while a goal is under way."""
FINAL = tuple(state for state in State if WIRE[state] in FINAL_STATES)
LATE = frozenset(
    (
        ErrorCode.ARM_SILENT,
        ErrorCode.CAMERA_SILENT,
        ErrorCode.NOT_READY,
        ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
    )
)
"""The tapper's codes for a tap that was not fired because a message or image came too late."""
REMEMBERED = (
    "object_id",
    "planner",
    "goal",
    "position_tolerance",
    "angle_tolerance",
    "residual_distance",
    "residual_rotation",
    "taps",
    "last_tap",
)
"""Fields of the last goal that are still published after the goal has ended, for late
subscribers."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Content of the topic ``markers``. Poses are in ``table``."""

    state: PlanState
    pose: Pose | None
    goal: Pose | None
    strike: Strike | None
    path: tuple[Pose, ...]
    """Poses of the object before each tap of this goal."""
    others: tuple[KeepOut | None, ...]


class PlannerLogic:
    """See the module's docstring."""

    tick_period = TICK_S

    goals: GoalHandling
    """Goal handling of the present configuration (``connected`` of the event ``Configured``)."""

    def __init__(self, settings: PlannerSettings) -> None:
        self._settings = settings
        self._machine = StateMachine(TABLE, S.IDLE)
        self._monitor = CellMonitor(settings.silence_limit)
        self._active = self._configured = False
        self._has_arm = True
        self._task: Task | None = None
        self._shot: Shot | None = None
        self._proposed: Shot | None = None
        self._confirmed: Confirmation | None = None
        self._answer_by = 0
        self._ask = settings.ask
        self._ask_resumed = False
        """Whether the planner that crashed was to ask before every tap. This applies to the resumed
        goal until somebody changes ``ask``."""
        self._deadline = math.inf
        self._computation = 0
        self._observe_after = -math.inf
        self._struck_at = math.inf
        self._last_tap_id = 0
        self._commanded = 0
        """Id of the last tap whose command the host has received."""
        self._withdrawn_tap_id = 0
        self._withdrawn_at = -math.inf
        self._parked_tap_id = 0
        self._view_cleared = False
        self._parking_until = -math.inf
        self._reported_at = -math.inf
        self._lens: tuple[float, float, float] | None = None
        """Position of the camera's lens in ``table``, m."""
        self._resumed: Request | None = None
        """Goal of a planner that crashed, until it is resumed."""
        self._resume_until = -math.inf
        self._recalled_at = -math.inf
        """Time at which the goal of the planner that crashed was loaded."""
        self._recalled_stops: Mapping[str, Sequence[int]] = {}
        """Stops that the planner that crashed knew (see ``CellMonitor.known_stops``)."""
        self._is_resumed = False
        """Whether the present goal is that of a planner that crashed."""
        self._stop_reported: CodedError | None = None
        """A stop or fault that was reported since the start of this planner; None if none was."""
        self._effects: list[Effect] = []
        self._learnt: tuple[Gains | None, LearntGains] = (None, LearntGains())
        self.last = PlanState(residual_distance=math.nan, residual_rotation=math.nan)
        """Last published report."""
        self._handlers: Mapping[State, Callable[[Task, Now], None]] = {
            S.WAITING_FOR_CELL: self._wait_for_cell,
            S.LOOKING: self._observe,
            S.CONFIRMING: self._wait_for_person,
            S.PLACING: self._wait_for_arm,
            S.FIRING: self._wait_for_tapper,
            S.SETTLING: self._wait_for_withdrawal,
        }

    @property
    def state(self) -> State:
        """Present state."""
        return self._machine.state

    # Handlers of the protocol ``Logic``

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """Handle a lifecycle event of the node."""
        if isinstance(event, Configured):
            assert isinstance(event.connected, GoalHandling)
            self.goals = event.connected
            self._configured = True
            cell = self.goals.cell
            self._has_arm = cell.file.arm is not None
            self._monitor.expect(self._has_arm, cell.object.name)
            if event.kept_goal is not None:
                self._recall(event, now)
        elif isinstance(event, Activated):
            self._active = True
            # A planner that crashed may have left an arrangement as active.
            self._effects.append(Publish("arrangement_state", _no_arrangement(now)))
            self._report(now, self.last.error_code, self.last.error_msg)
        else:
            # The node is deactivated or shut down. The remaining lifecycle event, Unreachable, does
            # not occur, because the planner has no device.
            self._active = False
            self._resumed = None
            if self._task is not None:
                sentence = "the planner was deactivated"
                self._fail(ErrorCode.NOT_ACTIVE, sentence, now)
            if not isinstance(event, Deactivated):
                # After an orderly shutdown, the goal is not resumed.
                self._effects.append(KeepGoal(None))
        return self._drain()

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """Handle a message."""
        stop: CodedError | None = None
        if topic == "goal_pose":
            self._on_goal(Request(message), now)
        elif topic == "object_state":
            self._monitor.on_object(message, now)
        elif topic == "object_states":
            self._monitor.on_objects(message, now)
            if self._configured:
                clock = self._monitor.camera_clock
                self.goals.other_objects.on_objects(message, clock, now)
                for state in message.objects:
                    name = state.object_id
                    if not state.visible and self._may_be_covered(name, self._monitor.place(name)):
                        self._monitor.note_covered(name, now)
        elif topic == "other_objects":
            if self._configured:
                clock = self._monitor.camera_clock
                others, name = self.goals.other_objects, message.object_id
                covered = not message.visible and self._may_be_covered(name, others.place(name))
                others.on_object(message, clock, now, covered)
        elif topic == "camera/pose":
            place = message.pose.position
            self._lens = (place.x, place.y, place.z)
        elif topic == "arm_state":
            stop = self._monitor.on_arm(message, now)
            self._note_position()
        elif topic == "tapper_state":
            stop = self._monitor.on_tapper(message, now)
            self._note_outcome(now)
        elif topic == "emergency_stop" and message.data:
            self._stop_reported = EMERGENCY_STOP
            if self._task is not None:
                self._fail(*EMERGENCY_STOP, now)
        if topic != "goal_pose":
            # A stop or a fault ends the goal in every state, so that a person who clears it does
            # not start a motion. It may have been cleared already if this process was suspended.
            stop = self._monitor.fault() or stop
            self._stop_reported = self._stop_reported or stop
            if stop is not None and self._task is not None:
                self._fail(*stop, now)
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
        elif isinstance(request, SingleTap.Goal):
            self._on_single_tap(request, token, now)
        elif isinstance(request, ArrangeObjects.Goal):
            self._on_arrangement(request, token, now)
        elif isinstance(request, PositionObject.Goal):
            asked = Request(
                request.goal_pose,
                request.position_tolerance,
                request.angle_tolerance,
                request.max_taps,
                request.time_limit,
                token,
                request.probe,
                request.ask,
                request.object_id,
            )
            self._on_goal(asked, now)
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
        """Act on the decision that a job has computed, unless an object was moved meanwhile."""
        task, seen = self._task, self._monitor.object
        awaited = isinstance(event, JobEnded) and event.job == self._computation
        if task is None or seen is None or self.state is not S.PLANNING or not awaited:
            return ()  # the decision is no longer awaited, for example because the goal has ended
        assert isinstance(event, JobEnded)
        if event.fault is not None:
            raise event.fault
        outdated = task.outdated(self._monitor, event.result, *self._moved_limits)
        if outdated or self._obstacles_changed(task):
            deadline = self._settings.observe_deadline
            self._enter(Event.OBSERVATION_REQUESTED, S.LOOKING, now, deadline)
        else:
            self._act(task, task.conclude(event.result), seen, now)
        return self._drain()

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Check the deadlines and publish the periodic report."""
        self._advance(now)
        self._repeat_withdrawal(now)
        quiet = now.steady - self._reported_at
        if self._active and (self.state in TAPPING or quiet > REPORT_PERIOD_S):
            if self._task is not None:
                self._effects.append(TouchGoal())
            self._report(
                now, self.last.error_code, self.last.error_msg, draw=quiet > REPORT_PERIOD_S
            )
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
        if self._shot is not None and self._shot.tap_id != self._commanded:
            self._shot = None  # its command was not published
        self._end_tap(now)
        sentence = _internal_error(error)
        if self._task is not None:
            self._finish(S.FAILED, ErrorCode.INTERNAL, sentence, now)
        else:
            # The handler may have ended a goal that is still stored, or it was cancelling the goal
            # of a planner that crashed.
            self._resumed = None
            self._effects.append(KeepGoal(None))
            if self._configured:
                self._report(now, self.last.error_code, self.last.error_msg)
        if isinstance(lost, UnansweredRequest):
            answered = [effect.token for effect in self._effects if isinstance(effect, Answer)]
            if lost.token not in answered:
                response = _failure(type(lost.request), ErrorCode.INTERNAL, sentence)
                self._effects.append(Answer(lost.token, response))
        return self._drain()

    # Goals

    def _on_goal(self, request: Request, now: Now) -> None:
        task = (
            self._refusal(now)
            or self._outdated(request)
            or self._accepted(lambda: self.goals.accept(request, now))
        )
        if isinstance(task, Refused):
            self._refuse(task, request, now)
        else:
            self._begin(task, now)
            task.sent = to_nanoseconds(request.message.header.stamp) or task.sent

    def _outdated(self, request: Request) -> Refused | None:
        """Return a refusal if a goal of the topic is older than the goal under way, or None. The
        client of an action learns what becomes of its goal, and may send it again."""
        sent = to_nanoseconds(request.message.header.stamp)
        of_action = request.token is not None
        if self._task is None or of_action or sent <= 0 or sent >= self._task.sent:
            return None
        older = (self._task.sent - sent) / NANOSECONDS
        return Refused(
            ErrorCode.GOAL_STALE,
            f"the goal's stamp is {older:.1f} s older than the goal under way; send the goal again"
            " with a current stamp or with stamp 0",
        )

    def _on_single_tap(self, asked: SingleTap.Goal, token: Token, now: Now) -> None:
        refused = self._refusal(now)
        if refused is None and self._task is not None:
            refused = Refused(
                ErrorCode.PLANNER_BUSY, "a goal is under way; wait for its end, or cancel it"
            )
        pose = self._monitor.pose
        task = refused or self._accepted(lambda: self.goals.accept_tap(asked, token, pose, now))
        if isinstance(task, Refused):
            self._log(LogLevel.ERROR, f"single tap refused ({task.code}): {task.sentence}")
            result = _failure(SingleTap.Goal, task.code, task.sentence)
            self._effects.append(Answer(token, result))
        else:
            self._begin(task, now)

    def _on_arrangement(self, asked: ArrangeObjects.Goal, token: Token, now: Now) -> None:
        task = self._refusal(now) or self._accepted(
            lambda: self.goals.accept_arrangement(asked, token, now)
        )
        if isinstance(task, Refused):
            self._log(LogLevel.ERROR, f"arrangement refused ({task.code}): {task.sentence}")
            result = _failure(ArrangeObjects.Goal, task.code, task.sentence)
            self._effects.append(Answer(token, result))
        else:
            self._begin(task, now)

    def _accepted(self, accept: Callable[[], Task | Refused]) -> Task | Refused:
        """Return the task for a request, or why the request is refused. If the check of the request
        raises, only this request ends, because the check changes nothing of the goal under way."""
        try:
            if self._task is not None:
                # The new task begins with what the goal under way has learnt so far.
                self.goals.learn(self._task)
            return accept()
        except PlanningError as error:
            return Refused(ErrorCode.COMMAND_INVALID, str(error))
        except Exception as error:
            self._log(LogLevel.ERROR, traceback.format_exc())
            return Refused(ErrorCode.INTERNAL, _internal_error(error))

    def _refusal(self, now: Now) -> Refused | None:
        """Return why no goal is accepted at present, or None if goals are accepted."""
        if not self._active:
            return Refused(ErrorCode.NOT_ACTIVE, "the planner is not active; activate it first")
        fault = self._monitor.fault()
        if fault is not None:
            return Refused(fault[0], f"the cell is faulted: {fault[1]}")
        foreign = self._monitor.foreign_object()
        return None if foreign is None else Refused(*foreign)

    def _refuse(self, refused: Refused, request: Request, now: Now) -> None:
        """Report a goal that was refused."""
        code, sentence = refused.code, refused.sentence
        report = GoalReport(
            refused=True,
            state=PlanState.FAILED,
            object_id=request.object_id,
            goal=request.message,
            position_tolerance=request.position_tolerance,
            angle_tolerance=request.angle_tolerance,
            residual_distance=math.nan,
            residual_rotation=math.nan,
            error_code=code,
            error_msg=sentence,
        )
        report.header.stamp = to_stamp(now.ros)
        report.header.frame_id = "table"
        self._effects.append(Publish("goal_report", report))
        self._log(LogLevel.ERROR, f"goal refused ({code}): {sentence}")
        if request.token is None:
            self._report(now, code, sentence)
            return
        result = _failure(PositionObject.Goal, code, sentence)
        self._effects.append(Answer(request.token, result))

    def _begin(self, task: Task, now: Now, resumed: bool = False) -> None:
        if self._task is not None:
            self._end_tap(now)
            self._finish(S.CANCELED, ErrorCode.GOAL_REPLACED, "a newer goal replaced this one", now)
        self._resumed = None  # a goal that arrives before the resumption is newer
        self._is_resumed = resumed
        self._ask_resumed = self._ask_resumed and resumed
        self._view_cleared = False
        self._struck_at = math.inf
        self._monitor.watch(task.watched)
        self._keep_goal(task, now)
        task.sent = now.ros - round(SKEW_LIMIT_S * NANOSECONDS)
        self._log(LogLevel.INFO, task.description())
        self._task = task
        self._enter(Event.GOAL_ACCEPTED, S.WAITING_FOR_CELL, now, self._settings.ready_deadline)

    def _cancel(self, now: Now) -> None:
        self._end_tap(now)
        self._finish(S.CANCELED, ErrorCode.GOAL_CANCELED, "the goal was canceled", now)

    def _cancel_any(self, now: Now) -> Trigger.Response:
        """End the present goal, whoever sent it. The goal of a planner that crashed has no action
        client; it may be under way, or not resumed yet."""
        crashed, self._resumed = self._resumed, None
        if self._task is not None:
            self._cancel(now)
        else:
            # Before the node is configured, the stored goal is still on disk.
            self._effects.append(KeepGoal(None))
            if self._configured and crashed is None:
                return Trigger.Response(success=False, message="there is no goal to cancel")
        return Trigger.Response(success=True, message="goal canceled")

    def _keep_goal(self, task: Task, now: Now) -> None:
        """Store the goal so that the planner can resume it after a crash."""
        if task.resumable and self._settings.resume_within > 0:
            # A tap under way counts, because its outcome is not known after a crash.
            content = {
                "goal": list(task.goal),
                "tolerance": list(task.tolerance),
                "max_taps": task.max_taps,
                "taps": task.taps + (self._shot is not None),
                "time_left": task.expires - now.steady,
                "kept_at": now.steady,
                "ask": task.ask,
                "ask_always": self._ask or self._ask_resumed,
                "probe": task.probe,
                "object_id": task.object_id,
                "stops": self._monitor.known_stops(),
            }
            self._effects.append(KeepGoal(content))

    def _asks(self, task: Task | None) -> bool:
        """Return whether a person confirms the taps of ``task`` (None: of the next goal)."""
        return self._ask or (task is not None and (task.ask or self._ask_resumed))

    def _change_ask(self, ask: bool, now: Now) -> None:
        """Set whether a person confirms the taps that are planned from now on. A tap that was
        already proposed still waits for its answer."""
        self._ask, self._ask_resumed = ask, False
        if self._task is not None:
            self._keep_goal(self._task, now)
        if self._active:
            self._report(now, self.last.error_code, self.last.error_msg)

    def _recall(self, event: Configured, now: Now) -> None:
        """Load the goal of a planner that crashed recently, to resume it."""
        kept = event.kept_goal
        assert kept is not None
        self._effects.append(KeepGoal(None))
        if event.kept_goal_age < 0:
            self._log(
                LogLevel.WARNING,
                "the goal saved before the planner's crash is not resumed: this computer's clock "
                f"was set back since, by more than {-event.kept_goal_age:.1f} s, so the age of the "
                "goal is unknown; send the goal again",
            )
            return
        try:
            message = PoseStamped(pose=to_message(Pose(*map(float, kept["goal"]))))
            position, angle = (float(value) for value in kept["tolerance"])
            # After the goal was stored, only the time of the file was updated. The difference is
            # negative after a start of the computer, because the steady clock then starts anew.
            passed = now.steady - float(kept.get("kept_at", now.steady))
            left = float(kept["time_left"]) - max(passed, event.kept_goal_age)
            most, ask = int(kept["max_taps"]), bool(kept["ask"])
            # Earlier versions did not store the following two.
            ask_always, probe = bool(kept.get("ask_always")), bool(kept.get("probe"))
            name = str(kept["object_id"])
            taps = int(kept.get("taps", 0))  # earlier versions did not store it
            stops = {name: [int(one) for one in known] for name, known in kept["stops"].items()}
            if not 0 <= taps <= most:
                raise ValueError(taps)
        except (AttributeError, KeyError, TypeError, ValueError, OverflowError):
            self._log(
                LogLevel.WARNING,
                "the goal saved before the planner's crash cannot be read; send the goal again",
            )
            return
        message.header.frame_id = "table"
        self._resumed = Request(
            message,
            position,
            angle,
            most,
            left,
            probe=probe,
            ask=ask,
            object_id=name,
            earlier_taps=taps,
        )
        self._ask_resumed = ask_always
        self._recalled_at, self._recalled_stops = now.steady, stops
        self._resume_until = now.steady + self._settings.resume_within - event.kept_goal_age

    def _resume(self, request: Request, now: Now) -> None:
        """Resume the goal of a planner that crashed. If a stop or a fault has been reported since
        the start of this planner, end the goal, as the planner that crashed would have done."""
        within = self._settings.resume_within
        late = now.steady - self._resume_until
        if late > 0:
            self._log(
                LogLevel.WARNING,
                f"the goal of a planner that crashed is not resumed: {within + late:.1f} s have "
                f"passed since the crash (resume_within is {within:g} s); send the goal again",
            )
            return
        left = request.time_limit - (now.steady - self._recalled_at)
        request = replace(request, time_limit=max(left, 1.0))
        task = self._accepted(lambda: self.goals.accept(request, now))
        if isinstance(task, Refused):
            self._refuse(task, request, now)
            return
        task.earlier_taps = request.earlier_taps
        stop = self._monitor.recall_stops(self._recalled_stops)
        self._stop_reported = self._stop_reported or stop
        self._log(LogLevel.WARNING, "resuming the goal of a planner that crashed")
        self._begin(task, now, resumed=True)
        self._withdraw_orphan(now)
        if self._stop_reported is not None:
            self._fail(*self._stop_reported, now)

    # The cycle

    def _advance(self, now: Now) -> None:
        """Run the handler of the present state, unless the time limit ends the goal."""
        if not self._active:
            return
        if self._resumed is not None:
            request, self._resumed = self._resumed, None
            self._resume(request, now)
        task = self._task
        if task is None:
            return
        if now.steady > task.expires:
            self._fail(
                ErrorCode.DEADLINE_EXCEEDED,
                f"the goal was not reached within its time limit ({task.taps} finished"
                f" taps, last state {self.state.value}); send it again with a longer time limit",
                now,
            )
            return
        if self.state is not S.PLANNING:  # the decision is received by ``on_job``
            self._handlers[self.state](task, now)

    def _wait_for_cell(self, task: Task, now: Now) -> None:
        """Wait until arm, tapper and camera are ready; end a tap left over from a former run."""
        missing = self._monitor.missing(now)
        if missing is None:
            self._observe_after = now.steady
            self._enter(Event.CELL_READY, S.LOOKING, now, self._settings.observe_deadline)
            return
        unhomed = self._monitor.unhomed()
        if self._is_resumed and unhomed is not None:
            # The arm may have been stopped while no planner ran. Homing must not continue the goal.
            self._fail(*unhomed, now)
            return
        self._withdraw_orphan(now)
        if self._late(now):
            code, sentence = missing
            self._fail(code, f"the cell was not ready: {sentence}", now)

    def _observe(self, task: Task, now: Now) -> None:
        """Observe the object at rest, evaluate the last tap, and decide on the next tap."""
        needed = self._settings.frames_needed
        after = self._struck_at if self._moved_by_tap(now) else self._observe_after
        observed = task.observed(self._monitor, after, needed, now)
        seen = self._monitor.object
        if seen is None or not observed:
            if self._monitor.silent("object", now):
                # The camera's node may be restarting, so wait until the cell is ready again.
                self._wait_again(now)
            elif self._hidden_by_arm(now):
                self._move_arm_aside(now)
                self._parking_until = now.steady + PARKING_S
                deadline = self._settings.withdraw_deadline
                self._enter(Event.HIDDEN, S.SETTLING, now, deadline)
            elif self._late(now):
                deadline = self._settings.observe_deadline
                self._fail(*self._monitor.blind(deadline, needed, now, self._view_cleared), now)
            return
        if self._awaits_solution(task, now):
            return
        # Before the obstacles change, because the model of the tap belongs to the present ones.
        shot = self._shot
        if shot is not None and self._may_have_been_fired(shot):
            self._take_in(task, shot, seen)
            self._shot = None  # from here on, the tap's record counts
        elif shot is not None:
            self._shot = None
            if self._exhausts(task, shot, late=True):
                self._fail(ErrorCode.NOT_READY, GIVEN_UP, now)
                return
            self._keep_goal(task, now)
        # While the arm may hide a part of the table, the camera does not search for unknown
        # objects.
        search_since = self._observe_after if self._monitor.withdrawn(now) else -math.inf
        unknown = self.goals.update_free_space(task, self._observe_after, search_since, now)
        if unknown is not None:
            if self._late(now):
                self._fail(*unknown, now)
            return
        if self._awaits_solution(task, now):  # other obstacles need another solution
            return
        task.arm = self._monitor.tip
        frames = 0 if self._late(now) else needed
        computation = task.computation(frames)
        if computation is None:
            self._act(task, task.decide(seen, frames), seen, now)
            return
        # The decision is computed by a job outside the lock, so that the planner keeps publishing
        # its state.
        self._computation += 1
        self._effects.append(RunJob(Job(self._computation, "plan", lambda _: computation())))
        self._enter(Event.OBSERVED, S.PLANNING, now, self._deadline - now.steady)

    def _awaits_solution(self, task: Task, now: Now) -> bool:
        """Return whether a solver still computes the solution for the goal, and if so, postpone the
        deadline of the observation. The goal's time limit still applies."""
        if task.ready:
            return False
        self._deadline = now.steady + self._settings.observe_deadline
        return True

    def _may_have_been_fired(self, shot: Shot) -> bool:
        """Return whether a tap of the past was or may have been fired. If the tapper has lost the
        outcome, for example by a restart, the tap was not fired unless the arm was in position."""
        if shot.outcome == TapperState.UNKNOWN:
            return shot.in_position or not self._has_arm
        return shot.outcome != TapperState.NOT_FIRED

    def _take_in(self, task: Task, shot: Shot, seen: ObjectState) -> None:
        """Record and learn from a tap that was fired or may have been fired."""
        self._confirmed = None
        task.take_in(shot, seen, self._monitor.track(seen))
        warning = task.session.edge_warning(from_message(seen.pose.pose))
        if warning:
            self._log(LogLevel.WARNING, warning)

    def _moved_by_tap(self, now: Now) -> bool:
        """Return whether a fixed tapper has moved the object and the object is at rest again. In
        this case, images show the result of the tap even before the striker has returned."""
        return self._monitor.at_rest_after(self._struck_at, now)

    def _keep_observing(self, now: Now) -> None:
        """Continue the observation, so that more images are fused."""
        if self.state is S.PLANNING:
            self._enter(Event.OBSERVATION_REQUESTED, S.LOOKING, now, self._deadline - now.steady)

    def _act(self, task: Task, decision: Decision, seen: ObjectState, now: Now) -> None:
        """Carry out a decision that is based on the observation ``seen``."""
        if isinstance(task, ArrangementTask):
            self._turn_to_object(task)
        if isinstance(decision, ObserveAgain):
            self._keep_observing(now)
            return
        if isinstance(decision, Refusal):
            # If the tap is refused only because the object's pose is too uncertain, continue the
            # observation, because every further image reduces the uncertainty.
            if decision.reason is not RefusalReason.CAMERA_TOO_COARSE or self._late(now):
                self._fail(REFUSALS[decision.reason], decision.sentence, now)
            else:
                self._keep_observing(now)
            return
        if self.state is S.LOOKING:
            self._enter(Event.OBSERVED, S.PLANNING, now)
        if isinstance(decision, Done):
            self._finish(
                S.IDLE if isinstance(task, SingleTapTask) else S.REACHED, ErrorCode.NONE, "", now
            )
            return
        error = self._exhausted(task)
        if error is not None:
            self._fail(*error, now)
        elif self._monitor.missing(now) is not None:
            self._wait_again(now)
        else:
            self._plan(task, decision, task.before(seen), now)

    def _turn_to_object(self, task: ArrangementTask) -> None:
        """Watch the present object of the arrangement; warn about other objects that taps have
        moved."""
        self._monitor.watch(task.object_id)
        names, task.touched = task.touched, []
        if names:
            self._log(
                LogLevel.WARNING,
                f"{', '.join(map(repr, names))} moved although another object was tapped; "
                "the next move is planned again",
            )

    def _exhausted(self, task: Task) -> CodedError | None:
        """Return why no further tap is made, or None if a further tap may be made."""
        if task.without_effect >= self._settings.attempts:
            return (
                ErrorCode.TAP_WITHOUT_EFFECT,
                f"{task.without_effect} taps in a row moved the object by less than"
                f" {100 * MIN_EFFECT:.0f} % of the wanted distance; check that the striker hits"
                " it at the right height, and calibrate arm and tapper",
            )
        if task.taps >= task.max_taps:
            return (
                ErrorCode.TAP_LIMIT_REACHED,
                f"the object is not at the goal after {task.taps} of at most"
                f" {task.max_taps} taps; {1000 * self.last.residual_distance:.2f} mm and"
                f" {math.degrees(self.last.residual_rotation):.2f} deg remain; allow more taps, or"
                " check the striker, the camera and the object's file",
            )
        return None

    def _plan(self, task: Task, strike: Strike, before: Pose, now: Now) -> None:
        """Command or propose one tap."""
        covariance = task.session.predicted_covariance(strike, before)
        shot = Shot(
            self._next_tap_id(now),
            task.object_id,
            task.taps + 1,
            strike,
            before,
            covariance,
            purpose=task.purpose,
        )
        if strike.detour:
            self._log(LogLevel.INFO, f"tap {shot.number}: {strike.detour}")
        if not self._asks(task) or self._confirmation_holds(shot, now):
            self._command(shot, now)
            return
        patience = self._settings.confirm_deadline
        self._proposed, self._answer_by = shot, now.ros + round(patience * NANOSECONDS)
        self._log(LogLevel.INFO, f"tap {shot.number} waits for confirmation (id {shot.tap_id})")
        self._enter(Event.TAP_PROPOSED, S.CONFIRMING, now, patience)

    def _next_tap_id(self, now: Now) -> int:
        """Return a tap id that was never used before.

        Ids are whole seconds of the clock, so they increase across restarts of every node and fit
        the tapper's 32 bits until 2106. If the clock was set back, the id is instead one above the
        greatest id that planner, arm or tapper has used.
        """
        # Arm and tapper refuse greater ids than this one, so they cannot have used them.
        largest = tap_commands.largest_id(self._last_tap_id, now)
        used = self._monitor.last_tap_id(largest)
        self._last_tap_id = max(self._last_tap_id + 1, now.ros // NANOSECONDS, used + 1)
        return self._last_tap_id

    def _confirmation_holds(self, shot: Shot, now: Now) -> bool:
        """Return whether a person has confirmed this tap in an earlier plan that was not fired."""
        confirmed = self._confirmed
        if confirmed is None:
            return False
        difference = confirmed.difference(shot, now.steady)
        if difference:
            self._confirmed = None
            shot.asked_again = f"asked again because {difference}"
            self._log(LogLevel.INFO, f"tap {shot.number} must be confirmed again: {difference}")
            return False
        self._log(
            LogLevel.INFO,
            f"tap {shot.number} differs from the confirmed tap by less than the limits; its "
            "confirmation remains valid",
        )
        return True

    def _command(self, shot: Shot, now: Now) -> None:
        """Publish the command of one tap."""
        assert self._task is not None
        self._shot, self._proposed = shot, None
        self._keep_goal(self._task, now)  # before the command, so that no crash loses the tap
        self._view_cleared = False
        self._struck_at = math.inf
        allowance = self._settings.place_deadline + self._settings.fire_deadline
        expiry = now.ros + round(allowance * NANOSECONDS)
        height = self.goals.cell.strike_height
        self._effects.append(Publish("tap_command", shot.command(now.ros, expiry, height)))
        if self._has_arm:
            self._enter(Event.TAP_COMMANDED, S.PLACING, now, self._settings.place_deadline)
        else:
            self._enter(Event.TAP_COMMANDED, S.FIRING, now, self._settings.fire_deadline)

    def _wait_for_person(self, task: Task, now: Now) -> None:
        """Wait until a person confirms or rejects the proposed tap; drop the proposal if an object
        moves."""
        shot = self._proposed
        assert shot is not None
        if self._monitor.lost(now):
            self._wait_again(now)
        elif self._disturbed(shot, now):
            self._drop_proposal("an object was moved", now)
        elif self._late(now):
            self._fail(
                ErrorCode.TAP_NOT_CONFIRMED,
                f"tap {shot.number} was not confirmed within"
                f" {self._settings.confirm_deadline:.0f} s; send the goal again and answer on the"
                " page or in the terminal",
                now,
            )

    def _on_confirmation(self, asked: ConfirmTap.Request, now: Now) -> ConfirmTap.Response:
        """Handle a person's answer. The answer is valid only for the tap that is proposed now."""
        if self._task is not None:
            self._advance(now)  # first handle received messages and expired deadlines
        shot, task = self._proposed, self._task
        if shot is None or task is None or shot.tap_id != asked.tap_id:
            waiting = (
                f"answer for tap {shot.tap_id} instead" if shot is not None else "no tap is waiting"
            )
            return ConfirmTap.Response(
                error_code=ErrorCode.TAP_NOT_AWAITED,
                error_msg=f"tap {asked.tap_id} is not waiting for confirmation; {waiting}",
            )
        self._confirmed = None
        if not asked.confirm and isinstance(task, SingleTapTask):
            self._fail(ErrorCode.TAP_NOT_CONFIRMED, "a person rejected the single tap", now)
            return ConfirmTap.Response(accepted=True)
        if not asked.confirm:
            task.skip(shot.strike)
            self._drop_proposal("it was skipped", now)
            return ConfirmTap.Response(accepted=True)
        missing = self._monitor.missing(now)
        needed = self._settings.frames_needed
        if missing is not None:
            self._wait_again(now)
        elif not task.observed(self._monitor, self._observe_after, needed, now):
            missing = self._monitor.blind(None, needed, now)
            self._drop_proposal("the object has not been observed at rest in enough images", now)
        else:
            self._confirmed = Confirmation(shot, now.steady)
            self._command(shot, now)
            return ConfirmTap.Response(accepted=True)
        code, sentence = missing
        if code in LATE:
            self._confirmed = Confirmation(shot, now.steady)
            return ConfirmTap.Response(accepted=True)
        return ConfirmTap.Response(
            error_code=code, error_msg=f"tap {shot.number} is planned again: {sentence}"
        )

    def _drop_proposal(self, why: str, now: Now) -> None:
        """Drop the proposed tap, observe the object again and plan another tap."""
        shot, self._proposed = self._proposed, None
        assert shot is not None
        self._log(LogLevel.INFO, f"tap {shot.number} (id {shot.tap_id}) is planned again: {why}")
        self._observe_after = now.steady
        self._enter(Event.TAP_DROPPED, S.LOOKING, now, self._settings.observe_deadline)

    def _wait_for_arm(self, task: Task, now: Now) -> None:
        """Wait until the arm has moved the striker to its strike pose."""
        shot = self._shot
        assert shot is not None
        if self._disturbed(shot, now):
            # arm_state may be late, so the tap may already have been fired. Only the tapper knows.
            self._log(LogLevel.WARNING, MOVED_BEFORE_TAP)
            self._withdraw_confirmation("an object was moved")
            self._give_up(TapperState.UNKNOWN, now)
        elif (unreachable := self._monitor.out_of_reach(shot.tap_id)) is not None:
            self._try_another_way(task, shot, *unreachable, now)
        elif self._monitor.outcome(shot.tap_id) != TapperState.NONE:
            self._take_outcome(task, shot, now)
        elif self._monitor.in_position(shot.tap_id):
            self._enter(Event.IN_POSITION, S.FIRING, now, self._settings.fire_deadline)
        else:
            self._check_cell(
                ErrorCode.ARM_TIMEOUT,
                "the striker did not reach its strike pose within"
                f" {self._settings.place_deadline:.0f} s",
                now,
            )

    def _try_another_way(self, task: Task, shot: Shot, code: int, sentence: str, now: Now) -> None:
        """Plan a tap from another direction, because the present tap is out of the arm's reach."""
        task.skip(shot.strike)
        self._withdraw_confirmation(sentence)
        # The arm will not be in position for this tap, so the tapper cannot fire it.
        shot.outcome = shot.outcome or TapperState.NOT_FIRED
        if self._exhausts(task, shot, late=False):
            self._fail(code, sentence, now)
            return
        self._log(LogLevel.WARNING, f"tap {shot.number}: {sentence}; planning another tap")
        self._give_up(TapperState.NOT_FIRED, now)

    def _wait_for_tapper(self, task: Task, now: Now) -> None:
        """Wait until the tapper has charged and fired once."""
        shot = self._shot
        assert shot is not None
        if self._monitor.outcome(shot.tap_id) != TapperState.NONE:
            self._take_outcome(task, shot, now)
        elif self._disturbed(shot, now):
            # Either an object was moved before the tap, or the tap itself moved the object and the
            # tapper's report has not arrived yet. In both cases, the tap is withdrawn, and the
            # tapper still reports the outcome.
            self._withdraw_confirmation("an object was moved")
            self._withdraw(shot.tap_id, now)
        if self.state is S.FIRING and (self._late(now) or self._monitor.lost(now)):
            self._log(LogLevel.WARNING, "the tap's outcome is not known; observing the object")
            self._give_up(TapperState.UNKNOWN, now)

    def _take_outcome(self, task: Task, shot: Shot, now: Now) -> None:
        """Process the outcome that the tapper reported."""
        tapper = self._monitor.tapper_of(shot.tap_id)
        assert tapper is not None
        if not self._has_arm and shot.outcome == TapperState.FIRED:
            self._struck_at = now.steady + shot.strike.plan.flight
        withdrawn = self._withdrawn_tap_id == shot.tap_id
        self._withdraw(shot.tap_id, now)
        if shot.outcome == TapperState.NOT_FIRED and withdrawn and not tapper.error_code:
            self._log(LogLevel.WARNING, MOVED_BEFORE_TAP)
        elif shot.outcome == TapperState.NOT_FIRED:
            code, sentence = tapper.error_code, tapper.error_msg
            if not code:
                code, sentence = WITHDRAWN_BY_ANOTHER
                self._withdraw_confirmation(sentence)
            self._log(LogLevel.WARNING, f"tap not fired: {sentence}")
            if self._has_arm and code == ErrorCode.OBJECT_NOT_SEEN:
                # On its way to this strike pose, the arm itself may hide the object, so choose
                # another tap.
                task.skip(shot.strike)
            if self._exhausts(task, shot, late=tapper.error_code in LATE):
                self._fail(code, sentence, now)
                return
        else:
            task.not_fired = task.late = 0
        self._enter(Event.OUTCOME_REPORTED, S.SETTLING, now, self._settings.withdraw_deadline)

    def _exhausts(self, task: Task, shot: Shot, late: bool) -> bool:
        """Count a tap that was commanded and not fired, once. Return whether no further tap is
        made: another attempt is as safe as the first, but their number is limited."""
        if shot.counted:
            return False
        shot.counted = True
        task.late += late
        task.not_fired += not late
        settings = self._settings
        return task.not_fired >= settings.attempts or task.late >= settings.late_attempts

    def _note_position(self) -> None:
        """Store that the arm was in position for the last tap."""
        arm, shot = self._monitor.arm, self._shot
        if shot is not None and arm is not None and arm.tap_id == shot.tap_id:
            shot.in_position = shot.in_position or arm.state == ArmState.IN_POSITION

    def _note_outcome(self, now: Now) -> None:
        """Store the outcome that the tapper reports of the last tap, possibly after the planner has
        given up the tap."""
        shot = self._shot
        tapper = self._monitor.tapper_of(shot.tap_id) if shot is not None else None
        if shot is None or tapper is None or tapper.outcome == TapperState.NONE:
            return
        shot.outcome = tapper.outcome
        if shot.outcome == TapperState.NOT_FIRED and tapper.error_code not in (0, *LATE):
            self._withdraw_confirmation(tapper.error_msg)
        if math.isfinite(tapper.measured_speed):
            shot.measured_speed = tapper.measured_speed
        if shot.fired_at is None:
            shot.fired_at = now.ros

    def _withdraw_confirmation(self, sentence: str) -> None:
        """Ask a person again before the next tap, because the confirmed tap was not fired for the
        reason ``sentence``. An earlier reason remains."""
        if self._confirmed is not None and not self._confirmed.withdrawn:
            why = f"the confirmed tap was not fired ({sentence})"
            self._confirmed = replace(self._confirmed, withdrawn=why)

    def _wait_for_withdrawal(self, task: Task, now: Now) -> None:
        """Wait until the arm has withdrawn and the camera has a free view."""
        if self._monitor.withdrawn(now) and now.steady >= self._parking_until:
            self._observe_after = now.steady
            self._enter(Event.WITHDRAWN, S.LOOKING, now, self._settings.observe_deadline)
            return
        self._check_cell(
            ErrorCode.ARM_TIMEOUT,
            f"the {'arm did not withdraw' if self._has_arm else 'striker did not return'} within"
            f" {self._settings.withdraw_deadline:.0f} s",
            now,
        )

    def _check_cell(self, code: int, sentence: str, now: Now) -> None:
        """End a wait for arm or tapper if the connection to a driver is lost, if the arm has lost
        its reference, or if the deadline has passed."""
        if self._monitor.lost(now):
            self._wait_again(now)
        elif (unhomed := self._monitor.unhomed()) is not None:
            self._fail(*unhomed, now)
        elif self._late(now):
            device = "arm" if self._has_arm else "tapper"
            self._fail(code, f"{sentence}; check the {device}, then send the goal again", now)

    def _wait_again(self, now: Now) -> None:
        """End the tap and wait until the cell is ready again."""
        self._end_tap(now)
        self._proposed = None
        self._struck_at = math.inf
        deadline = self._settings.ready_deadline
        self._enter(Event.CELL_NOT_READY, S.WAITING_FOR_CELL, now, deadline)

    @property
    def _moved_limits(self) -> tuple[float, float]:
        """Distance (m) and angle (rad) beyond which an object counts as moved."""
        return self._settings.moved_limit, self._settings.turned_limit

    def _disturbed(self, shot: Shot, now: Now) -> bool:
        """Return whether the present object or another object was moved since the tap was
        planned."""
        limits = self._moved_limits
        if self._monitor.seen_away_from(shot.before, *limits):
            return True
        if isinstance(self._task, ArrangementTask):
            moved = self._task.others_moved(self._monitor, *limits)
            return moved or self._obstacles_changed(self._task)
        return self.goals.others_moved(now)

    def _obstacles_changed(self, task: Task) -> bool:
        """Return whether the areas of unknown objects differ from those of the last decision."""
        if not isinstance(task, ArrangementTask):
            return False
        return task.obstacles != self.goals.other_objects.unknown

    def _give_up(self, outcome: int, now: Now) -> None:
        """Give up the tap under way and have the arm withdraw. ``outcome``: outcome of the tap
        unless the tapper reports it."""
        shot = self._shot
        assert shot is not None
        shot.outcome = shot.outcome or outcome
        self._withdraw(shot.tap_id, now)
        self._enter(Event.GIVEN_UP, S.SETTLING, now, self._settings.withdraw_deadline)

    def _end_tap(self, now: Now) -> None:
        """Withdraw the tap under way, if any. Its outcome is unknown until the tapper reports
        it."""
        shot = self._shot
        if shot is not None and self.state in TAPPING:
            self._withdraw(shot.tap_id, now)
            shot.outcome = shot.outcome or TapperState.UNKNOWN

    def _withdraw(self, tap_id: int, now: Now) -> None:
        """Publish the withdrawal of a tap; repeated calls for the same tap have no effect."""
        if tap_id == self._withdrawn_tap_id:
            return
        self._publish_withdrawal(tap_id, now)
        self._withdrawn_tap_id, self._withdrawn_at = tap_id, now.steady

    def _withdraw_orphan(self, now: Now) -> None:
        """Withdraw a tap of a previous planner that the arm still serves, if any."""
        orphan = self._monitor.left_behind()
        if orphan:
            self._withdraw(orphan, now)

    def _repeat_withdrawal(self, now: Now) -> None:
        """Publish the last withdrawal again if it was lost: the arm still serves the tap."""
        tap_id = self._withdrawn_tap_id
        serving = tap_id and self._monitor.left_behind() == tap_id
        due = now.steady > self._withdrawn_at + WITHDRAW_AGAIN_S
        if self._active and serving and due and not self._monitor.silent("arm", now):
            self._withdrawn_at = now.steady
            self._publish_withdrawal(tap_id, now)

    def _publish_withdrawal(self, tap_id: int, now: Now) -> None:
        command = TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id)
        command.header.stamp = to_stamp(now.ros)
        command.header.frame_id = "table"
        self._effects.append(Publish("tap_command", command))

    def _may_be_covered(self, name: str, pose: Pose | None) -> bool:
        """Return whether the arm may hide an object of the cell that was last seen at a pose."""
        tip, lens = self._monitor.tip, self._lens
        if not self._has_arm or pose is None or tip is None or lens is None:
            return False
        if not all(map(math.isfinite, (*tip, *lens, *pose))):
            return False
        cell = self.goals.cell
        found = next(
            (one for one in (cell.object, *self.goals.other_objects.files) if one.name == name),
            None,
        )
        if found is None:
            return False
        place = (pose.x, pose.y, found.height)
        return may_hide(cell, lens, tip, place, found.shape.reach())

    def _hidden_by_arm(self, now: Now) -> bool:
        """Return whether the arm probably hides the object, because the object was not seen for
        ``HIDDEN_S``."""
        if not self._has_arm or self._view_cleared:
            return False
        elapsed = now.steady - self._observe_after
        return min(elapsed, self._monitor.unseen_for(now)) > HIDDEN_S

    def _move_arm_aside(self, now: Now) -> None:
        """Move the arm, because the arm may hide the object. First move the arm to its park pose.
        If the object is still not seen, move the arm to a pose that uncovers the area that the arm
        hides."""
        if self._withdrawn_tap_id not in (0, self._parked_tap_id):
            self._park(now)
            return
        self._view_cleared = True
        self._log(
            LogLevel.WARNING,
            "the object is not seen; moving the arm aside in case it hides the object",
        )
        command = TapCommand(request=TapCommand.CLEAR_VIEW, tap_id=self._next_tap_id(now))
        command.header.stamp = to_stamp(now.ros)
        command.header.frame_id = "table"
        # The command expires when the planner stops waiting, so that a late command does not move
        # the arm. SKEW_LIMIT_S allows for the difference of the computers' clocks.
        command.expiry = to_stamp(now.ros + round((PARKING_S + SKEW_LIMIT_S) * NANOSECONDS))
        self._effects.append(Publish("tap_command", command))

    def _park(self, now: Now) -> None:
        """Make the withdrawn arm continue to its park pose, by publishing the withdrawal a second
        time."""
        tap_id = self._withdrawn_tap_id
        if not self._has_arm or tap_id in (0, self._parked_tap_id):
            return
        self._parked_tap_id = tap_id
        self._publish_withdrawal(tap_id, now)

    # State transitions, deadlines and the end of a goal

    def _enter(self, event: Event, state: State, now: Now, patience: float = math.inf) -> None:
        self._machine.move(event, state)
        self._deadline = now.steady + patience
        self._report(now)

    def _late(self, now: Now) -> bool:
        return now.steady > self._deadline

    def _fail(self, code: int, sentence: str, now: Now) -> None:
        self._end_tap(now)
        self._finish(S.FAILED, code, sentence, now)

    def _finish(self, state: State, code: int, sentence: str, now: Now) -> None:
        """End the goal; if it is an action goal, send its result."""
        task = self._task
        assert task is not None
        event = {S.FAILED: Event.GOAL_FAILED, S.CANCELED: Event.GOAL_CANCELED}.get(
            state, Event.GOAL_MET
        )
        if self.state in WORKING:  # not if a defect has interrupted this method before
            self._machine.move(event, state)
        self._proposed = self._confirmed = None
        self._monitor.watch(task.watched)  # the result contains the pose of this object
        if self._shot is not None:
            task.lose(self._shot)
        task.end(code, sentence)
        self._report(now, code, sentence)
        if task.token is not None:
            result = task.result(code, sentence, self.last, self._monitor.object)
            self._effects.append(Answer(task.token, result))
        self._task = self._shot = None
        self._monitor.watch("")
        self._park(now)
        self._effects.append(KeepGoal(None))
        if code:
            self._log(LogLevel.ERROR, f"goal ended ({code}): {sentence}")
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
        self._reported_at = now.steady if draw else self._reported_at
        task = self._task
        # While the monitor watches another object, of which an observation is missing, the report
        # is still about the present object.
        pose = self._monitor.pose_of("" if task is None else task.watched)
        state = PlanState(state=WIRE[self.state], error_code=code, error_msg=sentence)
        state.header.stamp = to_stamp(now.ros)
        state.header.frame_id = "table"
        state.residual_distance = state.residual_rotation = math.nan
        state.learnt = self._learnt_gains()
        state.ask = self._asks(task)
        planned = self._proposed or self._shot
        if planned is not None and self.state in (S.CONFIRMING, *TAPPING):
            by = self._answer_by if self._proposed is not None else 0
            state.planned_tap = planned.planned(by, self.goals.cell.strike_height)
        if task is not None:
            task.fill(state, pose)
            changed = (state.state, state.taps) != (self.last.state, self.last.taps)
            if task.token is not None and changed:
                self._effects.append(Feedback(task.token, task.feedback(state)))
        elif self.state in FINAL:
            for name in REMEMBERED:
                setattr(state, name, getattr(self.last, name))
        self.last = state
        if isinstance(task, ArrangementTask) and draw:
            # Published before `plan_state`, so that a recorder knows that the goal belongs to an
            # arrangement.
            active = self.state not in FINAL
            self._effects.append(Publish("arrangement_state", task.report(now, active)))
        self._effects.append(Publish("plan_state", state))
        if task is not None and self.state in FINAL and state.planner != PRESCRIBED:
            self._effects.append(Publish("goal_report", _final_report(state, task)))
        if draw and self._configured:
            self._effects.append(
                Publish(
                    "markers",
                    Scene(
                        state,
                        pose,
                        task.goal if task is not None else None,
                        planned.strike if planned is not None else None,
                        tuple(
                            from_message(record.object_pose)
                            for record in (task.records if task is not None else ())
                        ),
                        self.goals.others,
                    ),
                )
            )

    def _learnt_gains(self) -> LearntGains:
        """Return the learnt corrections of the object's model as a message; the message is cached
        until they change."""
        if not self._configured:
            return LearntGains()
        gains = self._task.session.gains if self._task is not None else self.goals.gains
        if self._learnt[0] is not gains:
            self._learnt = gains, learnt_message(gains)
        return self._learnt[1]

    def _log(self, level: LogLevel, sentence: str) -> None:
        self._effects.append(Log(level, sentence))

    def _drain(self) -> Sequence[Effect]:
        if self._shot is not None:
            self._commanded = self._shot.tap_id
        effects, self._effects = self._effects, []
        return effects


def _begins(effect: Effect) -> bool:
    """Return whether the effect begins a motion, a tap or a computation."""
    if isinstance(effect, Publish) and effect.topic == "tap_command":
        return bool(effect.message.request != TapCommand.WITHDRAW)
    return isinstance(effect, RunJob)


def _no_arrangement(now: Now) -> ArrangementState:
    """Return the state of a planner that has just been activated."""
    state = ArrangementState()
    state.header.stamp = to_stamp(now.ros)
    state.header.frame_id = "table"
    return state


def _internal_error(error: Exception) -> str:
    """Return the error message for a defect of the program."""
    return f"internal error ({error!r}): report it with the log"


def _failure(kind: type[Message], code: int, sentence: str) -> Message:
    """Return the answer to a request of this class that is refused or whose handler raised."""
    if kind is SetBool.Request:
        return SetBool.Response(success=False, message=sentence)
    if kind is Trigger.Request:
        return Trigger.Response(success=False, message=sentence)
    if kind is ConfirmTap.Request:
        return ConfirmTap.Response(error_code=code, error_msg=sentence)
    if kind is SingleTap.Goal:
        return SingleTap.Result(error_code=code, error_msg=sentence)
    if kind is ArrangeObjects.Goal:
        return ArrangeObjects.Result(error_code=code, error_msg=sentence)
    return PositionObject.Result(
        error_code=code,
        error_msg=sentence,
        residual_distance=math.nan,
        residual_rotation=math.nan,
    )


def _final_report(state: PlanState, task: Task) -> GoalReport:
    """Return the report of a goal that has ended."""
    report = GoalReport(header=state.header, state=state.state, records=task.records)
    for name in (
        "object_id",
        "goal",
        "position_tolerance",
        "angle_tolerance",
        "planner",
        "taps",
        "residual_distance",
        "residual_rotation",
        "error_code",
        "error_msg",
    ):
        setattr(report, name, getattr(state, name))
    return report
