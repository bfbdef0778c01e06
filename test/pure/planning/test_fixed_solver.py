"""Goals solved in a separate process have the same solution as goals solved in this process."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import pytest

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.planning.fixed_iteration import Abandoned, solve_coarse, solve_finer
from tapping_cell.planning.fixed_solver import GoalSolver

CELL = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")


@pytest.fixture(autouse=True)
def _normal_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the process at normal priority: at low priority it could wait for minutes on a busy
    machine."""
    monkeypatch.setattr("tapping_cell.planning.fixed_solver.REFINING_NICENESS", 0)


def test_the_background_gives_a_coarse_solution_and_then_the_same_fine_one() -> None:
    space = assembly.make_fixed_space(CELL)
    # A wide tolerance needs only a small grid.
    settings = assembly.make_planner_settings(CELL, (0.02, math.radians(20.0)))
    goal = np.array([0.01, -0.02, 0.3])
    here = GoalSolver().goal(space, settings, goal).solution
    assert here is not None
    solver = GoalSolver(background=True)
    asked = solver.goal(space, settings, goal)
    assert solver.goal(space, settings, goal) is asked
    wait_until(lambda: asked.solution is not None and asked.solution.grid == here.grid)
    assert asked.solution is not None
    np.testing.assert_allclose(asked.solution.value, here.value)


def test_a_later_goal_is_answered_before_an_earlier_one_is_refined() -> None:
    space = assembly.make_fixed_space(CELL)
    settings = assembly.make_planner_settings(CELL, (0.02, math.radians(20.0)))
    solver = GoalSolver(background=True, finer=(0.3, 0.1))
    first = solver.goal(space, settings, np.zeros(3))
    wait_until(lambda: first.solution is not None)
    second = solver.goal(space, settings, np.array([0.03, 0.01, 0.0]))
    wait_until(lambda: second.solution is not None)
    assert first.solution is not None
    assert first.solution.grid.along.step > 0.1


def test_a_goal_that_is_requested_twice_does_not_end_the_solver(monkeypatch):
    """The goal is no longer cached, but its first request is not answered yet."""
    monkeypatch.setattr("tapping_cell.planning.fixed_solver.KEPT_SOLUTIONS", 1)
    space = assembly.make_fixed_space(CELL)
    settings = assembly.make_planner_settings(CELL, (0.02, math.radians(20.0)))
    solver = GoalSolver(background=True, finer=())
    for x in (0.0, 0.01, 0.0):
        asked = solver.goal(space, settings, np.array([x, 0.0, 0.0]))
    wait_until(lambda: asked.solution is not None)
    later = solver.goal(space, settings, np.array([0.02, 0.0, 0.0]))
    wait_until(lambda: later.solution is not None)


def test_a_fine_solution_that_is_interrupted_is_abandoned() -> None:
    space = assembly.make_fixed_space(CELL)
    settings = assembly.make_planner_settings(CELL, (0.02, math.radians(20.0)))
    coarse = solve_coarse(space, settings, np.zeros(3))
    with pytest.raises(Abandoned):
        solve_finer(space, settings, coarse, 0.33, lambda: True)


def wait_until(holds: Callable[[], bool]) -> None:
    until = time.monotonic() + 60.0
    while not holds():
        assert time.monotonic() < until
        time.sleep(0.001)
