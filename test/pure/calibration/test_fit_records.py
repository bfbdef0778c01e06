"""Records of single taps: they are read as they were written, and invalid ones are reported with
file and row."""

import csv
import math
import os
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from single_tap_records import DISK, STRIKER, TRUE, taps, track, write

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import ExperimentFile, read_experiment, write_header
from tapping_cell.calibration.object_fit import fit_object
from tapping_cell.calibration.screening import screen
from tapping_cell.calibration.trials import (
    TRIAL_COLUMNS,
    Trial,
    append_trial,
    read_track,
    read_trials,
)
from tapping_cell.configuration.schema import ConfigurationError

GRAVITY = 9.81


def screened(folder):
    return screen([read_experiment(folder)], DISK.body(), GRAVITY)


def rewrite(file, change):
    """Replace each row of a CSV file by ``change(row)``."""
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    changed = [change(dict(row)) for row in rows]
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(changed[0]))
        writer.writeheader()
        writer.writerows(changed)


def times(*names, factor):
    def change(row):
        return row | {name: str(float(row[name]) * factor) for name in names}

    return change


@given(data=st.data())
def test_a_trial_is_read_back_as_written(tmp_path_factory, data):
    values = {}
    for column in TRIAL_COLUMNS:
        low, high = max(column.minimum, -90.0), min(column.maximum, 90.0)
        if data.draw(st.booleans()):
            values[column.name] = data.draw(st.floats(low, high, allow_nan=False))
    trial = Trial(run=3, trial=7, displacement=0.02, rotation=0.1, direction=0.5)
    trial = replace(trial, **values)
    folder = tmp_path_factory.mktemp("records")
    append_trial(folder, trial)
    (read,) = read_trials(folder).trials
    for entry in fields(Trial):
        if entry.compare:
            there, here = getattr(trial, entry.name), getattr(read, entry.name)
            missing = isinstance(there, float) and math.isnan(there)
            assert missing or here == there


def test_a_track_is_read_back_unwrapped(tmp_path):
    seen = replace(track(spin=6.0, start=(0.0, 0.0, 3.1)))
    wrapped = replace(seen, theta=np.remainder(seen.theta + math.pi, math.tau) - math.pi)
    append_trial(tmp_path, Trial(1, 1, displacement=0.02, rotation=0.1, track=wrapped))
    (read,) = read_trials(tmp_path).trials
    assert read.track.theta == pytest.approx(seen.theta, abs=1e-12)
    assert (read.track.time == seen.time).all()


def test_motion_is_computed_from_the_poses(tmp_path):
    poses = {"start_x": 0.01, "start_y": 0.0, "start_theta": 3.1}
    poses |= {"end_x": 0.01, "end_y": 0.03, "end_theta": -3.1}
    append_trial(tmp_path, Trial(1, 1, **poses))
    (read,) = read_trials(tmp_path).trials
    assert read.displacement == pytest.approx(0.03)
    assert read.rotation == pytest.approx(math.tau - 6.2)
    assert read.direction == pytest.approx(math.pi / 2)


