"""Goals and their taps as the planner stores and reports them."""

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
from tapping_cell.logic.learnt import track_message
from tapping_cell.logic.poses import (
    covariance_from_message,
    covariance_to_message,
    from_message,
    to_message,
)
from tapping_cell.messages import (
    ArrangementState,
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
from tapping_cell.planning.stopping import LONG_OBSERVATION
from tapping_cell.planning.track import Launched, Track
from tapping_cell.se2 import Pose
from tapping_cell.vision import ReferenceMap

Array = NDArray[np.float64]

MIN_EFFECT = 0.2
"""A tap that moves the object by less than this fraction of the intended distance counts as having
no effect."""


@dataclass(slots=True, eq=False)
class Shot:
    """One tap from its command to its measured result."""

    tap_id: int
    object_id: str
    number: int
    """Number of the tap within its goal, starting at 1."""
    strike: Strike
    before: Pose
    covariance: Array
    """Covariance (3, 3) of the predicted pose of the object after the tap, m and rad."""
    fired_at: int | None = None
    """Time at which the tapper's report arrived, ROS time in ns."""
    outcome: int = TapperState.NONE
    counted: bool = False
    """Whether this tap was counted as not fired."""
    in_position: bool = False
    """Whether the arm has reported that it is in position for this tap."""
    measured_speed: float = math.nan
    purpose: str = ""
    """Why this object is tapped now; empty for the only object with a goal."""
    asked_again: str = ""
    """Why a person is asked again although an earlier plan of this tap was confirmed."""

    def command(self, now: int, expiry: int, height: float) -> TapCommand:
        """Return the command of this tap. Times in ns; ``height``: height of the tip above the
        table, m."""
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
        """Return the message that announces this tap.

        ``answer_by``: deadline for a person's answer in ns; 0 if no confirmation is needed.
        ``height``: height of the tip above the table, m.
        """
        plan = self.strike.plan
        tap = PlannedTap(
            tap_id=self.tap_id,
            object_id=self.object_id,
            number=self.number,
            object_pose=to_message(self.before),
            strike_pose=to_message(plan.strike_pose, height),
            striker_speed=plan.striker_speed,
            reason="; ".join(filter(None, (self.purpose, self.strike.detour, self.asked_again))),
            expected_taps=self.strike.expected.taps,
            expected_seconds=self.strike.expected.seconds,
            answer_by=to_stamp(answer_by),
        )
        tap.predicted_pose.pose = to_message(self.strike.predicted)
        tap.predicted_pose.covariance = covariance_to_message(self.covariance)
        return tap

    def record(
        self, seen: ObjectState | None, gains: Gains, launched: Launched | None = None
    ) -> TapRecord:
        """Return the record of this tap. ``seen``: observation of its result, None if there was
        none. ``gains``: corrections of the object's model, learnt up to this tap. ``launched``:
        launch in the track of the slide, None if it was not seen."""
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
            expected_taps=strike.expected.taps,
            expected_seconds=strike.expected.seconds,
            measured_pose=seen.pose,
            striker_speed=strike.plan.striker_speed,
            measured_speed=self.measured_speed,
            contact_angle=strike.plan.contact_angle,
            strike_pose=to_message(strike.plan.strike_pose),
            outcome=self.outcome,
            at_rest_at=seen.at_rest_since,
            track=track_message(launched),
            learnt=learnt_message(gains),
        )
        if self.fired_at is not None:
            record.fired_at = to_stamp(self.fired_at)
        return record


