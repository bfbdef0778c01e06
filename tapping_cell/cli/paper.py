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
import datetime
import functools
import json
import math
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tapping_cell import __version__
from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.calibration.object_file import fit_record
from tapping_cell.calibration.object_fit import ObjectFit, fit_object
from tapping_cell.cli import evaluate, sweep
from tapping_cell.cli.errors import print_refusal
from tapping_cell.cli.objects.fit_verb import figures as fit_figures
from tapping_cell.cli.progress import progress
from tapping_cell.cli.sensitivity import sweep_norms
from tapping_cell.cli.simulated_single_taps import Design, simulated_experiment
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import GRAVITY, load_object
from tapping_cell.configuration.schema import ConfigurationError
from tapping_cell.mechanics import Sliding
from tapping_cell.mechanics.sensitivity import (
    PAPER_STRIKER_ERROR,
    norm,
    paper_tap,
    sensitivity,
)
from tapping_cell.planning import PlanningError, Taps
from tapping_cell.planning.evaluation.summary import NORMAL_95
from tapping_cell.planning.interface import Array
from tapping_cell.planning.two_tap import ConservativePlanner, ExactPlanner
from tapping_cell.report.paper_page import RUNS_RANGE, SAMPLE, Row
from tapping_cell.simulation.truth import ScatterTruth, TruthFile

