"""Comparison of all planning methods: a table and plots, in mm and degrees."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from tapping_cell.durable_file import replace_text
from tapping_cell.planning import Planner, PlannerSettings, planner_names
from tapping_cell.planning.evaluation.task import Results
from tapping_cell.planning.interface import Array
from tapping_cell.planning.multi import MultiPlanner
from tapping_cell.planning.registry import load_planner
from tapping_cell.report.palette import REST, STRIKE
from tapping_cell.report.tables import TRIALS, trial_columns, write_trials

FAN_RUNS = 60
FAN_SEED = 1
Goal = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Method:
    """A planning method with the settings of one of its variants.

    ``error_line``: assumed rotation error in percent of the tap's rotation; None means the method's
    default.
    """

    label: str
    planner: str
    variant: str = "overshoot"
    error_line: float | None = None


def methods(own: str = "optimal") -> tuple[Method, ...]:
    """Return the compared methods: built-in methods with variants, all registered methods, and
    ``own``, which may be given as module:Class."""
    built_in = (
        Method("exact, retreat", "exact", "retreat"),
        Method("exact, overshoot", "exact"),
        Method("conservative, retreat", "conservative", "retreat"),
        Method("conservative, overshoot", "conservative"),
        Method("multi 30 %", "multi", error_line=30.0),
        Method("multi 60 %", "multi", error_line=60.0),
        Method("optimal", "optimal"),
    )
    known = {method.planner for method in built_in}
    names = dict.fromkeys([*planner_names(), own])
    return built_in + tuple(Method(name, name) for name in names if name not in known)


def method_settings(method: Method, settings: PlannerSettings) -> PlannerSettings:
    """Return the common settings, updated with those of a method."""
    line = method.error_line
    return replace(
        settings, variant=method.variant, error_line=None if line is None else line / 100.0
    )


def comparison_table(rows: dict[str, dict[str, Any]]) -> str:
    """Return a Markdown table of the results, with one row per method."""
    reference = next(iter(rows.values()))["more_taps"]["than"]
    lines = [
        f"| method | mean taps (95 % interval) | more taps than {reference} (95 % interval) "
        "| 99 % of runs within (taps) | maximum taps "
        "| reached within 5 taps, of all | reached, of all | truly inside, of reached |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for label, figures in rows.items():
        taps, more = figures["taps"], figures["more_taps"]
        low, high = taps["mean_interval"]
        least, most = more["mean_interval"]
        difference = f"{more['mean']:+.3f} ({least:+.3f} to {most:+.3f})"
        lines.append(
            f"| {label} | {taps['mean']:.3f} ({low:.3f} to {high:.3f}) "
            f"| {'-' if label == reference else difference} | {taps['p99']} "
            f"| {taps['max']} | {100 * _within(figures)[min(5, taps['max'])]:.1f} % "
            f"| {100 * figures['success_rate']:.1f} % "
            f"| {100 * figures['truly_inside_rate']:.2f} % |"
        )
    return "\n".join(lines)


def write_comparison(
    folder: Path,
    rows: dict[str, dict[str, Any]],
    trials: dict[str, Results],
    settings: PlannerSettings,
    goal: Goal,
    compared: tuple[Method, ...],
) -> None:
    """Write ``comparison.md``, ``comparison.json``, ``trials.csv`` and the plots; create the folder
    if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    replace_text(folder / "comparison.md", comparison_table(rows) + "\n")
    replace_text(folder / "comparison.json", json.dumps(rows, indent=2) + "\n")
    write_trials(
        folder / TRIALS,
        [({"method": label}, trial_columns(results)) for label, results in trials.items()],
    )
    draw_histograms(rows, folder / "planning_taps.png")
    draw_success(rows, folder / "planning_success.png")
    draw_differences(rows, folder / "planning_differences.png")
    draw_cones(settings, goal, compared, folder / "planning_cones.png")
    draw_fans(settings, goal, compared, folder / "planning_fans.png")


