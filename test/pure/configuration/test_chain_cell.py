"""The cell file of a six-axis arm: the shipped example, its reach, and invalid files."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tapping_cell.cli import urdf
from tapping_cell.configuration.cell import load_cell, refuse_own_drivers
from tapping_cell.configuration.chain_reach import chain_reach
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.schema import ConfigurationError

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "six_axis_cell"


def cell_file(folder: Path, **changes: Any) -> Path:
    """Write the example with changes to its chain."""
    shutil.copytree(ROOT / "config", folder / "config")
    shutil.copytree(EXAMPLE, folder / "examples" / "six_axis_cell")
    path = folder / "examples" / "six_axis_cell" / "cell.yaml"
    content = yaml.safe_load(path.read_text())
    content["arm"]["ros2_control"]["chain"] |= changes
    path.write_text(yaml.safe_dump(content))
    return path


def test_the_example_is_consistent_and_its_arm_reaches_the_table() -> None:
    cell = load_cell(EXAMPLE / "cell.yaml")
    errors, warnings = conflicts(cell)
    assert not errors
    assert not [warning for warning in warnings if "reach" in warning], warnings
    with pytest.raises(ConfigurationError, match="/joint_trajectory_controller"):
        refuse_own_drivers(cell)


def test_an_arm_placed_too_far_away_is_reported_with_a_share_and_a_position(tmp_path: Path) -> None:
    far = load_cell(cell_file(tmp_path, mount=[-0.45, 0.0, 0.0, 0.0, 0.0, 0.0]))
    (warning,) = chain_reach(far)
    assert "% of the strike poses" in warning and "from arm_base" in warning


def test_an_arm_that_cannot_park_is_reported(tmp_path: Path) -> None:
    (warning,) = chain_reach(load_cell(cell_file(tmp_path, mount=[3.0, 0, 0, 0, 0, 0])))
    assert "arm.park" in warning


def test_the_cells_own_urdf_is_refused_for_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert urdf.run(argparse.Namespace(cell=EXAMPLE / "cell.yaml")) == 2
    assert "six_axis_arm.urdf" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"urdf": "other.urdf"}, "No such file"),
        ({"tip_link": "tool0"}, "its links are base_link"),
        ({"max_acceleration": [6.0]}, "has 1 values"),
        ({"tilt": 1.0}, "0.0005 to 0.1 rad"),
        ({"tool": [0.0, 0.0, 0.1]}, "tool"),
    ],
)
def test_an_incompatible_description_is_refused_with_a_message(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        load_cell(cell_file(tmp_path, **changes))


def test_a_description_that_is_not_utf_8_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = cell_file(tmp_path)
    description = path.with_name("six_axis_arm.urdf")
    description.write_bytes(description.read_bytes() + "<!-- Prüfstand -->".encode("latin-1"))
    with pytest.raises(ConfigurationError, match="is not UTF-8 text; save it as UTF-8"):
        load_cell(path)
