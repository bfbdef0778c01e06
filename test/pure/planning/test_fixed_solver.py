"""Goals solved in a process of their own are those that are solved here."""

from __future__ import annotations

import math
import time

import numpy as np

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.planning.fixed_solver import GoalSolver

CELL = load_cell(shared_folder() / "positioning_cell" / "cell.yaml")


def test_the_background_gives_a_coarse_solution_and_then_the_same_fine_one() -> None:
    space = assembly.make_fixed_space(CELL)
    # A wide tolerance makes a small grid.
    settings = assembly.make_planner_settings(CELL, (0.02, math.radians(20.0)))
    goal = np.array([0.01, -0.02, 0.3])
    here = GoalSolver().goal(space, settings, goal).solution
    assert here is not None
    solver = GoalSolver(background=True)
    asked = solver.goal(space, settings, goal)
    assert solver.goal(space, settings, goal) is asked
    until = time.monotonic() + 60.0
    while asked.solution is None or asked.solution.grid != here.grid:
        assert time.monotonic() < until
        time.sleep(0.01)
    np.testing.assert_allclose(asked.solution.value, here.value)
