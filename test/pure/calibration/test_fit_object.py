"""The complete fit of an object file, tested with simulated experiments and with records of known
impacts."""

import contextlib
import io
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from single_tap_records import DISK, RUNS, TRUE, taps, write

from benchmarks.calibration import draw
from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import StrikerSection, read_experiment
from tapping_cell.calibration.object_fit import fit_object, predict
from tapping_cell.cli import main
from tapping_cell.cli.simulated_single_taps import Design, simulated_trials
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object

STRIKER = StrikerSection(0.1, 0.0054, "free")
HELD = StrikerSection(0.1, 0.0054, "linear_bearings")


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Return an experiment in the simulated world, which integrates each slide in time."""
    content, truth, true = draw("disk", 3)
    folder = tmp_path_factory.mktemp("records") / "taps"
    trials = simulated_trials(content, STRIKER.striker(), truth, Design(trials=8), 11)
    write(folder, trials, object=content, rest_position_std=1e-5, rest_rotation_std=3.5e-4)
    return folder, content, true


@pytest.fixture(scope="module")
def fit(records):
    folder, content, _ = records
    return fit_object([read_experiment(folder)], content)


def test_the_simulated_parameters_are_recovered(records, fit):
    _, _, true = records
    assert len(fit.used) == 32
    for name, limit in (("friction", 0.01), ("torque_factor", 0.03), ("restitution", 0.08)):
        assert fit.estimate(name).value == pytest.approx(true[name], rel=limit)
    friction = fit.estimate("contact_friction")
    assert friction.fitted
    assert friction.value == pytest.approx(true["contact_friction"], rel=0.15)
    # From 32 taps, the scatter is known to within a quarter of its value (two standard deviations).
    # True values: 0.05 and 0.15.
    assert 0.03 < fit.estimate("scatter_speed").value < 0.075
    assert 0.09 < fit.estimate("scatter_spin").value < 0.23


def test_the_file_of_another_object_is_refused(records, tmp_path, capsys):
    square = shared_folder() / "objects" / "aluminium_square.yaml"
    assert main(["object", "fit", str(records[0]), "--object", str(square)]) == 2
    assert "describes a polygon, but the records are of" in " ".join(
        capsys.readouterr().err.split()
    )
    write(tmp_path / "records", taps(noise=(0.01, 0.01), scatter=(0.02, 0.03)))
    with pytest.raises(RecordError, match="do not suit the shape and the mass of 'aluminium squ"):
        fit_object([read_experiment(tmp_path / "records")], load_object(square))


def test_the_papers_criterion_agrees(records, fit):
    _, _, true = records
    assert fit.paper.torque_factor == pytest.approx(true["torque_factor"], rel=0.05)
    assert fit.paper.friction == pytest.approx(true["friction"], rel=0.02)


def test_new_taps_are_predicted(records, fit, tmp_path):
    folder, content, _ = records
    for run in predict(fit, [read_experiment(folder)]):
        assert abs(run.sliding_distance) < 0.02
        assert abs(run.sliding_rotation) < 0.04
        assert abs(run.tap_distance) < 0.15


@pytest.fixture(scope="module")
def fitted_file(records, tmp_path_factory):
    """Return the file that the verb has written for the records, and what it has printed."""
    output = tmp_path_factory.mktemp("fitted") / "fitted.yaml"
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["object", "fit", str(records[0]), "--output", str(output), "--json"]) == 0
    return output, json.loads(printed.getvalue())


def test_the_file_is_read_by_the_planners_reader(records, fit, fitted_file, capsys):
    folder, content, _ = records
    output, printed = fitted_file
    fitted = load_object(output)
    assert fitted.torque_factor == pytest.approx(fit.slide.torque_factor, rel=1e-5)
    assert fitted.torque_factor == pytest.approx(
        printed["estimates"]["torque_factor"]["value"], rel=1e-5
    )
    assert fitted.shape == content.shape
    assert fitted.calibration is not None
    assert fitted.calibration.observations == 32
    assert any("run_01.csv" in entry for entry in fitted.calibration.inputs)
    before = output.read_bytes()
    assert main(["object", "fit", str(folder), "--output", str(output)]) == 2
    assert "--force" in capsys.readouterr().err
    assert output.read_bytes() == before


def test_a_better_file_is_kept(fitted_file, tmp_path, capsys):
    output = Path(shutil.copy(fitted_file[0], tmp_path / "fitted.yaml"))
    before = output.read_bytes()
    worse = write(tmp_path / "noisy", taps(noise=(0.05, 0.2), trials=4))
    assert main(["object", "fit", str(worse), "--output", str(output), "--force"]) == 2
    errors = capsys.readouterr().err
    assert "more accurate than the new one and was kept" in errors
    assert "torque factor" in errors
    assert output.read_bytes() == before
    again = ["object", "fit", str(worse), "--output", str(output), "--force", "--accept-worse"]
    assert main(again) == 0
    assert output.read_bytes() != before


def test_the_report_is_one_page_with_its_figures(records, tmp_path):
    folder, _, _ = records
    assert main(["object", "fit", str(folder), "--report", str(tmp_path / "report")]) == 0
    page = (tmp_path / "report" / "report.html").read_text()
    assert page.count("data:image/png;base64") == 5
    assert 'src="http' not in page
    assert "torque factor" in page
    assert len(list((tmp_path / "report").glob("*.png"))) == 5


def known(tmp_path, name="r", **options):
    header = {"striker": options["striker"]} if "striker" in options else {}
    folder = write(tmp_path / name, taps(**{"trials": 5, **options}), **header)
    return fit_object([read_experiment(folder)], DISK)


@pytest.mark.parametrize("striker", [STRIKER, HELD], ids=["free", "linear bearings"])
def test_known_impacts_are_found_exactly(tmp_path, striker):
    fit = known(tmp_path, striker=striker)
    assert fit.estimate("restitution").value == pytest.approx(TRUE["restitution"], rel=2e-3)
    assert fit.estimate("contact_friction").value == pytest.approx(0.24, rel=5e-3)
    assert not fit.estimate("scale_b2").fitted


def test_small_incidences_do_not_determine_the_contact_friction(tmp_path):
    runs = ((0.5, 10.0), (0.7, 10.0), (0.5, 20.0), (0.7, 20.0))
    fit = known(tmp_path, runs=runs, scatter=(0.03, 0.1))
    friction = fit.estimate("contact_friction")
    assert not friction.fitted
    assert friction.value == DISK.contact_friction
    output = " ".join(fit.sentences)
    assert "contact friction" in output
    advised = [s for s in fit.sentences if "the uncertainty of the contact friction" in s]
    assert len(advised) == 1
    # With the assumed contact friction of 0.20 and the restitution of 0.75, the contact slides
    # during the whole impact at incidences above 29 degrees.
    assert float(advised[0].split("incidence of ")[1].split()[0]) >= 30


def test_restitution_and_b2_are_reported_as_not_separately_identifiable(tmp_path):
    fit = known(tmp_path, scatter=(0.03, 0.1))
    assert any("restitution and scale of B2" in s for s in fit.sentences)
    assert any("before and after the impact" in s for s in fit.sentences)
    together = fit.identifiability.together
    assert math.isinf(together["restitution"])
    assert math.isfinite(fit.identifiability.alone["restitution"])


def test_sliding_is_fitted_without_the_striker_speed(tmp_path):
    silent = {"striker_speed": math.nan, "striker_speed_measured": math.nan}
    trials = [replace_values(trial, silent) for trial in taps(noise=(0.01, 0.03))]
    fit = fit_object([read_experiment(write(tmp_path / "r", trials))], DISK)
    assert fit.impact is None
    assert fit.estimate("torque_factor").value == pytest.approx(2.6, rel=0.05)
    assert any("no striker speed" in s for s in fit.sentences)


def test_a_speed_that_is_only_commanded_is_reported(tmp_path):
    trials = [replace_values(t, {"striker_speed_measured": math.nan}) for t in taps(trials=5)]
    fit = fit_object([read_experiment(write(tmp_path / "r", trials))], DISK)
    assert any("was not measured" in s for s in fit.sentences)


def test_a_striker_faster_than_commanded_is_reported_and_not_taken_for_restitution(tmp_path):
    random = np.random.default_rng(4)
    trials = [
        replace_values(t, {"striker_speed": t.striker_speed / (1.03 + 0.01 * random.normal())})
        for t in taps(trials=5)
    ]
    fit = fit_object([read_experiment(write(tmp_path / "r", trials))], DISK)
    output = [s for s in fit.sentences if "speed differs from the commanded" in s]
    assert len(output) == 1 and "+6 %" in output[0] and "calibrate tapper" in output[0]
    assert fit.estimate("restitution").value == pytest.approx(TRUE["restitution"], rel=0.01)
    exact = fit_object([read_experiment(write(tmp_path / "e", taps(trials=5)))], DISK)
    assert not any("speed differs from the commanded" in s for s in exact.sentences)


def replace_values(trial, values):
    from dataclasses import replace

    return replace(trial, **values)


def test_taps_without_rotation_are_refused(tmp_path):
    straight = write(tmp_path / "r", taps(runs=tuple((v, 0.0) for v, _ in RUNS)))
    with pytest.raises(RecordError, match="hardly turned"):
        fit_object([read_experiment(straight)], DISK)


def test_unknown_records_are_refused_with_a_message(tmp_path, capsys):
    assert main(["object", "fit", str(tmp_path / "nothing")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_scatter_of_the_direction_is_estimated(tmp_path):
    random = np.random.default_rng(2)
    trials = [
        replace_values(t, {"direction": t.direction + 0.03 * random.standard_normal()})
        for t in taps(trials=5)
    ]
    fit = fit_object([read_experiment(write(tmp_path / "r", trials))], DISK)
    assert fit.estimate("scatter_direction").value == pytest.approx(0.03, rel=0.4)


def test_a_csv_file_alone_is_sufficient_to_fit_sliding(tmp_path, capsys):
    rows = ["run,trial,displacement_mm,rotation_deg,initial_speed_mm_s,initial_spin_deg_s"]
    for t in taps(noise=(0.01, 0.03)):
        numbers = (1e3 * t.displacement, math.degrees(t.rotation), 1e3 * t.initial_speed)
        cells = [t.run, t.trial, *numbers, math.degrees(t.initial_spin)]
        rows.append(",".join(str(cell) for cell in cells))
    file = tmp_path / "mine.csv"
    file.write_text("\n".join(rows) + "\n")
    assert main(["object", "fit", str(file)]) == 2
    assert "--object" in capsys.readouterr().err
    path = str(shared_folder() / "objects" / "aluminium_disk.yaml")
    assert main(["object", "fit", str(file), "--object", path, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["estimates"]
    assert found["torque_factor"]["value"] == pytest.approx(TRUE["torque_factor"], rel=0.04)
    assert found["friction"]["value"] == pytest.approx(TRUE["friction"], rel=0.02)
    assert "restitution" not in found
