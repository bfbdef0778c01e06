"""Figures of arranged scenes at the start, half-way and at the end, with goals and paths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke

from tapping_cell.planning.evaluation.arrangements import ArrangementTrial
from tapping_cell.report.palette import SERIES
from tapping_cell.se2 import Array, Pose, transform_points

MAX_SCENES = 6


def draw_scenes(folder: Path, trials: Sequence[ArrangementTrial]) -> list[Path]:
    """Draw up to ``MAX_SCENES`` scenes into ``folder``, failed scenes first; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    order = sorted(range(len(trials)), key=lambda number: trials[number].end == "done")
    files = []
    for number in order[:MAX_SCENES]:
        file = folder / f"scene_{number + 1:03d}.png"
        draw_scene(trials[number], file)
        files.append(file)
    return files


def draw_scene(trial: ArrangementTrial, file: Path) -> None:
    """Draw one scene in three panels: at the start, half-way and at the end."""
    figure = Figure(figsize=(13.0, 4.0), layout="constrained")
    last = len(trial.history) - 1
    titles = ("before", f"after {last // 2} taps", f"after {last} taps ({trial.end})")
    for axes, number, title in zip(
        figure.subplots(1, 3), (0, last // 2, last), titles, strict=True
    ):
        _draw(axes, trial, number)
        axes.set_title(title)
    figure.savefig(file, dpi=100)


def _draw(axes: Axes, trial: ArrangementTrial, number: int) -> None:
    length, width = 1e3 * trial.table[0], 1e3 * trial.table[1]
    edge = Rectangle((-length / 2, -width / 2), length, width, fill=False, edgecolor="black")
    axes.add_patch(edge)
    for index, (name, outline) in enumerate(trial.outlines.items()):
        if name not in trial.history[0]:  # the object was not seen at the start
            continue
        colour = SERIES[index % len(SERIES)]
        if name in trial.goals:
            ground = _ground(outline, trial.goals[name])
            axes.add_patch(Polygon(ground, fill=False, edgecolor=colour, linestyle="--"))
        way = 1e3 * np.array([poses[name][:2] for poses in trial.history[: number + 1]])
        axes.plot(way[:, 0], way[:, 1], "-", color=colour, linewidth=1.0)
        pose = trial.history[number][name]
        axes.add_patch(
            Polygon(_ground(outline, pose), facecolor=colour, edgecolor=colour, alpha=0.5)
        )
        axes.annotate(
            name.rsplit(" ", 1)[-1],
            (1e3 * pose.x, 1e3 * pose.y),
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=3, foreground="white")],
            zorder=5,
        )
    axes.set(
        aspect="equal",
        xlabel="x (mm)",
        ylabel="y (mm)",
        xlim=(-0.52 * length, 0.52 * length),
        ylim=(-0.52 * width, 0.52 * width),
    )


def _ground(outline: Array, pose: Pose) -> Array:
    return np.asarray(1e3 * transform_points(pose, outline))
