"""Oracle of confirmations: the planner commands no tap that no person has confirmed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from lab.virtual_cell.scheduler import Scheduler
from tapping_cell.logic.poses import from_message
from tapping_cell.messages import ConfirmTap, PlannedTap, PlanState, TapCommand

HOLDS_S = 20.0
"""Time for which a confirmation remains valid for another, nearly equal tap."""
OBJECT_M, OBJECT_RAD = 0.0005, math.radians(0.5)
"""Maximum displacement of the object from its pose in the confirmed tap."""
STRIKE_M, STRIKE_RAD = 0.001, math.radians(1.0)
"""Maximum difference between the strike poses, and between the predicted poses, of two taps."""
SPEED_SHARE = 0.05
"""Maximum relative difference of the striker's speeds."""
ROUNDING = 1e-6
"""Tolerance for rounding: m, rad, s, and fraction of the speed."""


@dataclass(slots=True)
class ConfirmationOracle:
    """Checks that a person confirmed each tap. Times are in s from the start of the run."""

    scheduler: Scheduler
    violate: Callable[[str, str], None]
    asks: bool = False
    """Whether the planner must ask before every tap."""
    _proposals: dict[int, PlannedTap] = field(default_factory=dict)
    _confirmed: list[tuple[float, PlannedTap]] = field(default_factory=list)
    """Taps that a person has confirmed, with the time of the confirmation."""
    _rejected: set[int] = field(default_factory=set)

    def on_plan_state(self, message: PlanState) -> None:
        """Record a tap that the planner proposes."""
        if message.state == PlanState.CONFIRMING:
            self._proposals.setdefault(message.planned_tap.tap_id, message.planned_tap)

    def on_call(self, request: ConfirmTap.Request) -> None:
        """Record an answer that a person sends. The planner acts on it at once, before it
        responds."""
        tap = self._proposals.get(request.tap_id)
        if request.confirm and tap is not None:
            self._confirmed.append((self.scheduler.now, tap))

    def on_answer(self, request: ConfirmTap.Request, response: ConfirmTap.Response) -> None:
        """Record the planner's response to a person's answer."""
        if response.accepted and not request.confirm:
            self._rejected.add(request.tap_id)

    def on_tap(self, command: TapCommand) -> None:
        """Check that a person confirmed a tap that the planner commands."""
        if command.tap_id in self._rejected:
            self.violate("rejected tap", f"tap {command.tap_id} was commanded after its rejection")
        elif self.asks and not any(self._covers(*one, command) for one in self._confirmed):
            self.violate(
                "tap not confirmed",
                f"tap {command.tap_id} was commanded, but no person has confirmed it or a nearly"
                f" equal tap within {HOLDS_S:g} s",
            )

    def _covers(self, time: float, tap: PlannedTap, command: TapCommand) -> bool:
        """Return whether a confirmation is valid for this tap."""
        if tap.tap_id == command.tap_id:
            return True
        if self.scheduler.now > time + HOLDS_S + ROUNDING:
            return False
        speed = abs(command.striker_speed - tap.striker_speed)
        pairs = (
            (tap.object_pose, command.object_pose, OBJECT_M, OBJECT_RAD),
            (tap.strike_pose, command.strike_pose, STRIKE_M, STRIKE_RAD),
            (tap.predicted_pose.pose, command.predicted_pose, STRIKE_M, STRIKE_RAD),
        )
        return speed <= (SPEED_SHARE + ROUNDING) * tap.striker_speed and all(
            from_message(one).distance_to(from_message(other)) <= distance + ROUNDING
            and abs(from_message(one).rotation_to(from_message(other))) <= angle + ROUNDING
            for one, other, distance, angle in pairs
        )
