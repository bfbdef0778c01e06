"""Tables of trials, runs and taps."""

import csv
import json
import math

import pytest
from made_bags import STOPS, MadeRun
from single_tap_records import taps, write

from tapping_cell.cli import evaluate_fixed, main
from tapping_cell.planning.evaluation.task import End, Results
from tapping_cell.report.run_folder import write_folder
from tapping_cell.report.tables import (
    METHOD,
    RUN_COLUMNS,
    SCENE_COLUMNS,
    TRIAL_COLUMNS,
    write_table,
)


def rows(path):
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_table_keeps_numbers_texts_and_unknown_values(tmp_path):
    columns = {"name": ["a, b", "c"], "taps": [1, 2], "x_mm": [1 / 3, math.nan]}
    columns["began_unix_s"] = [1795970540.125, 0.0]
    write_table(tmp_path / "t.csv", columns)
    first, second = rows(tmp_path / "t.csv")
    assert float(first.pop("x_mm")) == pytest.approx(1 / 3, rel=1e-9)
    assert first == {"name": "a, b", "taps": "1", "began_unix_s": "1795970540.125"}
    assert second["x_mm"] == "nan"


def test_a_parquet_file_has_the_same_values_and_their_types(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is optional (45 MB)")
    write_table(tmp_path / "t.csv", {"end": ["done"], "inside": [True], "x_mm": [0.25]})
    table = parquet.read_table(tmp_path / "t.parquet")
    assert table.to_pylist() == [{"end": "done", "inside": True, "x_mm": 0.25}]
    assert [str(kind) for kind in table.schema.types] == ["string", "bool", "double"]


def test_an_older_parquet_file_never_stands_beside_a_new_table(tmp_path):
    (tmp_path / "t.parquet").write_bytes(b"old")
    write_table(tmp_path / "t.csv", {"taps": [1]})
    other = tmp_path / "t.parquet"
    assert not other.exists() or other.read_bytes()[:4] == b"PAR1"


def test_one_evaluation_writes_its_trials(tmp_path, capsys):
    words = ["--planner", "exact", "--trials", "20", "--processes", "1", "--json"]
    assert main(["evaluate", *words, "--report", str(tmp_path / "new")]) == 0
    capsys.readouterr()
    trials = rows(tmp_path / "new" / "trials.csv")
    assert list(trials[0]) == [*METHOD, *TRIAL_COLUMNS] and len(trials) == 20
    assert [row["trial"] for row in trials] == [str(number) for number in range(20)]
    assert all(row["inside"] == "True" and float(row["distance_mm"]) <= 1.0 for row in trials)


def test_fixed_tappers_write_the_trials_of_each_start_angle(tmp_path, capsys, monkeypatch):
    def play(evaluation, note):
        angle = math.degrees(evaluation.start_angle)
        trial = (2 if angle < 20 else 5, int(End.DONE), True, 5e-4, 0.01, False, 8.0)
        return Results.of_trials([trial] * evaluation.trials)

    monkeypatch.setattr(evaluate_fixed, "evaluate_fixed", play)
    words = ["--cell", "config/positioning_cell/cell.yaml", "--start-angles", "10", "30"]
    assert main(["evaluate", *words, "--trials", "2", "--report", str(tmp_path / "new")]) == 0
    capsys.readouterr()
    trials = rows(tmp_path / "new" / "trials.csv")
    assert list(trials[0]) == ["start_angle_deg", *TRIAL_COLUMNS]
    assert [(row["start_angle_deg"], row["taps"]) for row in trials] == [
        ("10", "2"),
        ("10", "2"),
        ("30", "5"),
        ("30", "5"),
    ]


def test_arrangements_write_one_row_for_each_scene(tmp_path, capsys):
    words = ["--arrange", "2", "--radius", "20", "--trials", "2", "--processes", "1", "--json"]
    planner = ["--planner", "exact", "--camera-noise", "0.05", "0.05"]
    assert main(["evaluate", *words, *planner, "--report", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)["methods"]["sequence"]
    scenes = rows(tmp_path / "scenes.csv")
    assert list(scenes[0]) == list(SCENE_COLUMNS)
    assert [(row["scene"], row["objects"]) for row in scenes] == [("0", "2"), ("1", "2")]
    done = [int(row["taps"]) for row in scenes if row["end"] == "done"]
    assert sum(done) / len(done) == found["taps_mean"]


def test_runs_become_two_tables_that_belong_together(tmp_path, capsys):
    for name, planned in (("one", STOPS), ("two", STOPS[:2])):
        folder = tmp_path / name
        folder.mkdir()
        MadeRun(planned).write(folder)
        write_folder(folder, pictures=False)
    own = rows(tmp_path / "one" / "taps.csv")
    assert main(["report", str(tmp_path / "one"), str(tmp_path / "two")]) == 0
    capsys.readouterr()
    runs, made = rows(tmp_path / "runs.csv"), rows(tmp_path / "runs_taps.csv")
    assert list(runs[0]) == list(RUN_COLUMNS)
    assert [row["run"] for row in runs] == ["one", "two"]
    assert [int(row["taps"]) for row in runs] == [
        sum(tap["run"] == row["run"] for tap in made) for row in runs
    ]
    assert list(made[0]) == ["run", *own[0]]
    for tap, expected in zip(made, own, strict=False):
        assert float(tap["measured_x_mm"]) == pytest.approx(
            float(expected["measured_x_mm"]), abs=1e-3
        )
        assert tap["method"] == expected["method"]


def test_fit_writes_every_trial_and_says_which_it_used(tmp_path, capsys):
    records = write(tmp_path / "records", taps())
    assert main(["object", "fit", str(records), "--report", str(tmp_path / "fit"), "--json"]) == 0
    capsys.readouterr()
    trials = rows(tmp_path / "fit" / "single_taps.csv")
    first = next(iter(taps()))
    assert len(trials) == 40 and {row["used"] for row in trials} == {"True"}
    assert float(trials[0]["displacement_m"]) == pytest.approx(first.displacement, rel=1e-6)
    assert float(trials[0]["incidence_rad"]) == pytest.approx(first.incidence, rel=1e-6)
