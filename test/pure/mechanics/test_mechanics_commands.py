"""The verbs of the mechanics: their output for programs and for people, and their refusals."""

import json

import numpy as np
import pytest

from benchmarks import mechanics as benchmark
from benchmarks.__main__ import main as run_benchmarks
from tapping_cell.cli import main


def sensitivity(capsys, *words):
    status = main(["sensitivity", *words, "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_sensitivity_prints_the_papers_jacobian(capsys):
    status, report = sensitivity(capsys, "--distance", "10", "--rotation", "3")
    assert status == 0
    jacobian = np.array(report["jacobian"])
    assert jacobian.shape == (3, 3)
    assert report["product"] == pytest.approx(list(jacobian @ [7.5, 7.5, 5]))
    assert report["norm"] == pytest.approx(np.linalg.norm(jacobian, 2))
    assert jacobian[1] == pytest.approx([0, 0, 0.1745], abs=1e-4)
    assert 0.5 < report["sweep"]["share_below_one"] <= 1
    assert report["sweep"]["all_below_one_up_to_mm"] > 10


def test_the_opposite_sense_of_rotation_is_the_mirror_image(capsys):
    _, here = sensitivity(capsys, "--rotation", "2.5")
    _, there = sensitivity(capsys, "--rotation", "-2.5")
    mirror = np.array([[1, -1, -1], [-1, 1, 1], [-1, 1, 1]])
    assert np.array(there["physical"]["jacobian"]) == pytest.approx(
        mirror * here["physical"]["jacobian"], abs=1e-6
    )


def test_sensitivity_prints_readable_text_and_figures(capsys, tmp_path):
    assert main(["sensitivity", "--figures", str(tmp_path / "new")]) == 0
    out, err = capsys.readouterr()
    assert "norm of the Jacobian 0.24" in out and "degrees/mm" in out
    assert err.count("wrote") == 2
    assert {f.name for f in (tmp_path / "new").iterdir()} == {
        "mechanics_cone.png",
        "mechanics_velocities.png",
    }


def test_sensitivity_refuses_a_tap_outside_the_cone(capsys):
    assert main(["sensitivity", "--rotation", "9"]) == 2
    assert "at most 3.28" in capsys.readouterr().err


def test_bench_measures_speed_and_accuracy(capsys, monkeypatch):
    for name, value in (
        ("_MANY", 20_000),
        ("_POLYGONS", 20),
        ("_LAUNCHES", 2),
    ):
        monkeypatch.setattr(benchmark, name, value)
    assert run_benchmarks(["--section", "mechanics", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["mechanics"]
    assert report["solve_ivp"]["table_error"] < 1e-8
    assert report["solve_ivp"]["error"] < 1e-8
    assert report["solve_ivp"]["ratio"] > 1e3
    assert report["round_trip_error"] < 1e-9
    assert "skipped" in report["mujoco"] or report["mujoco"]["models"]
    text = "\n".join(benchmark.lines(report))
    assert "inverse:" in text and "solve_ivp" in text and "MuJoCo" in text
