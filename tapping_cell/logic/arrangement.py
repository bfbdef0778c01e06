"""An arrangement of several objects, as the planner keeps, decides and reports it.

Which object is tapped next, and how, is decided by ``planning.arrangement``; each of its taps runs
through the planner's machine like any other, with the same checks and waits. Here stands what an
arrangement is besides: the objects that must be seen before each decision, how far each of them is,
and what is told of it.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.poses import covariance_from_message, from_message, to_message
from tapping_cell.logic.task import Shot, Task
from tapping_cell.logic.transitions import StateMachine, table
from tapping_cell.messages import (
    ArrangementState,
    ArrangeObjects,
    ErrorCode,
    ObjectProgress,
    ObjectState,
    PlanState,
    PoseStamped,
    PositionObject,
    SingleTap,
    TapperState,
)
from tapping_cell.planning import Decision, Done, Gains, Refusal
from tapping_cell.planning.arrangement import (
    AllDone,
    ArrangementDecision,
    ArrangementSession,
    Body,
    LookLonger,
    Observation,
    Purpose,
    TapOf,
)
from tapping_cell.planning.stopping import LONG_LOOK
from tapping_cell.se2 import Array, Pose


class Progress(Enum):
    """How far one object is."""

    WAITING = "Waiting"
    ACTIVE = "Active"
    MAKING_WAY = "MakingWay"
    REACHED = "Reached"
    FAILED = "Failed"


class Change(Enum):
    """What moves it on."""

    TAPPED_TO_GOAL = "tapped to its goal"
    TAPPED_AWAY = "tapped out of the way"
    LEFT = "another object is tapped"
    SEEN_AT_GOAL = "seen at its goal"
    GIVEN_UP = "arrangement ended without it"


P = Progress
OPEN = (P.WAITING, P.ACTIVE, P.MAKING_WAY, P.REACHED)
PROGRESS_TABLE = table(
    [
        # An object that was touched by another one, or has to make way, leaves its goal again.
        (OPEN, Change.TAPPED_TO_GOAL, (P.ACTIVE,)),
        (OPEN, Change.TAPPED_AWAY, (P.MAKING_WAY,)),
        (OPEN, Change.LEFT, (P.WAITING,)),
        (OPEN, Change.SEEN_AT_GOAL, (P.REACHED,)),
        ((P.WAITING, P.ACTIVE, P.MAKING_WAY), Change.GIVEN_UP, (P.FAILED,)),
    ]
)
FOLLOWS = {
    Change.TAPPED_TO_GOAL: P.ACTIVE,
    Change.TAPPED_AWAY: P.MAKING_WAY,
    Change.LEFT: P.WAITING,
    Change.SEEN_AT_GOAL: P.REACHED,
    Change.GIVEN_UP: P.FAILED,
}
WIRE = {progress: getattr(ObjectProgress, progress.name) for progress in Progress}


@dataclass(frozen=True, slots=True)
class Wanted:
    """Where one object is to go. ``tolerance`` in m and rad."""

    message: PoseStamped
    goal: Pose
    tolerance: tuple[float, float]


@dataclass(slots=True, eq=False, kw_only=True)
class ArrangementTask(Task):
    """Several objects, each to its place; ``object_id`` and ``goal`` are those of the move under
    way. A planner that crashed in it leaves it."""

    resumable: ClassVar[bool] = False

    wanted: Mapping[str, Wanted]
    """By object, in the order of the request."""
    bodies: Sequence[Body]
    """Every object of the cell."""
    known: Mapping[str, Gains]
    """What earlier goals taught about each."""
    adapt: bool
    in_order: bool
    arrangement: ArrangementSession | None = None
    touched: list[str] = field(default_factory=list)
    """Objects that moved with a tap of another one, since they were last told."""
    _seen: dict[str, Observation] = field(default_factory=dict)
    _states: dict[str, ObjectState] = field(default_factory=dict)
    _tap: TapOf | None = None
    _progress: dict[str, StateMachine[Progress, Change]] = field(default_factory=dict)
    _ended: tuple[int, str] = (ErrorCode.NONE, "")

    def description(self) -> str:
        """The arrangement for people."""
        goals = "; ".join(
            f"'{name}' to x {1000 * one.goal.x:.1f} mm, y {1000 * one.goal.y:.1f} mm, "
            f"{math.degrees(one.goal.theta):.1f} deg"
            for name, one in self.wanted.items()
        )
        return f"arrangement: {goals}"

    def observed(self, monitor: CellMonitor, after: float, frames: int, now: Now) -> bool:
        """Whether every object was seen at rest after a steady time; the monitor then watches the
        object in hand, else the one that is missing. An object that need not be tapped and is not
        on the table is left out from the beginning."""
        found = {}
        for body in self._bodies():
            monitor.watch(body.name)
            if not monitor.usable(after, frames, now):
                state = monitor.object
                absent = state is not None and not state.visible and not body.movable
                if self.arrangement is None and absent and monitor.observed_at(now) > after:
                    continue
                return False
            assert monitor.object is not None
            found[body.name] = monitor.object
        self._states.update(found)
        self._seen = {
            name: Observation(
                from_message(state.pose.pose), covariance_from_message(state.pose.covariance)
            )
            for name, state in found.items()
        }
        monitor.watch(self.object_id)
        return True

    def computation(self, frames: int) -> Callable[[], ArrangementDecision]:
        """Which object is tapped next and how; see ``Task.computation``."""
        if self.arrangement is None:
            present = [body for body in self.bodies if body.name in self._seen]
            self.arrangement = ArrangementSession(
                present,
                gains=self.known,
                adapt=self.adapt,
                order=tuple(self.wanted) if self.in_order else (),
                most_taps=self.max_taps,
            )
        return functools.partial(self._compute, self.arrangement, frames)

    def _compute(self, arrangement: ArrangementSession, frames: int) -> ArrangementDecision:
        decision = arrangement.decide(self._seen, look_again=True)
        self.touched += arrangement.touched
        if isinstance(decision, LookLonger):
            state = self._states[decision.name]
            if state.frames_fused >= LONG_LOOK * frames:
                decision = arrangement.decide(self._seen, look_again=False)
        return decision

    def conclude(self, computed: ArrangementDecision) -> Decision:
        """Take in what was decided; see ``Task.conclude``."""
        assert self.arrangement is not None
        decision = computed
        if isinstance(decision, LookLonger):
            self._turn_to(decision.name)
            return decision.look
        self._take_progress(decision)
        if isinstance(decision, AllDone):
            return Done(decision.residuals[next(iter(self.wanted))], None)
        if isinstance(decision, Refusal):
            return decision
        assert isinstance(decision, TapOf)
        assert self.arrangement.current is not None
        self._tap, self.session = decision, self.arrangement.current
        self._turn_to(decision.name)
        self.goal = decision.move.target
        self.message = _stamped(self.goal)
        settings = self.session.settings
        self.tolerance = settings.tolerance_position, settings.tolerance_angle
        return decision.strike

    def before(self, seen: ObjectState) -> Pose:
        """Where the object in hand lies, by the observation that the decision used."""
        return self._seen[self.object_id].pose

    def others_moved(self, monitor: CellMonitor, distance: float, angle: float) -> bool:
        """Whether an object that is not tapped is seen elsewhere than when the tap was planned."""
        return any(
            monitor.moved(name, observed.pose, distance, angle)
            for name, observed in self._seen.items()
            if name != self.object_id
        )

    def learn(self, shot: Shot, pose: Pose, covariance: Array) -> None:
        """Learn from a tap of the object in hand."""
        assert self.arrangement is not None and self._tap is not None
        after = Observation(pose, covariance)
        self.arrangement.observe(self._tap, Observation(shot.before), after)

    def learnt(self) -> dict[str, Gains]:
        """What the taps taught, by object that was tapped."""
        if self.arrangement is None:
            return {}
        return {
            name: self.arrangement.gains[name]
            for name, taps in self.arrangement.taps.items()
            if taps
        }

    def end(self, code: int, sentence: str) -> None:
        """Keep why it ended."""
        self._ended = (code, sentence)
        if code:
            for name in self._told():
                if self._machine(name).state is not P.REACHED:
                    self._change(name, Change.GIVEN_UP)

    # Reports

    def progress(self) -> list[ObjectProgress]:
        """How far every object is."""
        return [self._progress_of(name) for name in self._told()]

    def report(self, now: Now, active: bool) -> ArrangementState:
        """How far the arrangement is."""
        code, sentence = self._ended
        state = ArrangementState(
            active=active,
            objects=self.progress(),
            taps=len(self.records),
            error_code=code,
            error_msg=sentence,
        )
        state.header.stamp = to_stamp(now.ros)
        state.header.frame_id = "table"
        return state

    def feedback(
        self, state: PlanState
    ) -> PositionObject.Feedback | SingleTap.Feedback | ArrangeObjects.Feedback:
        """The action's feedback."""
        return ArrangeObjects.Feedback(plan_state=state, objects=self.progress())

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """The action's result."""
        return ArrangeObjects.Result(
            error_code=code,
            error_msg=sentence,
            objects=self.progress(),
            taps=len(self.records),
            records=self.records,
        )

    def lose(self, shot: Shot) -> None:
        """Keep a record of the tap, if it was or may have been fired."""
        if shot.outcome in (TapperState.FIRED, TapperState.UNKNOWN):
            self.records.append(shot.record(None, self.session.gains))

    def _bodies(self) -> Sequence[Body]:
        return self.bodies if self.arrangement is None else self.arrangement.bodies

    def _turn_to(self, name: str) -> None:
        """Take an object in hand: the camera follows it, and states tell of it."""
        self.object_id = name
        if name in self.wanted:
            self.goal, self.message = self.wanted[name].goal, self.wanted[name].message
            self.tolerance = self.wanted[name].tolerance

    def _take_progress(self, decision: ArrangementDecision) -> None:
        assert self.arrangement is not None
        tapped = decision.name if isinstance(decision, TapOf) else ""
        for name in (*self.wanted, *(n for n in self._progress if n not in self.wanted), tapped):
            if isinstance(decision, TapOf) and name == tapped and name:
                away = decision.move.purpose is Purpose.MAKE_WAY
                self._change(name, Change.TAPPED_AWAY if away else Change.TAPPED_TO_GOAL)
            elif name in self.arrangement.finished:
                self._change(name, Change.SEEN_AT_GOAL)
            elif name:
                self._change(name, Change.LEFT)

    def _machine(self, name: str) -> StateMachine[Progress, Change]:
        return self._progress.setdefault(name, StateMachine(PROGRESS_TABLE, P.WAITING))

    def _change(self, name: str, change: Change) -> None:
        self._machine(name).move(change, FOLLOWS[change])

    def _told(self) -> list[str]:
        """Objects with a goal in the order of the request, then those that made way."""
        return [*self.wanted, *(name for name in self._progress if name not in self.wanted)]

    def _progress_of(self, name: str) -> ObjectProgress:
        progress, wanted = self._machine(name).state, self.wanted.get(name)
        told = ObjectProgress(
            object_id=name,
            state=WIRE[progress],
            has_goal=wanted is not None,
            residual_distance=math.nan,
            residual_rotation=math.nan,
            taps=0 if self.arrangement is None else self.arrangement.taps.get(name, 0),
        )
        state = self._states.get(name)
        if state is not None:
            told.pose = state.pose
        if wanted is not None:
            told.goal_pose = to_message(wanted.goal)
            if state is not None:
                pose = from_message(state.pose.pose)
                told.residual_distance = pose.distance_to(wanted.goal)
                told.residual_rotation = pose.rotation_to(wanted.goal)
        if progress is P.FAILED:
            told.error_code, told.error_msg = self._ended
        return told


@dataclass(slots=True, eq=False, kw_only=True)
class AmongOthersTask(ArrangementTask):
    """A goal of one object that is not the cell's own: an arrangement of one, which the others
    stay out of."""

    resumable: ClassVar[bool] = True

    def description(self) -> str:
        """The goal for people."""
        return f"'{self.object_id}': {Task.description(self)}"

    def feedback(
        self, state: PlanState
    ) -> PositionObject.Feedback | SingleTap.Feedback | ArrangeObjects.Feedback:
        """The action's feedback."""
        return Task.feedback(self, state)

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """The action's result."""
        return Task.result(self, code, sentence, last, seen)


def _stamped(pose: Pose) -> PoseStamped:
    message = PoseStamped(pose=to_message(pose))
    message.header.frame_id = "table"
    return message
