"""The values learnt from taps are contained in ``plan_state`` and in the tap's record."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from logic_parts import goal_handling

from tapping_cell.logic.clock import Now
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.host import Activated, Configured
from tapping_cell.logic.learnt import to_message
from tapping_cell.logic.planner import PlannerLogic
from tapping_cell.logic.planner_settings import PlannerSettings
from tapping_cell.logic.poses import to_message as pose_message
from tapping_cell.logic.task import Shot, Task
from tapping_cell.messages import ObjectState, PoseStamped, TapperState
from tapping_cell.planning import Gains, Strike
from tapping_cell.se2 import Pose

NOW = Now(100.0, 1_800_000_000_000_000_000)
COVARIANCE = [1e-10 if index in (0, 7, 35) else 0.0 for index in range(36)]


@pytest.fixture(scope="module")
def goals() -> GoalHandling:
    return goal_handling(now=NOW)


def accepted(goals: GoalHandling, *, probe: bool = False) -> Task:
    message = PoseStamped(pose=pose_message(Pose(0.02, 0.01, 0.1)))
    message.header.frame_id = "table"
    task = goals.accept(Request(message, probe=probe), NOW)
    assert isinstance(task, Task)
    return task


def seen_at(pose: Pose) -> ObjectState:
    seen = ObjectState(visible=True, at_rest=True, frames_fused=100)
    seen.pose.pose = pose_message(pose)
    seen.pose.covariance = list(COVARIANCE)
    return seen


def test_an_idle_planner_reports_its_estimate_of_a_new_object(goals: GoalHandling) -> None:
    logic = PlannerLogic(PlannerSettings())
    logic.on_lifecycle(Configured(goals.cell, goals), NOW)
    logic.on_lifecycle(Activated(), NOW)
    assert logic.last.learnt == to_message(Gains.start())
    assert logic.last.learnt.distance == 1.0 and logic.last.learnt.distance_deviation > 0.04


def test_the_record_of_a_tap_contains_what_was_learnt(goals: GoalHandling) -> None:
    task, before = accepted(goals), Pose(0.0, 0.0, 0.0)
    strike = task.decide(seen_at(before), 0)
    assert isinstance(strike, Strike)
    asked = strike.commanded
    after = Pose(2.5 * asked.x, 2.5 * asked.y, 2.5 * asked.theta)
    shot = Shot(7, task.object_id, 1, strike, before, np.zeros((3, 3)), outcome=TapperState.FIRED)
    task.take_in(shot, seen_at(after))
    learnt = task.records[0].learnt
    assert learnt == to_message(task.session.gains)
    assert learnt.distance == pytest.approx(2.5, rel=0.1)
    assert learnt.explained == 1 and learnt.unexplained == 0
    assert all(math.isfinite(value) for value in dataclasses.astuple(learnt))


def test_a_goal_may_ask_for_a_probe(goals: GoalHandling) -> None:
    for probe in (False, True):
        decision = accepted(goals, probe=probe).decide(seen_at(Pose(0.0, 0.0, 0.0)), 0)
        assert isinstance(decision, Strike)
        assert ("probe" in decision.detour) is probe
