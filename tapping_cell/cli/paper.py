"""Repeat the experiments of the paper and put its numbers beside ours on one page.

Single taps, the three planning methods, the rounded striker and the Jacobian are simulated without
ROS. The folder receives paper.html and paper.csv: for each number that of the paper, ours, and why
they differ. An interrupted run continues with the experiments that are missing. With --graph, the
single taps and the positioning are repeated in the simulated ROS cell, in real time (20 minutes).

    python -m tapping_cell paper
    python -m tapping_cell paper --graph --report paper_graph
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.calibration.object_file import fit_record
from tapping_cell.calibration.object_fit import ObjectFit, fit_object
from tapping_cell.cli import evaluate, sweep
from tapping_cell.cli.errors import print_refusal
from tapping_cell.cli.objects.fit_verb import figures as fit_figures
from tapping_cell.cli.progress import progress
from tapping_cell.cli.simulated_single_taps import Design, simulated_experiment
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import GRAVITY, load_object
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.mechanics import Sliding
from tapping_cell.mechanics.sensitivity import (
    PAPER_JACOBIAN,
    PAPER_STRIKER_ERROR,
    norm,
    paper_tap,
    sensitivity,
)
from tapping_cell.planning import PlanningError, Taps
from tapping_cell.planning.interface import Array
from tapping_cell.planning.two_tap import ConservativePlanner, ExactPlanner
from tapping_cell.report.paper_page import Row
from tapping_cell.simulation.truth import ScatterTruth, TruthFile

TASK = "--goal 10 0 10 --gain-bias 10 10"
"""The task of section 4. The errors of the model are those of section 3.1.2 (1 to 12 %)."""
CAMERA = "--camera-noise 0.35 0.4"
"""The paper's accuracy of 0.7 mm and 0.8 degrees, taken as two standard deviations."""
OURS = "--camera-noise 0.1 0.06"
THEIRS = f"{TASK} {CAMERA} --variant retreat --box 1"
NOISE = {"0": 0.0, "1/3": 1 / 3, "1/2": 0.5, "1": 1.0}
"""Standard deviations of the camera as shares of the paper's accuracy."""
BIASES = (0, 10, 20)
ROUNDING = {"none": (0, 0), "10 mm, 5 deg": (10, 5), "15 mm, 10 deg": (15, 10)}
CHANGES = {
    "paper's cell: exact, retreat": f"--planner exact {THEIRS}",
    "+ camera 0.1 mm, 0.06 deg": f"--planner exact {TASK} {OURS} --variant retreat --box 1",
    "+ learns from its taps": f"--planner exact {TASK} {OURS} --variant retreat --box 1 --adapt",
    "+ stops by probability": f"--planner exact {TASK} {OURS} --variant retreat --adapt",
    "+ overshoots first": f"--planner exact {TASK} {OURS} --adapt",
    "+ conservative": f"--planner conservative {TASK} {OURS} --adapt",
    "+ optimal: this cell": f"--planner optimal {TASK} {OURS} --adapt",
}
POSITIONING = {
    **{name: f"--planner {name} {THEIRS}" for name in ("exact", "conservative", "multi")},
    "exact, tolerant": f"--planner tapping_cell.cli.paper:TolerantExact {THEIRS}",
    "conservative, tolerant": f"--planner tapping_cell.cli.paper:TolerantConservative {THEIRS}",
    "half the scatter": f"--planner exact {THEIRS} --scatter 2.5 7.5 0.5",
    "twice the scatter": f"--planner exact {THEIRS} --scatter 10 30 2",
    "stops by probability": f"--planner exact {TASK} {CAMERA} --variant retreat",
    **CHANGES,
    **{
        f"camera {label}, model {bias} %": "--planner exact --goal 10 0 10 --variant retreat "
        f"--box 1 --camera-noise {0.7 * share:g} {0.8 * share:g} --gain-bias {bias} {bias}"
        for label, share in NOISE.items()
        for bias in BIASES
    },
    **{
        f"rounding {label}, {whose}": f"{words} --model physics --round-position {mm} "
        f"--round-angle {degrees}"
        for label, (mm, degrees) in ROUNDING.items()
        for whose, words in (
            ("theirs", f"--planner exact {THEIRS}"),
            ("ours", f"--planner optimal {TASK} {OURS} --adapt"),
        )
    },
}
"""Options of ``evaluate`` for each experiment."""
OBJECTS = ("aluminium_disk", "plexiglas_disk", "aluminium_square")
STRIKER = StrikerSection(mass=0.1, tip_radius=0.0054, constraint="free")
SCATTER = ScatterTruth(speed=0.05, spin=0.15, direction=math.radians(1.0))
GRAPH_METHODS = ("exact", "conservative", "multi", "optimal")
GRAPH_SEEDS = (1, 2, 3, 4, 5)
STUDENT_95 = 2.776
"""Two-sided 95 % quantile of Student's distribution for the mean of five runs."""
SMALL_SERIES = 10
"""Number of runs of each method in one series, assumed for the paper, which does not state it."""


