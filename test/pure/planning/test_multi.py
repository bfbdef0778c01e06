import math

import numpy as np
import pytest

from tapping_cell.planning import PlannerSettings, PlanningError, make_planner
from tapping_cell.planning.multi import MultiPlanner


@pytest.mark.parametrize(("line", "taps"), [(0.3, 2), (0.6, 5)])
def test_the_papers_task_takes_the_published_number_of_taps(line, taps):
    planner = MultiPlanner(PlannerSettings(error_line=line))
    assert int(planner.planned_taps(0.010, math.radians(10.0))) == taps


@pytest.mark.parametrize("line", [0.3, 0.6])
def test_every_tap_takes_its_whole_error_line_into_a_lower_cone(line):
    planner = MultiPlanner(PlannerSettings(error_line=line))
    rng = np.random.default_rng(4)
    r, theta = rng.uniform(0.0, 0.08, 3000), rng.uniform(0.0, 0.6, 3000)
    level = planner.planned_taps(r, theta)
    tap = planner.choose(r, theta)
    inside = (level >= 1) & (theta <= planner.cones[-1][0])
    for error in np.linspace(-1.0, 1.0, 9):
        left = np.abs(theta - tap.rotation * (1.0 + line * error))
        after = planner.planned_taps(np.abs(r - tap.distance), left * (1.0 - 1e-9))
        assert np.all(after[inside] < level[inside])


def test_every_goal_of_the_table_has_a_plan():
    planner = MultiPlanner(PlannerSettings())
    assert float(planner.cones[-1].min()) >= math.pi


def test_without_error_lines_there_are_no_cones():
    with pytest.raises(PlanningError, match="error_line above 0"):
        make_planner("multi", PlannerSettings(error_line=0.0))
