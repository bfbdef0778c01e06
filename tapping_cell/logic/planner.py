"""The planner's machine: a goal in, tap after tap out, until the object is seen to be there.

One tap: observe the object at rest, decide, command the tap, wait until the tapper tells how it
ended, have the arm withdraw, wait for rest, observe again. Where taps are asked for, a person
confirms each one before it is commanded. Every wait has a deadline and every goal a time limit.
What is not known is observed; nothing is fired twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from tapping_cell.logic.arrangement import ArrangementTask
from tapping_cell.logic.cell_monitor import CellMonitor, Trouble
from tapping_cell.logic.clock import NANOSECONDS, Now, to_stamp
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
from tapping_cell.logic.host import Activated, Configured, Deactivated, LifecycleEvent
from tapping_cell.logic.learnt import to_message as learnt_message
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.poses import from_message, to_message
from tapping_cell.logic.task import LEAST_EFFECT, Shot, SingleTapTask, Task
from tapping_cell.logic.transitions import StateMachine, table
from tapping_cell.messages import (
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
)
from tapping_cell.planning import (
    Decision,
    Done,
    Gains,
    KeepOut,
    LookAgain,
    Refusal,
    RefusalReason,
    Strike,
)
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.se2 import Pose

TICK_S = 0.1
WITHDRAWN_BY_ANOTHER = (
    ErrorCode.NOT_READY,
    "the tap was ended before it was fired, and not by this planner; see who else publishes"
    " tap_command or tapper_state",
)
"""Why a tap was not fired whose tapper has no complaint."""
HIDDEN_S = 0.7
"""An object that is not seen for so long after the arm withdrew may be hidden by it: it parks."""
PARKING_S = 0.5
"""Within so long an arm that was told to park says that it moves."""
REPORT_PERIOD_S = 0.5
"""Between two reports while nothing changes. While a tap is under way every tick reports: the
tapper discharges the striker when this heartbeat ends."""


class State(Enum):
    """Where the planner is with its goal."""

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
    """What moves it on."""

    GOAL_ACCEPTED = "goal accepted"
    CELL_READY = "cell ready"
    CELL_NOT_READY = "cell not ready"
    OBSERVED = "object observed at rest"
    TAP_PROPOSED = "tap proposed"
    TAP_DROPPED = "proposed tap dropped"
    TAP_COMMANDED = "tap commanded"
    IN_POSITION = "arm in position"
    OUTCOME_TOLD = "tapper told the outcome"
    GIVEN_UP = "tap given up"
    WITHDRAWN = "arm withdrawn"
    HIDDEN = "object hidden"
    LOOK_WANTED = "longer look wanted"
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
"""States in which a tap is under way that may yet be fired."""

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
        ((S.PLANNING,), Event.LOOK_WANTED, (S.LOOKING,)),
        ((S.PLANNING,), Event.TAP_PROPOSED, (S.CONFIRMING,)),
        ((S.CONFIRMING,), Event.TAP_DROPPED, (S.LOOKING,)),
        # Nothing must be placed before a tapper at a fixed mount fires.
        ((S.PLANNING, S.CONFIRMING), Event.TAP_COMMANDED, (S.PLACING, S.FIRING)),
        ((S.PLACING,), Event.IN_POSITION, (S.FIRING,)),
        (TAPPING, Event.OUTCOME_TOLD, (S.SETTLING,)),
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
"""Of ``plan_state``: a goal is under way."""
FINAL = (S.REACHED, S.FAILED, S.CANCELED)
FINAL_STATES = tuple(WIRE[state] for state in FINAL)
"""Of ``plan_state``: the goal has ended."""
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
"""Fields of the last goal that stay readable after its end, for whoever joins late."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What there is to draw: published as ``markers``. Poses in ``table``."""

    state: PlanState
    pose: Pose | None
    goal: Pose | None
    strike: Strike | None
    path: tuple[Pose, ...]
    """Where the object lay before each tap of this goal."""
    others: tuple[KeepOut | None, ...]


