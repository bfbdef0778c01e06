"""check-config reports all errors at once without starting any node."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from tapping_cell.cli import main
from tapping_cell.cli.check_config import KINDS, check, recognise
from tapping_cell.configuration.files import shared_folder

Change = tuple[str, str, Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shutil.copytree(shared_folder(), tmp_path / "config")
    return tmp_path / "config"


def change(path: Path, *changes: tuple[str, Any]) -> Path:
    """Set keys such as arm.base of a YAML file; a value of None removes the key."""
    document = yaml.safe_load(path.read_text())
    for key, value in changes:
        *above, last = key.split(".")
        place = document
        for name in above:
            place = place[int(name)] if name.isdigit() else place[name]
        if value is None:
            del place[last]
        else:
            place[last] = value
    path.write_text(yaml.safe_dump(document))
    return path


def errors(path: Path, kind: str | None = None) -> list[str]:
    return [sentence for found in check(path, kind) for sentence in found.errors]


def shipped() -> list[Path]:
    return sorted(path for path in shared_folder().rglob("*.yaml"))


@pytest.mark.parametrize("path", shipped(), ids=lambda path: path.name)
def test_every_shipped_file_is_recognised_and_valid(path: Path) -> None:
    (found, *_) = check(path)
    assert found.kind in KINDS
    assert found.errors == []


def test_all_errors_of_a_file_are_reported_together(folder: Path) -> None:
    cell = change(
        folder / "cell.yaml",
        ("arm.upper_arm", "long"),
        ("arm.upper_leg", 0.4),
        ("table.width", None),
        ("tapper.mass", -1),
        ("arm.dialect", "german"),
    )
    found = errors(cell)
    assert len(found) == 5
    for words in ("upper_arm", "upper_leg", "table.width", "tapper.mass", "arm.dialect"):
        assert any(words in sentence and str(cell) in sentence for sentence in found), words


def test_the_files_that_a_cell_names_are_checked_too(folder: Path) -> None:
    change(folder / "objects" / "aluminium_disk.yaml", ("mass", "heavy"), ("shape.radius", None))
    change(folder / "table.yaml", ("markers.3.id", "x"))
    found = errors(folder / "cell.yaml")
    assert len(found) == 3
    (folder / "camera_info.yaml").unlink()
    assert any(
        "camera_info.yaml: cannot be read" in sentence for sentence in errors(folder / "cell.yaml")
    )


def test_the_home_folder_in_the_path_of_a_further_object_is_expanded(folder, monkeypatch):
    monkeypatch.setenv("HOME", str(folder / "objects"))
    cell = change(folder / "cell.yaml", ("objects", ["~/plexiglas_disk.yaml"]))
    assert errors(cell) == []
    change(folder / "objects" / "plexiglas_disk.yaml", ("mass", "heavy"))
    assert len(errors(cell)) == 1
    (found,) = errors(change(cell, ("objects", ["~nobody_of_this_name/disk.yaml"])))
    assert "cannot be read" in found


@pytest.mark.parametrize(
    ("file", "key", "value", "words"),
    [
        ("objects/aluminium_disk.yaml", "marker.id", 104, "reference marker"),
        ("objects/aluminium_disk.yaml", "height", 0.004, "passes over the object"),
        ("objects/aluminium_disk.yaml", "marker.size", 0.09, "extends beyond"),
        ("cell.yaml", "arm.strike_height", 0.004, "scrapes the table"),
        ("cell.yaml", "tapper.tip_radius", 0.0108, "if it is the tip's diameter"),
        ("cell.yaml", "tapper.stroke", 0.05, "for 'tapper.stroke'"),
        ("cell.yaml", "arm.travel_height", 0.011, "above the object"),
        ("cell.yaml", "arm.travel_height", 0.3, "lifts the tip to at most"),
        ("cell.yaml", "tapper.stroke", 0.010, "never reaches"),
        ("cell.yaml", "arm.park", [3.0, 1.2, -0.02, 0.0], "arm.park[0]"),
        ("cell.yaml", "goal.planner", "guess", "must be one of"),
        ("cell.yaml", "arm.base", [0.0, 4.0, -1.57], "the arm can tap the object nowhere"),
        ("cell.yaml", "table.width", 0.08, "fits nowhere"),
        ("cell.yaml", "tapper.speeds", [0.9, 1.0, 1.1, 1.2, 1.3], "more than the charged"),
        ("camera_info.yaml", "image_width", 2560, "fits an image of about 1280 x 1024"),
        ("cell.yaml", "tapper.energies", [1e-5, 1e-4], "shorter"),
    ],
)
def test_contradictions_are_reported(file, key, value, words, folder):
    change(folder / file, (key, value))
    found = errors(folder / "cell.yaml")
    assert found and (words == "shorter" or any(words in sentence for sentence in found)), found


def test_a_value_that_may_be_valid_is_a_warning(folder: Path) -> None:
    cell = change(
        folder / "cell.yaml",
        ("arm.port", "/dev/nothing"),
        ("camera.position_noise", 0.0008),
        ("arm.base", [0.0, 0.80, -1.57]),
    )
    (found, *_) = check(cell)
    assert found.errors == []
    for words in ("/dev/nothing", "position_tolerance", "are within the arm's reach for taps"):
        assert any(words in sentence for sentence in found.warnings), (words, found.warnings)


@pytest.mark.parametrize("document", [None, [], {}, {"apples": 1}, 3, {"name": "x"}])
def test_the_kind_of_an_unrecognised_file_is_not_guessed(document: Any, tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(yaml.safe_dump(document))
    assert recognise(document) in (None, "object", "cell")
    assert errors(path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_forced_on_another_file_is_refused_with_a_message(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("apples: 3\n")
    assert all(str(path) in sentence for sentence in errors(path, kind))
    assert errors(path, kind)


def test_one_key_of_another_kind_does_not_make_a_file_of_that_kind(tmp_path: Path) -> None:
    path = tmp_path / "camera_info.yaml"  # the names of a camera's own program
    path.write_text("{width: 1280, height: 1024, fx: 900.0, fy: 900.0, ppx: 640.0, ppy: 512.0}")
    assert "name the values as in the package's camera_info.yaml" in errors(path, "camera_info")[0]


PARAMETERS = """
/**:
  ros__parameters: {autostart: true}
/left/tap_planner:
  ros__parameters: {attempts: 5, atempts: 3, place_deadline: 900.0}
nobody:
  ros__parameters: {}
camera_pose:
  ros__parameters: {use_sim_time: true, silence_limit: many}
"""


def test_a_parameter_file_is_checked_against_the_nodes(tmp_path: Path) -> None:
    path = tmp_path / "parameters.yaml"
    path.write_text(PARAMETERS)
    assert recognise(yaml.safe_load(PARAMETERS)) == "parameters"
    found = errors(path)
    for words in ("'atempts'", "'place_deadline' is", "nobody: no node", "'silence_limit' is"):
        assert sum(words in sentence for sentence in found) == 1, (words, found)
    assert len(found) == 4


@pytest.mark.parametrize(
    ("text", "place", "key"),
    [
        (
            "tap_planner: {ros__parameters: {ask: true}, use_sim_time: false}",
            "tap_planner",
            "use_sim_time",
        ),
        ("tap_planner: {ros__parameters: {ask: true}, attempts: }", "tap_planner", "attempts"),
        ("tap_planner: {ros__parameters: {}, planner: optimal}", "tap_planner", "planner"),
        ("tap_planner: {ros__parameters: {}, values: {ask: true}}", "tap_planner/values", "ask"),
    ],
)
def test_a_key_outside_ros_parameters_is_reported(text, place, key, tmp_path):
    path = tmp_path / "parameters.yaml"
    path.write_text(text)
    assert errors(path) == [
        f"{path}: {place}: key '{key}' must be under 'ros__parameters'; correct its indentation"
    ]


def test_a_parameter_file_without_its_second_key_is_recognised_by_its_nodes(tmp_path):
    path = tmp_path / "parameters.yaml"
    path.write_text("/**/tap_planner:\n  ros_parameters: {adapt: true}\n")
    assert "'ros__parameters' (two underscores) under each" in errors(path)[0]
    path.write_text("ros__parameters: {adapt: true}\n")
    assert "node names with 'ros__parameters'" in errors(path)[0]
    path.write_text("/**/tap-planner: {ros__parameters: {adapt: true}}\n")
    assert "no node has this name; did you mean 'tap_planner'?" in errors(path)[0]


def test_the_verb_returns_an_exit_status_and_json(folder, capsys):
    cell = folder / "cell.yaml"
    assert main(["check-config", str(cell), str(folder / "truth" / "default.yaml")]) == 0
    assert "ok" in capsys.readouterr().out
    change(cell, ("goal.planner", "guess"))
    assert main(["check-config", str(cell), "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] is False
    assert {entry["kind"] for entry in result["files"]} == {
        "cell",
        "table",
        "camera_info",
        "object",
    }
    assert "guess" in result["files"][0]["errors"][0]
    assert main(["check-config", "/nowhere.yaml"]) == 1
    assert "/nowhere.yaml" in capsys.readouterr().out
