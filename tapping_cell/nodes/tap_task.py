"""One goal and one tap of it, as the planning node keeps and reports them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from geometry_msgs.msg import PoseStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.time import Time
from tapping_cell_msgs.msg import ObjectState, PlanState, TapCommand, TapperState, TapRecord

from tapping_cell.nodes.conversions import covariance_from_message, from_message, to_message
from tapping_cell.planning import Done, PositioningSession, Refusal, Strike
from tapping_cell.se2 import Pose

LEAST_EFFECT = 0.2
"""Share of the wanted distance below which a tap counts as without effect."""


@dataclass(slots=True, eq=False)
class Shot:
    """One tap from its command to its measured result."""

    tap_id: int
    strike: Strike
    before: Pose
    fired_at: Time | None = None
    outcome: int = TapperState.NONE
    measured_speed: float = math.nan

    def command(self, now: Time, expiry: Time, height: float) -> TapCommand:
        """The command of this tap; ``height`` is that of the tip over the table, in m."""
        plan = self.strike.plan
        command = TapCommand(
            request=TapCommand.TAP,
            tap_id=self.tap_id,
            striker_speed=plan.striker_speed,
            expiry=expiry.to_msg(),
            strike_pose=to_message(plan.strike_pose, height),
            object_pose=to_message(self.before),
            predicted_pose=to_message(self.strike.predicted),
        )
        command.header.stamp = now.to_msg()
        command.header.frame_id = "table"
        return command

    def record(self, number: int, seen: ObjectState) -> TapRecord:
        """What is kept of this tap once its result is seen."""
        strike = self.strike
        record = TapRecord(
            tap_id=self.tap_id,
            number=number,
            planner=strike.method,
            object_pose=to_message(self.before),
            dx=strike.commanded.x,
            dy=strike.commanded.y,
            dtheta=strike.commanded.theta,
            predicted_pose=to_message(strike.predicted),
            measured_pose=seen.pose,
            striker_speed=strike.plan.striker_speed,
            measured_speed=self.measured_speed,
            contact_angle=strike.plan.contact_angle,
            strike_pose=to_message(strike.plan.strike_pose),
            outcome=self.outcome,
            at_rest_at=seen.at_rest_since,
        )
        if self.fired_at is not None:
            record.fired_at = self.fired_at.to_msg()
        return record


@dataclass(slots=True, eq=False)
class Task:
    """One goal from its acceptance to its end. ``tolerance`` in m and rad."""

    message: PoseStamped
    goal: Pose
    tolerance: tuple[float, float]
    max_taps: int
    session: PositioningSession
    handle: ServerGoalHandle | None
    records: list[TapRecord] = field(default_factory=list)
    not_fired: int = 0
    without_effect: int = 0
    canceled: bool = False

    def decide(self, seen: ObjectState) -> Done | Strike | Refusal:
        """What to do with the object at rest as it is seen."""
        pose = from_message(seen.pose.pose)
        return self.session.decide(pose, covariance_from_message(seen.pose.covariance))

    def take_in(self, shot: Shot, seen: ObjectState) -> None:
        """Learn from a tap that was, or may have been, fired."""
        pose = from_message(seen.pose.pose)
        covariance = covariance_from_message(seen.pose.covariance)
        self.session.observe(shot.strike, shot.before, pose, covariance)
        self.records.append(shot.record(len(self.records) + 1, seen))
        wanted = math.hypot(shot.strike.wanted.x, shot.strike.wanted.y)
        moved = shot.before.distance_to(pose) > LEAST_EFFECT * wanted
        self.without_effect = 0 if moved else self.without_effect + 1

    def fill(self, state: PlanState, pose: Pose | None) -> None:
        """Write this goal and its residual into a report; ``pose`` is None while not seen."""
        state.planner = self.session.planner.name
        state.goal = self.message
        state.position_tolerance, state.angle_tolerance = self.tolerance
        state.taps = len(self.records)
        if self.records:
            state.last_tap = self.records[-1]
        state.residual_distance = state.residual_rotation = math.nan
        if pose is not None:
            state.residual_distance = pose.distance_to(self.goal)
            state.residual_rotation = pose.rotation_to(self.goal)
