"""One goal and one tap of it, as the planner keeps and reports them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.effects import Token
from tapping_cell.logic.learnt import to_message as learnt_message
from tapping_cell.logic.poses import (
    covariance_from_message,
    covariance_to_message,
    from_message,
    to_message,
)
from tapping_cell.messages import (
    ArrangeObjects,
    ObjectState,
    PlannedTap,
    PlanState,
    PoseStamped,
    PositionObject,
    SingleTap,
    TapCommand,
    TapperState,
    TapRecord,
)
from tapping_cell.planning import (
    Decision,
    Gains,
    PrescribedSession,
    Strike,
)
from tapping_cell.planning.session import GoalSession
from tapping_cell.planning.stopping import LONG_LOOK
from tapping_cell.se2 import Pose
from tapping_cell.vision import ReferenceMap

Array = NDArray[np.float64]

LEAST_EFFECT = 0.2
"""Share of the wanted distance below which a tap counts as without effect."""


@dataclass(slots=True, eq=False)
class Shot:
    """One tap from its command to its measured result."""

    tap_id: int
    object_id: str
    number: int
    """Its place in its goal, from 1."""
    strike: Strike
    before: Pose
    covariance: Array
    """(3, 3), m and rad: of where the object is expected to come to rest."""
    fired_at: int | None = None
    """When the tapper's report arrived, ROS time in ns."""
    outcome: int = TapperState.NONE
    measured_speed: float = math.nan

    def command(self, now: int, expiry: int, height: float) -> TapCommand:
        """The command of this tap; times in ns, ``height`` of the tip over the table in m."""
        plan = self.strike.plan
        command = TapCommand(
            request=TapCommand.TAP,
            tap_id=self.tap_id,
            tapper=plan.tapper,
            object_id=self.object_id,
            striker_speed=plan.striker_speed,
            expiry=to_stamp(expiry),
            strike_pose=to_message(plan.strike_pose, height),
            object_pose=to_message(self.before),
            predicted_pose=to_message(self.strike.predicted),
        )
        command.header.stamp = to_stamp(now)
        command.header.frame_id = "table"
        return command

    def planned(self, answer_by: int, height: float) -> PlannedTap:
        """This tap before it is made; ``answer_by`` in ns, 0 where nobody is asked."""
        plan = self.strike.plan
        tap = PlannedTap(
            tap_id=self.tap_id,
            object_id=self.object_id,
            number=self.number,
            object_pose=to_message(self.before),
            strike_pose=to_message(plan.strike_pose, height),
            striker_speed=plan.striker_speed,
            reason=self.strike.detour,
            answer_by=to_stamp(answer_by),
        )
        tap.predicted_pose.pose = to_message(self.strike.predicted)
        tap.predicted_pose.covariance = covariance_to_message(self.covariance)
        return tap

    def record(self, seen: ObjectState | None, gains: Gains) -> TapRecord:
        """What is kept of this tap once its result is seen; ``seen`` None: it never was. ``gains``:
        what is known of the object after it."""
        strike = self.strike
        if seen is None:
            seen = ObjectState()
            seen.pose.pose = to_message(Pose(math.nan, math.nan, math.nan))
        record = TapRecord(
            tap_id=self.tap_id,
            tapper=strike.plan.tapper,
            object_id=self.object_id,
            number=self.number,
            planner=strike.method,
            object_pose=to_message(self.before),
            dx=strike.commanded.x,
            dy=strike.commanded.y,
            dtheta=strike.commanded.theta,
            predicted_pose=to_message(strike.predicted),
            predicted_covariance=self.covariance.reshape(-1).tolist(),
            reason=strike.detour,
            measured_pose=seen.pose,
            striker_speed=strike.plan.striker_speed,
            measured_speed=self.measured_speed,
            contact_angle=strike.plan.contact_angle,
            strike_pose=to_message(strike.plan.strike_pose),
            outcome=self.outcome,
            at_rest_at=seen.at_rest_since,
            learnt=learnt_message(gains),
        )
        if self.fired_at is not None:
            record.fired_at = to_stamp(self.fired_at)
        return record


