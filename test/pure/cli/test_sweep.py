"""Sweeps of evaluations over a grid of parameters."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path

import pytest

from tapping_cell.cli import main, sweep
from tapping_cell.report.sweep import POINT_COLUMNS, sweep_table

WORDS = ["evaluate", "--planner", "exact", "--trials", "60", "--sweep"]


def run_sweep(folder: Path, *axes: str, more: tuple[str, ...] = ()) -> int:
    return main([*WORDS, *axes, "--report", str(folder), "--processes", "1", *more])


def kept_lines(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "points.jsonl").read_text().splitlines()]


def test_axes_are_ranges_or_lists() -> None:
    assert sweep.read_axis("friction=0.1:0.4:4") == ("friction", (0.1, 0.2, 0.3, 0.4))
    assert sweep.read_axis("tolerance=1,0.3") == ("tolerance", (1.0, 0.3))
    assert sweep.read_axis("planner=exact,multi") == ("planner", ("exact", "multi"))
    grid = list(sweep.grid(sweep.read_axes(["tolerance=1,2", "friction=0.1,0.2,0.3"])))
    assert len(grid) == 6 and grid[1] == {"tolerance": 1.0, "friction": 0.2}


@pytest.mark.parametrize(
    ("axes", "sentence"),
    [
        (["speed=1,2"], "cannot be swept"),
        (["tolerance=a"], "gives no values"),
        (["tolerance=1:2"], "gives no values"),
        (["tolerance=1:2:0"], "gives no values"),
        (["tolerance=1", "tolerance=2"], "swept twice"),
        (["planner="], "names no method"),
        (["friction=0.2"], "--model physics"),
        (["tolerance=-1"], "tolerance_position"),
    ],
)
def test_invalid_axes_are_refused_before_anything_is_written(axes, sentence, tmp_path, capsys):
    assert run_sweep(tmp_path / "out", *axes) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_sweep_writes_a_table_and_a_plot(tmp_path, capsys):
    axes = ("tolerance=2,1", "rotation-scatter=0,30")
    assert run_sweep(tmp_path, *axes) == 0
    shown = capsys.readouterr().out
    assert shown.count("\n| ") == 5 and "| tolerance | rotation-scatter |" in shown
    rows = (tmp_path / "sweep.csv").read_text().splitlines()
    assert len(rows) == 5
    assert rows[0].startswith("tolerance_mm_deg,rotation_scatter_percent,mean_taps")
    assert (tmp_path / "sweep.png").stat().st_size > 5000
    mean = [float(row.split(",")[2]) for row in rows[1:]]
    with (tmp_path / "trials.csv").open(encoding="utf-8") as stream:
        trials = list(csv.DictReader(stream))
    tight = [row for row in trials if row["tolerance_mm_deg"] == "1"]
    taps = [int(row["taps"]) for row in tight if row["rotation_scatter_percent"] == "30"]
    assert len(trials) == 4 * 60 and sum(taps) / 60 == pytest.approx(mean[3])
    assert mean[0] < mean[1] and mean[2] < mean[3]  # more taps with more scatter


def test_every_parameter_has_a_column() -> None:
    assert list(sweep.PARAMETERS) == list(POINT_COLUMNS)


def test_an_interrupted_sweep_is_resumed(tmp_path, monkeypatch, capsys):
    axes = ("tolerance=2,1,0.5",)
    assert run_sweep(tmp_path / "whole", *axes) == 0
    run_sweep(tmp_path / "parts", *axes)
    lines = (tmp_path / "parts" / "points.jsonl").read_text().splitlines(keepends=True)
    # The last line is incomplete, as if the power had failed while the second point was written.
    (tmp_path / "parts" / "points.jsonl").write_text(lines[0] + lines[1][:40])
    asked = []
    measure = sweep.sweep

    def count(points, kept, run_point, *others):
        def counted(point):
            asked.append(point)
            return run_point(point)

        return measure(points, kept, counted, *others)

    monkeypatch.setattr(sweep, "sweep", count)
    assert run_sweep(tmp_path / "parts", *axes) == 0
    assert asked == [{"tolerance": 1.0}, {"tolerance": 0.5}]
    whole, parts = ((tmp_path / name / "sweep.csv").read_text() for name in ("whole", "parts"))
    columns = [[row.split(",")[:6] for row in text.splitlines()] for text in (whole, parts)]
    assert columns[0] == columns[1]


def test_other_options_are_not_mixed_into_a_sweep(tmp_path, capsys):
    assert run_sweep(tmp_path, "tolerance=2") == 0
    assert run_sweep(tmp_path, "tolerance=2,1", more=("--adapt",)) == 2
    assert "adapt" in capsys.readouterr().err
    assert len(kept_lines(tmp_path)) == 1


def test_the_points_share_the_cores(tmp_path: Path) -> None:
    words = [*WORDS, "tolerance=2,1", "--report", str(tmp_path), "--processes", "2"]
    assert main(words) == 0
    alone = tmp_path / "alone"
    assert run_sweep(alone, "tolerance=2,1") == 0

    def taps(folder: Path) -> dict[str, object]:
        return {str(kept["point"]): kept["figures"]["taps"] for kept in kept_lines(folder)}

    assert taps(tmp_path) == taps(alone)


@pytest.mark.timeout(120)
def test_a_sweep_on_a_cluster_gives_the_same_results(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="pip install distributed")
    assert run_sweep(tmp_path / "here", "tolerance=2,1") == 0
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as cluster:
        more = ("--cluster", cluster.scheduler_address)
        assert run_sweep(tmp_path / "there", "tolerance=2,1", more=more) == 0
        with pytest.raises(ValueError, match="broken"):
            sweep.sweep(
                [{"tolerance": 1.0}],
                sweep.KeptPoints(tmp_path / "failed", {}),
                _fail,
                None,
                lambda count: None,
                sweep.cluster_executor(cluster.scheduler_address),
            )
    here, there = (
        {str(kept["point"]): kept["figures"]["taps"] for kept in kept_lines(tmp_path / name)}
        for name in ("here", "there")
    )
    assert here == there


def _fail(point: sweep.Point) -> dict[str, object]:
    raise ValueError("broken")


def test_an_unavailable_cluster_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sweep, "CONNECTION_DEADLINE", "1s")
    more = ("--cluster", "tcp://127.0.0.1:1")
    assert run_sweep(tmp_path, "tolerance=2", more=more) == 2
    # If Dask is installed, the message says that no scheduler answers; otherwise, how to install
    # Dask.
    assert "scheduler" in (text := capsys.readouterr().err) or "pip install distributed" in text
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert run_sweep(tmp_path, "tolerance=2", more=more) == 2
    assert "pip install distributed" in capsys.readouterr().err
    assert main([*WORDS[:-1], *more]) == 2
    assert "--sweep" in capsys.readouterr().err


def test_a_swept_friction_sets_the_true_friction(tmp_path: Path) -> None:
    words = ["evaluate", "--planner", "exact", "--trials", "40", "--model", "physics"]
    sweeping = ["--sweep", "friction=0.1,0.34", "--report", str(tmp_path), "--processes", "1"]
    assert main([*words, *sweeping]) == 0
    slippery, rough = (kept["figures"]["taps"]["mean"] for kept in kept_lines(tmp_path))
    assert main([*words, "--sweep", "friction=0.2", "--report", str(tmp_path / "right")]) == 0
    right = kept_lines(tmp_path / "right")[0]["figures"]["taps"]["mean"]
    assert right < slippery and right < rough


def test_the_table_names_what_was_swept() -> None:
    figures = {
        "taps": {"mean": 2.0, "mean_interval": [1.9, 2.1], "p90": 3},
        "success_rate": 1.0,
        "truly_inside_rate": 0.995,
        "trials_per_second": 1000.0,
        "trials": 40,
        "endless": 0,
    }
    text = sweep_table([({"planner": "exact", "tolerance": 0.3}, figures)])
    assert text.splitlines()[2].startswith("| exact | 0.3 | 2.000 (1.900 to 2.100) | 3 | 100.0 %")
    text = sweep_table([({"planner": "exact"}, figures | {"endless": 4})])
    assert "| at least 2.000 (10.0 % endless) |" in text
