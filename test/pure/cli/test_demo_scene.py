"""The files of a demo with several objects."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

from tapping_cell.cli.demo_scene import GAP_M, write_scene
from tapping_cell.configuration.cell import load_cell, load_further_objects
from tapping_cell.configuration.schema import ConfigurationError, load
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import TruthFile


def test_a_scene_gives_start_and_goal_poses_of_every_object(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, 3, 7, None, None, None)
    cell = load_cell(scene.cell)
    files = (cell.object, *load_further_objects(cell))
    truth = load(TruthFile, scene.truth)
    starts = [Pose(*truth.object_start), *(Pose(*start) for start in truth.further_starts)]
    assert [goal.object for goal in scene.layout.goals] == [file.name for file in files]
    assert len(starts) == len(files) == 3
    for places in (starts, [Pose(*goal.pose) for goal in scene.layout.goals]):
        placed = zip(places, files, strict=True)
        for (one, a), (other, b) in itertools.combinations(placed, 2):
            between = one.distance_to(other) - a.shape.reach() - b.shape.reach()
            assert between >= GAP_M - 2e-5  # values in the files are rounded to 0.01 mm


def test_objects_swap_places_in_pairs(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, 3, 7, None, None, None, "swap")
    truth = load(TruthFile, scene.truth)
    starts = [Pose(*truth.object_start), *(Pose(*start) for start in truth.further_starts)]
    goals = [Pose(*goal.pose) for goal in scene.layout.goals]
    for goal, start in zip(goals, (starts[1], starts[0], starts[2]), strict=True):
        assert goal.distance_to(start) < 2e-5
    assert abs(goals[2].rotation_to(starts[2])) < 2e-5


def test_a_cell_without_an_arm_is_refused(tmp_path: Path) -> None:
    cell = Path("config/positioning_cell/cell.yaml")
    with pytest.raises(ConfigurationError, match="an arm"):
        write_scene(tmp_path, 2, 1, cell, None, None)
