"""Messages in which the planner reports its state, its goal and the end of the goal."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.confirmation import Confirmations
from tapping_cell.logic.effects import Effect, Feedback, Publish
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.goal_validation import Refused
from tapping_cell.logic.learnt import to_message as learnt_message
from tapping_cell.logic.planner_states import FINAL, TAPPING, WIRE, State
from tapping_cell.logic.poses import from_message
from tapping_cell.logic.task import Shot, Task
from tapping_cell.messages import ArrangementState, ErrorCode, GoalReport, LearntGains, PlanState
from tapping_cell.planning import Gains, KeepOut, Strike
from tapping_cell.planning.prescribed import METHOD as PRESCRIBED
from tapping_cell.se2 import Pose

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
OF_THE_GOAL = (
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
)
"""Fields of the last ``plan_state`` of a goal that its ``goal_report`` repeats."""


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


@dataclass(frozen=True, slots=True)
class Subject:
    """What is reported: the state, and the goal and the tap of this state."""

    state: State
    task: Task | None = None
    shot: Shot | None = None
    """Proposed tap, or last tap whose result has not been observed."""
    answer_by: int = 0
    """Deadline for a person's answer, ROS time in ns; 0 if none is awaited."""


class PlanReports:
    """Makes the reports."""

    def __init__(self, monitor: CellMonitor, confirmations: Confirmations) -> None:
        self._monitor = monitor
        self._confirmations = confirmations
        self._reported_at = -math.inf
        self._learnt: tuple[Gains | None, LearntGains] = (None, LearntGains())
        """The gains that were reported last, and their message, which is computed only once."""
        self.last = PlanState(residual_distance=math.nan, residual_rotation=math.nan)
        """Last published ``plan_state``."""

    def quiet_for(self, now: Now) -> float:
        """Return the time since the last complete report, s."""
        return now.steady - self._reported_at

    def report(
        self,
        subject: Subject,
        goals: GoalHandling | None,
        now: Now,
        code: int = ErrorCode.NONE,
        sentence: str = "",
        draw: bool = True,
    ) -> Iterator[Effect]:
        """Publish the state with its error code and message. ``goals``: None before the planner is
        configured; ``draw``: also publish the markers."""
        self._reported_at = now.steady if draw else self._reported_at
        task, shot, is_final = subject.task, subject.shot, subject.state in FINAL
        # While the monitor watches another object, of which an observation is missing, the report
        # is still about the present object.
        pose = self._monitor.pose_of("" if task is None else task.object_id)
        state = PlanState(state=WIRE[subject.state], error_code=code, error_msg=sentence)
        state.header.stamp = to_stamp(now.ros)
        state.header.frame_id = "table"
        state.residual_distance = state.residual_rotation = math.nan
        state.learnt = self._learnt_gains(task, goals)
        state.ask = self._confirmations.asks(task)
        announced = subject.state in (State.CONFIRMING, *TAPPING)
        if shot is not None and goals is not None and announced:
            state.planned_tap = shot.planned(subject.answer_by, goals.cell.strike_height)
        if task is not None:
            task.fill(state, pose)
            changed = (state.state, state.taps) != (self.last.state, self.last.taps)
            if task.token is not None and changed:
                yield Feedback(task.token, task.feedback(state))
        elif is_final:
            for name in REMEMBERED:
                setattr(state, name, getattr(self.last, name))
        self.last = state
        progress = None if task is None or not draw else task.progress_report(now, not is_final)
        if progress is not None:
            # Published before `plan_state`, so that a recorder knows that the goal belongs to an
            # arrangement.
            yield Publish("arrangement_state", progress)
        yield Publish("plan_state", state)
        if task is not None and is_final and state.planner != PRESCRIBED:
            yield Publish("goal_report", _final_report(state, task))
        if draw and goals is not None:
            strike = None if shot is None else shot.strike
            yield Publish("markers", _scene(state, pose, task, strike, goals))

    def _learnt_gains(self, task: Task | None, goals: GoalHandling | None) -> LearntGains:
        """Return the learnt corrections of the object's model as a message; the message is cached
        until they change."""
        if goals is None:
            return LearntGains()
        gains = goals.gains if task is None else task.session.gains
        if self._learnt[0] is not gains:
            self._learnt = gains, learnt_message(gains)
        return self._learnt[1]


def _scene(
    state: PlanState,
    pose: Pose | None,
    task: Task | None,
    strike: Strike | None,
    goals: GoalHandling,
) -> Scene:
    records = () if task is None else task.records
    path = tuple(from_message(record.object_pose) for record in records)
    return Scene(state, pose, None if task is None else task.goal, strike, path, goals.others)


def no_arrangement(now: Now) -> ArrangementState:
    """Return the state of a planner that has just been activated."""
    state = ArrangementState()
    state.header.stamp = to_stamp(now.ros)
    state.header.frame_id = "table"
    return state


def refusal_report(refused: Refused, request: Request, now: Now) -> GoalReport:
    """Return the report of a goal that was refused."""
    report = GoalReport(
        refused=True,
        state=PlanState.FAILED,
        object_id=request.object_id,
        goal=request.message,
        position_tolerance=request.position_tolerance,
        angle_tolerance=request.angle_tolerance,
        residual_distance=math.nan,
        residual_rotation=math.nan,
        error_code=refused.code,
        error_msg=refused.sentence,
    )
    report.header.stamp = to_stamp(now.ros)
    report.header.frame_id = "table"
    return report


def _final_report(state: PlanState, task: Task) -> GoalReport:
    """Return the report of a goal that has ended."""
    report = GoalReport(header=state.header, state=state.state, records=task.records)
    for name in OF_THE_GOAL:
        setattr(report, name, getattr(state, name))
    return report
