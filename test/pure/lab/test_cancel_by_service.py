"""A person ends the present goal by the planner's service, whoever sent this goal."""

from __future__ import annotations

import pytest

from lab.trial import Trial
from tapping_cell.messages import ErrorCode, PlanState, TapCommand
from tapping_cell.se2 import Pose

GOAL = Pose(0.04, -0.02, 0.3)


@pytest.fixture
def trial() -> Trial:
    made = Trial(seed=21, faults=False)
    made.bring_up()
    return made


def run_until_tap(trial: Trial) -> int:
    """Run until the planner has commanded a tap; return its id."""
    now, before = trial.scheduler.now, len(trial.oracle.commands)
    trial.scheduler.run(now + 20.0, lambda: len(trial.oracle.commands) > before)
    assert len(trial.oracle.commands) > before
    return max(trial.oracle.commands)


@pytest.mark.parametrize("by_topic", [False, True])
def test_the_service_ends_a_goal_and_withdraws_its_tap(trial: Trial, by_topic: bool) -> None:
    trial.send_goal(GOAL, foreign=by_topic)
    tap_id = run_until_tap(trial)
    trial.cancel_by_service()
    trial.scheduler.run(trial.scheduler.now + 10.0)
    plan = trial.network.history["plan_state"][-1]
    assert (plan.state, plan.error_code) == (PlanState.CANCELED, ErrorCode.GOAL_CANCELED)
    command = trial.network.history["tap_command"][-1]
    assert (command.request, command.tap_id) == (TapCommand.WITHDRAW, tap_id)
    assert max(trial.oracle.commands) == tap_id and not trial.physical.releases
    assert trial.oracle.violations == []


@pytest.mark.parametrize("activated_after", [0.0, 6.0])
def test_the_service_ends_a_goal_that_would_be_resumed(
    trial: Trial, activated_after: float
) -> None:
    trial.send_goal(GOAL)
    tap_id = run_until_tap(trial)
    trial.processes["tap_planner"].activation_delay = activated_after
    trial.kill("tap_planner", 0.2)
    trial.scheduler.run(trial.scheduler.now + 4.0)
    trial.cancel_by_service()
    after = trial.scheduler.now
    trial.scheduler.run(after + 15.0)
    later = {number for number in trial.oracle.commands if number > tap_id}
    plan = trial.network.history["plan_state"][-1]
    if activated_after:
        assert not later and plan.state == PlanState.IDLE
    else:
        assert plan.state == PlanState.CANCELED
    assert trial.oracle.violations == []
