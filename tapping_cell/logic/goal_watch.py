"""Whether the planner that took a goal still serves it, for a client that waits for the end.

A planner that dies takes the action's answer with it. Where it is started again soon it resumes the
goal and tells its end in ``plan_state`` alone; where it is not, the client has to end the wait.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from tapping_cell.logic.planner import FINAL_STATES
from tapping_cell.messages import ErrorCode, PlanState
from tapping_cell.se2 import Pose

SILENCE_S = 3.0
"""A planner that is not heard for so long may be gone; it reports every 0.5 s."""
RETURN_S = 30.0
"""A planner that is started again is back within so long, or is given up."""
RESUMING_S = 10.0
"""A planner that is back has taken up the goal within so long, or does not."""
GRACE_S = 1.0
"""The answer of the action comes so soon after the last report, where it comes at all."""
SAME_M = 1e-6


@dataclass(frozen=True, slots=True)
class Ended:
    """How the goal ended, as a code and a sentence of ErrorCode; NONE where it was reached."""

    code: int
    sentence: str


class GoalWatch:
    """Follows one goal from its acceptance. Times are steady, in s."""

    def __init__(self, goal: Pose, planners: frozenset[bytes], now: float) -> None:
        """``goal`` in ``table``; ``planners``: who publishes ``plan_state`` as the goal is sent."""
        self._goal = goal
        self._planners = planners
        self._heard = self._quiet_since = now
        self._final_since = math.inf
        self.gone = False
        """The planner that took the goal does not exist any more, or is silent."""

    def look(
        self,
        plan: PlanState | None,
        pose: Pose | None,
        heard: float,
        planners: frozenset[bytes],
        now: float,
    ) -> Ended | None:
        """How the goal has ended without an answer; None while one may come.

        ``plan`` and ``pose``: the last report and its goal, arrived at ``heard``; ``planners``: who
        publishes ``plan_state`` now.
        """
        self._heard = max(self._heard, heard)
        silent = now - self._heard > SILENCE_S
        self.gone = self.gone or silent or not planners <= self._planners
        if not self.gone:
            return None
        if silent:
            self._quiet_since, self._final_since = now, math.inf
            if now - self._heard > RETURN_S:
                return Ended(
                    ErrorCode.NOT_READY,
                    "the planner ended while the goal was under way and was not heard for "
                    f"{RETURN_S:.0f} s; read its log, start it, then send the goal again",
                )
            return None
        same = plan is not None and pose is not None and pose.distance_to(self._goal) < SAME_M
        if not same or plan is None or plan.state == PlanState.IDLE:
            self._final_since = math.inf
            if now - self._quiet_since > RESUMING_S:
                return Ended(
                    ErrorCode.NOT_READY,
                    "the planner was started again while the goal was under way and did not "
                    "resume it; send the goal again",
                )
            return None
        self._quiet_since = now
        if plan.state not in FINAL_STATES:
            self._final_since = math.inf
            return None
        self._final_since = min(self._final_since, now)
        if now - self._final_since < GRACE_S:
            return None
        return Ended(plan.error_code, plan.error_msg)
