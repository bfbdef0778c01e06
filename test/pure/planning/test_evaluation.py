import argparse
import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from tapping_cell.cli import main
from tapping_cell.cli.evaluate_common import refuse_faulty, share_text
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.planning import CameraNoise, PlannerSettings, PlanningError
from tapping_cell.planning.evaluation import Evaluation, Results, evaluate, parallel, summarise
from tapping_cell.planning.evaluation.task import TRUTH, End, draw_gains

CAMERA_NOISE = CameraNoise(1e-4, math.radians(0.1))


def figures(planner, trials=4000, settings=None, **others):
    settings = settings or PlannerSettings()
    return summarise(evaluate(Evaluation(planner, settings, trials=trials, **others), processes=1))


@pytest.mark.parametrize(
    ("planner", "variant", "mean"),
    [
        ("exact", "retreat", 3.68),
        ("exact", "overshoot", 3.12),
        ("conservative", "retreat", 3.18),
        ("conservative", "overshoot", 3.18),
        ("multi", "overshoot", 2.91),
        ("optimal", "overshoot", 2.22),
    ],
)
def test_the_papers_task_takes_no_more_taps_than_the_reference(planner, variant, mean):
    found = figures(planner, settings=PlannerSettings(variant=variant), seed=5)
    assert found["taps"]["mean"] <= mean
    assert found["success_rate"] == 1.0 and found["truly_inside_rate"] == 1.0


def test_multi_reaches_the_goal_with_its_plan_of_five_taps():
    results = evaluate(Evaluation("multi", PlannerSettings(), seed=8), processes=1)
    assert summarise(results, planned_taps=5)["within_planned_rate"] > 0.98


def test_optimal_with_camera_noise_bias_and_adaptation():
    found = figures(
        "optimal", 8000, PlannerSettings(camera=CAMERA_NOISE), gain_bias=(0.06, 0.10), adapt=True
    )
    assert found["taps"]["mean"] <= 2.55 and found["taps"]["p99"] <= 6
    assert found["truly_inside_rate"] >= 0.995 and found["success_rate"] == 1.0


def test_on_random_tasks_optimal_is_below_every_other_method():
    common = {"gain_bias": (0.06, 0.10), "adapt": True, "random_tasks": (0.04, 0.35)}
    settings = PlannerSettings(camera=CAMERA_NOISE)
    best = figures("optimal", 4000, settings, **common)["taps"]["mean_interval"][1]
    for name in ("exact", "conservative", "multi"):
        assert figures(name, 2000, settings, **common)["taps"]["mean_interval"][0] > best


@pytest.mark.parametrize("planner", ["exact", "conservative", "multi", "optimal"])
def test_a_wide_tolerance_is_reached_if_the_object_turns_more_or_less_than_its_file_says(planner):
    """With a tolerance above the smallest tap, an object whose rotation was divided by its gain was
    tapped to and fro without being turned."""
    settings = PlannerSettings(
        camera=CAMERA_NOISE, tolerance_position=0.0024, tolerance_angle=math.radians(2.7)
    )
    common = {"gain_bias": (0.0, 0.4), "adapt": True, "random_tasks": (0.04, 0.35)}
    found = figures(planner, 1000, settings, seed=6, **common)
    assert found["success_rate"] == 1.0 and found["taps"]["max"] <= 10


def test_adaptation_helps_against_bias():
    biased = {"gain_bias": (0.15, 0.15)}
    assert (
        figures("exact", adapt=True, **biased)["taps"]["mean"]
        < figures("exact", **biased)["taps"]["mean"]
    )


def test_the_result_depends_on_the_seed_but_not_on_the_number_of_processes(monkeypatch):
    task = Evaluation("exact", PlannerSettings(), trials=12_500, seed=3)
    one = evaluate(task, processes=1)
    monkeypatch.setattr(parallel, "WORTH_PROCESSES", 0.0)
    two = evaluate(task, processes=2)
    for first, second in zip(one, two, strict=True):
        np.testing.assert_array_equal(first, second)
    other = evaluate(Evaluation("exact", PlannerSettings(), trials=12_500, seed=4), processes=1)
    assert not np.array_equal(one.taps, other.taps)