def draw_histograms(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw the histogram of the number of taps for each method."""
    figure, axes = _figure(len(rows), columns=4, size=(12.0, 2.6))
    longest = max(figures["taps"]["max"] for figures in rows.values())
    last = min(longest, 12)
    for axis, (label, figures) in zip(axes, rows.items(), strict=False):
        share = np.zeros(last + 1)
        for taps, count in figures["taps"]["histogram"].items():
            share[min(int(taps), last)] += 100.0 * count / figures["trials"]
        axis.bar(np.arange(last + 1), share, color=REST)
        axis.axvline(figures["taps"]["mean"], color=STRIKE, linewidth=1.2)
        axis.set_title(f"{label}: mean {figures['taps']['mean']:.2f}", fontsize=9)
        more = f" ({last} and more)" if longest > last else ""
        axis.set(xlabel=f"taps{more}", ylabel="runs (%)")
    figure.savefig(path)


def draw_success(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw, for each method, the fraction of finished runs as a function of the number of taps."""
    figure, (axis,) = _figure(1, columns=1, size=(7.5, 4.5))
    for label, figures in rows.items():
        share = 100.0 * _within(figures)
        axis.plot(np.arange(share.size), share, marker="o", markersize=3, label=label)
    axis.set(xlim=(0, 10), ylim=(0, 101), xlabel="taps", ylabel="completed runs (%)")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.savefig(path)


def draw_differences(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Draw how many more taps each method needs than the reference, with 95 % intervals."""
    figure, (axis,) = _figure(1, columns=1, size=(7.5, 0.7 + 0.35 * len(rows)))
    for place, figures in enumerate(rows.values()):
        more = figures["more_taps"]
        axis.plot(more["mean_interval"], [place, place], color=REST, lw=3, solid_capstyle="butt")
        axis.plot(more["mean"], place, "o", color=REST)
    axis.axvline(0.0, color=STRIKE, linewidth=1.2)
    axis.set_yticks(range(len(rows)), list(rows))
    axis.invert_yaxis()
    reference = next(iter(rows.values()))["more_taps"]["than"]
    axis.set_xlabel(f"more taps than {reference}, mean with 95 % interval")
    axis.grid(axis="x", alpha=0.3)
    figure.savefig(path)


def draw_cones(
    settings: PlannerSettings, goal: Goal, compared: tuple[Method, ...], path: Path
) -> None:
    """Draw the cone of one tap, the subgoals of the first tap, and the multi-tap plan's cones."""
    figure, (left, right) = _figure(2, columns=2, size=(11.0, 4.6))
    distance, turn = math.hypot(goal[0], goal[1]), goal[2]
    slope = math.degrees(settings.cone_slope) * 1e-3
    span = distance + max(turn / slope, distance, 5.0)
    x = np.linspace(-span, span, 201)
    left.fill_between(x, -slope * np.abs(x), slope * np.abs(x), color="#cfe2f3", lw=0)
    back = slope * np.abs(x - distance)
    left.fill_between(x, turn - back, turn + back, color="#f4cccc", alpha=0.5, lw=0)
    left.plot(0.0, 0.0, "ko")
    left.annotate("start", (0.0, 0.0), (6, -12), textcoords="offset points", fontsize=8)
    left.plot(distance, turn, "k*", markersize=12)
    for method in compared:
        tap = _planner(method, settings).choose(1e-3 * distance, math.radians(turn))
        place, angle = 1e3 * float(tap.distance), math.degrees(float(tap.rotation))
        left.plot([0.0, place], [0.0, angle], marker="o", markersize=4, lw=1.0, label=method.label)
    left.set_title(
        "blue: reachable by one tap\nred: subgoals from which one more tap reaches the goal",
        fontsize=9,
    )
    left.set_ylim(-2.0, max(1.3 * turn, 12.0))
    left.legend(fontsize=7, loc="upper right", bbox_to_anchor=(-0.1, 1.0))
    _draw_chain(right, settings, distance, turn)
    for axis in (left, right):
        axis.set(xlabel="distance (mm)", ylabel="rotation (degrees)")
    figure.savefig(path)


def _draw_chain(axis: Axes, settings: PlannerSettings, distance: float, turn: float) -> None:
    planner = MultiPlanner(replace(settings, error_line=None))
    shown = planner.distances <= max(4e-3 * distance, 0.03)
    x = 1e3 * planner.distances[shown]
    planned = int(planner.planned_taps(1e-3 * distance, math.radians(turn)))
    for number, opening in enumerate(planner.cones[: planned + 1], start=1):
        upper = np.degrees(np.clip(opening, 0.0, None))[shown]
        axis.plot(x, upper, label=f"cone {number}")
    axis.plot(distance, turn, "ko")
    start = f"start: {planned} taps"
    axis.annotate(start, (distance, turn), (8, -3), textcoords="offset points", fontsize=8)
    axis.set_ylim(0.0, max(2.5 * turn, 12.0))
    axis.set_title(
        "cone n: errors that the method multi corrects with n taps,\n"
        f"if the rotation of each tap is wrong by at most {100 * planner.error_line:.0f} %",
        fontsize=9,
    )
    axis.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def draw_fans(
    settings: PlannerSettings, goal: Goal, compared: tuple[Method, ...], path: Path
) -> None:
    """Draw runs of every method in the distance-rotation plane, like figures 5 and 6 of the
    paper."""
    figure, axes = _figure(len(compared), columns=4, size=(13.0, 3.0))
    distance, turn = math.hypot(goal[0], goal[1]), goal[2]
    for axis, method in zip(axes, compared, strict=False):
        planner = _planner(method, settings)
        for run in fan_of_runs(planner, (1e-3 * distance, math.radians(turn)), FAN_RUNS, FAN_SEED):
            axis.plot(1e3 * run[:, 0], np.degrees(run[:, 1]), color=REST, alpha=0.15, lw=0.8)
            axis.plot(1e3 * run[1:, 0], np.degrees(run[1:, 1]), ".", color=STRIKE, markersize=2)
        wide, high = 1e3 * settings.stopping.distance, math.degrees(settings.stopping.rotation)
        corner = (distance - wide, turn - high)
        axis.add_patch(Rectangle(corner, 2 * wide, 2 * high, fill=False, color="k", lw=0.8))
        axis.set_title(method.label, fontsize=9)
        axis.set(xlabel="distance (mm)", ylabel="rotation (degrees)")
    figure.savefig(path)


def _planner(method: Method, settings: PlannerSettings) -> Planner:
    return load_planner(method.planner, method_settings(method, settings))


def _within(figures: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the fractions of all runs that finish within 0, 1, 2, ... taps."""
    counts = np.zeros(figures["taps"]["max"] + 1)
    for taps, count in figures["taps"]["histogram"].items():
        counts[int(taps)] = count
    share = np.cumsum(counts) / np.sum(counts) * float(figures["success_rate"])
    return np.asarray(share)


def _figure(count: int, columns: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    rows = math.ceil(count / columns)
    figure = Figure(figsize=(size[0], size[1] * rows), dpi=110, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[count:]:
        axis.set_axis_off()
    return figure, list(axes[:count])


def fan_of_runs(
    planner: Planner, goal: tuple[float, float], count: int, seed: int, most_taps: int = 20
) -> list[Array]:
    """Simulate runs from (0, 0) to ``goal`` = (distance in m, rotation in rad); return the states
    of each run, (taps + 1, 2).

    The camera has no noise, and taps have the scatter that the planner assumes. The first
    coordinate is the object's position along the line from the start to the goal; sideways drift is
    not included.
    """
    rng = np.random.default_rng(seed)
    scatter, box = planner.settings.scatter, planner.settings.stopping
    runs = []
    for _ in range(count):
        place = np.zeros(3)
        track = [(0.0, 0.0)]
        while len(track) <= most_taps:
            left = np.array([goal[0], 0.0, goal[1]]) - place
            distance = math.hypot(left[0], left[1])
            if distance <= box.distance and abs(left[2]) <= box.rotation:
                break
            tap = planner.choose(distance, left[2])
            noise = rng.standard_normal(3)
            size, turn = float(tap.distance), float(tap.rotation)
            length = size + float(scatter.along(size)) * noise[0]
            heading = math.atan2(left[1], left[0]) + float(scatter.across(size)) / size * noise[2]
            turn += float(scatter.turning(turn)) * noise[1]
            place = place + np.array([length * math.cos(heading), length * math.sin(heading), turn])
            track.append((float(place[0]), float(place[2])))
        runs.append(np.array(track))
    return runs
