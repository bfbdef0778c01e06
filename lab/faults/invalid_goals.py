"""Goals of another client with one wrong field, which the planner must refuse."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tapping_cell.logic.clock import to_stamp
from tapping_cell.messages import PoseStamped

HOURS_NS = 2 * 3600 * 10**9
"""Age of an outdated goal, ns. It is longer than any step of a clock."""
TILT_RAD, HEIGHT_M, NORM = math.radians(2.0), 0.005, 0.9


@dataclass(frozen=True, slots=True)
class WrongGoal:
    """A wrong field. ``spoil`` enters it in a goal; its second argument is the ROS time of the
    planner in ns."""

    name: str
    spoil: Callable[[PoseStamped, int], None]


def _old(goal: PoseStamped, now: int) -> None:
    goal.header.stamp = to_stamp(now - HOURS_NS)


def _future(goal: PoseStamped, now: int) -> None:
    goal.header.stamp = to_stamp(now + HOURS_NS)


def _tilted(goal: PoseStamped, _: int) -> None:
    turn = goal.pose.orientation
    # A rotation about the x axis, before the rotation about z.
    sine, cosine = math.sin(0.5 * TILT_RAD), math.cos(0.5 * TILT_RAD)
    turn.x, turn.y, turn.z, turn.w = turn.w * sine, turn.z * sine, turn.z * cosine, turn.w * cosine


def _lifted(goal: PoseStamped, _: int) -> None:
    goal.pose.position.z = HEIGHT_M


def _norm(goal: PoseStamped, _: int) -> None:
    goal.pose.orientation.z *= NORM
    goal.pose.orientation.w *= NORM


def _frame(goal: PoseStamped, _: int) -> None:
    goal.header.frame_id = "table_of_another_cell"


def _not_a_number(goal: PoseStamped, _: int) -> None:
    goal.pose.position.y = math.nan


def _off_the_table(goal: PoseStamped, _: int) -> None:
    goal.pose.position.x += 2.0


WRONG_GOALS = (
    WrongGoal("outdated", _old),
    WrongGoal("from the future", _future),
    WrongGoal("tilted", _tilted),
    WrongGoal("above the table", _lifted),
    WrongGoal("quaternion", _norm),
    WrongGoal("unknown frame", _frame),
    WrongGoal("not a number", _not_a_number),
    WrongGoal("off the table", _off_the_table),
)


def draw_wrong_goal(rng: np.random.Generator) -> WrongGoal:
    """Choose a wrong field at random."""
    return WRONG_GOALS[int(rng.integers(len(WRONG_GOALS)))]
