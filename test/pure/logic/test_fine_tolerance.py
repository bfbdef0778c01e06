"""A tolerance that is too fine for the object's smallest tap is refused before anything moves."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import pytest
from logic_parts import goal_handling

from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.clock import Now
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.goal_validation import Refused
from tapping_cell.logic.task import Task
from tapping_cell.messages import (
    ArrangeObjects,
    ErrorCode,
    Header,
    ObjectGoal,
    Point,
    Pose,
    PoseStamped,
    Quaternion,
)

NOW = Now(100.0, 1_800_000_000_000_000_000)


@cache
def goals_with(smallest_tap: float) -> GoalHandling:
    cell = load_cell()
    return goal_handling(
        replace(cell, object=replace(cell.object, smallest_tap=smallest_tap)), now=NOW
    )


def answer(
    smallest_tap: float, tolerance_mm: float, *, arranged: bool = False, x: float = 0.01
) -> Task | Refused:
    goals = goals_with(smallest_tap)
    pose = Pose(position=Point(x=x, y=0.0, z=0.0), orientation=Quaternion(w=1.0))
    message = PoseStamped(header=Header(frame_id="table"), pose=pose)
    size = 1e-3 * tolerance_mm, math.radians(tolerance_mm)
    if arranged:
        goal = ObjectGoal(
            object_id=goals.cell.object.name,
            goal_pose=message,
            position_tolerance=size[0],
            angle_tolerance=size[1],
        )
        return goals.accept_arrangement(ArrangeObjects.Goal(goals=[goal]), None, NOW)
    return goals.accept(Request(message, position_tolerance=size[0], angle_tolerance=size[1]), NOW)


@pytest.mark.parametrize("arranged", [False, True])
@pytest.mark.parametrize(("smallest_tap", "tolerance_mm"), [(0.0017, 0.3), (0.0005, 0.05)])
def test_tolerances_achievable_with_the_smallest_tap_are_accepted(
    smallest_tap: float, tolerance_mm: float, arranged: bool
) -> None:
    assert isinstance(answer(smallest_tap, tolerance_mm, arranged=arranged), Task)


@pytest.mark.parametrize("arranged", [False, True])
def test_unachievable_tolerances_are_refused_with_the_scatter(arranged: bool) -> None:
    refused = answer(0.02, 0.2, arranged=arranged)
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_BAD_TOLERANCE
    assert "a tap of 20 mm scatters by 1 mm" in refused.sentence


@pytest.mark.parametrize("arranged", [False, True])
def test_a_goal_beyond_the_table_is_refused_when_it_is_sent(arranged: bool) -> None:
    refused = answer(0.0017, 1.0, arranged=arranged, x=0.5)
    assert isinstance(refused, Refused) and refused.code == ErrorCode.GOAL_OFF_TABLE
