"""In the complete simulated cell, a planner resumes the goal of a planner that crashed only if this
goal is recent by the clock of its computer, which may be set back meanwhile."""

from __future__ import annotations

import pytest

from lab.trial import Trial
from tapping_cell.messages import PlanState
from tapping_cell.se2 import Pose

GOAL = Pose(0.04, -0.02, 0.3)


@pytest.mark.parametrize(
    ("away", "set_back", "resumed"),
    [(5.0, 0.0, True), (24.0, 0.0, False), (24.0, 15.0, True), (24.0, 100.0, False)],
    ids=["recent", "old", "seems recent", "from the future"],
)
def test_only_a_recent_goal_is_resumed(away: float, set_back: float, resumed: bool) -> None:
    trial = Trial(seed=21, faults=False)
    trial.bring_up()
    trial.send_goal(GOAL)
    trial.scheduler.run(trial.scheduler.now + 20.0, lambda: bool(trial.oracle.commands))
    last = max(trial.oracle.commands)
    trial.kill("tap_planner", away)
    trial.clocks["tap_planner"].offset -= set_back
    trial.scheduler.run(trial.scheduler.now + away + 15.0)
    state = trial.network.history["plan_state"][-1].state
    assert (state != PlanState.IDLE) == resumed
    assert resumed or max(trial.oracle.commands) == last
    assert trial.oracle.violations == []