TASK = "--goal 10 0 10 --gain-bias 10 10"
"""The task of section 4. The errors of the model are those of section 3.1.2 (1 to 12 %)."""
CAMERA = "--camera-noise 0.35 0.4"
"""The paper's accuracy of 0.7 mm and 0.8 degrees, taken as two standard deviations."""
SCATTER = "--scatter 10 16 1"
"""Scatter of a tap for the standard deviations of the initial velocities in section 3.1.1, 5 and
15 %: the distance grows with the square of the speed, the rotation with speed times spin. The
paper does not state the scatter of the direction."""
OURS = "--camera-noise 0.1 0.06"
STOPPING = "--variant retreat --box 1"
THEIRS = f"{TASK} {CAMERA} {SCATTER} {STOPPING}"
NOISE = {"0": 0.0, "1/3": 1 / 3, "1/2": 0.5, "1": 1.0}
"""Standard deviations of the camera as shares of the paper's accuracy."""
BIASES = (0, 10, 20)
ROUNDING = {"none": (0, 0), "10 mm, 5 deg": (10, 5), "15 mm, 10 deg": (15, 10)}
CHANGES = {
    "assumed paper's cell: exact, retreat": f"--planner exact {THEIRS}",
    "+ camera 0.1 mm, 0.06 deg": f"--planner exact {TASK} {OURS} {SCATTER} {STOPPING}",
    "+ scatter 5 % in distance": f"--planner exact {TASK} {OURS} {STOPPING}",
    "+ learns from its taps": f"--planner exact {TASK} {OURS} {STOPPING} --adapt",
    "+ stops by probability": f"--planner exact {TASK} {OURS} --variant retreat --adapt",
    "+ overshoots first": f"--planner exact {TASK} {OURS} --adapt",
    "+ conservative": f"--planner conservative {TASK} {OURS} --adapt",
    "+ optimal: this cell": f"--planner optimal {TASK} {OURS} --adapt",
}
POSITIONING = {
    **{name: f"--planner {name} {THEIRS}" for name in ("exact", "conservative", "multi")},
    "exact, tolerant": f"--planner tapping_cell.cli.paper:TolerantExact {THEIRS}",
    "conservative, tolerant": f"--planner tapping_cell.cli.paper:TolerantConservative {THEIRS}",
    "half the scatter": f"--planner exact {THEIRS} --scatter 5 8 0.5",
    "twice the scatter": f"--planner exact {THEIRS} --scatter 20 32 2",
    "stops by probability": f"--planner exact {TASK} {CAMERA} {SCATTER} --variant retreat",
    **CHANGES,
    **{
        f"camera {label}, model {bias} %": f"--planner exact --goal 10 0 10 {SCATTER} {STOPPING} "
        f"--camera-noise {0.7 * share:g} {0.8 * share:g} --gain-bias {bias} {bias}"
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
VELOCITIES = ScatterTruth(speed=0.05, spin=0.15, direction=math.radians(1.0))
SEED, SINGLE_TAP_SEED = 0, 1
OTHER_TRIALS = 4
"""Trials of each run with the plexiglas disk and with the aluminium square."""
PLANNED = 5
"""Number of taps in the statements of section 4."""
SWEPT = 0.050
"""Longest tap whose Jacobian is computed, m."""
REPLICATES = 400
"""Number of bootstrap samples."""
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
    print(f"page in {write(folder, results, arguments.trials)}")
    return 0


def experiments(
    folder: Path, trials: int, processes: int | None = None, graph: bool = False
) -> dict[str, dict[str, Any]]:
    """Return the results of all experiments by name; those in ``folder`` are not repeated."""
    kept = sweep.KeptPoints(folder, {"trials": trials, "version": __version__})
    points: list[sweep.Point] = [{"experiment": f"single taps {name}"} for name in OBJECTS]
    points += [{"experiment": name, "options": words} for name, words in POSITIONING.items()]
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
        [
            *shlex.split(str(point["options"])),
            *("--trials", str(trials), "--seed", str(SEED), "--processes", "1", "--json"),
        ]
    )
    return evaluate.measure(chosen, evaluate.make_evaluation(chosen, chosen.planner))


def _single_taps(folder: Path, name: str) -> dict[str, Any]:
    """Tap an object of the paper in the simulated world and fit it. The first object has four runs
    of ten taps, as in section 3.1, figures 3 and 4, and a fit of the impact. Of the other objects,
    the paper gives only the torque factor."""
    from tapping_cell.cli.objects.fit_report import report_of
    from tapping_cell.report.single_tap_figures import PROFILES, RUNS, write_figures

    content = load_object(shared_folder() / "objects" / f"{name}.yaml")
    truth = TruthFile((0.0, 0.0, 0.0), scatter=VELOCITIES)
    if name != OBJECTS[0]:
        design = Design(trials=OTHER_TRIALS)
        experiment = simulated_experiment(content, STRIKER, truth, design, SINGLE_TAP_SEED)
        without = experiment._replace(header=replace(experiment.header, striker=None))
        return fit_figures(fit_object([without], content))
    experiment = simulated_experiment(content, STRIKER, truth, Design(), SINGLE_TAP_SEED)
    fit = fit_object([experiment], content)
    write_figures(report_of(fit, fit_record(fit, [])), folder, (RUNS, PROFILES))
    return {**fit_figures(fit), **_velocities(fit)}


def _velocities(fit: ObjectFit) -> dict[str, Any]:
    """Return the ratio of calculated to measured rotation without a torque factor, and the scatter
    of the initial velocities within a run with its 95 % interval."""
    sliding = Sliding(fit.content.body(), fit.slide.friction, 1.0, GRAVITY).approximated()
    seen = fit.measured
    turned = np.abs(sliding.rest(seen.speed, np.abs(seen.spin)).rotation)
    labels = np.array(fit.labels)
    runs = [labels == label for label in dict.fromkeys(fit.labels)]

    def scatter(values: Array) -> dict[str, float]:
        apart = np.concatenate([values[run] / np.mean(values[run]) - 1.0 for run in runs])
        freedom = len(apart) - len(runs)
        total = float(apart @ apart)
        low, high = (total / scipy.stats.chi2.ppf(level, freedom) for level in (0.975, 0.025))
        names = ("value", "low", "high")
        return dict(zip(names, np.sqrt([total / freedom, low, high]).tolist(), strict=True))

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


STATEMENTS = {
    "exact": "consistently 5 or fewer taps",
    "conservative": "about 5 taps in most runs, slightly worse than exact",
    "multi": "5 taps planned, 5 in almost every run",
}
"""Statements of sections 4.1 to 4.3. The paper gives no means."""
NO_INTERVAL: tuple[float, float, str] = (math.nan, math.nan, "")


def rows_of(results: Mapping[str, Mapping[str, Any]], trials: int) -> list[Row]:
    """Return every number of the paper with ours, from this number of positioning trials."""
    return [
        *_single_tap_rows(results),
        *_positioning_rows(results, trials),
        *_rounding_rows(results, trials),
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
        rows.append(Row(section, title, "", paper, value, low, high, SAMPLE, why, command))
    disk = results["single taps aluminium_disk"]
    for key, title, paper, why in (
        ("friction", "friction", "0.17", "the paper does not say how it was determined; here it is "
         "fitted to the taps"),
        ("restitution", "restitution", "0.86", "the paper measured it with a light-emitting diode "
         "on the striker; here it is fitted to the taps"),
    ):  # fmt: skip
        found = disk["estimates"][key]
        rows.append(Row(section, title, "", paper, found["value"], found["low"], found["high"],
                        SAMPLE, why, command))  # fmt: skip
    runs = disk["runs_errors"]
    ideal = "the simulated slide follows the model, so only scatter and camera remain"
    straight = "the simulated striker has no error of its angle or place"
    for key, title, paper, why in (
        ("sliding_distance", "sliding model, translation", "1.2 to 10.8 %", ideal),
        ("sliding_rotation", "sliding model, rotation", "3.2 to 12.3 %", ideal),
        ("impact_speed", "impact model, speed", "5 to 15 %", straight),
        ("impact_spin", "impact model, spin", "up to 30 %", straight),
    ):
        errors = [100 * abs(run[key]) for run in runs]
        rows.append(Row(section, f"{title}: error of the mean of a run", "%", paper,
                        float(np.mean(errors)), min(errors), max(errors), RUNS_RANGE, why,
                        command))  # fmt: skip
    for key, title, paper, true in (
        ("speed_scatter", "speed", "up to 5 %", VELOCITIES.speed),
        ("spin_scatter", "spin", "up to 15 %", VELOCITIES.spin),
    ):
        share = {end: 100 * value for end, value in disk[key].items()}
        rows.append(Row(section, f"scatter of the initial {title} in a run", "%", paper,
                        share["value"], share["low"], share["high"], SAMPLE, "the simulated world "
                        f"has {100 * true:.0f} % in every run; the paper gives its largest run",
                        command))  # fmt: skip
    rows.append(
        Row(section, "calculated to measured rotation without a torque factor", "",
            "much above 1 (no number)", disk["unscaled_rotation"], *NO_INTERVAL,
            "follows from the torque factor of the simulated world", command)
    )  # fmt: skip
    return rows


def _command(name: str, trials: int) -> str:
    return f"python -m tapping_cell evaluate {POSITIONING[name]} --trials {trials}"


def _mean_row(section: str, title: str, paper: str, why: str, figures: Mapping[str, Any],
              command: str) -> Row:  # fmt: skip
    """Return the row of a mean number of taps."""
    taps = figures["taps"]
    low, high = taps["mean_interval"]
    return Row(section, f"{title}: mean", "taps", paper, taps["mean"], low, high, SAMPLE,
               why, command)  # fmt: skip


def _share_row(section: str, title: str, paper: str, why: str, figures: Mapping[str, Any],
               command: str, least: int, most: int) -> Row:  # fmt: skip
    """Return the row of the percentage of runs with a number of taps in a range."""
    share = _share(figures, least, most)
    count = sum(figures["taps"]["histogram"].values())
    low, high = _wilson(share, count)
    return Row(section, title, "%", paper, 100 * share, 100 * low, 100 * high, SAMPLE, why,
               command)  # fmt: skip


def _share(figures: Mapping[str, Any], least: int, most: int) -> float:
    histogram = figures["taps"]["histogram"]
    within = sum(count for taps, count in histogram.items() if least <= int(taps) <= most)
    return float(within / sum(histogram.values()))


def _wilson(share: float, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share of ``count`` runs."""
    z = NORMAL_95
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + (z / 2 / count) ** 2)
    return max(0.0, middle - half), min(1.0, middle + half)


def _more(figures: Mapping[str, Any], than: Mapping[str, Any]) -> str:
    """Describe the difference of two means and its 95 % interval."""
    mean = figures["taps"]["mean"] - than["taps"]["mean"]
    errors = (each["taps"]["mean_interval"][1] - each["taps"]["mean"] for each in (figures, than))
    error = math.hypot(*errors)
    return f"{mean:+.2f} taps ({mean - error:+.2f} to {mean + error:+.2f})"


def _in_a_row(figures: Mapping[str, Any]) -> str:
    chance = _share(figures, 0, PLANNED) ** SMALL_SERIES
    return (
        f"{SMALL_SERIES} runs in a row need at most {PLANNED} taps with a probability of "
        f"{100 * chance:.0f} %"
    )


def _positioning_rows(results: Mapping[str, Mapping[str, Any]], trials: int) -> list[Row]:
    section = "Planning methods (section 4): 10 mm and 10 degrees, to 1 mm and 1 degree"

    def mean(name: str, title: str, paper: str, why: str) -> Row:
        return _mean_row(section, title, paper, why, results[name], _command(name, trials))

    def share(name: str, title: str, paper: str, why: str, least: int = 0,
              most: int = PLANNED) -> Row:  # fmt: skip
        return _share_row(section, title, paper, why, results[name], _command(name, trials), least,
                          most)  # fmt: skip

    def within(name: str, title: str, more: str = "") -> Row:
        taps = results[name]["taps"]
        why = f"mean {taps['mean']:.2f} taps; {_in_a_row(results[name])}{more}"
        return share(name, f"exact, {title}: at most {PLANNED} taps", STATEMENTS["exact"], why)

    exact, conservative, multi = (results[name] for name in ("exact", "conservative", "multi"))
    tolerant = results["exact, tolerant"], results["conservative, tolerant"]
    inside = 100 * exact["truly_inside_rate"]
    slope = 10.0 / (10.0 * math.degrees(paper_tap().cone_slope) / 1e3)
    multi_taps = multi["taps"]
    few, many = _share(conservative, 0, 3), 1.0 - _share(conservative, 0, 6)
    return [
        Row(section, "rotation of the task to that of one tap", "", "about 3", slope, *NO_INTERVAL,
            "the contact friction of 0.20 was chosen for this ratio",
            "python -m tapping_cell sensitivity"),
        share("exact", f"exact: at most {PLANNED} taps", STATEMENTS["exact"], _in_a_row(exact)),
        mean("exact", "exact", "not stated", "the errors of camera and model were assumed so that "
             "this mean is about 5"),
        share("conservative", "conservative: 4 to 6 taps", STATEMENTS["conservative"],
              f"{100 * few:.0f} % of the runs need fewer taps, {100 * many:.0f} % more", 4, 6),
        mean("conservative", "conservative", STATEMENTS["conservative"],
             f"compared with exact: {_more(conservative, exact)}"),
        mean("exact, tolerant", "exact, if a tap need only reach the tolerance", "not stated",
             f"compared with exact that must reach the goal itself: {_more(tolerant[0], exact)}"),
        mean("conservative, tolerant", "conservative, if a tap need only reach the tolerance",
             STATEMENTS["conservative"],
             f"compared with exact in this reading: {_more(tolerant[1], tolerant[0])}"),
        _series_row(section, "exact", "conservative", "exact at least as good as conservative",
                    results, trials),
        _series_row(section, "exact, tolerant", "conservative, tolerant",
                    "the same, if a tap need only reach the tolerance", results, trials),
        Row(section, "multi: planned", "taps", "5", float(multi["planned_taps"]), *NO_INTERVAL,
            "error lines of 60 % were chosen, because they give five taps",
            _command("multi", trials)),
        share("multi", f"multi: within the planned {PLANNED} taps", STATEMENTS["multi"],
              f"median {multi_taps['p50']}, maximum {multi_taps['max']} taps"),
        mean("multi", "multi", "not stated", "here a tap may skip cones, so that a run may need "
             "fewer taps than planned"),
        within("camera 1, model 10 %", "0.7 mm and 0.8 degrees as one standard deviation"),
        within("camera 1/3, model 10 %", "0.7 mm and 0.8 degrees as three standard deviations"),
        within("camera 0, model 0 %", "perfect camera and model"),
        within("half the scatter", "half the scatter of a tap"),
        within("twice the scatter", "twice the scatter of a tap"),
        within("stops by probability", "stops only with a probability of 99.9 %",
               f"; without this rule {inside:.0f} % of the final poses are truly inside"),
        mean("+ optimal: this cell", "this cell (optimal)", "-", "better camera, less scatter, "
             "learning, other stopping rule and method: see \"From the paper's cell to this one\""),
    ]  # fmt: skip


def _series_row(
    section: str,
    first: str,
    second: str,
    title: str,
    results: Mapping[str, Mapping[str, Any]],
    trials: int,
) -> Row:
    share, low, high = (100 * value for value in share_of_series(results[first], results[second]))
    return Row(
        section,
        f"series of {SMALL_SERIES} runs: {title}",
        "%",
        "exact was slightly better",
        share,
        low,
        high,
        SAMPLE,
        f"the means of the two methods differ by {_more(results[second], results[first])}",
        f"python -m tapping_cell paper --trials {trials}",
    )


def share_of_series(
    first: Mapping[str, Any], second: Mapping[str, Any]
) -> tuple[float, float, float]:
    """Return the probability that the first method needs no more taps than the second in a small
    series of each, and its 95 % interval (bootstrap)."""
    rng = np.random.default_rng(0)
    counts: list[Array] = []
    for figures in (first, second):
        histogram = figures["taps"]["histogram"]
        numbers = np.array([int(taps) for taps in histogram])
        counts.append(np.bincount(numbers, list(histogram.values())).astype(float))

    def no_more(one: Array, other: Array) -> float:
        totals = [_total_of_series(each / np.sum(each)) for each in (one, other)]
        at_least = np.cumsum(totals[1][::-1])[::-1]
        shared = min(len(totals[0]), len(at_least))
        return float(totals[0][:shared] @ at_least[:shared])

    drawn = [
        no_more(*(rng.multinomial(int(np.sum(n)), n / np.sum(n)).astype(float) for n in counts))
        for _ in range(REPLICATES)
    ]
    low, high = np.quantile(drawn, [0.025, 0.975]).tolist()
    return no_more(*counts), low, high


def _total_of_series(chances: Array) -> Array:
    """Return the probabilities of the total taps of a series, from those of one run."""
    total: Array = np.ones(1)
    for _ in range(SMALL_SERIES):
        total = np.asarray(np.convolve(total, chances), dtype=float)
    return total


def _rounding_rows(results: Mapping[str, Mapping[str, Any]], trials: int) -> list[Row]:
    section = "Rounded striker (section 5)"
    rows = []
    for label in ROUNDING:
        for whose, title in (("theirs", "assumed cell, exact"), ("ours", "this cell, optimal")):
            name = f"rounding {label}, {whose}"
            why = f"median {results[name]['taps']['p50']} taps"
            paper = "not stated"
            if label != "none":
                paper = "5 to 6 taps in a typical trial"
                why += f"; rounding adds {_more(results[name], results[f'rounding none, {whose}'])}"
            rows.append(_mean_row(section, f"rounding {label}: {title}", paper, why, results[name],
                                  _command(name, trials)))  # fmt: skip
    return rows


def _jacobian_rows() -> list[Row]:
    section, command = "Sensitivity (section 5.1)", "python -m tapping_cell sensitivity"
    tap = paper_tap()
    both = sensitivity(tap, [0.010, 0.0, math.radians(3.0)])
    error = np.asarray(PAPER_STRIKER_ERROR)
    printed, physical = (both.printed @ error).tolist(), (both.physical @ error).tolist()
    fitted = "two impact constants were fitted to this row of the printed Jacobian"
    norms = sweep_norms(tap, SWEPT)
    low, high = norms["distance_mm"]
    times = "Jacobian times striker error"
    return [
        Row(section, f"{times}: x", "mm", "1.1 mm", printed[0], *NO_INTERVAL, fitted, command),
        Row(section, f"{times}: y, if the direction of travel rotates with the striker", "mm",
            "0.9 mm", printed[1], *NO_INTERVAL, "this is the paper's assumption, so it agrees "
            "apart from rounding", command),
        Row(section, f"{times}: y, impact model", "mm", "0.9 mm", physical[1], *NO_INTERVAL,
            "here a striker beside its place also rotates the contact normal; the printed row "
            "contains no such part", command),
        Row(section, f"{times}: theta", "degrees", "0.2 degrees", printed[2], *NO_INTERVAL, fitted,
            command),
        Row(section, "norm of the Jacobian", "", "below 1", float(norm(both.printed)),
            *NO_INTERVAL, "units of mm and degrees, as in the paper", command),
        Row(section, f"taps of {low:.1f} to {high:.0f} mm with a norm below 1", "%",
            "all that the tapper can make", 100 * norms["share_below_one"], *NO_INTERVAL,
            "the paper does not state the longest tap of its tapper; here the norm is below 1 for "
            f"all taps of up to {norms['all_below_one_up_to_mm']:.0f} mm", command),
    ]  # fmt: skip


def _graph_rows(results: Mapping[str, Mapping[str, Any]]) -> list[Row]:
    section = "In the ROS cell, with rendered images and emulated devices"
    if "graph single taps" not in results:
        return []
    found = results["graph single taps"]["estimates"]["torque_factor"]
    rows = [
        Row(section, "torque factor, aluminium disk", "", "3.64", found["value"], found["low"],
            found["high"], SAMPLE, "in this simulated world the factor is 8 % below the object "
            "file and the pressure is higher at the rim",
            "python -m tapping_cell single-tap")
    ]  # fmt: skip
    for method in GRAPH_METHODS:
        runs = [results[f"graph {method} {seed}"] for seed in GRAPH_SEEDS]
        taps = np.array([run["taps"] for run in runs])
        mean = float(taps.mean())
        error = STUDENT_95 * float(taps.std(ddof=1)) / math.sqrt(taps.size)
        reached = sum(run["reached"] for run in runs)
        rows.append(
            Row(section, f"{method}: mean", "taps", STATEMENTS.get(method, "-"), mean,
                mean - error, mean + error, SAMPLE, "camera, learning and stopping rule of this "
                f"cell; {reached} of {len(runs)} goals reached",
                f"python -m tapping_cell demo --move 10 0 10 --planner {method} --seed 1")
        )  # fmt: skip
    return rows


def write(folder: Path, results: Mapping[str, Mapping[str, Any]], trials: int) -> Path:
    """Draw the figures and write page and table; return the page."""
    from tapping_cell.report import mechanics_figures, paper_page, planning_comparison
    from tapping_cell.report.single_tap_figures import PROFILES, RUNS

    parser = argparse.ArgumentParser()
    evaluate.add_arguments(parser)
    options = parser.parse_args(shlex.split(POSITIONING["exact"]))
    settings = evaluate.make_evaluation(options, "exact").settings
    methods = tuple(each for each in planning_comparison.methods() if each.planner in STATEMENTS)
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
    cone = mechanics_figures.write_figures(paper_tap(), folder, (mechanics_figures.CONE,))[0]
    shown: Sequence[tuple[str, Sequence[tuple[Path, str]]]] = (
        ("From the paper's cell to this one", [(files["changes"], "Each line adds one change to "
          "the lines above it. Percentage: final poses truly inside the tolerance.")]),
        ("Which camera and which errors of the model give the paper's taps", [(files["causes"],
          "exact (retreat, stops when the measured error is inside the tolerance; scatter 10 % in "
          "distance, 16 % in rotation). Left: mean. Right: runs of at most five taps. The paper's "
          "accuracy is 0.7 mm.")]),
        ("Exact and conservative, and the rounded striker", [(files["planners"],
          "In the assumed cell of the paper, for two meanings of "
          "\"the goal can be reached in one tap\"."),
          (files["rounding"], "Mean taps with a rounded pose of the striker.")]),
        ("Figure 3: displacements and initial velocities", [(folder / RUNS, "Aluminium disk, 4 "
          "runs of 10 taps. Crosses are calculated from the other quantity; open marks are the "
          "mean prediction from the striker.")]),
        ("Figure 4: velocity profiles", [(folder / PROFILES, "Two taps, with the prediction from "
          "their displacement; dashed without a torque factor.")]),
        ("Figures 5 and 6: subgoals", [(files["cones"], "Cones and first subgoals.")]),
        ("Runs in the plane of the subgoals", [(files["fans"], "Sixty simulated runs of each "
          "method with the scatter of the assumed cell, a perfect camera and no error of the "
          "model; the rectangle is the stopping box. The paper draws no runs.")]),
        ("Reachable cone and norm of the Jacobian", [(cone, "Left: displacements that one tap "
          "can cause. Right: norm of the impact model's Jacobian.")]),
    )  # fmt: skip
    provenance = {
        "version": __version__,
        "date": datetime.date.today().isoformat(),
        "seed": f"{SEED} (single taps: {SINGLE_TAP_SEED})",
        "trials": str(trials),
    }
    return paper_page.write_page(folder, rows_of(results, trials), shown, provenance)