def test_the_summary_counts_match_the_trials():
    results = Results(
        taps=np.array([2, 3, 100, 0, 4]),
        end=np.array([End.DONE, End.DONE, End.ENDLESS, End.REFUSED_BEFORE, End.REFUSED_LATER]),
        inside=np.array([True, False, False, False, True]),
        distance=np.full(5, 0.0005),
        rotation=np.full(5, -0.01),
        over_edge=np.array([False, True, False, False, False]),
        seconds=np.array([4.0, 6.0, 200.0, 0.0, 10.0]),
    )
    found = summarise(results)
    assert found["seconds"]["mean"] == pytest.approx(220 / 4)
    unknown = results._replace(seconds=np.full(5, np.nan))
    assert "seconds" not in summarise(unknown)
    # The refused trials count among all trials.
    assert (found["done"], found["trials"], found["truly_inside"]) == (2, 5, 1)
    assert found["success_rate"] == 0.4 and found["truly_inside_rate"] == 0.5
    assert (found["endless"], found["refused_before"], found["refused_later"]) == (1, 1, 1)
    assert found["taps"]["histogram"] == {"2": 1, "3": 1, "4": 1, "100": 1}
    assert found["over_edge"] == 1
    assert found["taps"]["mean"] == pytest.approx(109 / 4)


def run_json(capsys, words):
    status = main(["evaluate", *words.split(), "--json"])
    captured = capsys.readouterr()
    assert status == 0, captured.err
    return json.loads(captured.out)


@pytest.mark.parametrize("planner", ["exact", "conservative", "multi", "optimal"])
def test_a_rounded_striker_still_brings_every_object_to_the_goal(capsys, planner):
    words = "--model physics --trials 400 --round-position 15 --round-angle 10"
    found = run_json(capsys, f"--planner {planner} {words}")
    assert found["success_rate"] == 1.0 and found["truly_inside_rate"] == 1.0
    assert found["taps"]["mean"] <= 6.0


def test_the_command_line_prints_mm_and_degrees(capsys):
    found = run_json(
        capsys,
        "--planner exact --trials 500 --goal -20 5 -30 --tolerance 2 3 --scatter 4 10 2"
        " --camera-noise 0.05 0.1 --gain-bias 6 10 --adapt --box 0.8 --seed 3",
    )
    assert found["trials"] == 500 and found["inputs"]["goal"] == [-20.0, 5.0, -30.0]
    assert found["box"]["distance_mm"] == pytest.approx(1.6)
    assert sum(found["taps"]["histogram"].values()) == 500
    assert set(found["taps"]) >= {"mean", "p50", "p90", "p99", "max", "histogram"}


def test_goals_across_the_table_are_reached_or_refused_at_once(capsys):
    found = run_json(
        capsys,
        "--planner exact --table --random-tasks 300 180 --gain-bias 15 15 --adapt --trials 8",
    )
    assert found["done"] + found["refused_before"] == found["trials"]
    assert found["endless"] == found["refused_later"] == 0
    assert 0 < found["refused_before"] < 8


