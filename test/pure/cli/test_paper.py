"""The experiments of the paper in a short form: each number within its interval."""

from __future__ import annotations

import csv
import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from without_ros import run

from tapping_cell.cli import paper, sweep
from tapping_cell.planning import CameraNoise, PlannerSettings

ROOT = Path(__file__).resolve().parents[3]
TRIALS = 100
EXPECTED = {
    "torque factor, aluminium disk": (3.5, 3.8),
    "torque factor, plexiglas disk": (0.95, 1.05),
    "torque factor, aluminium square": (2.05, 2.30),
    "friction": (0.165, 0.175),
    "restitution": (0.82, 0.90),
    "sliding model, translation: error of the mean of a run": (0.0, 10.8),
    "sliding model, rotation: error of the mean of a run": (0.0, 12.3),
    "impact model, speed: error of the mean of a run": (0.0, 15.0),
    "impact model, spin: error of the mean of a run": (0.0, 30.0),
    "scatter of the initial speed in a run": (3.0, 6.0),
    "scatter of the initial spin in a run": (11.0, 18.0),
    "calculated to measured rotation without a torque factor": (1.5, 3.64),
    "rotation of the task to that of one tap": (2.9, 3.2),
    "exact": (4.3, 5.5),
    "conservative": (3.8, 5.2),
    "exact, if a tap need only reach the tolerance": (3.6, 5.0),
    "conservative, if a tap need only reach the tolerance": (3.4, 4.8),
    "series of 10 runs in which exact is as good as conservative": (5.0, 50.0),
    "the same, if a tap need only reach the tolerance": (5.0, 60.0),
    "multi: planned taps": (5.0, 5.0),
    "multi: mean taps": (3.3, 4.5),
    "exact with 0.7 mm and 0.8 degrees as standard deviations": (8.0, 12.5),
    "exact with half the scatter of a tap": (4.1, 5.4),
    "exact with twice the scatter of a tap": (4.9, 6.4),
    "exact, stops only if the goal is reached with 99.9 % probability": (5.3, 7.1),
    "this cell (optimal)": (2.2, 2.9),
    "rounding none: paper's cell, exact": (4.3, 5.6),
    "rounding none: this cell, optimal": (2.1, 2.8),
    "rounding 10 mm, 5 deg: paper's cell, exact": (4.5, 6.0),
    "rounding 10 mm, 5 deg: this cell, optimal": (2.4, 3.2),
    "rounding 15 mm, 10 deg: paper's cell, exact": (4.8, 6.3),
    "rounding 15 mm, 10 deg: this cell, optimal": (2.7, 3.6),
    "Jacobian times striker error: x": (1.0, 1.3),
    "Jacobian times striker error: y": (0.8, 1.0),
    "Jacobian times striker error: theta": (0.15, 0.25),
    "largest difference of an element of the Jacobian": (0.0, 0.012),
    "norm of the Jacobian": (0.0, 1.0),
}
"""Intervals of the numbers here. Those of the taps are wide, because few runs are made."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The verb runs without ROS, as in a Python where pip installed the package."""
    folder = tmp_path_factory.mktemp("paper")
    words = ("paper", "--trials", str(TRIALS), "--processes", "1", "--report", str(folder))
    done = run(ROOT, folder, "-m", "tapping_cell", *words)
    assert done.returncode == 0, done.stderr
    return folder


def test_each_number_is_within_its_interval_and_explained(folder):
    with (folder / "paper.csv").open(encoding="utf-8") as stream:
        rows = {row["quantity"]: row for row in csv.DictReader(stream)}
    assert rows.keys() == EXPECTED.keys()
    for name, (low, high) in EXPECTED.items():
        assert low <= float(rows[name]["value"]) <= high, rows[name]
        assert rows[name]["why"] and rows[name]["command"].startswith("python -m tapping_cell ")
    page = (folder / "paper.html").read_text(encoding="utf-8")
    assert page.count("<figure>") == 10 and "3.64" in page


def test_an_interrupted_run_continues_with_the_missing_experiments(folder, tmp_path, monkeypatch):
    lines = (folder / sweep.POINTS).read_text(encoding="utf-8").splitlines(keepends=True)
    cut = "".join(lines[:-2]) + lines[-2][:40]
    (tmp_path / sweep.POINTS).write_text(cut, encoding="utf-8")
    measured = []
    monkeypatch.setattr(paper, "measure_one", lambda *values: measured.append(values[-1]) or {})
    paper.experiments(tmp_path, TRIALS, processes=1)
    assert measured == [json.loads(line)["point"] for line in lines[-2:]]


def test_the_ros_cell_continues_its_series_and_has_its_own_rows(folder, monkeypatch):
    """The verbs are played; test/graph starts the cells that they use."""
    called = []
    disk = {"estimates": {"torque_factor": {"value": 3.4, "low": 3.2, "high": 3.5}}}

    def play(*words):
        called.append(words)
        if words[0] == "single-tap":
            (folder / "graph" / "single-tap_1").mkdir(exist_ok=True)
        if words[0] == "demo":
            seed, out = words[words.index("--seed") + 1], Path(words[words.index("--out") + 1])
            out.mkdir()  # demo refuses a folder with a run
            printed = json.dumps({"taps": int(seed) % 2 + 2, "reached": seed != "5"})
            if seed == "5":
                raise subprocess.CalledProcessError(1, words, printed, "goal not reached")
            return printed
        return json.dumps(disk)

    def interrupted(where, method, seed):
        (where / f"{method}_{seed}").mkdir()
        raise ZeroDivisionError

    monkeypatch.setattr(paper, "_verb", play)
    with monkeypatch.context() as failing:
        failing.setattr(paper, "_graph_goal", interrupted)
        with pytest.raises(ZeroDivisionError):
            paper.experiments(folder, TRIALS, processes=1, graph=True)
    results = paper.experiments(folder, TRIALS, processes=1, graph=True)
    verbs = [words[0] for words in called]
    assert verbs.count("single-tap") == verbs.count("object") == 1
    assert verbs.count("demo") == len(paper.GRAPH_METHODS) * len(paper.GRAPH_SEEDS)
    rows = {row.quantity: row for row in paper.rows_of(results) if "ROS" in row.section}
    assert rows["torque factor, aluminium disk"].here == "3.40 (3.20\u00a0to\u00a03.50)"
    assert rows["multi"].value == 2.6 and rows["multi"].low < 2.6 < rows["multi"].high
    assert rows["multi"].why.endswith("4 of 5 goals reached")


@given(distance=st.floats(0.0, 0.3), rotation=st.floats(-np.pi, np.pi))
def test_the_tolerant_methods_make_possible_taps(distance, rotation):
    settings = PlannerSettings(camera=CameraNoise(), box=1.0)
    for method in (paper.TolerantExact(settings), paper.TolerantConservative(settings)):
        tap = method.choose(distance, rotation)
        size = abs(float(tap.distance))
        assert size >= settings.smallest_distance * (1 - 1e-9)
        assert abs(float(tap.rotation)) <= settings.cone_slope * size * (1 + 1e-6)
