"""The memory of visited poses prevents the planner from going round in circles."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.planning.visited import ANGLE, RADIUS, VisitedPoses

GOAL = np.array([0.2, 0.0, 0.0])
SHARES = st.floats(0.0, 1.0)


@given(
    SHARES,
    st.floats(0.0, 6.28),
    SHARES,
    st.floats(0.0, 10.0),
    st.lists(st.floats(0, 9), max_size=5),
)
def test_a_pose_near_visited_ones_costs_at_least_their_maximum(
    share: float, heading: float, turned: float, estimate: float, costs: list[float]
) -> None:
    visited = VisitedPoses(GOAL)
    for cost in costs:
        visited.add(np.zeros(3), cost)
    near = 0.999 * RADIUS * share
    pose = np.array([near * np.cos(heading), near * np.sin(heading), 0.999 * ANGLE * turned])
    extra = visited.extra(pose[None, :], np.array([estimate]))
    assert np.allclose(extra, max([0.0, *(cost - estimate for cost in costs)]))
    for far in ([1.01 * RADIUS, 0.0, 0.0], [0.0, 0.0, 1.01 * ANGLE]):
        assert visited.extra(np.array([far]), np.array([estimate])) == [0.0]


def test_the_goal_has_no_cost_however_close_a_visited_pose_was() -> None:
    visited = VisitedPoses(GOAL)
    for distance in (0.0001, 0.001, 0.004, 0.02):
        visited.add(GOAL - [distance, 0.0, 0.0], 50.0)
    assert visited.extra(GOAL[None, :], np.zeros(1)) == [0.0]


@given(st.integers(2, 6))
def test_a_walk_along_a_line_leaves_a_dead_end(length: int) -> None:
    """The places form a line. The goal seems to be near, but it is behind a wall, and the only way
    out leads back past the start."""
    visited = VisitedPoses(np.array([1.0, 0.0, 0.0]))
    place = length
    for _ in range(40 * length**2):
        choices = [each for each in (place - 1, place + 1) if each <= length]
        poses = np.array([[0.02 * each, 0.0, 0.0] for each in choices])
        estimate = 1.0 + length - np.array(choices, dtype=float)  # smaller towards the wall
        cost = estimate + visited.extra(poses, estimate)
        best = int(np.argmin(cost))
        visited.add(np.array([0.02 * place, 0.0, 0.0]), 1.0 + float(cost[best]))
        place = choices[best]
        if place < 0:
            return
    raise AssertionError("never left the dead end")
