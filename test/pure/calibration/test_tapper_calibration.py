"""The tapper's curve from travelled distances: known curves, missed taps, wrong units."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import calibration_truths as truths
import numpy as np
import pytest

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.tapper import SHARES, TapRecord, calibrate_tapper
from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell, load_further_objects
from tapping_cell.configuration.files import shared_folder

CELL = load_cell(shared_folder() / "cell.yaml")
SIX_AXES = Path(__file__).parents[3] / "examples" / "six_axis_cell" / "cell.yaml"
TAP = CELL.object.tap(CELL.file.tapper.striker())


def record(seed: int, scatter: float = 0.05):
    random = np.random.default_rng(seed)
    speed = truths.tapper(random, CELL.file.tapper.mass)
    return speed, truths.tap_record(random, TAP, speed, SHARES, scatter)


def changed(taps: TapRecord, distances: np.ndarray) -> TapRecord:
    return replace(taps, distances=distances)


def test_the_travel_without_rotation_matches_the_textbook_formula() -> None:
    energies = np.geomspace(1e-3, 5e-2, 12)
    speeds = np.sqrt(2 * energies / 0.1)
    # Central impact of two free bodies: v0 = (1 + e) m_s / (m + m_s) v, with the striker's mass
    # m_s = 0.1 kg and speed v. Then the object slides with Coulomb friction.
    ratio = (1 + CELL.object.restitution) * 0.1 / (0.1 + CELL.object.mass)
    travel = (ratio * speeds) ** 2 / (2 * CELL.object.friction * 9.81)
    zero = np.zeros(12)
    result = calibrate_tapper(TapRecord(energies, travel, zero, zero, zero, np.arange(12)), TAP)
    np.testing.assert_allclose(result.speeds, np.sqrt(2 * np.array(result.energies) / 0.1), 1e-3)
    assert result.by_friction == pytest.approx(0.5, abs=0.01)
    assert result.by_restitution == pytest.approx(-1 / (1 + CELL.object.restitution), rel=0.01)


def test_thirty_taps_determine_the_speeds_to_three_percent() -> None:
    within = []
    for seed in range(12):
        speed, taps = record(seed)
        result = calibrate_tapper(taps, TAP)
        assert np.all(np.diff(result.speeds) > 0) and np.all(np.diff(result.energies) > 0)
        error = np.array(result.speeds) / speed(np.array(result.energies)) - 1.0
        within.append(np.sqrt((error**2).mean()) < 0.03)
        assert 0.03 < result.scatter < 0.08
    assert sum(within) >= 11


def test_missed_taps_and_outliers_are_named_and_have_little_effect() -> None:
    _, taps = record(3)
    clean = calibrate_tapper(taps, TAP)
    distances = taps.distances.copy()
    distances[17], distances[22] = 0.0, 1e3 * distances[22]
    result = calibrate_tapper(changed(taps, distances), TAP)
    named = {entry.row for entry in result.left_out}
    assert {19, 24} <= named and len(named) <= 3
    assert result.energies[0] == clean.energies[0]
    np.testing.assert_allclose(result.speeds, clean.speeds, rtol=0.03)


def test_charges_too_small_to_move_the_object_end_the_curve() -> None:
    _, taps = record(4)
    lowest = taps.energies == taps.energies.min()
    distances = np.where(lowest, 0.0001, taps.distances)
    result = calibrate_tapper(changed(taps, distances), TAP)
    assert result.least_energy == pytest.approx(taps.energies[~lowest].min())
    assert len(result.left_out) == int(lowest.sum())
    assert result.draws[0].moved == 0


@pytest.mark.parametrize(
    ("pick", "words"),
    [
        (lambda n: np.arange(n) % 5 == 0, "too few"),
        (lambda n: np.arange(n) < 10, "different energies"),
    ],
)
def test_records_that_give_no_curve_are_refused(pick, words: str) -> None:
    _, taps = record(5)
    part = pick(len(taps.rows))
    cut = TapRecord(*(getattr(taps, name)[part] for name in TapRecord.__slots__))
    with pytest.raises(CalibrationRefused, match=words):
        calibrate_tapper(cut, TAP)


def test_the_verb_writes_a_cell_that_the_nodes_read(tmp_path: Path, capsys) -> None:
    _, taps = record(6)
    pairs = zip(taps.energies * 1e3, taps.distances * 1e3, strict=True)
    text = "energy_mJ,distance_mm\n" + "".join(f"{e:.6f},{d:.4f}\n" for e, d in pairs)
    path, output = tmp_path / "taps.csv", tmp_path / "cell.yaml"
    path.write_text(text.replace("distance_mm", "distance"))
    words = ["calibrate", "tapper", str(path), "--cell", str(CELL.path), "--output", str(output)]
    assert main(words) == 2
    assert "name the column distance_mm" in capsys.readouterr().err
    path.write_text(text)
    assert main(words) == 0
    cell = load_cell(output)
    assert cell.file.tapper.calibration is not None
    assert cell.file.tapper.calibration.by == "calibrate tapper"
    assert cell.file.tapper.curve().slowest > CELL.file.tapper.curve().slowest
    assert cell.object == CELL.object


def test_speeds_far_from_those_of_the_old_curve_are_named(tmp_path: Path, capsys) -> None:
    _, taps = record(6)
    names, columns = "energy_mJ,distance_mm", (1e3 * taps.energies, 1e3 * taps.distances)
    outputs = []
    cell = CELL.path
    for first, second in (columns, columns, columns[::-1]):
        path, output = tmp_path / "taps.csv", tmp_path / f"cell_{len(outputs)}.yaml"
        rows = "".join(f"{a:.6f},{b:.6f}\n" for a, b in zip(first, second, strict=True))
        path.write_text(f"{names}\n{rows}")
        words = ["calibrate", "tapper", str(path), "--cell", str(cell), "--output", str(output)]
        assert main(words) == 0
        outputs.append(capsys.readouterr().out)
        cell = output
    assert ["check names and units of the columns" in text for text in outputs] == [
        True,
        False,
        True,
    ]


@pytest.mark.parametrize("kind", ["several objects", "chain"])
def test_a_copy_in_another_folder_finds_the_files_of_the_cell(tmp_path: Path, kind: str) -> None:
    _, taps = record(6)
    pairs = zip(taps.energies * 1e3, taps.distances * 1e3, strict=True)
    path, output = tmp_path / "taps.csv", tmp_path / "other" / "cell.yaml"
    output.parent.mkdir()
    path.write_text("energy_mJ,distance_mm\n" + "".join(f"{e:.6f},{d:.4f}\n" for e, d in pairs))
    if kind == "chain":
        source = SIX_AXES
    else:
        shutil.copytree(shared_folder(), tmp_path / "config")
        source = tmp_path / "config" / "cell.yaml"
        shutil.copy(source.parent / "objects" / "aluminium_square.yaml", tmp_path / "é square.yaml")
        listed = f"objects:\n  - {tmp_path / 'é square.yaml'}   # the square\n"
        source.write_text(source.read_text(encoding="utf-8") + listed, encoding="utf-8")
    words = ["calibrate", "tapper", str(path), "--cell", str(source), "--output", str(output)]
    assert main(words) == 0
    cell, copy = load_cell(source), load_cell(output)
    assert copy.file.tapper.calibration is not None
    assert copy.object_path == cell.object_path
    assert load_further_objects(copy) == load_further_objects(cell)
    if kind == "chain":
        assert copy.arm.chain() is not None
    else:
        written = output.read_text(encoding="utf-8")
        assert '- "../é square.yaml"   # the square' in written


def test_a_further_object_that_is_missing_is_named_at_once(tmp_path: Path, capsys) -> None:
    shutil.copytree(shared_folder(), tmp_path / "config")
    source = tmp_path / "config" / "cell.yaml"
    source.write_text(source.read_text(encoding="utf-8") + "objects: [objects/none.yaml]\n")
    words = ["calibrate", "tapper", str(tmp_path / "taps.csv"), "--cell", str(source)]
    assert main([*words, "--output", str(tmp_path / "cell.yaml")]) == 2
    assert "objects/none.yaml" in capsys.readouterr().err