@dataclass(slots=True, eq=False)
class Task:
    """One goal from its acceptance to its end. ``tolerance`` in m and rad."""

    resumable: ClassVar[bool] = True
    """Whether a planner that crashed goes on with it."""

    object_id: str
    """Name of the object."""
    message: PoseStamped
    goal: Pose
    tolerance: tuple[float, float]
    max_taps: int
    session: GoalSession | PrescribedSession
    token: Token | None
    """Of the action goal that waits for the result; None for a goal of the topic."""
    expires: float
    """Steady time in s after which the goal is given up."""
    ask: bool = False
    """A person confirms every tap."""
    records: list[TapRecord] = field(default_factory=list)
    not_fired: int = 0
    without_effect: int = 0
    free_space: object | None = None
    """The map that the session was last told to work in."""
    arm: tuple[float, float, float, float] | None = None
    """Where the arm's tip stands before a decision: x, y, height and yaw in ``table``."""

    def description(self) -> str:
        """The goal for people."""
        return (
            f"goal x {1000 * self.goal.x:.1f} mm, y {1000 * self.goal.y:.1f} mm, "
            f"{math.degrees(self.goal.theta):.1f} deg"
        )

    @property
    def ready(self) -> bool:
        """Whether a decision can be made: a goal may have to be solved first."""
        return not isinstance(self.session, GoalSession) or self.session.ready

    def computation(self, frames: int) -> Callable[[], Any] | None:
        """What takes so long to decide on what was ``observed`` that it is computed beside the
        machine, for ``conclude``; None where ``decide`` answers at once. ``frames`` as there."""
        return None

    def conclude(self, computed: Any) -> Decision:
        """The decision that follows from what was computed."""
        raise NotImplementedError

    def decide(self, seen: ObjectState, frames: int) -> Decision:
        """What to do with the object at rest as it is seen; a look is ``frames`` long, a long one
        ``LONG_LOOK`` times that; 0 where there is no time left for a long one."""
        assert isinstance(self.session, GoalSession)
        self.session.arm = self.arm
        pose = from_message(seen.pose.pose)
        return self.session.decide(
            pose,
            covariance_from_message(seen.pose.covariance),
            look_again=seen.frames_fused < LONG_LOOK * frames,
        )

    def take_in(self, shot: Shot, seen: ObjectState) -> None:
        """Learn from a tap that was, or may have been, fired."""
        pose = from_message(seen.pose.pose)
        covariance = covariance_from_message(seen.pose.covariance)
        self.learn(shot, pose, covariance)
        self.records.append(shot.record(seen, self.session.gains))
        wanted = math.hypot(shot.strike.wanted.x, shot.strike.wanted.y)
        moved = shot.before.distance_to(pose) > LEAST_EFFECT * wanted
        self.without_effect = 0 if moved else self.without_effect + 1

    def observed(self, monitor: CellMonitor, after: float, frames: int, now: Now) -> bool:
        """Whether what a decision needs was seen at rest after a steady time, by so many images."""
        return monitor.usable(after, frames, now)

    def before(self, seen: ObjectState) -> Pose:
        """Where the object lies that the decided tap is for."""
        return from_message(seen.pose.pose)

    def learn(self, shot: Shot, pose: Pose, covariance: Array) -> None:
        """Learn from a tap and what is seen after it."""
        self.session.observe(shot.strike, shot.before, pose, covariance)

    def lose(self, shot: Shot) -> None:
        """The goal ends with a tap under way."""

    def end(self, code: int, sentence: str) -> None:
        """The goal ends, with NONE where it is reached."""

    def feedback(
        self, state: PlanState
    ) -> PositionObject.Feedback | SingleTap.Feedback | ArrangeObjects.Feedback:
        """The action's feedback."""
        return PositionObject.Feedback(plan_state=state)

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """The action's result; ``last``: the last report of this goal."""
        result = PositionObject.Result(
            error_code=code,
            error_msg=sentence,
            residual_distance=last.residual_distance,
            residual_rotation=last.residual_rotation,
            taps=len(self.records),
            records=self.records,
        )
        if seen is not None and seen.visible:
            result.final_pose.header = seen.header
            result.final_pose.pose = seen.pose
        return result

    def fill(self, state: PlanState, pose: Pose | None) -> None:
        """Write this goal and its residual into a report; ``pose`` is None while not seen."""
        state.object_id = self.object_id
        state.planner = self.session.method
        state.goal = self.message
        state.position_tolerance, state.angle_tolerance = self.tolerance
        state.taps = len(self.records)
        if self.records:
            state.last_tap = self.records[-1]
        state.residual_distance = state.residual_rotation = math.nan
        if pose is not None:
            state.residual_distance = pose.distance_to(self.goal)
            state.residual_rotation = pose.rotation_to(self.goal)


@dataclass(slots=True, eq=False, kw_only=True)
class SingleTapTask(Task):
    """One prescribed tap; its goal is where it is expected to send the object.

    A planner that crashed in it leaves it: whether the tap was fired is for the camera to see.
    """

    resumable: ClassVar[bool] = False

    session: PrescribedSession
    references: ReferenceMap

    def description(self) -> str:
        """The tap for people."""
        asked = self.session.prescription
        return (
            f"single tap: striker {1000 * asked.striker_speed:.0f} mm/s, incidence "
            f"{math.degrees(asked.incidence):.1f} deg"
        )

    def decide(self, seen: ObjectState, frames: int) -> Decision:
        """The tap, kept between the reference markers that the camera sees; then Done."""
        used = set(seen.references_used)
        known = [marker.id in used for marker in self.references.markers]
        decision = self.session.decide(
            from_message(seen.pose.pose),
            covariance_from_message(seen.pose.covariance),
            in_view=self.references.corners()[np.array(known)].reshape(-1, 2),
        )
        if isinstance(decision, Strike):
            self.goal = decision.predicted
            self.message.pose = to_message(decision.predicted)
        return decision

    def feedback(
        self, state: PlanState
    ) -> PositionObject.Feedback | SingleTap.Feedback | ArrangeObjects.Feedback:
        """The action's feedback."""
        return SingleTap.Feedback(plan_state=state)

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """The action's result: the record of the tap."""
        record = self.records[-1] if self.records else TapRecord()
        return SingleTap.Result(error_code=code, error_msg=sentence, record=record)

    def lose(self, shot: Shot) -> None:
        """Keep a record of the tap, if it was or may have been fired."""
        if shot.outcome in (TapperState.FIRED, TapperState.UNKNOWN):
            self.records.append(shot.record(None, self.session.gains))
