"""The verb `object new` makes an object file from an image, and the file can be loaded."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tapping_cell.cli import main
from tapping_cell.cli.objects.probing import REACH, goal_of
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.se2 import Pose
from tapping_cell.simulation.rendered_camera import SceneRenderer
from tapping_cell.vision import CameraPose, ObjectMarker

SQUARE = 0.03 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """Write an image of the package's table with a square on it."""
    camera = load_camera_model(shared_folder() / "camera_info.yaml")
    table = load_reference_map(shared_folder() / "table.yaml")
    marker = ObjectMarker("APRILTAG_36h11", 7, 0.025, 0.012)
    scene = SceneRenderer(camera, CameraPose.above((0.0, 0.0, 0.7)), table, SQUARE, marker)
    path = tmp_path / "shot.png"
    cv2.imwrite(str(path), scene.render((0.01, 0.0, 0.3)))
    return path


def test_an_image_is_converted_to_an_object_file(tmp_path, picture, capsys):
    made = tmp_path / "square.yaml"
    words = ["object", "new", str(picture), "--name", "square", "--height", "12"]
    assert main([*words, "--output", str(made)]) == 0
    assert "marker 7 of APRILTAG_36h11" in capsys.readouterr().out
    content = load_object(made)
    assert content.name == "square" and content.marker is not None
    corners = np.array(content.shape.vertices)
    apart = np.linalg.norm(corners[:, None] - SQUARE[None], axis=2).min(axis=0)
    assert apart.max() < 5e-4
    # Expected mass: a square of 60 x 60 x 12 mm with the assumed density.
    assert content.mass == pytest.approx(0.0648, rel=0.03)
    # An existing file is not overwritten, and values that contradict the image are refused.
    assert main([*words, "--output", str(made)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*words, "--ring", "--output", str(tmp_path / "ring.yaml")]) == 2
    assert "the image shows a polygon" in capsys.readouterr().err


def test_measuring_goals_stay_near_the_object_and_turn_it_back_and_forth() -> None:
    middle = here = Pose(0.05, -0.02, 3.0)
    turned = []
    for number in range(8):
        goal = goal_of(middle, here, number)
        assert goal.distance_to(middle) == pytest.approx(REACH)
        turned.append(here.rotation_to(goal))
        here = goal
    assert abs(sum(turned)) < 1e-9 and min(map(abs, turned)) > 0.3