@dataclass(slots=True, eq=False)
class Task:
    """One goal from its acceptance to its end. ``tolerance`` in m and rad."""

    resumable: ClassVar[bool] = True
    """Whether a restarted planner resumes this goal after a crash."""
    prescribed: ClassVar[bool] = False
    """Whether the tap is prescribed, so that no other tap can be planned and no goal is reached."""

    object_id: str
    """Name of the object."""
    message: PoseStamped
    goal: Pose
    tolerance: tuple[float, float]
    max_taps: int
    session: GoalSession | PrescribedSession
    token: Token | None
    """Token of the action goal that waits for the result; None for a goal from the topic."""
    expires: float
    """Steady time in s after which the goal is aborted."""
    ask: bool = False
    """Whether a person confirms every tap."""
    probe: bool = False
    """Whether the goal begins with a few of the smallest taps."""
    earlier_taps: int = 0
    """Taps of this goal that a planner commanded before it crashed, without those that are known
    not to have been fired. There are no records of these taps."""
    records: list[TapRecord] = field(default_factory=list)
    not_fired: int = 0
    late: int = 0
    """Consecutive taps that were not fired because a message came too late."""
    without_effect: int = 0
    sent: int = 0
    """ROS time in ns; a goal with an older stamp does not replace this one."""
    is_resumed: bool = False
    """Whether this is the goal of a planner that crashed."""
    free_space: object | None = None
    """Map of the free space that the session uses at present."""
    touched: list[str] = field(default_factory=list)
    """Objects that were moved by a tap of another object. This motion has not been reported yet."""
    arm: tuple[float, float, float, float] | None = None
    """Pose of the arm's tip when a decision is made: x, y, height and yaw in ``table``."""

    @property
    def taps(self) -> int:
        """Number of taps of this goal that were fired or may have been fired."""
        return self.earlier_taps + len(self.records)

    def description(self) -> str:
        """Return a readable description of the goal."""
        return (
            f"goal x {1000 * self.goal.x:.1f} mm, y {1000 * self.goal.y:.1f} mm, "
            f"{math.degrees(self.goal.theta):.1f} deg"
        )

    @property
    def purpose(self) -> str:
        """Why the present object is tapped now; empty for the only object with a goal."""
        return ""

    @property
    def ready(self) -> bool:
        """Whether a decision can be made; False while a solver still computes the solution for this
        goal."""
        return not isinstance(self.session, GoalSession) or self.session.ready

    def computation(self, frames: int) -> Callable[[], Any] | None:
        """Return the slow part of a decision as a function. This function runs as a job once
        ``observed`` returns True.
        ``conclude`` receives the result of the function. Return None if ``decide`` is fast enough
        without a job. ``frames``: see ``decide``.
        """
        return None

    def conclude(self, computed: Any) -> Decision:
        """Return the decision that follows from the result of ``computation``."""
        raise NotImplementedError

    def outdated(self, monitor: CellMonitor, computed: Any, distance: float, angle: float) -> bool:
        """Return whether the result of ``computation`` no longer fits the objects: one was moved,
        or is not seen at rest, since the observation from which it was computed. ``distance`` in m
        and ``angle`` in rad are the limits."""
        raise NotImplementedError

    def decide(self, seen: ObjectState, frames: int) -> Decision:
        """Decide on the next action from an observation of the object at rest.

        ``frames``: number of frames of a normal observation; 0 if there is no time for a longer
        one. The decision may be to continue the observation until ``LONG_OBSERVATION * frames``
        frames are fused.
        """
        assert isinstance(self.session, GoalSession)
        self.session.arm = self.arm
        pose = from_message(seen.pose.pose)
        return self.session.decide(
            pose,
            covariance_from_message(seen.pose.covariance),
            observe_again=seen.frames_fused < LONG_OBSERVATION * frames,
        )

    def take_in(self, shot: Shot, seen: ObjectState, track: Track | None = None) -> None:
        """Process a tap that was fired or may have been fired: learn from the tap and record it.
        ``track``: poses during the slide; None if they were not seen."""
        if isinstance(self.session, GoalSession):
            self.session.track = track
        pose = from_message(seen.pose.pose)
        covariance = covariance_from_message(seen.pose.covariance)
        self.learn(shot, pose, covariance)
        launched = self.session.launched if isinstance(self.session, GoalSession) else None
        self.records.append(shot.record(seen, self.session.gains, launched))
        wanted = math.hypot(shot.strike.wanted.x, shot.strike.wanted.y)
        moved = shot.before.distance_to(pose) > MIN_EFFECT * wanted
        self.without_effect = 0 if moved else self.without_effect + 1

    def observed(self, monitor: CellMonitor, after: float, frames: int, now: Now) -> bool:
        """Return whether every object that a decision needs was observed at rest, in at least
        ``frames`` frames, after the steady time ``after``."""
        return monitor.usable(after, frames, now)

    def before(self, seen: ObjectState) -> Pose:
        """Return the object's pose in ``seen``, the observation from which the tap was decided."""
        return from_message(seen.pose.pose)

    def learn(self, shot: Shot, pose: Pose, covariance: Array) -> None:
        """Learn from a tap and the pose observed after it."""
        self.session.observe(shot.strike, shot.before, pose, covariance)

    def learnt(self) -> dict[str, Gains]:
        """Return the learnt corrections of the model for every object that was tapped."""
        return {self.object_id: self.session.gains}

    def skip(self, strike: Strike) -> None:
        """Choose a tap other than this one, if possible, until the next tap is fired."""
        self.session.skip(strike)

    def record_unobserved(self, shot: Shot) -> None:
        """Record the tap during which the goal ended, without a measured displacement, if it may
        have been fired and has no record yet."""
        recorded = any(record.tap_id == shot.tap_id for record in self.records)
        if shot.outcome in (TapperState.FIRED, TapperState.UNKNOWN) and not recorded:
            self.records.append(shot.record(None, self.session.gains))

    def end(self, code: int, sentence: str) -> None:
        """Handle the end of the goal; ``code`` is NONE if it was reached."""

    def progress_report(self, now: Now, active: bool) -> ArrangementState | None:
        """Return the message on the progress of several objects; None for a goal of one object."""
        return None

    def feedback(
        self, state: PlanState
    ) -> PositionObject.Feedback | SingleTap.Feedback | ArrangeObjects.Feedback:
        """Return the action's feedback."""
        return PositionObject.Feedback(
            state=state.state,
            taps=state.taps,
            residual_distance=state.residual_distance,
            residual_rotation=state.residual_rotation,
        )

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """Return the action's result; ``last``: the last report of this goal."""
        result = PositionObject.Result(
            error_code=code,
            error_msg=sentence,
            residual_distance=last.residual_distance,
            residual_rotation=last.residual_rotation,
            taps=self.taps,
            records=self.records,
        )
        if seen is not None and seen.visible:
            result.final_pose.header = seen.header
            result.final_pose.pose = seen.pose
        return result

    def fill(self, state: PlanState, pose: Pose | None) -> None:
        """Write this goal and its residual into ``state``; ``pose``: pose of the object, None while
        it is not seen."""
        state.object_id = self.object_id
        state.planner = self.session.method
        state.goal = self.message
        state.position_tolerance, state.angle_tolerance = self.tolerance
        state.taps = self.taps
        if self.records:
            state.last_tap = self.records[-1]
        state.residual_distance, state.residual_rotation = self.residual(pose)

    def residual(self, pose: Pose | None) -> tuple[float, float]:
        """Return the distance (m) and rotation (rad) from a pose to the goal; NaN without a
        pose."""
        if pose is None:
            return math.nan, math.nan
        return pose.distance_to(self.goal), pose.rotation_to(self.goal)


@dataclass(slots=True, eq=False, kw_only=True)
class SingleTapTask(Task):
    """One prescribed tap; its goal is the predicted pose of the object.

    A planner that crashed does not resume this task, because the tap may have been fired.
    """

    resumable: ClassVar[bool] = False
    prescribed: ClassVar[bool] = True

    session: PrescribedSession
    references: ReferenceMap

    def description(self) -> str:
        """Return a readable description of the tap."""
        asked = self.session.prescription
        return (
            f"single tap: striker {1000 * asked.striker_speed:.0f} mm/s, incidence "
            f"{math.degrees(asked.incidence):.1f} deg"
        )

    def decide(self, seen: ObjectState, frames: int) -> Decision:
        """Return the prescribed tap; after this tap, return Done. The tap must keep the object
        in the area between the visible reference markers."""
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
        """Return the action's feedback."""
        return SingleTap.Feedback(state=state.state)

    def result(
        self, code: int, sentence: str, last: PlanState, seen: ObjectState | None
    ) -> PositionObject.Result | SingleTap.Result | ArrangeObjects.Result:
        """Return the action's result: the record of the tap."""
        record = self.records[-1] if self.records else TapRecord()
        return SingleTap.Result(error_code=code, error_msg=sentence, record=record)