class PlannerLogic:
    """See the module's docstring."""

    tick_period = TICK_S

    goals: GoalHandling
    """Of the present configuration: what ``Configured`` brings as ``connected``."""

    def __init__(self, settings: PlannerSettings) -> None:
        self._settings = settings
        self._machine = StateMachine(TABLE, S.IDLE)
        self._monitor = CellMonitor(settings.silence_limit)
        self._active = self._configured = False
        self._has_arm = True
        self._task: Task | None = None
        self._shot: Shot | None = None
        self._proposed: Shot | None = None
        self._answer_by = 0
        self._ask = settings.ask
        self._deadline = math.inf
        self._computation = 0
        self._look_after = -math.inf
        self._last_tap_id = 0
        self._withdrawn_tap_id = 0
        self._parked_tap_id = 0
        self._parking_until = -math.inf
        self._reported_at = -math.inf
        self._resumed: Request | None = None
        self._effects: list[Effect] = []
        self._learnt: tuple[Gains | None, LearntGains] = (None, LearntGains())
        self.last = PlanState(residual_distance=math.nan, residual_rotation=math.nan)
        """The last report."""

    @property
    def state(self) -> State:
        """The machine's state."""
        return self._machine.state

    # The contract

    def on_lifecycle(self, event: LifecycleEvent, now: Now) -> Sequence[Effect]:
        """The node's life cycle."""
        if isinstance(event, Configured):
            assert isinstance(event.connected, GoalHandling)
            self.goals = event.connected
            self._configured = True
            cell = self.goals.cell
            self._has_arm = cell.file.arm is not None
            self._monitor.expect(self._has_arm, [list(board.channels) for board in cell.boards])
            if event.kept_goal is not None:
                self._recall(event, now)
        elif isinstance(event, Activated):
            self._active = True
            self._report(now)
        else:
            # Unreachable does not come: the planner has no device.
            self._active = False
            if self._task is not None:
                sentence = "the planner was deactivated"
                self._fail(ErrorCode.NOT_ACTIVE, sentence, now)
            if not isinstance(event, Deactivated):
                # An orderly end is an end of the goal, too.
                self._effects.append(KeepGoal(None))
        return self._drain()

    def on_message(self, topic: str, message: Message, now: Now) -> Sequence[Effect]:
        """A message."""
        if topic == "goal_pose":
            self._on_goal(Request(message), now)
        elif topic == "object_state":
            self._monitor.on_object(message, now)
        elif topic == "object_states":
            self._monitor.on_objects(message, now)
        elif topic == "other_objects":
            if self._configured:
                clock = self._monitor.camera_clock
                self.goals.other_objects.on_object(message, clock, now)
        elif topic == "arm_state":
            self._monitor.on_arm(message, now)
        elif topic == "tapper_state":
            self._monitor.on_tapper(message, now)
        elif topic == "emergency_stop" and message.data and self._task is not None:
            self._fail(
                ErrorCode.EMERGENCY_STOP,
                "emergency stop: make the cell safe, clear the faults, then send the goal again",
                now,
            )
        if topic != "goal_pose":
            self._advance(now)
        return self._drain()

    def on_request(
        self, service: str, request: Message, token: Token, now: Now
    ) -> Sequence[Effect]:
        """An action goal, or the cancellation of one; the answer to a proposed tap; whether every
        tap is to be asked for (``ask``, the parameter of that name)."""
        if service == "cancel":
            if self._task is not None and self._task.token == token:
                self._end_tap(now)
                self._finish(S.CANCELED, ErrorCode.GOAL_CANCELED, "the goal was canceled", now)
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
        """The planner asks nobody."""
        return ()

    def on_job(self, event: JobProgress | JobEnded, now: Now) -> Sequence[Effect]:
        """What a decision needed is computed."""
        task, seen = self._task, self._monitor.object
        awaited = isinstance(event, JobEnded) and event.job == self._computation
        if task is None or seen is None or self.state is not S.PLANNING or not awaited:
            return ()  # of a goal that has ended meanwhile
        assert isinstance(event, JobEnded)
        if event.fault is not None:
            raise event.fault
        self._act(task, task.conclude(event.result), seen, now)
        return self._drain()

    def on_tick(self, now: Now) -> Sequence[Effect]:
        """Time has passed."""
        self._advance(now)
        quiet = now.steady - self._reported_at
        if self._active and (self.state in TAPPING or quiet > REPORT_PERIOD_S):
            if self._task is not None:
                self._effects.append(TouchGoal())
            self._report(
                now, self.last.error_code, self.last.error_msg, draw=quiet > REPORT_PERIOD_S
            )
        return self._drain()

    def on_defect(self, error: Exception, now: Now) -> Sequence[Effect]:
        """A handler raised: end the tap and the goal."""
        self._effects.clear()
        if self._shot is not None:
            self._withdraw(self._shot.tap_id, now)
        if self._task is not None:
            self._finish(
                S.FAILED,
                ErrorCode.INTERNAL,
                f"a defect of this program ({error!r}): please report it with the log",
                now,
            )
        return self._drain()

    # Goals

    def _on_goal(self, request: Request, now: Now) -> None:
        refused = self._refusal(now)
        task: Task | Refused = refused or self.goals.accept(request, now)
        if isinstance(task, Refused):
            self._refuse(task, request, now)
        else:
            self._begin(task, now)

    def _on_single_tap(self, asked: SingleTap.Goal, token: Token, now: Now) -> None:
        refused = self._refusal(now)
        if refused is None and self._task is not None:
            refused = Refused(
                ErrorCode.PLANNER_BUSY, "a goal is under way; wait for its end, or cancel it"
            )
        task = refused or self.goals.accept_tap(asked, token, self._monitor.pose, now)
        if isinstance(task, Refused):
            self._log(LogLevel.ERROR, f"single tap refused ({task.code}): {task.sentence}")
            result = SingleTap.Result(error_code=task.code, error_msg=task.sentence)
            self._effects.append(Answer(token, result))
        else:
            self._begin(task, now)

    def _on_arrangement(self, asked: ArrangeObjects.Goal, token: Token, now: Now) -> None:
        task = self._refusal(now) or self.goals.accept_arrangement(asked, token, now)
        if isinstance(task, Refused):
            self._log(LogLevel.ERROR, f"arrangement refused ({task.code}): {task.sentence}")
            result = ArrangeObjects.Result(error_code=task.code, error_msg=task.sentence)
            self._effects.append(Answer(token, result))
        else:
            self._begin(task, now)

    def _refusal(self, now: Now) -> Refused | None:
        """Why no goal is taken at present; None when one is."""
        if not self._active:
            return Refused(ErrorCode.NOT_ACTIVE, "the planner is not active; activate it first")
        fault = self._monitor.fault()
        if fault is not None:
            return Refused(fault[0], f"the cell is faulted: {fault[1]}")
        return None

    def _refuse(self, refused: Refused, request: Request, now: Now) -> None:
        """Report a goal that is not taken."""
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
        result = PositionObject.Result(
            error_code=code,
            error_msg=sentence,
            residual_distance=math.nan,
            residual_rotation=math.nan,
        )
        self._effects.append(Answer(request.token, result))

    def _begin(self, task: Task, now: Now) -> None:
        if self._task is not None:
            self._end_tap(now)
            self._finish(
                S.CANCELED, ErrorCode.GOAL_REPLACED, "a newer goal took this one's place", now
            )
        self._task = task
        self._monitor.watch(task.object_id if isinstance(task, ArrangementTask) else "")
        self._keep_goal(task, now)
        self._log(LogLevel.INFO, task.description())
        self._enter(Event.GOAL_ACCEPTED, S.WAITING_FOR_CELL, now, self._settings.ready_deadline)

    def _keep_goal(self, task: Task, now: Now) -> None:
        """Keep the goal over a crash."""
        if task.resumable and self._settings.resume_within > 0:
            content = {
                "goal": list(task.goal),
                "tolerance": list(task.tolerance),
                "max_taps": task.max_taps,
                "time_left": task.expires - now.steady,
                "ask": self._asks(task),
                "object_id": task.object_id,
            }
            self._effects.append(KeepGoal(content))

    def _asks(self, task: Task | None) -> bool:
        """Whether a person confirms the taps: of a goal, or of the next one."""
        return self._ask or (task is not None and task.ask)

    def _change_ask(self, ask: bool, now: Now) -> None:
        """Ask before the taps that are planned from now on, or do not. A tap that was proposed
        still waits for its answer."""
        self._ask = ask
        if self._task is not None:
            self._keep_goal(self._task, now)
        if self._active:
            self._report(now, self.last.error_code, self.last.error_msg)

    def _recall(self, event: Configured, now: Now) -> None:
        """Resume the goal of a planner that crashed a moment ago."""
        kept = event.kept_goal
        assert kept is not None
        self._effects.append(KeepGoal(None))
        if not 0 <= event.kept_goal_age <= self._settings.resume_within:
            return
        try:
            message = PoseStamped(pose=to_message(Pose(*map(float, kept["goal"]))))
            position, angle = (float(value) for value in kept["tolerance"])
            limit = max(float(kept["time_left"]) - event.kept_goal_age, 1.0)
            taps, ask = int(kept["max_taps"]), bool(kept["ask"])
            name = str(kept["object_id"])
        except (KeyError, TypeError, ValueError, OverflowError):
            self._log(LogLevel.WARNING, "the goal kept over the crash cannot be read")
            return
        message.header.frame_id = "table"
        self._resumed = Request(message, position, angle, taps, limit, ask=ask, object_id=name)

    # The cycle

    def _advance(self, now: Now) -> None:
        """Do what is due in the present state."""
        if not self._active:
            return
        if self._resumed is not None:
            request, self._resumed = self._resumed, None
            self._log(LogLevel.WARNING, "resuming the goal of a planner that crashed")
            self._on_goal(request, now)
        task = self._task
        if task is None:
            return
        if now.steady > task.expires:
            self._fail(
                ErrorCode.DEADLINE_EXCEEDED,
                f"the goal was not reached within its time limit, {len(task.records)} taps were"
                f" made; last state: {self.state.value}. Send it again with a longer time limit",
                now,
            )
            return
        {
            S.WAITING_FOR_CELL: self._wait_for_cell,
            S.LOOKING: self._look,
            S.PLANNING: self._wait_for_computation,
            S.CONFIRMING: self._wait_for_person,
            S.PLACING: self._wait_for_arm,
            S.FIRING: self._wait_for_tapper,
            S.SETTLING: self._wait_for_withdrawal,
        }[self.state](task, now)

    def _wait_for_cell(self, task: Task, now: Now) -> None:
        """Wait until arm, tapper and camera are ready; end a tap that a restart left behind."""
        missing = self._monitor.missing(now)
        if missing is None:
            self._look_after = now.steady
            self._enter(Event.CELL_READY, S.LOOKING, now, self._settings.look_deadline)
            return
        orphan = self._monitor.left_behind()
        if orphan:
            self._withdraw(orphan, now)
        if self._late(now):
            code, sentence = missing
            self._fail(code, f"the cell was not ready: {sentence}", now)

    def _look(self, task: Task, now: Now) -> None:
        """Observe the object at rest, take in the last tap, decide on the next."""
        needed = self._settings.frames_needed
        observed = task.observed(self._monitor, self._look_after, needed, now)
        seen = self._monitor.object
        if seen is None or not observed:
            if self._monitor.silent("object", now):
                # Its node may be on the way back: it has as long as any part of the cell.
                self._wait_again(now)
            elif self._hidden_by_arm(now):
                self._park(now)
                self._parking_until = now.steady + PARKING_S
                deadline = self._settings.withdraw_deadline
                self._enter(Event.HIDDEN, S.SETTLING, now, deadline)
            elif self._late(now):
                self._fail(*self._monitor.blind(self._settings.look_deadline, needed, now), now)
            return
        if not task.ready:
            # The goal's own time limit ends this, if nothing does.
            self._deadline = now.steady + self._settings.look_deadline
            return
        unknown = self.goals.update_free_space(task, self._look_after, now)
        if unknown is not None:
            if self._late(now):
                self._fail(*unknown, now)
            return
        shot, self._shot = self._shot, None
        if shot is not None and shot.outcome != TapperState.NOT_FIRED:
            task.take_in(shot, seen)
            warning = task.session.edge_warning(from_message(seen.pose.pose))
            if warning:
                self._log(LogLevel.WARNING, warning)
        task.arm = self._monitor.tip
        frames = 0 if self._late(now) else needed
        computation = task.computation(frames)
        if computation is None:
            self._act(task, task.decide(seen, frames), seen, now)
            return
        # Beside the machine, which goes on telling that it is there.
        self._computation += 1
        self._effects.append(RunJob(Job(self._computation, "plan", lambda _: computation())))
        self._enter(Event.OBSERVED, S.PLANNING, now, self._deadline - now.steady)

    def _wait_for_computation(self, task: Task, now: Now) -> None:
        """The goal's own time limit ends this, if nothing does."""
        fault = self._monitor.fault()
        if fault is not None:
            self._fail(*fault, now)

    def _look_on(self, now: Now) -> None:
        """The observation gets longer with every image."""
        if self.state is S.PLANNING:
            self._enter(Event.LOOK_WANTED, S.LOOKING, now, self._deadline - now.steady)

    def _act(self, task: Task, decision: Decision, seen: ObjectState, now: Now) -> None:
        """Do what was decided on what was seen."""
        if isinstance(task, ArrangementTask):
            self._turn_to_object(task)
        if isinstance(decision, LookAgain):
            self._look_on(now)
            return
        if isinstance(decision, Refusal):
            # An observation that is too uncertain gets better with every image.
            if decision.reason is not RefusalReason.CAMERA_TOO_COARSE or self._late(now):
                self._fail(REFUSALS[decision.reason], decision.sentence, now)
            else:
                self._look_on(now)
            return
        if self.state is S.LOOKING:
            self._enter(Event.OBSERVED, S.PLANNING, now)
        if isinstance(decision, Done):
            self._finish(
                S.IDLE if isinstance(task, SingleTapTask) else S.REACHED, ErrorCode.NONE, "", now
            )
            return
        trouble = self._exhausted(task)
        if trouble is not None:
            self._fail(*trouble, now)
        elif self._monitor.missing(now) is not None:
            self._wait_again(now)
        else:
            self._plan(task, decision, task.before(seen), now)

    def _turn_to_object(self, task: ArrangementTask) -> None:
        """Watch the object in hand from now on; tell of one that another one has touched."""
        self._monitor.watch(task.object_id)
        names, task.touched = task.touched, []
        if names:
            self._log(
                LogLevel.WARNING,
                f"{', '.join(map(repr, names))} moved although another object was tapped; planning "
                "anew",
            )

    def _exhausted(self, task: Task) -> Trouble | None:
        """Why no further tap is tried; None when one is."""
        if task.without_effect >= self._settings.attempts:
            return (
                ErrorCode.TAP_WITHOUT_EFFECT,
                f"{task.without_effect} taps in a row moved the object by less than"
                f" {100 * LEAST_EFFECT:.0f} % of what was wanted; check that the striker reaches it"
                " at the right height, and calibrate arm and tapper",
            )
        if len(task.records) >= task.max_taps:
            return (
                ErrorCode.TAP_LIMIT_REACHED,
                f"{len(task.records)} taps did not bring the object to the goal, the limit is"
                f" {task.max_taps}; {1000 * self.last.residual_distance:.2f} mm and"
                f" {math.degrees(self.last.residual_rotation):.2f} deg remain",
            )
        return None

    def _plan(self, task: Task, strike: Strike, before: Pose, now: Now) -> None:
        """Make or propose one tap, under an id that was never used before."""
        # Whole seconds of the clock: ids rise over restarts of every node, and fit the tapper's
        # 32 bits until 2106. What arm and tapper have served already counts where a clock was set
        # back.
        self._last_tap_id = max(
            self._last_tap_id + 1, now.ros // NANOSECONDS, self._monitor.last_tap_id() + 1
        )
        covariance = task.session.predicted_covariance(strike, before)
        shot = Shot(
            self._last_tap_id, task.object_id, len(task.records) + 1, strike, before, covariance
        )
        if strike.detour:
            self._log(LogLevel.INFO, f"tap {shot.number}: {strike.detour}")
        if not self._asks(task):
            self._command(shot, now)
            return
        patience = self._settings.confirm_deadline
        self._proposed, self._answer_by = shot, now.ros + round(patience * NANOSECONDS)
        self._log(LogLevel.INFO, f"tap {shot.number} waits for confirmation (id {shot.tap_id})")
        self._enter(Event.TAP_PROPOSED, S.CONFIRMING, now, patience)

    def _command(self, shot: Shot, now: Now) -> None:
        """Publish one tap."""
        self._shot, self._proposed = shot, None
        allowance = self._settings.place_deadline + self._settings.fire_deadline
        expiry = now.ros + round(allowance * NANOSECONDS)
        height = self.goals.cell.strike_height
        self._effects.append(Publish("tap_command", shot.command(now.ros, expiry, height)))
        if self._has_arm:
            self._enter(Event.TAP_COMMANDED, S.PLACING, now, self._settings.place_deadline)
        else:
            self._enter(Event.TAP_COMMANDED, S.FIRING, now, self._settings.fire_deadline)

    def _wait_for_person(self, task: Task, now: Now) -> None:
        """A person looks at the proposed tap; the plan holds as long as the object stays."""
        shot = self._proposed
        assert shot is not None
        fault = self._monitor.fault()
        if fault is not None:
            self._fail(*fault, now)
        elif self._monitor.lost(now):
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
        """A person's answer: only for the tap that is proposed now, as it was proposed."""
        if self._task is not None:
            self._advance(now)  # what was heard, or is overdue, comes first
        shot, task = self._proposed, self._task
        if shot is None or task is None or shot.tap_id != asked.tap_id:
            waiting = f"tap {shot.tap_id} does" if shot is not None else "none does"
            return ConfirmTap.Response(
                error_code=ErrorCode.TAP_NOT_AWAITED,
                error_msg=f"tap {asked.tap_id} does not wait for confirmation, {waiting}; look at "
                "what is shown now and answer for that",
            )
        if not asked.confirm:
            task.session.skip(shot.strike)
            self._drop_proposal("it was skipped", now)
            return ConfirmTap.Response(accepted=True)
        missing = self._monitor.missing(now)
        needed = self._settings.frames_needed
        if missing is not None:
            self._wait_again(now)
        elif not task.observed(self._monitor, self._look_after, needed, now):
            missing = self._monitor.blind(0.0, needed, now)
            self._drop_proposal("the object is not seen at rest", now)
        else:
            self._command(shot, now)
            return ConfirmTap.Response(accepted=True)
        code, sentence = missing
        return ConfirmTap.Response(
            error_code=code, error_msg=f"tap {shot.number} is planned anew: {sentence}"
        )

    def _drop_proposal(self, why: str, now: Now) -> None:
        """Observe the object again and plan another tap in place of the proposed one."""
        shot, self._proposed = self._proposed, None
        assert shot is not None
        self._log(LogLevel.INFO, f"tap {shot.number} (id {shot.tap_id}) is planned anew: {why}")
        self._look_after = now.steady
        self._enter(Event.TAP_DROPPED, S.LOOKING, now, self._settings.look_deadline)

    def _wait_for_arm(self, task: Task, now: Now) -> None:
        """The arm brings the striker to its strike pose; the tapper waits for it."""
        shot = self._shot
        assert shot is not None
        if self._disturbed(shot, now):
            self._log(LogLevel.WARNING, "an object was moved before the tap; observing again")
            self._give_up(TapperState.NOT_FIRED, now)
        elif self._monitor.outcome(shot.tap_id) != TapperState.NONE:
            self._take_outcome(task, shot, now)
        elif self._monitor.in_position(shot.tap_id):
            self._enter(Event.IN_POSITION, S.FIRING, now, self._settings.fire_deadline)
        else:
            self._check_cell(
                ErrorCode.ARM_TIMEOUT,
                "the striker was not at its strike pose within"
                f" {self._settings.place_deadline:.0f} s",
                now,
            )

    def _wait_for_tapper(self, task: Task, now: Now) -> None:
        """The tapper charges and fires once."""
        shot = self._shot
        assert shot is not None
        if self._monitor.outcome(shot.tap_id) != TapperState.NONE:
            self._take_outcome(task, shot, now)
        elif self._disturbed(shot, now):
            # It may be the tap itself, seen before the tapper's report: withdrawing is right in
            # both cases, and the outcome stays what the tapper tells.
            self._withdraw(shot.tap_id, now)
        if self.state is S.FIRING and (self._late(now) or self._monitor.lost(now)):
            self._log(LogLevel.WARNING, "the tap's outcome is not known; observing the object")
            self._give_up(TapperState.UNKNOWN, now)

    def _take_outcome(self, task: Task, shot: Shot, now: Now) -> None:
        """Take in the outcome that the tapper told."""
        tapper = self._monitor.tapper_of(shot.tap_id)
        assert tapper is not None
        shot.outcome = self._monitor.outcome(shot.tap_id)
        shot.measured_speed = tapper.measured_speed
        shot.fired_at = now.ros
        self._withdraw(shot.tap_id, now)
        task.not_fired = task.not_fired + 1 if shot.outcome == TapperState.NOT_FIRED else 0
        if shot.outcome == TapperState.NOT_FIRED:
            code, sentence = tapper.error_code, tapper.error_msg
            if not code:
                code, sentence = WITHDRAWN_BY_ANOTHER
            self._log(LogLevel.WARNING, f"tap not fired: {sentence}")
            if task.not_fired >= self._settings.attempts:
                self._fail(code, sentence, now)
                return
        self._enter(Event.OUTCOME_TOLD, S.SETTLING, now, self._settings.withdraw_deadline)

    def _wait_for_withdrawal(self, task: Task, now: Now) -> None:
        """The arm gives the camera a free view."""
        shot = self._shot
        if shot is not None:
            # What the tapper tells later of a tap whose outcome was not known.
            shot.outcome = self._monitor.outcome(shot.tap_id) or shot.outcome
        if self._monitor.withdrawn(now) and now.steady >= self._parking_until:
            self._look_after = now.steady
            self._enter(Event.WITHDRAWN, S.LOOKING, now, self._settings.look_deadline)
            return
        self._check_cell(
            ErrorCode.ARM_TIMEOUT,
            f"the {'arm did not withdraw' if self._has_arm else 'striker was not back'} within"
            f" {self._settings.withdraw_deadline:.0f} s",
            now,
        )

    def _check_cell(self, code: int, sentence: str, now: Now) -> None:
        """End a wait for arm or tapper: by a fault, a lost driver, the deadline."""
        fault = self._monitor.fault()
        if fault is not None:
            self._fail(*fault, now)
        elif self._monitor.lost(now):
            self._wait_again(now)
        elif self._late(now):
            self._fail(code, sentence + "; check the arm, then send the goal again", now)

    def _wait_again(self, now: Now) -> None:
        """A part of the cell is not there: end the tap, wait for the cell."""
        self._end_tap(now)
        self._proposed = None
        deadline = self._settings.ready_deadline
        self._enter(Event.CELL_NOT_READY, S.WAITING_FOR_CELL, now, deadline)

    def _disturbed(self, shot: Shot, now: Now) -> bool:
        """True when the object, or another one, was moved since the tap was planned."""
        limits = self._settings.moved_limit, self._settings.turned_limit
        if self._monitor.seen_away_from(shot.before, *limits):
            return True
        if isinstance(self._task, ArrangementTask):
            return self._task.others_moved(self._monitor, *limits)
        return self.goals.others_moved(now)

    def _give_up(self, outcome: int, now: Now) -> None:
        """Give up the tap under way and have the arm withdraw."""
        shot = self._shot
        assert shot is not None
        shot.outcome = outcome
        self._withdraw(shot.tap_id, now)
        self._enter(Event.GIVEN_UP, S.SETTLING, now, self._settings.withdraw_deadline)

    def _end_tap(self, now: Now) -> None:
        """Withdraw the tap under way, if there is one; whether it was fired is observed later."""
        shot = self._shot
        if shot is None or self.state not in TAPPING:
            return
        self._withdraw(shot.tap_id, now)
        if shot.outcome == TapperState.NONE:
            placing = self.state is S.PLACING
            shot.outcome = TapperState.NOT_FIRED if placing else TapperState.UNKNOWN

    def _withdraw(self, tap_id: int, now: Now) -> None:
        """Command, once, that this tap is over."""
        if tap_id == self._withdrawn_tap_id:
            return
        self._withdrawn_tap_id = tap_id
        self._publish_withdrawal(tap_id, now)

    def _publish_withdrawal(self, tap_id: int, now: Now) -> None:
        command = TapCommand(request=TapCommand.WITHDRAW, tap_id=tap_id)
        command.header.stamp = to_stamp(now.ros)
        command.header.frame_id = "table"
        self._effects.append(Publish("tap_command", command))

    def _hidden_by_arm(self, now: Now) -> bool:
        """True when the object should be seen and is not, and the arm may have to park."""
        if not self._has_arm or self._withdrawn_tap_id in (0, self._parked_tap_id):
            return False
        looked = now.steady - self._look_after
        return min(looked, self._monitor.unseen_for(now)) > HIDDEN_S

    def _park(self, now: Now) -> None:
        """Send the arm on to its park pose: a second withdrawal says so."""
        tap_id = self._withdrawn_tap_id
        if not self._has_arm or tap_id in (0, self._parked_tap_id):
            return
        self._parked_tap_id = tap_id
        self._publish_withdrawal(tap_id, now)

    # States and their ends

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
        """End the goal; whoever sent it as an action gets its result."""
        task = self._task
        assert task is not None
        event = {S.FAILED: Event.GOAL_FAILED, S.CANCELED: Event.GOAL_CANCELED}.get(
            state, Event.GOAL_MET
        )
        self._machine.move(event, state)
        self._proposed = None
        if self._shot is not None:
            task.lose(self._shot)
        task.end(code, sentence)
        self._report(now, code, sentence)
        seen = self._monitor.object
        self._task = self._shot = None
        self._monitor.watch("")
        self._park(now)
        self._effects.append(KeepGoal(None))
        try:
            self.goals.learn(task)
        except OSError as error:
            self._log(LogLevel.WARNING, f"what was learnt of the object was not kept: {error}")
        if code:
            self._log(LogLevel.ERROR, f"goal ended ({code}): {sentence}")
        else:
            self._log(LogLevel.INFO, f"goal done after {len(task.records)} taps")
        if task.token is not None:
            result = task.result(code, sentence, self.last, seen)
            self._effects.append(Answer(task.token, result))

    # Reports

    def _report(
        self, now: Now, code: int = ErrorCode.NONE, sentence: str = "", draw: bool = True
    ) -> None:
        """Publish the state with its error code and sentence, and what is known."""
        self._reported_at = now.steady if draw else self._reported_at
        task, pose = self._task, self._monitor.pose
        state = PlanState(state=WIRE[self.state], error_code=code, error_msg=sentence)
        state.header.stamp = to_stamp(now.ros)
        state.header.frame_id = "table"
        state.residual_distance = state.residual_rotation = math.nan
        state.learnt = self._known_of_the_object()
        state.ask = self._asks(task)
        planned = self._proposed or self._shot
        if planned is not None and self.state in (S.CONFIRMING, *TAPPING):
            by = self._answer_by if self._proposed is not None else 0
            state.planned_tap = planned.planned(by, self.goals.cell.strike_height)
        if task is not None:
            task.fill(state, pose)
            if task.token is not None:
                self._effects.append(Feedback(task.token, task.feedback(state)))
        elif self.state in FINAL:
            for name in REMEMBERED:
                setattr(state, name, getattr(self.last, name))
        self.last = state
        self._effects.append(Publish("plan_state", state))
        if isinstance(task, ArrangementTask) and draw:
            active = self.state not in FINAL
            self._effects.append(Publish("arrangement_state", task.report(now, active)))
        if task is not None and self.state in FINAL and state.planner != PRESCRIBED:
            self._effects.append(Publish("goal_report", _final_report(state, task)))
        if draw:
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

    def _known_of_the_object(self) -> LearntGains:
        """What is known of the object now; made again only where it has changed."""
        if not self._configured:
            return LearntGains()
        gains = self._task.session.gains if self._task is not None else self.goals.gains
        if self._learnt[0] is not gains:
            self._learnt = gains, learnt_message(gains)
        return self._learnt[1]

    def _log(self, level: LogLevel, sentence: str) -> None:
        self._effects.append(Log(level, sentence))

    def _drain(self) -> Sequence[Effect]:
        effects, self._effects = self._effects, []
        return effects


def _final_report(state: PlanState, task: Task) -> GoalReport:
    """The report of a goal that has ended."""
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
