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

from tapping_cell import __version__
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
    "exact: at most 5 taps": (55.0, 82.0),
    "exact: mean": (4.4, 5.6),
    "conservative: 4 to 6 taps": (30.0, 65.0),
    "conservative: mean": (3.9, 5.3),
    "exact, if a tap need only reach the tolerance: mean": (3.6, 5.2),
    "conservative, if a tap need only reach the tolerance: mean": (3.5, 5.0),
    "series of 10 runs: exact at least as good as conservative": (5.0, 55.0),
    "series of 10 runs: the same, if a tap need only reach the tolerance": (5.0, 65.0),
    "multi: planned": (5.0, 5.0),
    "multi: within the planned 5 taps": (75.0, 96.0),
    "multi: mean": (3.3, 4.5),
    "exact, 0.7 mm and 0.8 degrees as one standard deviation: at most 5 taps": (14.0, 42.0),
    "exact, 0.7 mm and 0.8 degrees as three standard deviations: at most 5 taps": (70.0, 93.0),
    "exact, perfect camera and model: at most 5 taps": (92.0, 100.0),
    "exact, half the scatter of a tap: at most 5 taps": (62.0, 88.0),
    "exact, twice the scatter of a tap: at most 5 taps": (30.0, 65.0),
    "exact, stops only with a probability of 99.9 %: at most 5 taps": (30.0, 65.0),
    "this cell (optimal): mean": (2.2, 2.9),
    "rounding none: assumed cell, exact: mean": (4.3, 5.7),
    "rounding none: this cell, optimal: mean": (2.1, 2.8),
    "rounding 10 mm, 5 deg: assumed cell, exact: mean": (4.6, 6.1),
    "rounding 10 mm, 5 deg: this cell, optimal: mean": (2.4, 3.2),
    "rounding 15 mm, 10 deg: assumed cell, exact: mean": (4.8, 6.6),
    "rounding 15 mm, 10 deg: this cell, optimal: mean": (2.7, 3.6),
    "Jacobian times striker error: x": (1.0, 1.3),
    "Jacobian times striker error: y, if the direction of travel rotates with the striker": (
        0.8,
        1.0,
    ),
    "Jacobian times striker error: y, impact model": (-0.6, -0.3),
    "Jacobian times striker error: theta": (0.15, 0.25),
    "norm of the Jacobian": (0.0, 1.0),
    "taps of 1.7 to 50 mm with a norm below 1": (80.0, 87.0),
}
"""Intervals of the numbers here. Those of the taps are wide, because few runs are made."""


WITHOUT_RENDERING = """
import runpy
from matplotlib.figure import Figure
Figure.savefig = lambda figure, path, **options: path.write_bytes(bytes(len(figure.axes)))
runpy.run_module("tapping_cell", run_name="__main__", alter_sys=True)
"""
"""Runs the verb in the arguments. The figures are drawn, but not rendered, which takes longer than
the experiments."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The verb runs without ROS, as in a Python where pip installed the package."""
    folder = tmp_path_factory.mktemp("paper")
    words = ("paper", "--trials", str(TRIALS), "--processes", "1", "--report", str(folder))
    done = run(ROOT, folder, "-c", WITHOUT_RENDERING, *words)
    assert done.returncode == 0, done.stderr
    return folder


def test_each_number_is_within_its_interval_and_explained(folder):
    with (folder / "paper.csv").open(encoding="utf-8") as stream:
        rows = {row["quantity"]: row for row in csv.DictReader(stream)}
    assert rows.keys() == EXPECTED.keys()
    for name, (low, high) in EXPECTED.items():
        row = rows[name]
        assert low <= float(row["value"]) <= high, row
        assert row["why"] and row["command"].startswith("python -m tapping_cell ")
        # Each random number has a range, and the command that repeats it has the same trials.
        assert bool(row["interval"]) == (float(row["low"]) < float(row["high"])), row
        assert "evaluate" not in row["command"] or f"--trials {TRIALS}" in row["command"]
        assert row["trials"] == str(TRIALS) and row["version"] == __version__
    page = (folder / "paper.html").read_text(encoding="utf-8")
    assert page.count("<figure>") == 9 and "3.64" in page
    assert f"{TRIALS} runs of each" in page and __version__ in page


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
    rows = {row.quantity: row for row in paper.rows_of(results, TRIALS) if "ROS" in row.section}
    assert rows["torque factor, aluminium disk"].here == "3.40 (3.20\u00a0to\u00a03.50)"
    assert (
        rows["multi: mean"].value == 2.6
        and rows["multi: mean"].low < 2.6 < rows["multi: mean"].high
    )
    assert rows["multi: mean"].why.endswith("4 of 5 goals reached")


def test_the_chance_of_a_series_agrees_with_drawn_series():
    rng = np.random.default_rng(1)
    counts = {"2": 30, "3": 40, "6": 30}, {"3": 80, "4": 20}
    drawn = [
        rng.choice(np.repeat(list(map(int, each)), list(each.values())), (20_000, 10)).sum(axis=1)
        for each in counts
    ]
    share, low, high = paper.share_of_series(*({"taps": {"histogram": each}} for each in counts))
    assert share == pytest.approx(np.mean(drawn[0] <= drawn[1]), abs=0.02)
    assert low < share < high


@given(distance=st.floats(0.0, 0.3), rotation=st.floats(-np.pi, np.pi))
def test_the_tolerant_methods_make_possible_taps(distance, rotation):
    settings = PlannerSettings(camera=CameraNoise(), box=1.0)
    for method in (paper.TolerantExact(settings), paper.TolerantConservative(settings)):
        tap = method.choose(distance, rotation)
        size = abs(float(tap.distance))
        assert size >= settings.smallest_distance * (1 - 1e-9)
        assert abs(float(tap.rotation)) <= settings.cone_slope * size * (1 + 1e-6)