def test_files_in_other_units_are_read(tmp_path):
    (tmp_path / "trials.csv").write_text(
        "run,trial,displacement_mm,rotation_deg,initial_speed_mm_s,initial_spin_deg_s\n"
        "2,1,18.5,5.0,250,90\n"
    )
    (read,) = read_trials(tmp_path).trials
    assert (read.run, read.displacement, read.initial_speed) == (2, 0.0185, 0.25)
    assert read.rotation == pytest.approx(math.radians(5))
    assert read.initial_spin == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("run,trial,displacement_m\n1,1,0.02\n", "rotation"),
        ("run,displacement_m,rotation_rad\n1,0.02,0.1\n", "trial"),
        ("run,trial,displacement_m,rotation_rad\n1,1,0.02,0.1\n1,1,0.03,0.1\n", "row 3"),
        ("", "empty"),
        ("run,trial,displacement_m,rotation_rad\n1,1,18,0.1\n1,2,20,0.2\n", "displacement_mm"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused(tmp_path, text, words):
    file = tmp_path / "trials.csv"
    file.write_text(text)
    with pytest.raises(RecordError, match=words) as refusal:
        read_trials(tmp_path)
    assert str(file) in str(refusal.value)


def test_a_non_numeric_row_is_excluded_and_its_number_reported(tmp_path):
    (tmp_path / "trials.csv").write_text(
        "run,trial,displacement_m,rotation_rad,outcome\n"
        "1,1,0.02,0.1,ok\n1,2,about 2 cm,0.1,ok\n1,3,0.02,0.1,perhaps\n1,4,0.02,0.1,ok\n"
    )
    found = read_trials(tmp_path)
    assert [trial.trial for trial in found.trials] == [1, 4]
    assert sorted(row.row for row in found.left_out) == [3, 4]
    assert all("trials.csv" in row.file for row in found.left_out)


def test_a_trial_is_never_written_twice(tmp_path):
    trial = Trial(1, 1, displacement=0.02, rotation=0.1)
    append_trial(tmp_path, trial)
    with pytest.raises(RecordError, match="already"):
        append_trial(tmp_path, trial)


@pytest.mark.parametrize("present", [0, 1])
def test_a_program_killed_while_writing_leaves_the_rows_unchanged(tmp_path, monkeypatch, present):
    for trial in range(present):
        append_trial(tmp_path, Trial(1, trial + 1, displacement=0.02, rotation=0.1))
    before = {file.name: file.read_bytes() for file in tmp_path.glob("*.csv")}
    with monkeypatch.context() as ended:
        ended.setattr(os, "replace", lambda *_: pytest.fail("ended"))
        with pytest.raises(pytest.fail.Exception):
            append_trial(tmp_path, Trial(1, present + 1, displacement=0.03, rotation=0.2))
    assert {file.name: file.read_bytes() for file in tmp_path.glob("*.csv")} == before
    append_trial(tmp_path, Trial(1, present + 1, displacement=0.03, rotation=0.2))
    assert [trial.trial for trial in read_trials(tmp_path).trials] == list(range(1, present + 2))
    assert len(list(tmp_path.iterdir())) == 1


def test_the_header_is_strict(tmp_path):
    write_header(tmp_path, ExperimentFile(1, "today", "other", striker=STRIKER, object=DISK))
    with pytest.raises(RecordError, match="already"):
        write_header(tmp_path, ExperimentFile(1, "today", "other"))
    append_trial(tmp_path, Trial(1, 1, displacement=0.02, rotation=0.1))
    assert read_experiment(tmp_path).header.object == DISK
    with (tmp_path / "experiment.yaml").open("a") as stream:
        stream.write("colour: red\n")
    with pytest.raises(ConfigurationError, match="colour"):
        read_experiment(tmp_path)


def test_good_records_are_all_used(tmp_path):
    found = screened(write(tmp_path / "r", taps(noise=(0.02, 0.05), scatter=(0.05, 0.15))))
    assert len(found.used) == 40
    assert found.left_out == ()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (times("displacement_m", factor=1e3), "displacement_mm"),
        (times("displacement_m", factor=1e-3), "displacement"),
        (times("initial_speed_m_s", factor=1e-3), "initial_speed"),
        (times("initial_speed_m_s", "initial_spin_rad_s", factor=1e3), "initial_speed"),
        (times("displacement_m", "initial_speed_m_s", factor=1e-3), "units"),
        (times("rotation_rad", factor=180 / math.pi), "degrees"),
        (times("initial_spin_rad_s", factor=180 / math.pi), "degrees"),
        (times("striker_speed_measured_m_s", factor=1e3), "striker_speed"),
    ],
)
def test_a_file_in_wrong_units_is_refused(tmp_path, change, words):
    folder = write(tmp_path / "r", taps(noise=(0.02, 0.05), scatter=(0.05, 0.15)))
    rewrite(folder / "run_03.csv", change)
    with pytest.raises(RecordError, match=words) as refusal:
        screened(folder)
    assert "run_03.csv" in str(refusal.value)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (times("initial_speed_m_s", factor=1e-3), "units"),
        (times("initial_speed_m_s", factor=12.0), "units"),
        (lambda row: row | {"outcome": "missed"}, "missed"),
        (lambda row: row | {"outcome": "disturbed"}, "disturbed"),
        (
            lambda row: (
                row
                | {"displacement_m": "5e-5", "rotation_rad": "0"}
                | {"initial_speed_m_s": "0.001", "initial_spin_rad_s": "0"}
            ),
            "missed",
        ),
        (lambda row: row | {"initial_spin_rad_s": "", "initial_speed_m_s": ""}, "no velocity"),
        (lambda row: row | {"displacement_m": ""}, "not measured"),
        (lambda row: row | {"rotation_rad": str(-float(row["rotation_rad"]))}, "disturbed"),
    ],
)
def test_one_invalid_row_is_excluded_and_named_by_file_and_row(tmp_path, change, reason):
    folder = write(tmp_path / "r", taps())
    rewrite(folder / "run_03.csv", lambda row: change(row) if row["trial"] == "4" else row)
    found = screened(folder)
    assert [(row.file.rpartition("/")[2], row.row, row.reason) for row in found.left_out] == [
        ("run_03.csv", 5, reason)
    ]
    assert len(found.used) == 39


