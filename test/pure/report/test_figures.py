"""Every figure of the reports and documents is readable: see ``figure_check``."""

from __future__ import annotations

import argparse
import math
from itertools import pairwise
from pathlib import Path

import cv2
import figure_check
import numpy as np
import pytest
from matplotlib.figure import Figure
from report_parts import made_run, tap_row

from tapping_cell.cli import evaluate, main, paper
from tapping_cell.configuration.cell import load_cell
from tapping_cell.report import (
    paper_page,
    planning_comparison,
    single_tap_figures,
    sweep,
)
from tapping_cell.report.cell_view import draw_cell
from tapping_cell.report.layout_figure import draw_layout
from tapping_cell.report.run import Run, RunObject
from tapping_cell.report.single_tap import (
    Motions,
    Parameter,
    ProfileView,
    RunError,
    SingleTapReport,
)
from tapping_cell.report.tables import TRIAL_COLUMNS
from tapping_cell.se2 import Pose

ROOT = Path(__file__).resolve().parents[3]
POSITIONING = ROOT / "config" / "positioning_cell" / "cell.yaml"
DISK = tuple(
    (0.048 * math.cos(a), 0.048 * math.sin(a)) for a in np.linspace(0, math.tau, 40, endpoint=False)
)
GOAL = Pose(0.05, 0.03, 0.2)


def straight(count: int) -> Run:
    """Return a run whose taps lead straight to the goal, each from the other side."""
    share = [1 - 0.5**number for number in range(count)] + [1.0]
    places = [Pose(-0.06 + 0.11 * s, -0.02 + 0.05 * s, 0.2 * s) for s in share]
    taps = [
        tap_row(
            number,
            before=before,
            measured=after,
            predicted=Pose(after.x + 0.002, after.y - 0.002, after.theta),
            strike=Pose(before.x - 0.06, before.y - 0.02, 0.4),
        )
        for number, (before, after) in enumerate(pairwise(places), start=1)
    ]
    return made_run(taps, goal=GOAL, outline=DISK)


def fixed() -> Run:
    """Return a run of the supplied positioning cell."""
    cell = load_cell(POSITIONING)
    mounts = tuple((e.name, Pose(*e.position, e.direction)) for e in cell.fixed_tappers.tappers)
    tap = tap_row(1, strike=Pose(-0.05, 0.0, 0.0), tapper="west")
    size = (cell.file.table.length, cell.file.table.width)
    return made_run([tap], goal=GOAL, outline=DISK, mounts=mounts, table_size=size)


def arrangement() -> Run:
    """Return a run with three objects, two of which move."""
    outline = tuple((x / 2, y / 2) for x, y in DISK)
    objects = tuple(
        RunObject(name, outline, Pose(x, -0.1, 0.0), Pose(x, 0.1, 0.0), tolerance=(0.001, 0.02))
        for name, x in (("disk 1", -0.15), ("disk 2", 0.0), ("a long name of disk 3", 0.15))
    )
    taps = [
        tap_row(n, object_name=one.name, before=one.start, measured=one.goal, true_pose=one.goal)
        for n, one in enumerate(objects[:2], start=1)
    ]
    return Run(**{**dict_of(made_run(taps)), "objects": objects})


def dict_of(run: Run) -> dict[str, object]:
    return {name: getattr(run, name) for name in Run.__slots__}


RUNS = {
    "one tap": lambda: straight(1),
    "three taps": lambda: straight(3),
    "nine taps": lambda: straight(9),
    "no tap": lambda: made_run([], goal=GOAL, outline=DISK),
    "fixed tappers": fixed,
    "several objects": arrangement,
}


@pytest.mark.parametrize("name", RUNS)
def test_the_figure_of_a_run_is_readable(name: str, tmp_path: Path) -> None:
    with figure_check.collected() as found:
        draw_cell(RUNS[name](), tmp_path / "cell.png")
    assert found and not any(found.values()), found


def test_the_path_fills_the_close_up_of_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    kept: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **_: kept.append(figure))
    monkeypatch.setattr(Path, "replace", lambda *_: None)
    draw_cell(straight(3), Path("unused.png"))
    close_up = next(axes for axes in kept[0].axes if axes.get_title().startswith("path"))
    ends = np.array([(-60.0, -20.0), (50.0, 30.0)])
    share = np.ptp(ends, axis=0) / [np.ptp(close_up.get_xlim()), np.ptp(close_up.get_ylim())]
    assert 0.6 < np.max(share) < 0.95


def test_the_drawing_of_fixed_tappers_is_readable(tmp_path: Path) -> None:
    with figure_check.collected() as found:
        draw_layout(load_cell(POSITIONING), tmp_path / "layout.png")
    assert found and not any(found.values()), found


def test_the_figures_of_the_mechanics_are_readable_and_those_of_the_documents(
    tmp_path: Path,
) -> None:
    with figure_check.collected() as found:
        assert main(["sensitivity", "--figures", str(tmp_path)]) == 0
    files = sorted(tmp_path.iterdir())
    assert len(found) == len(files) == 2 and not any(found.values()), found
    for file in files:
        drawn, kept = (cv2.imread(str(p)) for p in (file, ROOT / "docs" / "images" / file.name))
        assert drawn.shape == kept.shape, f"draw {file.name} again: sensitivity --figures"
        differing = np.mean(np.any(drawn != kept, axis=-1))
        # Other versions of Matplotlib and FreeType draw the edges of letters differently.
        assert differing < 0.02, f"draw {file.name} again: sensitivity --figures docs/images"


