"""Cell files whose arm has its own driver: valid and invalid values."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tapping_cell.configuration.cell import load_cell, refuse_own_drivers
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError

SECTION = {"controller": "/scara_controller", "joints": ["a", "b", "c", "d"]}


def cell_file(folder: Path, **changes: Any) -> Path:
    """Write the package's cell file with such an arm; a value of None removes a key."""
    shutil.copytree(shared_folder(), folder / "config")
    path = folder / "config" / "cell.yaml"
    content = yaml.safe_load(path.read_text())
    arm = content["arm"]
    arm |= {"dialect": "ros2_control", "homing": "none", "ros2_control": SECTION}
    del arm["port"], arm["baud"]
    arm |= changes
    for key in [key for key, value in changes.items() if value is None]:
        del arm[key]
    path.write_text(yaml.safe_dump(content))
    return path


def test_the_cell_is_accepted_but_not_simulated(tmp_path: Path) -> None:
    cell = load_cell(cell_file(tmp_path))
    assert cell.file.arm.ros2_control is not None
    errors, _ = conflicts(cell)
    assert not errors
    with pytest.raises(ConfigurationError, match="would move the arm of /scara_controller"):
        refuse_own_drivers(cell)
    refuse_own_drivers(load_cell())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ros2_control": None}, "'arm.ros2_control' is missing"),
        ({"homing": "firmware"}, "must be none"),
        ({"port": "/dev/ttyUSB0"}, "arm.port is not used"),
        ({"ros2_control": SECTION | {"joints": ["a", "b", "c"]}}, "3 names, the arm has 4"),
        ({"ros2_control": SECTION | {"joints": ["a", "b", "c", "a"]}}, "a name of its own"),
        ({"ros2_control": SECTION | {"controller": "scara"}}, "must be a full name"),
        ({"ros2_control": SECTION | {"state_timeout": 3.0}}, "0.05 to 1 s"),
        ({"ros2_control": SECTION | {"interface": "servo"}}, "auto, topic, action"),
        ({"dialect": "grbl", "homing": "firmware", "port": "/dev/a"}, "not used by the dialect"),
        ({"dialect": "grbl", "homing": "firmware", "ros2_control": None}, "'arm.port' is missing"),
    ],
)
def test_contradictions_are_refused_with_a_message(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        load_cell(cell_file(tmp_path, **changes))