def test_a_push_by_hand_does_not_affect_the_mean(tmp_path):
    clean = fit_object([read_experiment(write(tmp_path / "a", taps(noise=(0.01, 0.03))))], DISK)
    pushed = write(tmp_path / "b", taps(noise=(0.01, 0.03)))
    further = times("displacement_m", factor=1.6)
    rewrite(pushed / "run_02.csv", lambda row: further(row) if row["trial"] == "6" else row)
    fit = fit_object([read_experiment(pushed)], DISK)
    assert [(row.row, row.reason) for row in fit.left_out] == [(7, "disturbed")]
    assert fit.slide.friction == pytest.approx(clean.slide.friction, rel=0.003)


def test_all_pushed_taps_are_named_if_launches_are_exact(tmp_path):
    pushed = write(tmp_path / "b", taps())
    further = times("displacement_m", factor=1.6)
    for run, trial in ((1, "5"), (2, "8"), (4, "2")):
        rewrite(
            pushed / f"run_0{run}.csv",
            lambda row, trial=trial: further(row) if row["trial"] == trial else row,
        )
    fit = fit_object([read_experiment(pushed)], DISK)
    assert {(row.file[-10:], row.row) for row in fit.left_out} == {
        ("run_01.csv", 6),
        ("run_02.csv", 9),
        ("run_04.csv", 3),
    }
    assert fit.slide.friction == pytest.approx(TRUE["friction"], rel=0.002)


def test_units_wrong_by_a_factor_of_ten_are_refused(tmp_path):
    short = write(tmp_path / "b", taps())
    for file in short.glob("run_*.csv"):
        rewrite(file, times("displacement_m", factor=0.1))
    with pytest.raises(RecordError, match="units"):
        fit_object([read_experiment(short)], DISK)


def test_too_few_runs_or_trials_are_refused(tmp_path):
    one = write(tmp_path / "one", taps(runs=((0.6, 30.0),)))
    with pytest.raises(RecordError, match="1 runs"):
        screened(one)
    few = write(tmp_path / "few", taps(trials=2))
    with pytest.raises(RecordError, match="too few") as refusal:
        screened(few)
    assert "run_01.csv, row 2" in str(refusal.value)


def tracked(tmp_path, seen, **values):
    slide = Trial(1, 1, track=seen, **values)
    append_trial(tmp_path, slide)
    header = ExperimentFile(1, "today", "simulated", camera_rate_hz=30.0)
    write_header(tmp_path, header)
    experiment = read_experiment(tmp_path)
    with pytest.raises(RecordError) as refusal:
        # always raises, because one trial is not enough
        screen([experiment], DISK.body(), GRAVITY)
    return str(refusal.value)


def part(seen, keep):
    return replace(seen, **{entry.name: getattr(seen, entry.name)[keep] for entry in fields(seen)})


def test_a_single_good_track_is_refused_only_as_a_short_run(tmp_path):
    assert "short run" in tracked(tmp_path, track(), displacement=math.nan)


def test_a_track_with_a_gap_while_sliding_is_reported(tmp_path):
    seen = track()
    keep = (seen.time < 0.44) | (seen.time > 0.50)
    assert "gap" in tracked(tmp_path, part(seen, keep))


def test_a_hand_in_the_image_is_reported(tmp_path):
    seen = track()
    moved = seen.x + np.where(seen.time < 0.2, 0.004, 0.0)  # the hand is removed before the tap
    assert "run_01.csv, row 2" in tracked(tmp_path, replace(seen, x=moved))


def test_a_second_push_is_reported(tmp_path):
    first = track()
    later = np.maximum(first.time - 0.55, 0.0)
    pushed = first.x + np.where(later > 0, 0.2 * later - 0.5 * later**2, 0.0)
    pushed = np.maximum.accumulate(pushed)
    assert "disturbed" in tracked(tmp_path, replace(first, x=pushed))


def test_a_track_without_motion_counts_as_a_miss(tmp_path):
    seen = track()
    assert "missed" in tracked(tmp_path, replace(seen, x=0 * seen.x, theta=0 * seen.theta))


def test_times_in_milliseconds_are_reported(tmp_path):
    seen = track()
    assert "t_s in ms" in tracked(tmp_path, replace(seen, time=1e3 * seen.time))


def test_a_track_with_constant_time_is_refused(tmp_path):
    file = tmp_path / "track.csv"
    file.write_text("t_s,x_m,y_m,theta_rad\n0,0,0,0\n0.1,0,0,0\n0.1,0,0,0\n")
    with pytest.raises(RecordError, match="row 4"):
        read_track(file)