def taps(mean: float, most: int = 8) -> dict[str, object]:
    """Return the results of an evaluation, as far as figures show them."""
    histogram = {str(n): 10 for n in range(1, most + 1)}
    interval = (mean - 0.1, mean + 0.1)
    counted = {"mean": mean, "mean_interval": interval, "max": most, "histogram": histogram}
    return {
        "taps": {**counted, "p90": most},
        "trials": 10 * most,
        "trials_per_second": 1000.0,
        "endless": 0,
        "success_rate": 0.98,
        "truly_inside_rate": 0.97,
        "more_taps": {"mean": mean - 3.0, "mean_interval": interval, "than": "optimal"},
    }


@pytest.mark.parametrize("mean", [2.7, 6.2])
def test_the_figures_of_the_paper_are_readable(mean: float, tmp_path: Path) -> None:
    # The taps fall from the paper's cell to this one.
    means = np.linspace(5.0, 2.6, len(paper.CHANGES))
    results = {name: taps(float(m)) for name, m in zip(paper.CHANGES, means, strict=True)}
    every = {name: results.get(name, taps(mean)) for name in paper.POSITIONING}
    with figure_check.collected() as found:
        paper_page.draw_changes([*results.items()], tmp_path / "changes.png")
        curves = {f"error of the model {bias} %": [taps(mean)] * 4 for bias in paper.BIASES}
        noise = [0.0007 * share for share in paper.NOISE.values()]
        paper_page.draw_causes(noise, curves, tmp_path / "causes.png")
        paper_page.draw_planners(every, tmp_path / "planners.png")
        paper_page.draw_rounding(every, tmp_path / "rounding.png")
    assert len(found) == 4 and not any(found.values()), found


def test_the_figures_of_a_comparison_of_methods_are_readable(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    settings = evaluate.make_evaluation(parser.parse_args([]), "exact").settings
    compared = tuple(m for m in planning_comparison.methods() if m.planner != "optimal")
    rows = {method.label: taps(3.0 + k) for k, method in enumerate(compared)}
    goal = (10.0, 0.0, 10.0)
    with figure_check.collected() as found:
        planning_comparison.draw_histograms(rows, tmp_path / "taps.png")
        planning_comparison.draw_success(rows, tmp_path / "success.png")
        planning_comparison.draw_differences(rows, tmp_path / "differences.png")
        planning_comparison.draw_cones(settings, goal, compared, tmp_path / "cones.png")
        planning_comparison.draw_fans(settings, goal, compared, tmp_path / "fans.png")
    assert len(found) == 5 and not any(found.values()), found


@pytest.mark.parametrize("second", [{}, {"planner": ("exact", "conservative", "multi")}])
def test_the_figure_of_a_sweep_is_readable(second, tmp_path: Path) -> None:
    points = [{"tolerance": t} for t in (0.5, 1.0, 2.0, 5.0)]
    points = [
        {**p, **({name: value} if second else {})}
        for p in points
        for name, values in (second or {"": ("",)}).items()
        for value in values
    ]
    rows = [(point, taps(9.0 - k % 5)) for k, point in enumerate(points)]
    with figure_check.collected() as found:
        sweep.write_sweep(tmp_path, rows, [dict.fromkeys(TRIAL_COLUMNS, ()) for _ in rows])
    assert found and not any(found.values()), found


def test_the_figures_of_single_taps_are_readable(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    labels = tuple(label for label in "1234" for _ in range(10))
    distance = np.concatenate([rng.normal(mean, 1.0, 10) for mean in (10.0, 20.0, 30.0, 40.0)])

    def motions(factor: float) -> Motions:
        d = factor * distance
        return Motions(d, 0.4 * d, 20.0 * np.sqrt(d), 12.0 * np.sqrt(d))

    time = np.linspace(0.0, 150.0, 40)
    fall = np.maximum(0.0, 1 - time / 120.0)
    moved = 30.0 * (1 - fall**2)
    curve = (time, moved, 0.4 * moved, 500.0 * fall, 200.0 * fall)
    view = ProfileView(
        "run 2, trial 4", time, moved, 0.4 * moved, time, 500.0 * fall, 200.0 * fall, *curve,
        time, 480.0 * fall, 230.0 * fall,
    )  # fmt: skip
    report = SingleTapReport(
        title="aluminium disk",
        made="today",
        inputs=(),
        labels=labels,
        parameters=tuple(
            Parameter(name, 1.0, 1.0 + k / 20, 0.97 + k / 20, 1.03 + k / 20)
            for k, name in enumerate(("friction", "torque factor", "restitution", "impact"))
        ),
        measured=motions(1.0),
        by_sliding=motions(1.03),
        by_tapping=motions(0.95),
        own_friction=rng.normal(1.0, 0.02, 40),
        profiles=(view, view),
        runs=tuple(
            RunError(label, 10, (1.0, -2.0), (-0.5, 3.0), (2.0, 8.0), (-4.0, 1.0))
            for label in "1234"
        ),
        tapper=(),
        sentences=(),
        left_out=(),
        facts={},
    )  # fmt: skip
    with figure_check.collected() as found:
        single_tap_figures.write_figures(report, tmp_path)
    assert len(found) == 5 and not any(found.values()), found
