"""The planner's task of arranging several objects: it tracks and reports each object's progress.

``planning.arrangement`` decides which object is tapped next and how. The planner's state machine
executes each of these taps like any other tap, with the same checks and waits. This module
determines which objects must be seen before a decision.
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
)
from tapping_cell.planning import Decision, Done, Gains, KeepOut, Refusal, Strike
from tapping_cell.planning.arrangement import (
    AllDone,
    ArrangementDecision,
    ArrangementSession,
    Body,
    Observation,
    ObserveLonger,
    Purpose,
    TapOf,
)
from tapping_cell.planning.stopping import LONG_OBSERVATION
from tapping_cell.se2 import Array, Pose


class Progress(Enum):
    """Progress of one object."""

    WAITING = "Waiting"
    ACTIVE = "Active"
    MAKING_WAY = "MakingWay"
    REACHED = "Reached"
    FAILED = "Failed"


class Change(Enum):
    """Events that change the progress of an object."""

    TAPPED_TO_GOAL = "tapped to its goal"
    TAPPED_AWAY = "tapped out of the way"
    LEFT = "not at its goal, and another object is tapped"
    SEEN_AT_GOAL = "seen at its goal"
    GIVEN_UP = "arrangement ended without it"


P = Progress
OPEN = (P.WAITING, P.ACTIVE, P.MAKING_WAY, P.REACHED)
PROGRESS_TABLE = table(
    [
        # An object can leave its goal again, because another object or a person touched it or
        # because it must make way for another object.
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
class RequestedGoal:
    """Goal of one object. ``tolerance`` in m and rad."""

    message: PoseStamped
    goal: Pose
    tolerance: tuple[float, float]


@dataclass(slots=True, eq=False, kw_only=True)
class ArrangementTask(Task):
    """Task of moving several objects to their goals. ``object_id`` and ``goal`` belong to the
    object that is moved at present. After a crash, the planner does not resume this task."""

    resumable: ClassVar[bool] = False

    wanted: Mapping[str, RequestedGoal]
    """Goals by name of the object, in the order of the request."""
    bodies: Sequence[Body]
    """All objects of the cell."""
    known: Mapping[str, Gains]
    """Corrections of the model for each object, learnt in earlier goals."""
    adapt: bool
    in_order: bool
    memory: float = 0.0
    """Time after which an unseen object that must not be moved counts as removed, s."""
    obstacles: Sequence[KeepOut] = ()
    """Areas on the table that belong to no object of the cell."""
    arrangement: ArrangementSession | None = None
    _seen: dict[str, Observation] = field(default_factory=dict)
    _states: dict[str, ObjectState] = field(default_factory=dict)
    _tap: TapOf | None = None
    _progress: dict[str, StateMachine[Progress, Change]] = field(default_factory=dict)
    _ended: tuple[int, str] = (ErrorCode.NONE, "")

    def description(self) -> str:
        """Return a readable description of the arrangement."""
        goals = "; ".join(
            f"'{name}' to x {1000 * one.goal.x:.1f} mm, y {1000 * one.goal.y:.1f} mm, "
            f"{math.degrees(one.goal.theta):.1f} deg"
            for name, one in self.wanted.items()
        )
        return f"arrangement: {goals}"

    @property
    def purpose(self) -> str:
        """Why the present object is tapped now."""
        if self._tap is None:
            return ""
        move = self._tap.move
        away = move.purpose is Purpose.MAKE_WAY
        return f"'{move.name}' {'makes way' if away else 'goes to its goal'}: {move.reason}"

    def observed(self, monitor: CellMonitor, after: float, frames: int, now: Now) -> bool:
        """Return whether every object was seen at rest after the steady time ``after``.

        If every object was seen, the monitor watches the present object after this call; otherwise
        it watches the first object that was not seen. An object that must not be moved and has not
        been seen for longer than ``memory``, although the arm did not hide it, counts as removed
        until it is seen again. A hand may hide it for a shorter time.
        """
        found = {}
        for body in self.bodies:
            monitor.watch(body.name)
            if not monitor.usable(after, frames, now):
                state = monitor.object
                absent = state is not None and not state.visible and not body.movable
                absent = absent and monitor.missing_for(now) > self.memory
                if absent and monitor.observed_at(now) > after:
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
        self._notice_departures()
        monitor.watch(self.object_id)
        return True

    def _notice_departures(self) -> None:
        """Mark objects that are no longer at their goals, because a person moved or turned them. An
        arrangement that ends before the next decision must not report them at their goals."""
        for body in self.bodies:
            if body.goal is None or body.name not in self._seen:
                continue
            reached = self._machine(body.name).state is P.REACHED
            if reached and not body.is_at_goal(self._seen[body.name].pose):
                self._change(body.name, Change.LEFT)

    def avoid(self, obstacles: Sequence[KeepOut]) -> None:
        """Avoid these areas from the next decision on."""
        if obstacles != self.obstacles:
            self.obstacles = obstacles
            if self.arrangement is not None:
                self.arrangement.avoid(obstacles)

    def computation(self, frames: int) -> Callable[[], ArrangementDecision]:
        """Return the job that decides which object to tap and how; see ``Task.computation``."""
        bodies = [body for body in self.bodies if body.name in self._seen]
        if self.arrangement is None:
            self.arrangement = ArrangementSession(
                bodies,
                gains=self.known,
                adapt=self.adapt,
                order=tuple(self.wanted) if self.in_order else (),
                most_taps=self.max_taps,
                obstacles=self.obstacles,
            )
        elif self._seen.keys() != {body.name for body in self.arrangement.bodies}:
            # An object was put on the table, or was taken away.
            self.arrangement.set_bodies(bodies)
        return functools.partial(self._compute, self.arrangement, frames)

    def _compute(self, arrangement: ArrangementSession, frames: int) -> ArrangementDecision:
        decision = arrangement.decide(self._seen, observe_again=True)
        self.touched += arrangement.touched
        if isinstance(decision, ObserveLonger):
            state = self._states[decision.name]
            if state.frames_fused >= LONG_OBSERVATION * frames:
                decision = arrangement.decide(self._seen, observe_again=False)
        return decision

    def conclude(self, computed: ArrangementDecision) -> Decision:
        """Apply the computed decision; see ``Task.conclude``."""
        assert self.arrangement is not None
        decision = computed
        if isinstance(decision, ObserveLonger):
            self._turn_to(decision.name)
            return decision.request
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

    def outdated(
        self, monitor: CellMonitor, computed: ArrangementDecision, distance: float, angle: float
    ) -> bool:
        """Return whether the decision no longer fits the objects; see ``Task.outdated``."""
        if any(
            not monitor.sees_at_rest(name) or monitor.moved(name, observed.pose, distance, angle)
            for name, observed in self._seen.items()
        ):
            return True
        # The tolerance of a goal may be smaller than these limits.
        left = isinstance(computed, AllDone) and self._has_left_goal(monitor)
        return left or self._has_appeared(monitor)

    def _has_left_goal(self, monitor: CellMonitor) -> bool:
        """Return whether an object with a goal is seen outside the tolerance of its goal."""
        goals = self.wanted.items()
        return any(monitor.moved(name, one.goal, *one.tolerance) for name, one in goals)

    def before(self, seen: ObjectState) -> Pose:
        """Return the pose of the present object in the observation that the decision used."""
        return self._seen[self.object_id].pose

    def others_moved(self, monitor: CellMonitor, distance: float, angle: float) -> bool:
        """Return whether an object other than the tapped object has moved or appeared since the tap
        was planned.

        ``distance`` in m and ``angle`` in rad are the limits.
        """
        return any(
            monitor.moved(name, observed.pose, distance, angle)
            for name, observed in self._seen.items()
            if name != self.object_id
        ) or self._has_appeared(monitor)

    def _has_appeared(self, monitor: CellMonitor) -> bool:
        """Return whether an object is seen that was not seen in the last observation."""
        return any(monitor.sees(body.name) for body in self.bodies if body.name not in self._seen)

    def learn(self, shot: Shot, pose: Pose, covariance: Array) -> None:
        """Learn from a tap of the present object."""
        assert self.arrangement is not None and self._tap is not None
        after = Observation(pose, covariance)
        self.arrangement.observe(self._tap, Observation(shot.before), after)

    def skip(self, strike: Strike) -> None:
        """See :class:`Task`."""
        assert self.arrangement is not None and self._tap is not None
        self.arrangement.skip(self._tap)

    def learnt(self) -> dict[str, Gains]:
        """See :class:`Task`."""
        if self.arrangement is None:
            return {}
        return {
            name: self.arrangement.gains[name]
            for name, taps in self.arrangement.taps.items()
            if taps
        }

    def end(self, code: int, sentence: str) -> None:
        """Store why the task ended. After a failure, mark the objects that are not at their goals
        as failed. A repeated call, after an internal error in the end of the task, continues."""
        self._ended = (code, sentence)
        if code:
            for name in self._reported_objects():
                if self._machine(name).state not in (P.REACHED, P.FAILED):
                    self._change(name, Change.GIVEN_UP)

    # Reports

    def progress(self) -> list[ObjectProgress]:
        """Return the progress of every object."""
        return [self._progress_of(name) for name in self._reported_objects()]

    def progress_report(self, now: Now, active: bool) -> ArrangementState | None:
        """Return the message on the progress of the arrangement."""
        code, sentence = self._ended
        state = ArrangementState(
            active=active,
            objects=self.progress(),
            taps=self.taps,
            error_code=code,
            error_msg=sentence,
        )
        state.header.stamp = to_stamp(now.ros)
        state.header.frame_id = "table"
        return state

    def feedback(
        self, state: PlanState
    ) -> PositionObject.Feedback | SingleTap.Feedback | ArrangeObjects.Feedback:
        """Return the action's feedback."""
        return ArrangeObjects.Feedback(
            object_id=state.object_id,
            state=state.state,
            taps=state.taps,
            residual_distance=state.residual_distance,
            residual_rotation=state.residual_rotation,
        )

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """Return the action's result."""
        return ArrangeObjects.Result(
            error_code=code,
            error_msg=sentence,
            objects=self.progress(),
            taps=self.taps,
            records=self.records,
        )

    def _turn_to(self, name: str) -> None:
        """Make ``name`` the present object. This object is observed and reported from now on."""
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

    def _reported_objects(self) -> list[str]:
        """Return the objects with a goal in the order of the request, then the objects that made
        way."""
        return [*self.wanted, *(name for name in self._progress if name not in self.wanted)]

    def _progress_of(self, name: str) -> ObjectProgress:
        progress, wanted = self._machine(name).state, self.wanted.get(name)
        report = ObjectProgress(
            object_id=name,
            state=WIRE[progress],
            has_goal=wanted is not None,
            residual_distance=math.nan,
            residual_rotation=math.nan,
            taps=0 if self.arrangement is None else self.arrangement.taps.get(name, 0),
        )
        state = self._states.get(name)
        if state is not None:
            report.pose = state.pose
        if wanted is not None:
            report.goal_pose = to_message(wanted.goal)
            report.position_tolerance, report.angle_tolerance = wanted.tolerance
            if state is not None:
                pose = from_message(state.pose.pose)
                report.residual_distance = pose.distance_to(wanted.goal)
                report.residual_rotation = pose.rotation_to(wanted.goal)
        if progress is P.FAILED:
            report.error_code, report.error_msg = self._ended
        return report


def _stamped(pose: Pose) -> PoseStamped:
    message = PoseStamped(pose=to_message(pose))
    message.header.frame_id = "table"
    return message
