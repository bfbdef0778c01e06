"""The cell file of a cell with fixed tappers."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.conflicts import conflicts
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError


@pytest.fixture
def file(tmp_path: Path) -> Path:
    shutil.copytree(shared_folder(), tmp_path / "config")
    return tmp_path / "config" / "positioning_cell" / "cell.yaml"


def change(path: Path, edit) -> None:
    document = yaml.safe_load(path.read_text())
    edit(document)
    path.write_text(yaml.safe_dump(document))


def test_the_shipped_cell_has_eight_tappers_and_no_arm(file: Path) -> None:
    cell = load_cell(file)
    assert len(cell.tapper_names) == 8
    assert conflicts(cell)[0] == []
    with pytest.raises(ConfigurationError, match="fixed tappers and no arm"):
        _ = cell.arm
    assert load_cell().tapper_names == ("tapper",)
    with pytest.raises(ConfigurationError, match="an arm and no fixed tappers"):
        _ = load_cell().fixed_tappers


@pytest.mark.parametrize("shape", ["aluminium_disk", "aluminium_square"])
def test_the_shipped_cell_with_twelve_tappers_has_two_boards(file: Path, shape: str) -> None:
    cell = load_cell(
        file.with_name("twelve_tappers.yaml"), file.parent.parent / "objects" / f"{shape}.yaml"
    )
    assert conflicts(cell)[0] == []
    assert [len(board.channels) for board in cell.boards] == [8, 4]
    assert len(set(cell.tapper_channels.values())) == len(cell.tapper_names) == 12


def test_a_cell_has_either_an_arm_or_fixed_tappers(file: Path) -> None:
    change(file, lambda d: d.pop("fixed_tappers"))
    with pytest.raises(ConfigurationError, match="either the key 'arm'"):
        load_cell(file)


def test_a_tapper_may_differ_from_the_others(file: Path) -> None:
    def edit(document) -> None:
        document["fixed_tappers"]["tappers"][2] |= {"stroke": 0.18, "tip_radius": 0.004}

    change(file, edit)
    cell = load_cell(file)
    sections = cell.tapper_sections
    assert sections["north"].stroke == 0.18
    assert sections["east"].stroke == 0.2
    assert sections["north"].energies == sections["east"].energies


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda f: f["tappers"].__delitem__(slice(4, 8)), "no tap moves the object inward"),
        (lambda f: f["tappers"][1].update(channel=0), "are both channel 0"),
        (lambda f: f.update(strike_height=0.02), "pass over the object"),
        (lambda f: f["tappers"][0].update(position=[0.1, 0.013]), "would touch the tip"),
        (
            lambda f: f.update(working_area=[0.0, 0.13, 0.07]),
            "hang over the table's edge",
        ),
    ],
)
def test_an_infeasible_layout_is_refused(file: Path, edit, words: str) -> None:
    change(file, lambda document: edit(document["fixed_tappers"]))
    errors = conflicts(load_cell(file))[0]
    assert any(words in error for error in errors), errors


def test_two_tappers_with_the_same_name_are_refused(file: Path) -> None:
    change(file, lambda d: d["fixed_tappers"]["tappers"][1].update(name="east"))
    with pytest.raises(ConfigurationError, match="name of its own"):
        load_cell(file)


def test_check_config_draws_the_layout(file: Path, tmp_path: Path) -> None:
    picture = tmp_path / "layout.png"
    assert main(["check-config", str(file), "--drawing", str(picture)]) == 0
    assert picture.stat().st_size > 10_000
