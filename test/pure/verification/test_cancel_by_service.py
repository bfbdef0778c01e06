"""A person ends the present goal by the planner's service, whoever sent this goal."""

from __future__ import annotations

import pytest

from tapping_cell.messages import ErrorCode, PlanState, TapCommand
from tapping_cell.se2 import Pose
from tapping_cell.verification.trial import Trial

GOAL = Pose(0.04, -0.02, 0.3)


@pytest.fixture
def trial() -> Trial:
    made = Trial(seed=21, faults=False)
    made.bring_up()
    return made


def run_until_tap(trial: Trial) -> int:
    """Run until the planner has commanded a tap; return its id."""
    now, before = trial.scheduler.now, len(trial.checker.commands)
    trial.scheduler.run(now + 20.0, lambda: len(trial.checker.commands) > before)
    assert len(trial.checker.commands) > before
    return max(trial.checker.commands)


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
    assert max(trial.checker.commands) == tap_id and not trial.physical.releases
    assert trial.checker.violations == []


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
    later = {number for number in trial.checker.commands if number > tap_id}
    plan = trial.network.history["plan_state"][-1]
    if activated_after:
        assert not later and plan.state == PlanState.IDLE
    else:
        assert plan.state == PlanState.CANCELED
    assert trial.checker.violations == []


def test_a_goal_without_faults_may_be_cancelled_by_an_earlier_fault() -> None:
    """A fault calls the service after seconds, while a later goal may be the present one (run
    43000692)."""
    trial = Trial(seed=21, faults=False)
    trial.scheduler.at(12.0, trial.cancel_by_service)
    report = trial.run(1)
    assert [outcome.code for outcome in report.outcomes] == [ErrorCode.GOAL_CANCELED]
    assert report.violations == []
