"""Lines of fixed tappers are determined from single taps and compared with the true lines."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from report_parts import made_run, tap_row

from tapping_cell.calibration.mounts import MAX_DEVIATION, TapScatter, fit_mount
from tapping_cell.cli import main
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.report.run import Run
from tapping_cell.report.run_folder import write_illustrated_run
from tapping_cell.report.run_reader import IllustratedRun
from tapping_cell.se2 import Pose, wrap_angle

FILE = shared_folder() / "positioning_cell" / "cell.yaml"
CELL = load_cell(FILE)
SCATTER = TapScatter(0.05, 0.15, math.radians(1.0), 5e-5, math.radians(0.05))


def moved(mount: Pose, offset: float, angle: float) -> Pose:
    return Pose(
        mount.x - offset * math.sin(mount.theta),
        mount.y + offset * math.cos(mount.theta),
        mount.theta + angle,
    )


def made_taps(entry, true: Pose, factor: float, count: int, rng: np.random.Generator):
    """Return taps of an object that was placed by hand near the middle, as measured by the
    camera."""
    tap = CELL.object.tap(CELL.tapper_of(entry).striker())
    angles, radii = rng.uniform(-math.pi, math.pi, count), 0.05 * np.sqrt(rng.random(count))
    before = np.stack([radii * np.cos(angles), radii * np.sin(angles), angles], axis=-1)
    speeds = np.full(count, 0.6)
    predicted = tap.outcome(before, np.array([true.x, true.y, true.theta]), factor * speeds)
    heading = np.arctan2(
        predicted[:, 1], predicted[:, 0]
    ) + SCATTER.direction * rng.standard_normal(count)
    size = np.hypot(predicted[:, 0], predicted[:, 1]) * (1.0 + 0.05 * rng.standard_normal(count))
    turn = predicted[:, 2] * (1.0 + 0.15 * rng.standard_normal(count))
    after = before + np.stack([size * np.cos(heading), size * np.sin(heading), turn], axis=-1)
    camera_noise = np.array([5e-5, 5e-5, math.radians(0.05)])
    seen = [pose + camera_noise * rng.standard_normal(pose.shape) for pose in (before, after)]
    return speeds, seen[0], seen[1]


def line_error(found: Pose, true: Pose) -> float:
    """Return the signed distance between the two lines, measured near the middle of the table,
    m."""
    reach = math.hypot(true.x, true.y) - 0.05
    point = np.array([true.x + reach * math.cos(true.theta), true.y + reach * math.sin(true.theta)])
    off = point - np.array([found.x, found.y])
    return float(off[0] * math.sin(found.theta) - off[1] * math.cos(found.theta))


def test_twelve_taps_determine_a_line_to_a_third_of_a_millimetre() -> None:
    rng = np.random.default_rng(5)
    errors, claimed = [], []
    for trial in range(40):
        entry = CELL.fixed_tappers.tappers[trial % 8]
        nominal = Pose(*entry.position, entry.direction)
        true = moved(nominal, 1e-3 * rng.standard_normal(), 0.01 * rng.standard_normal())
        factor = 1.0 + 0.05 * rng.standard_normal()
        tap = CELL.object.tap(CELL.tapper_of(entry).striker())
        fit = fit_mount(entry.name, nominal, tap, *made_taps(entry, true, factor, 12, rng), SCATTER)
        errors.append(line_error(fit.mount, true))
        claimed.append(fit.line_deviation)
        assert fit.speed_factor == pytest.approx(factor, rel=0.05)
        expected = line_error(fit.mount, true) - line_error(nominal, true)
        # The fit gives the offset of the line at the mean position of the objects, which may be up
        # to 3 cm from the middle of the table.
        assert fit.line_offset == pytest.approx(expected, abs=0.03 * abs(fit.angle) + 1e-4)
        assert abs(wrap_angle(fit.mount.theta - true.theta)) < 5.0 * fit.angle_deviation
    assert np.sqrt(np.mean(np.square(errors))) < MAX_DEVIATION
    # The stated uncertainty is within a factor of two of the actual error.
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) / np.mean(claimed) < 2.0


def write(path: Path, rows) -> Path:
    names = "x_before,y_before,theta_before,x_after,y_after,theta_after"
    lines = [f"tapper,speed,{names}"]
    for name, speed, before, after in rows:
        lines.append(",".join([name, *(f"{value:.7f}" for value in (speed, *before, *after))]))
    path.write_text("\n".join(lines))
    return path


def test_the_verb_writes_the_measured_mounts(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    entry = CELL.fixed_tappers.tappers[1]
    true = moved(Pose(*entry.position, entry.direction), 8e-4, -0.006)
    taps = zip(*made_taps(entry, true, 1.0, 16, rng), strict=True)
    record = write(tmp_path / "taps.csv", ((entry.name, *tap) for tap in taps))
    made = tmp_path / "cell.yaml"
    assert (
        main(["calibrate", "mounts", str(record), "--cell", str(FILE), "--output", str(made)]) == 0
    )
    found = load_cell(made).fixed_tappers
    measured = found.tappers[1]
    assert abs(line_error(Pose(*measured.position, measured.direction), true)) < 2 * MAX_DEVIATION
    assert found.tappers[0] == CELL.fixed_tappers.tappers[0]
    assert found.calibration is not None
    assert found.calibration.observations + found.calibration.left_out == 16


def run_of(name: str, taps, object_name: str = CELL.object.name) -> Run:
    """Return a run of taps by one tapper, as the recorder writes it."""
    rows = [
        tap_row(
            number,
            before=Pose(*before),
            measured=Pose(*after),
            striker_speed=float(speed),
            tapper=name,
        )
        for number, (speed, before, after) in enumerate(taps, start=1)
    ]
    return made_run(rows, object_name=object_name, began=0.0)


def test_the_verb_reads_the_taps_of_goals_from_run_folders(tmp_path: Path, capsys) -> None:
    rng = np.random.default_rng(7)
    entry = CELL.fixed_tappers.tappers[2]
    true = moved(Pose(*entry.position, entry.direction), -7e-4, 0.005)
    taps = list(zip(*made_taps(entry, true, 1.0, 16, rng), strict=True))
    folders = [tmp_path / "one", tmp_path / "two"]
    for folder, part in zip(folders, (taps[:7], taps[7:]), strict=True):
        folder.mkdir()
        write_illustrated_run(folder, IllustratedRun(run_of(entry.name, part), ()), pictures=False)
    made = tmp_path / "cell.yaml"
    command = ["calibrate", "mounts", *map(str, folders), "--cell", str(FILE)]
    assert main([*command, "--output", str(made)]) == 0
    measured = load_cell(made).fixed_tappers.tappers[2]
    assert abs(line_error(Pose(*measured.position, measured.direction), true)) < 2 * MAX_DEVIATION

    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    capsys.readouterr()
    again = [*command[:2], str(unfinished), *command[2:]]
    assert main([*again, "--output", str(tmp_path / "again.yaml")]) == 0
    assert f"left out: {unfinished} has no summary.json" in capsys.readouterr().out

    # The pattern runs/* also gives the comparison page.
    page = tmp_path / "comparison.html"
    page.write_text("<html></html>")
    with_page = [*command[:2], str(page), *command[2:]]
    assert main([*with_page, "--output", str(tmp_path / "with_page.yaml")]) == 0
    assert f"left out: {page} is not a run folder" in capsys.readouterr().out
    for name, words in (("none", "does not exist"), ("taps.csv", "give one CSV file, or run")):
        (tmp_path / "taps.csv").touch()
        mixed = [*command[:2], str(tmp_path / name), *command[2:]]
        assert main([*mixed, "--output", str(tmp_path / "mixed.yaml")]) == 2
        assert words in capsys.readouterr().err

    other = run_of(entry.name, taps, "teapot")
    write_illustrated_run(folders[0], IllustratedRun(other, ()), pictures=False)
    assert main([*command, "--output", str(tmp_path / "other.yaml")]) == 2
    assert "teapot" in capsys.readouterr().err


def test_taps_that_contradict_the_cell_file_are_refused(tmp_path: Path, capsys) -> None:
    """Poses before and after the tap are exchanged, or another tapper made the taps."""
    rng = np.random.default_rng(8)
    entry, other = CELL.fixed_tappers.tappers[:2]
    true = Pose(*entry.position, entry.direction)
    for name, exchanged, words in (
        (entry.name, True, "taps moved the object towards the tapper"),
        (other.name, False, "check that this tapper made them"),
    ):
        speeds, before, after = made_taps(entry, true, 1.0, 12, rng)
        poses = (after, before) if exchanged else (before, after)
        taps = zip(speeds, *poses, strict=True)
        record = write(tmp_path / "taps.csv", ((name, *tap) for tap in taps))
        output = tmp_path / "cell.yaml"
        command = ["calibrate", "mounts", str(record), "--cell", str(FILE)]
        assert main([*command, "--output", str(output)]) == 1
        assert words in capsys.readouterr().err
        assert not output.exists()


def test_an_unknown_tapper_and_too_few_taps_are_refused(tmp_path: Path, capsys) -> None:
    still = ((0.0, 0.0, 0.0), (0.02, 0.0, 0.1))
    for name, words in (("upstairs", "made by 'upstairs'"), ("east", "at least 4")):
        record = write(tmp_path / "taps.csv", [(name, 0.5, *still)])
        output = tmp_path / "cell.yaml"
        status = main(
            ["calibrate", "mounts", str(record), "--cell", str(FILE), "--output", str(output)]
        )
        assert status in (1, 2)
        assert words in capsys.readouterr().err
        assert not output.exists()
