"""A node with an invalid parameter reports it by name and does not keep running half-configured."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes import MODULES

NODES = ("camera_pose", "tap_planner", "scara_arm", "tapper_trigger", "sim_world")


def run_node(node: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", MODULES[node], "--ros-args", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=150, check=False)


def wrong_cell(tmp_path: Path, old: str, new: str) -> Path:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    path = folder / "cell.yaml"
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    return path


@pytest.mark.parametrize("node", NODES)
def test_an_unknown_key_in_the_cell_file_is_refused_with_file_and_key(
    node: str, tmp_path: Path
) -> None:
    path = wrong_cell(tmp_path, "upper_arm: 0.425", "upper_leg: 0.425")
    ended = run_node(node, "-p", f"cell_file:={path}")
    assert ended.returncode == 1
    assert f"{path}: unknown key 'arm.upper_leg'" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("length: 0.60", "length: [", ("malformed YAML", "line ")),
        ("length: 0.60", "length: wide", ("'table.length'", "'wide'", "a number")),
        ("length: 0.60", "length: 60", ("'table.length'", "60", "0.05 to 10 m")),
        ("object: objects", "object: no_objects", ("no_objects", "cannot be read")),
    ],
    ids=["malformed", "type", "range", "missing file"],
)
def test_an_invalid_cell_file_is_refused_with_value_and_range(
    old: str, new: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    path = wrong_cell(tmp_path, old, new)
    ended = run_node("tap_planner", "-p", f"cell_file:={path}")
    assert ended.returncode == 1
    for word in words:
        assert word in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("-p", "cell_flie:=x"), ("unknown parameter 'cell_flie'", "cell_file")),
        (("-p", "attempts:=many"), ("'attempts'", "'many'", "1 to 100")),
        (("-p", "attempts:=1000"), ("'attempts'", "1000", "1 to 100")),
        (("-p", "planner:=guess"), ("'guess'", "exact", "optimal")),
    ],
    ids=["unknown", "type", "range", "method"],
)
def test_an_invalid_parameter_is_refused_with_value_and_range(
    arguments: tuple[str, ...], words: tuple[str, ...]
) -> None:
    ended = run_node("tap_planner", *arguments)
    assert ended.returncode == 1
    for word in words:
        assert word in ended.stderr, ended.stderr
    assert "Traceback" not in ended.stderr
