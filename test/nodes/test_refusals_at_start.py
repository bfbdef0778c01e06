"""A node with an invalid parameter reports it by name and does not keep running half-configured."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path

import pytest

from tapping_cell.configuration.files import shared_folder
from tapping_cell.nodes import MODULES

pytestmark = pytest.mark.usefixtures("own_signals")
NODES = ("camera_pose", "tap_planner", "scara_arm", "tapper_trigger", "sim_world")


def run_node(capsys: pytest.CaptureFixture[str], node: str, *arguments: str) -> tuple[int, str]:
    """Run the main function of a node; return its exit code and its errors."""
    status = importlib.import_module(MODULES[node]).main(["--ros-args", *arguments])
    return status, capsys.readouterr().err


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
    node: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = wrong_cell(tmp_path, "upper_arm: 0.425", "upper_leg: 0.425")
    status, errors = run_node(capsys, node, "-p", f"cell_file:={path}")
    assert status == 1
    assert f"{path}: unknown key 'arm.upper_leg'" in errors
    assert "Traceback" not in errors


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
    old: str, new: str, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = wrong_cell(tmp_path, old, new)
    status, errors = run_node(capsys, "tap_planner", "-p", f"cell_file:={path}")
    assert status == 1
    for word in words:
        assert word in errors


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
    arguments: tuple[str, ...], words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    status, errors = run_node(capsys, "tap_planner", *arguments)
    assert status == 1
    for word in words:
        assert word in errors, errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    "name", ["/camera/image_raw.subscription.durability", "/emergency_stop.subscription.depth"]
)
def test_an_unknown_quality_of_service_is_refused_with_those_that_exist(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, errors = run_node(capsys, "camera_pose", "-p", f"qos_overrides.{name}:=volatile")
    assert status == 1
    assert f"'qos_overrides.{name}'" in errors
    assert "qos_overrides./camera/image_raw.subscription.reliability" in errors