@dataclass(frozen=True, slots=True)
class TolerantExact(ExactPlanner):
    """``exact``, except that one tap counts as sufficient if it reaches the tolerance."""

    name: str = "exact, tolerant"

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose the direct tap if it ends in 0.9 of the stopping box."""
        settings = self.settings
        r, theta = np.broadcast_arrays(
            np.asarray(distance, dtype=float), np.asarray(rotation, dtype=float)
        )
        reach = settings.cone_slope * r
        slack = 0.9 * settings.stopping.rotation
        direct = (r >= settings.smallest_distance) & (r <= settings.largest_distance)
        direct &= np.abs(theta) <= reach + slack
        other = ExactPlanner.choose(self, r, theta)
        return Taps(
            np.where(direct, r, other.distance),
            np.where(direct, np.clip(theta, -reach, reach), other.rotation),
        )


@dataclass(frozen=True, slots=True)
class TolerantConservative(TolerantExact):
    """``conservative``, except that one tap counts as sufficient if it reaches the tolerance."""

    name: str = "conservative, tolerant"

    @property
    def error_line(self) -> float:
        """Relative error of the first tap's rotation that plans allow for."""
        return ConservativePlanner(self.settings).error_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "--report",
        type=Path,
        default=Path("paper"),
        metavar="DIR",
        help="folder for the page, the table and the figures (default: paper)",
    )
    parser.add_argument(
        "--trials",
        type=int,
        default=2000,
        metavar="N",
        help="number of positioning runs of each experiment (default: 2000)",
    )
    parser.add_argument(
        "--graph",
        action="store_true",
        help="also repeat single taps and positioning in the simulated ROS cell, in real time",
    )
    parser.add_argument(
        "--processes", type=int, metavar="N", help="number of processes (default: one per core)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the experiments and write the page. Return 0, 1 after a failure, 2 for invalid input."""
    # The work is distributed over processes, and additional BLAS threads would slow them down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    folder = arguments.report.expanduser()
    try:
        results = experiments(folder, arguments.trials, arguments.processes, arguments.graph)
    except (PlanningError, ConfigurationError, RecordError, OSError) as error:
        return print_refusal(error)
    except subprocess.CalledProcessError as error:
        print(f"error: {shlex.join(error.cmd)} failed: {error.stderr[-500:]}", file=sys.stderr)
        return 1
    print(f"page in {write(folder, results)}")
    return 0


def experiments(
    folder: Path, trials: int, processes: int | None = None, graph: bool = False
) -> dict[str, dict[str, Any]]:
    """Return the results of all experiments by name; those in ``folder`` are not repeated."""
    kept = sweep.KeptPoints(folder, {"trials": trials})
    points: list[sweep.Point] = [
        {"experiment": name} for name in (*(f"single taps {o}" for o in OBJECTS), *POSITIONING)
    ]
    live: list[sweep.Point] = []
    if graph:
        names = [f"graph {name} {seed}" for name in GRAPH_METHODS for seed in GRAPH_SEEDS]
        live = [{"experiment": name} for name in ("graph single taps", *names)]
    with progress("experiments", len(points) + len(live)) as advance:
        rows = []
        measure = functools.partial(measure_one, folder, trials)
        # The ROS cell needs the whole computer, so its experiments run one after the other.
        for some, workers in ((points, processes), (live, 1)):
            rows += sweep.sweep(some, kept, measure, workers, advance)
    return {str(point["experiment"]): figures for point, figures in rows}


def measure_one(folder: Path, trials: int, point: sweep.Point) -> dict[str, Any]:
    """Run one experiment."""
    name = str(point["experiment"])
    if name == "graph single taps":
        return _graph_single_taps(folder / "graph")
    if name.startswith("graph "):
        _, method, seed = name.split()
        return _graph_goal(folder / "graph", method, seed)
    if name.startswith("single taps "):
        return _single_taps(folder, name.removeprefix("single taps "))
    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    chosen = parser.parse_args(
        [*shlex.split(POSITIONING[name]), "--trials", str(trials), "--processes", "1", "--json"]
    )
    return evaluate.measure(chosen, evaluate.make_evaluation(chosen, chosen.planner))


def _single_taps(folder: Path, name: str) -> dict[str, Any]:
    """Tap an object of the paper in the simulated world, fit it, and draw figures 3 and 4."""
    from tapping_cell.cli.objects.fit_report import write_report

    content = load_object(shared_folder() / "objects" / f"{name}.yaml")
    truth = TruthFile((0.0, 0.0, 0.0), scatter=SCATTER)
    experiment = simulated_experiment(content, STRIKER, truth, Design(), 1)
    fit = fit_object([experiment], content)
    write_report(folder / name, fit, fit_record(fit, []))
    return {**fit_figures(fit), **_unscaled(fit)}


def _unscaled(fit: ObjectFit) -> dict[str, float]:
    """Return the ratio of calculated to measured rotation without a torque factor, and the scatter
    of the initial velocities within a run."""
    sliding = Sliding(fit.content.body(), fit.slide.friction, 1.0, GRAVITY).approximated()
    seen = fit.measured
    turned = np.abs(sliding.rest(seen.speed, np.abs(seen.spin)).rotation)
    labels = np.array(fit.labels)
    runs = [labels == label for label in dict.fromkeys(fit.labels)]

    def scatter(values: Array) -> float:
        return float(np.mean([np.std(values[run], ddof=1) / np.mean(values[run]) for run in runs]))

    return {
        "unscaled_rotation": float(np.mean(turned) / np.mean(np.abs(seen.rotation))),
        "speed_scatter": scatter(seen.speed),
        "spin_scatter": scatter(np.abs(seen.spin)),
    }


def _graph_single_taps(folder: Path) -> dict[str, Any]:
    """Run ``single-tap`` in the ROS cell, or continue it, and fit its records."""
    folder.mkdir(parents=True, exist_ok=True)
    begun = sorted(folder.glob("single-tap_*"))
    where = ["--resume", str(begun[-1])] if begun else ["--runs-folder", str(folder)]
    _verb("single-tap", *where)
    result: dict[str, Any] = json.loads(
        _verb("object", "fit", str(max(folder.glob("single-tap_*"))), "--json")
    )
    return result


def _graph_goal(folder: Path, method: str, seed: str) -> dict[str, Any]:
    """Run the task of section 4 once in the ROS cell. A goal that is not reached counts too."""
    own = folder / f"{method}_{seed}"
    shutil.rmtree(own, ignore_errors=True)  # of a run that was interrupted
    words = ["--planner", method, "--move", "10", "0", "10", "--seed", seed]
    try:
        printed = _verb("demo", *words, "--out", str(own), "--json")
    except subprocess.CalledProcessError as error:
        if not error.stdout:
            raise
        printed = error.stdout
    result: dict[str, Any] = json.loads(printed)
    return result


def _verb(*words: str) -> str:
    """Run a verb of this program and return its output."""
    done = subprocess.run(
        [sys.executable, "-m", "tapping_cell", *words], capture_output=True, text=True, check=True
    )
    return done.stdout


def rows_of(results: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    """Return every number of the paper with ours."""
    return [
        *_single_tap_rows(results),
        *_positioning_rows(results),
        *_rounding_rows(results),
        *_jacobian_rows(),
        *_graph_rows(results),
    ]


def _single_tap_rows(results: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    section = "Single taps (section 3)"
    command = "python -m tapping_cell paper"
    rows = []
    for name, paper, why in (
        ("aluminium_disk", "3.64", "the simulated world has this factor as its true value; the fit "
         "must find it from 40 tracks"),
        ("plexiglas_disk", "1 (none needed)", "the true value of the simulated world, found by the "
         "fit"),
        ("aluminium_square", "2.17", "the true value of the simulated world; the paper's fit, like "
         "ours, replaces the square by a disk"),
    ):  # fmt: skip
        found = results[f"single taps {name}"]["estimates"]["torque_factor"]
        title = f"torque factor, {name.replace('_', ' ')}"
        value, low, high = found["value"], found["low"], found["high"]
        rows.append(Row(section, title, "", paper, value, low, high, why, command))
    disk = results["single taps aluminium_disk"]
    for key, title, paper in (
        ("friction", "friction", "0.17"),
        ("restitution", "restitution", "0.86"),
    ):
        found = disk["estimates"][key]
        rows.append(
            Row(section, title, "", paper, found["value"], found["low"], found["high"],
                "the paper measured it apart from the taps; we fit it to the taps", command)
        )  # fmt: skip
    runs = disk["runs_errors"]
    ideal = "the simulated slide follows the model, so only scatter and camera remain"
    for key, title, paper, why in (
        ("sliding_distance", "sliding model, translation", "1.2 to 10.8 %", ideal),
        ("sliding_rotation", "sliding model, rotation", "3.2 to 12.3 %", ideal),
        ("impact_speed", "impact model, speed", "5 to 15 %",
         "the simulated striker has no error of its angle or place"),
        ("impact_spin", "impact model, spin", "up to 30 %",
         "the simulated striker has no error of its angle or place"),
    ):  # fmt: skip
        errors = [100 * abs(run[key]) for run in runs]
        rows.append(Row(section, f"{title}: error of the mean of a run", "%", paper,
                        float(np.mean(errors)), min(errors), max(errors),
                        f"{why}; in brackets the smallest and largest run", command))  # fmt: skip
    for key, title, paper in (
        ("speed_scatter", "scatter of the initial speed in a run", "up to 5 %"),
        ("spin_scatter", "scatter of the initial spin in a run", "up to 15 %"),
    ):
        share = 100 * disk[key]
        rows.append(Row(section, title, "%", paper, share, share, share,
                        "scatter of the simulated world, as in the paper", command))  # fmt: skip
    ratio = disk["unscaled_rotation"]
    rows.append(
        Row(section, "calculated to measured rotation without a torque factor", "",
            "much above 1 (no number)", ratio, ratio, ratio,
            "follows from the torque factor of the simulated world", command)
    )  # fmt: skip
    return rows


def _taps_row(
    section: str, title: str, paper: str, why: str, results: Mapping[str, Any], name: str
) -> Row:
    taps = results[name]["taps"]
    low, high = taps["mean_interval"]
    command = f"python -m tapping_cell evaluate {POSITIONING[name]}"
    return Row(section, title, "taps", paper, taps["mean"], low, high, why, command)


def _positioning_rows(results: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    section = "Planning methods (section 4): 10 mm and 10 degrees, to 1 mm and 1 degree"
    taps = functools.partial(_taps_row, section, results=results)
    better = 100 * share_of_series(results["exact"], results["conservative"])
    alike = 100 * share_of_series(results["exact, tolerant"], results["conservative, tolerant"])
    inside = 100 * results["exact"]["truly_inside_rate"]
    planned = float(results["multi"]["planned_taps"])
    slope = 10.0 / (10.0 * math.degrees(paper_tap().cone_slope) / 1e3)
    return [
        Row(section, "rotation of the task to that of one tap", "", "about 3", slope, slope, slope,
            "the contact friction of 0.20 was chosen for this ratio",
            "python -m tapping_cell sensitivity"),
        taps("exact", "5 or fewer", "camera and model errors are estimates from the paper's text; "
             "its number of runs is unknown", name="exact"),
        taps("conservative", "about 5, slightly worse than exact", "here exact fails if a tap ends "
             "just beyond the edge of the cone; see the next rows", name="conservative"),
        taps("exact, if a tap need only reach the tolerance", "5 or fewer", "this reading of \"the "
             "goal can be reached in one tap\" removes most of the difference",
             name="exact, tolerant"),
        taps("conservative, if a tap need only reach the tolerance", "about 5", "the larger "
             "excursions hardly pay, and the methods are nearly equal",
             name="conservative, tolerant"),
        Row(section, f"series of {SMALL_SERIES} runs in which exact is as good as conservative",
            "%", "exact was slightly better", better, better, better,
            "the scatter of ten runs is larger than the difference of the methods",
            "python -m tapping_cell paper"),
        Row(section, "the same, if a tap need only reach the tolerance", "%",
            "exact was slightly better", alike, alike, alike,
            "the paper's order is then about as likely as the opposite",
            "python -m tapping_cell paper"),
        Row(section, "multi: planned taps", "taps", "5", planned, planned, planned,
            "equal: error lines of 60 % give five taps",
            f"python -m tapping_cell evaluate {POSITIONING['multi']}"),
        taps("multi: mean taps", "5 in almost every run", "here a tap may skip cones if it is "
             "lucky; the paper's plan does not attempt less than five", name="multi"),
        taps("exact with 0.7 mm and 0.8 degrees as standard deviations", "5 or fewer",
             "contradicts the paper, so its accuracy is hardly a standard deviation",
             name="camera 1, model 10 %"),
        taps("exact with half the scatter of a tap", "5 or fewer", "the scatter matters less than "
             "camera and model", name="half the scatter"),
        taps("exact with twice the scatter of a tap", "5 or fewer", "the paper's scatter, 5 and "
             "15 %, is nearer to its number of taps", name="twice the scatter"),
        taps("exact, stops only if the goal is reached with 99.9 % probability", "5 or fewer",
             "the paper's cell hardly stopped by such a rule; without it, "
             f"{inside:.0f} % of the final poses are truly inside", name="stops by probability"),
        taps("this cell (optimal)", "-", "better camera, learning, other stopping rule and method: "
             "see \"From the paper's cell to this one\"", name="+ optimal: this cell"),
    ]  # fmt: skip


def share_of_series(first: Mapping[str, Any], second: Mapping[str, Any]) -> float:
    """Return the share of pairs of small series in which the first method needs no more taps."""
    rng = np.random.default_rng(0)
    means = []
    for figures in (first, second):
        histogram = figures["taps"]["histogram"]
        taps = np.repeat([int(key) for key in histogram], list(histogram.values()))
        means.append(rng.choice(taps, (10_000, SMALL_SERIES)).mean(axis=1))
    return float(np.mean(means[0] <= means[1]))


def _rounding_rows(results: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    section = "Rounded striker (section 5)"
    rows = []
    for label in ROUNDING:
        paper = "about 5 (section 4)" if label == "none" else "5 to 6"
        for whose, title, why in (
            ("theirs", "paper's cell, exact", "camera and model errors are estimates"),
            ("ours", "this cell, optimal", "rounding adds as much in both cells; the paper's cell "
             "starts at more taps"),
        ):  # fmt: skip
            name = f"rounding {label}, {whose}"
            rows.append(_taps_row(section, f"rounding {label}: {title}", paper, why, results, name))
    return rows


def _jacobian_rows() -> list[Row]:
    section, command = "Sensitivity (section 5.1)", "python -m tapping_cell sensitivity"
    both = sensitivity(paper_tap(), [0.010, 0.0, math.radians(3.0)])
    product = both.printed @ np.asarray(PAPER_STRIKER_ERROR)
    units = ("mm", "mm", "degrees")
    why = "tip radius and two impact constants were fitted to the printed Jacobian"
    rows = [
        Row(section, f"Jacobian times striker error: {axis}", unit, paper, value, value, value,
            why, command)
        for axis, unit, paper, value in zip(
            ("x", "y", "theta"), units, ("1.1", "0.9", "0.2"), product.tolist(), strict=True
        )
    ]  # fmt: skip
    off = float(np.max(np.abs(both.printed - PAPER_JACOBIAN)))
    size = float(norm(both.printed))
    return [
        *rows,
        Row(section, "largest difference of an element of the Jacobian", "", "0", off, off, off,
            why, command),
        Row(section, "norm of the Jacobian", "", "below 1", size, size, size, why, command),
    ]  # fmt: skip


def _graph_rows(results: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    section = "In the ROS cell, with rendered images and emulated devices"
    if "graph single taps" not in results:
        return []
    found = results["graph single taps"]["estimates"]["torque_factor"]
    rows = [
        Row(section, "torque factor, aluminium disk", "", "3.64", found["value"], found["low"],
            found["high"], "in this simulated world the factor is 8 % below the object file "
            "and the pressure is higher at the rim",
            "python -m tapping_cell single-tap")
    ]  # fmt: skip
    for method in GRAPH_METHODS:
        runs = [results[f"graph {method} {seed}"] for seed in GRAPH_SEEDS]
        taps = np.array([run["taps"] for run in runs])
        mean = float(taps.mean())
        error = STUDENT_95 * float(taps.std(ddof=1)) / math.sqrt(taps.size)
        reached = sum(run["reached"] for run in runs)
        rows.append(
            Row(section, method, "taps", "-" if method == "optimal" else "about 5", mean,
                mean - error, mean + error, "camera, learning and stopping rule of this cell; "
                f"{reached} of {len(runs)} goals reached",
                f"python -m tapping_cell demo --move 10 0 10 --planner {method}")
        )  # fmt: skip
    return rows


def write(folder: Path, results: Mapping[str, Mapping[str, Any]]) -> Path:
    """Draw the figures and write page and table; return the page."""
    from tapping_cell.report import mechanics_figures, paper_page, planning_comparison
    from tapping_cell.report.single_tap_figures import PROFILES, RUNS

    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    options = parser.parse_args(shlex.split(POSITIONING["exact"]))
    settings = evaluate.make_evaluation(options, "exact").settings
    methods = planning_comparison.methods()
    files = {name: folder / f"{name}.png" for name in
             ("changes", "causes", "planners", "rounding", "cones", "fans")}  # fmt: skip
    paper_page.draw_changes([(name, results[name]) for name in CHANGES], files["changes"])
    paper_page.draw_causes(
        [0.0007 * share for share in NOISE.values()],
        {
            f"error of the model {bias} %": [
                results[f"camera {label}, model {bias} %"] for label in NOISE
            ]
            for bias in BIASES
        },
        files["causes"],
    )
    paper_page.draw_planners(results, files["planners"])
    paper_page.draw_rounding(results, files["rounding"])
    goal = (10.0, 0.0, 10.0)
    planning_comparison.draw_cones(settings, goal, methods, files["cones"])
    planning_comparison.draw_fans(settings, goal, methods, files["fans"])
    cone, velocities = mechanics_figures.write_figures(paper_tap(), folder)
    disk = folder / OBJECTS[0]
    shown: Sequence[tuple[str, Sequence[tuple[Path, str]]]] = (
        ("From the paper's cell to this one", [(files["changes"], "Each line adds one change to "
          "the lines above it. Percentage: final poses truly inside the tolerance.")]),
        ("Which camera, scatter and model errors give five taps", [(files["causes"], "Taps of "
          "exact (retreat, stops when the measured error is inside the tolerance; scatter 5 % and "
          "15 %). The paper's accuracy is 0.7 mm.")]),
        ("Exact and conservative, and the rounded striker", [(files["planners"],
          "In the paper's cell, for two meanings of "
          "\"the goal can be reached in one tap\"."),
          (files["rounding"], "Rounding adds about as many taps in both cells.")]),
        ("Figure 3: displacements and initial velocities", [(disk / RUNS, "Aluminium disk, 4 runs "
          "of 10 taps. Crosses are calculated from the other quantity; open marks are the mean "
          "prediction from the striker.")]),
        ("Figure 4: velocity profiles", [(disk / PROFILES, "Two taps, with the prediction from "
          "their displacement; dashed without a torque factor.")]),
        ("Figures 5 and 6: subgoals", [(files["cones"], "Cones and first subgoals.")]),
        ("Figures 5 and 6: runs", [(files["fans"], "Sixty runs of each method; the rectangle is "
          "the stopping box.")]),
        ("Reachable cone and norm of the Jacobian", [(cone, "Reachable cone of one tap.")]),
        ("Velocities during a slide", [(velocities, "Model of the sliding disk.")]),
    )  # fmt: skip
    return paper_page.write_page(folder, rows_of(results), shown)
