"""Preset layouts: gaps between objects, the shortest assignment of objects to places, and pairs
that swap places."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.preset_layout import preset_layout
from tapping_cell.planning import PlanningError
from tapping_cell.planning.arrangement import preset_goals
from tapping_cell.se2 import Pose

MIDDLE = (0.02, -0.01)
places = st.tuples(st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(-3.1, 3.1))


def table(starts: list[tuple[float, float, float]]) -> dict[str, Pose]:
    return {f"o{number}": Pose(*start) for number, start in enumerate(starts)}


@given(
    st.sampled_from(["line", "circle", "grid"]),
    st.lists(places, min_size=2, max_size=9),
    st.floats(0.01, 0.05),
    st.floats(0.0, 0.06),
)
def test_objects_keep_the_gap_and_the_layout_is_centred(preset, starts, radius, gap):
    goals = preset_goals(preset, table(starts), radius, MIDDLE, gap)
    assert set(goals) == {f"o{number}" for number in range(len(starts))}
    nearest = min(a.distance_to(b) for a, b in itertools.combinations(goals.values(), 2))
    assert nearest == pytest.approx(2 * radius + gap, abs=1e-9)
    x, y = (np.array([goal[axis] for goal in goals.values()]) for axis in (0, 1))
    if preset == "circle":
        assert (x.mean(), y.mean()) == pytest.approx(MIDDLE, abs=1e-9)
    else:
        assert ((x.min() + x.max()) / 2, (y.min() + y.max()) / 2) == pytest.approx(MIDDLE, abs=1e-9)


@given(st.sampled_from(["line", "circle", "grid"]), st.lists(places, min_size=2, max_size=5))
def test_no_other_assignment_has_shorter_paths(preset, starts):
    poses = table(starts)
    goals = preset_goals(preset, poses, 0.03, MIDDLE)
    way = sum(poses[name].distance_to(goal) for name, goal in goals.items())
    for order in itertools.permutations(goals.values()):
        other = sum(a.distance_to(b) for a, b in zip(poses.values(), order, strict=True))
        assert way <= other + 1e-9


def test_a_swap_exchanges_pairs_and_leaves_an_odd_object_in_place() -> None:
    poses = table([(0.0, 0.0, 1.0), (0.1, 0.0, 2.0), (0.2, 0.1, 0.0)])
    goals = preset_goals("swap", poses, 0.03, MIDDLE)
    assert goals == {"o0": poses["o1"], "o1": poses["o0"]}


def test_unknown_presets_and_single_objects_are_refused() -> None:
    two = table([(0.0, 0.0, 0.0), (0.1, 0.0, 0.0)])
    with pytest.raises(PlanningError, match="'star'; it must be one of line, circle, grid, swap"):
        preset_goals("star", two, 0.03, MIDDLE)
    with pytest.raises(PlanningError, match="not 1"):
        preset_goals("swap", table([(0.0, 0.0, 0.0)]), 0.03, MIDDLE)


def test_a_line_that_is_longer_than_the_table_is_refused_and_a_grid_is_not() -> None:
    cell = load_cell()
    cells = {f"o{k}": cell for k in range(8)}
    poses = table([(0.0, 0.0, 0.0)] * 8)
    with pytest.raises(PlanningError, match="a line of 8 objects does not fit on the table: 'o"):
        preset_layout(cells, "line", poses)
    assert len(preset_layout(cells, "grid", poses)) == 8