def test_the_report_compares_a_class_of_the_user_with_all_methods(capsys, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[3] / "examples/patient_planner")
    folder, own = tmp_path / "new" / "report", "patient_planner:PatientPlanner"
    words = ["--all", "--planner", own, "--trials", "200", "--report", str(folder)]
    assert main(["evaluate", *words]) == 0
    shown = capsys.readouterr().out
    assert "| optimal |" in shown and "| multi 60 % |" in shown and f"| {own} |" in shown
    rows = json.loads((folder / "comparison.json").read_text())
    for label, figures in rows.items():
        more = figures["more_taps"]
        low, high = more["mean_interval"]
        difference = figures["taps"]["mean"] - rows[own]["taps"]["mean"]
        assert more["than"] == own and more["mean"] == pytest.approx(difference)
        assert (low == high == 0.0) if label == own else low < more["mean"] < high
    assert rows["optimal"]["more_taps"]["mean_interval"][1] < 0.0
    with (folder / "trials.csv").open(encoding="utf-8") as stream:
        trials = [row for row in csv.DictReader(stream) if row["method"] == own]
    assert np.mean([int(row["taps"]) for row in trials]) == rows[own]["taps"]["mean"]
    assert {row["end"] for row in trials} == {"done"} and len(trials) == 200
    assert max(abs(float(row["rotation_deg"])) for row in trials) <= 1.0
    for name in (
        "comparison.md",
        "comparison.json",
        "planning_taps.png",
        "planning_success.png",
        "planning_differences.png",
        "planning_cones.png",
        "planning_fans.png",
    ):
        assert (folder / name).stat().st_size > 200, name


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--planner", "exakt"], "choose one of exact"),
        (["--unknown", "weight=2"], "weight=2"),
        (["--unknown", "friction"], "NAME=FACTOR"),
        (["--track", "fast"], "images per second"),
        (["--track", "30"], "--adapt"),
        (["--track", "30", "--adapt", "--table"], "abstract"),
        (["--track", "30", "--adapt", "--model", "physics"], "no motion in time"),
        (["--arrange", "2", "--track", "30"], "does not simulate"),
        (["--arrange", "2", "--unknown", "2", "2"], "does not simulate"),
        (["--planner", "no_such_module:Mine"], "No module named 'no_such_module'"),
        (["--trials", "0"], "0 trials"),
        (["--box", "3"], "box is 3.0"),
        (["--round-position", "15"], "--model physics"),
        (["--random-tasks", "40"], "two"),
        (["--gain-bias", "90", "0"], "40 %"),
        (["--scatter", "500", "0", "0"], "distance is 5.0"),
        (["--model", "physics", "--truth", "/no/such/file.yaml"], "no/such/file"),
    ],
)
def test_invalid_options_are_refused_with_a_message(capsys, words, sentence):
    assert main(["evaluate", *words]) == 2
    assert sentence in capsys.readouterr().err


def test_evaluations_out_of_range_are_refused():
    with pytest.raises(PlanningError, match="random-tasks"):
        Evaluation("exact", PlannerSettings(), random_tasks=(-1.0, 0.0))


def test_a_cell_that_check_config_refuses_is_evaluated_only_with_force(tmp_path, capsys) -> None:
    folder = tmp_path / "config"
    shutil.copytree(shared_folder(), folder)
    file = folder / "positioning_cell" / "cell.yaml"
    content = yaml.safe_load(file.read_text())
    file.write_text(yaml.safe_dump({**content, "objects": ["none.yaml"]}))
    words = ["evaluate", "--cell", str(file), "--trials", "20", "--start-angles", "10"]
    assert main(words) == 2
    assert "none.yaml" in (said := capsys.readouterr().err) and "--force" in said
    cell = load_cell(file)
    refuse_faulty(argparse.Namespace(cell=file, force=True), cell)
    assert "warning: check-config refuses this cell" in capsys.readouterr().err
    with pytest.raises(ConfigurationError, match="none.yaml"):
        refuse_faulty(argparse.Namespace(cell=file, force=False), cell)


def test_a_share_states_what_it_is_a_share_of() -> None:
    assert share_text(4, 20) == "4 of 20 (20.00 %)"
    assert share_text(0, 0) == "0 of 0"


def test_a_track_saves_taps_up_to_the_limit_of_full_knowledge() -> None:
    """Friction and rotation within 2, goals to 60 mm and 60 degrees: paired with the same seeds."""
    taps = {}
    for name, rate in (("off", 0.0), ("30 Hz", 30.0), ("truth", TRUTH)):
        evaluation = Evaluation(
            "optimal",
            PlannerSettings(camera=CameraNoise(1.5e-5, math.radians(0.015))),
            trials=1000,
            random_tasks=(0.060, math.radians(60.0)),
            unknown=(2.0, 2.0),
            adapt=True,
            track=rate,
        )
        results = evaluate(evaluation, processes=1)
        assert np.all(results.inside)
        taps[name] = float(results.taps.mean())
    assert taps["30 Hz"] < taps["off"] - 0.1
    assert taps["truth"] < taps["30 Hz"]


def test_the_torque_factor_is_drawn_apart_from_the_friction() -> None:
    evaluation = Evaluation("exact", PlannerSettings(), torque_factor=2.0)
    gains = draw_gains(evaluation, 500, np.random.default_rng(1))
    assert np.all(gains[:, 0] == 1.0)
    assert np.all((gains[:, 1] > 0.55) & (gains[:, 1] < 1.55)) and np.ptp(gains[:, 1]) > 0.7
