"""Invariants of the confirmation of taps: the planner commands no tap that no person confirmed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell.logic.poses import from_message
from tapping_cell.messages import (
    ConfirmTap,
    ErrorCode,
    PlannedTap,
    PlanState,
    TapCommand,
    TapperState,
)
from tapping_cell.verification.physical_cell import PhysicalCell
from tapping_cell.verification.scheduler import Scheduler

# The limits are written here and not imported from ``logic``, so that a wrong limit in the product
# is detected.
HOLDS_S = 20.0
"""Time for which a confirmation remains valid for another, nearly equal tap, s."""
OBJECT_M, OBJECT_RAD = 0.0005, math.radians(0.5)
"""Maximum displacement of the object from its pose in the confirmed tap."""
STRIKE_M, STRIKE_RAD = 0.001, math.radians(1.0)
"""Maximum difference between the strike poses and between the predicted poses of the two taps."""
SPEED_SHARE = 0.05
"""Maximum relative difference of the striker's speeds."""
ROUNDING = 1e-6
"""Tolerance for rounding: m, rad, s, and fraction of the speed."""
LATE = (
    ErrorCode.ARM_SILENT,
    ErrorCode.CAMERA_SILENT,
    ErrorCode.NOT_READY,
    ErrorCode.TAPPER_ARM_NOT_IN_POSITION,
)
"""Codes of a tap that was not fired because a message or image came too late."""
ENDED = (PlanState.IDLE, PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
"""States of the planner without a goal."""


@dataclass(slots=True)
class Confirmed:
    """A tap that a person confirmed at ``time``.

    ``ids``: all taps commanded for it. ``refused``: whether the planner has received that a tap
    commanded for it was not fired for another reason than a late message.
    """

    tap: PlannedTap
    time: float
    ids: list[int]
    refused: bool = False


@dataclass(slots=True)
class ConfirmationChecker:
    """Checks that a person confirmed each tap. Times are in s from the start of the run."""

    scheduler: Scheduler
    physical: PhysicalCell
    violate: Callable[[str, str], None]
    asks_from_start: bool = False
    """Whether a planner asks before every tap from its start on."""
    asking_goals: set[int] = field(default_factory=set)
    """Indices of the requests whose goal demands a confirmation of its taps."""
    _asks: bool = False
    """Whether the planner has been told to ask before every tap."""
    _goal_asks: bool = False
    """Whether the present goal demands a confirmation of its taps."""
    _kept: bool = False
    """Whether the planner that crashed had been told to ask before every tap."""
    _resumed_asks: bool = False
    """Whether this applies to the present goal, because the goal was resumed."""
    _proposals: dict[int, PlannedTap] = field(default_factory=dict)
    _last: int = 0
    """Id of the last proposed tap."""
    _sent: set[int] = field(default_factory=set)
    """Ids of the taps for which a person has sent a confirmation."""
    _accepted: set[int] = field(default_factory=set)
    """Ids of the taps whose confirmation the planner has accepted."""
    _rejected: set[int] = field(default_factory=set)
    _confirmed: list[Confirmed] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._asks = self.asks_from_start

    def on_asks(self, asks: bool) -> None:
        """Process that the planner has accepted a change of ``ask``."""
        self._asks, self._resumed_asks = asks, False

    def on_planner_ended(self) -> None:
        """Process the end of the planner's process. A resumed goal demands the same
        confirmations."""
        self._kept = self._asks or self._resumed_asks
        self._asks, self._goal_asks = self.asks_from_start, False
        self._resumed_asks = False
        self._confirmed.clear()

    def on_goal_begun(self, request: int, resumed: bool) -> None:
        """Process that the planner begins or resumes the goal of a request."""
        self._goal_asks = request in self.asking_goals
        self._resumed_asks = resumed and self._kept
        self._confirmed.clear()

    def on_plan_state(self, message: PlanState) -> None:
        """Process a report of the planner."""
        if message.state in ENDED:
            self._confirmed.clear()
        if message.state == PlanState.CONFIRMING:
            self._last = message.planned_tap.tap_id
            self._proposals.setdefault(self._last, message.planned_tap)

    def on_call(self, request: ConfirmTap.Request) -> None:
        """Process an answer that a person sends."""
        if request.confirm:
            self._sent.add(request.tap_id)

    def on_answer(self, request: ConfirmTap.Request, response: ConfirmTap.Response) -> None:
        """Process the planner's response to a person's answer."""
        if not response.accepted:
            return
        if request.tap_id != self._last:
            self.violate(
                "answer for another tap",
                f"an answer for tap {request.tap_id} was accepted while tap {self._last} was"
                " proposed",
            )
            return
        if not request.confirm:
            self._rejected.add(request.tap_id)
            self._confirmed.clear()
            return
        self._accepted.add(request.tap_id)
        tap = self._proposals[request.tap_id]
        self._confirmed.append(Confirmed(tap, self.scheduler.now, [request.tap_id]))

    def on_tapper_state(self, message: TapperState) -> None:
        """Process a state of the tapper that the planner's process has handled. If a tap was not
        fired, for example because the guard was open, a person must confirm the next tap."""
        code = message.error_code
        if message.outcome != TapperState.NOT_FIRED or not code or code in LATE:
            return
        for confirmed in self._confirmed:
            if confirmed.ids[-1] == message.tap_id:
                confirmed.refused = True

    def on_tap(self, command: TapCommand) -> None:
        """Check that a person confirmed a tap that the planner commands."""
        tap_id = command.tap_id
        if tap_id in self._rejected:
            self.violate("rejected tap", f"tap {tap_id} was commanded after a person rejected it")
            return
        if tap_id in self._sent:
            # The planner answers within the same event.
            self.scheduler.after(0.0, lambda: self._check_accepted(tap_id))
            return
        if not (self._asks or self._goal_asks or self._resumed_asks or tap_id in self._proposals):
            return
        for confirmed in reversed(self._confirmed):
            if self._covers(confirmed, command):
                confirmed.ids.append(tap_id)
                return
        self.violate(
            "tap not confirmed",
            f"tap {tap_id} was commanded, but no person has confirmed it or a nearly equal tap"
            f" within {HOLDS_S:g} s",
        )

    def _check_accepted(self, tap_id: int) -> None:
        if tap_id not in self._accepted:
            self.violate(
                "tap not confirmed",
                f"tap {tap_id} was commanded although the planner has not accepted the confirmation"
                " that a person sent",
            )

    def _covers(self, confirmed: Confirmed, command: TapCommand) -> bool:
        """Return whether a confirmation is valid for this tap: it is recent, its tap is nearly
        equal, and no tap was fired or refused for it."""
        tap = confirmed.tap
        if confirmed.refused:
            return False
        if self.scheduler.now > confirmed.time + HOLDS_S + ROUNDING:
            return False
        if any(release.shot in confirmed.ids for release in self.physical.releases):
            return False
        speed = abs(command.striker_speed - tap.striker_speed)
        if speed > (SPEED_SHARE + ROUNDING) * tap.striker_speed:
            return False
        pairs = (
            (tap.object_pose, command.object_pose, OBJECT_M, OBJECT_RAD),
            (tap.strike_pose, command.strike_pose, STRIKE_M, STRIKE_RAD),
            (tap.predicted_pose.pose, command.predicted_pose, STRIKE_M, STRIKE_RAD),
        )
        return all(
            from_message(one).distance_to(from_message(other)) <= distance + ROUNDING
            and abs(from_message(one).rotation_to(from_message(other))) <= angle + ROUNDING
            for one, other, distance, angle in pairs
        )
