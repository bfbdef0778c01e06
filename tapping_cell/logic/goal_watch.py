"""Check, for a waiting client, whether the planner still pursues the goal that it has accepted.

The result of an action may be lost on its way. After a crash of the planner, none is sent. If the
planner restarts early enough to resume the goal, it reports the end of the goal only in
``plan_state``. If the planner does not resume the goal, the client has to end the wait.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.messages import ErrorCode, PlanState
from tapping_cell.se2 import Pose

FINAL_STATES = (PlanState.REACHED, PlanState.FAILED, PlanState.CANCELED)
"""Values of ``plan_state`` after a goal has ended."""

SILENCE_S = 3.0
"""Message timeout of the planner, which reports every 0.5 s."""
RETURN_S = 30.0
"""Maximum wait for a planner to restart."""
RESUMING_S = 10.0
"""Maximum wait for a restarted planner to resume the goal."""
GRACE_S = 1.0
"""Maximum time between the final report and the action result, if there is a result."""
LOST_RESULT_S = 5.0
"""Time after the final report of a running planner from which the action result counts as lost."""
SAME_M = 1e-6
SAME_RAD = 1e-6


@dataclass(frozen=True, slots=True)
class Ended:
    """How the goal ended: an ErrorCode and a message. The code is NONE if the goal was reached."""

    code: int
    sentence: str


class GoalWatch:
    """Follows one goal from its acceptance. Times are in s of the steady clock."""

    def __init__(self, goal: Pose | None, planners: frozenset[bytes], now: float) -> None:
        """``goal``: pose in ``table``; None if the planner does not resume the goal after a crash.
        ``planners``: publishers of ``plan_state`` when the goal was
        sent."""
        self._goal = goal
        self._planners = planners
        self._received = self._quiet_since = self._new_since = now
        self._final_since = math.inf
        self.gone = False
        """Whether the planner that accepted the goal has ended or has timed out."""

    def check(
        self,
        plan: PlanState | None,
        pose: Pose | None,
        received_at: float,
        planners: frozenset[bytes],
        now: float,
    ) -> Ended | None:
        """Return how the goal has ended if no action result will follow, or None while a result may
        still arrive.

        ``plan``: last report, received at ``received_at``; ``pose``: goal in this report.
        ``planners``: present publishers of ``plan_state``.
        """
        self._received = max(self._received, received_at)
        silent = now - self._received > SILENCE_S
        if not self.gone and (silent or not planners <= self._planners):
            self.gone = True
            self._new_since = self._quiet_since = now
            self._final_since = math.inf
        # A report from before this time may be of an earlier goal with the same pose.
        new = received_at > self._new_since and pose is not None and self._is_goal(pose)
        if not self.gone:
            return self._reported_end(plan if new else None, LOST_RESULT_S, now)
        if silent:
            self._quiet_since, self._final_since = now, math.inf
            if now - self._received > RETURN_S:
                return Ended(
                    ErrorCode.NOT_READY,
                    "while the goal was under way, the planner sent no message for "
                    f"{RETURN_S:.0f} s; check its log, restart it, then send the goal again",
                )
            return None
        if not new or plan is None or plan.state == PlanState.IDLE:
            self._final_since = math.inf
            if now - self._quiet_since > RESUMING_S:
                return Ended(
                    ErrorCode.NOT_READY,
                    "the planner was restarted while the goal was under way and did not "
                    "resume it; send the goal again",
                )
            return None
        self._quiet_since = now
        return self._reported_end(plan, GRACE_S, now)

    def _reported_end(self, plan: PlanState | None, patience: float, now: float) -> Ended | None:
        """Return the end that ``plan`` has reported for ``patience`` s, or None."""
        if plan is None or plan.state not in FINAL_STATES:
            self._final_since = math.inf
            return None
        self._final_since = min(self._final_since, now)
        if now - self._final_since < patience:
            return None
        return Ended(plan.error_code, plan.error_msg)

    def _is_goal(self, pose: Pose) -> bool:
        if self._goal is None:
            return False
        near = pose.distance_to(self._goal) < SAME_M
        return near and abs(pose.rotation_to(self._goal)) < SAME_RAD
