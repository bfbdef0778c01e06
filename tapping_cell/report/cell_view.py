"""``cell.png``: a true-to-scale plan view of a run, and the residual after each tap."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from tapping_cell.durable_file import part_of
from tapping_cell.planning.evaluation.arrangements import ArrangementTrial
from tapping_cell.report.arrangement_figures import draw_scene
from tapping_cell.report.palette import GOAL, LINE, MUTED, REST, START, STRIKE, TABLE, WAITING
from tapping_cell.report.run import Run, TapRow
from tapping_cell.report.svg import MOUNT_MM, NAME_BEHIND_MM
from tapping_cell.report.words import counted, motion, numbers_in_words, remaining_error
from tapping_cell.se2 import Array, Pose, transform_points

MAX_IN_WORDS = 6
MAX_LABELLED = 6
"""Largest number of residuals that are all labelled; of more, only the first and the last are."""
NUMBER_MM = 20.0
"""Distance between the numbers of two strikes in the plan of the table."""


def draw_cell(run: Run, path: Path) -> None:
    """Write the figure of a run as PNG. With several objects, it shows the table at the start,
    half-way and at the end."""
    if len(run.objects) > 1:
        draw_scene(_scene_of(run), path)
        return
    figure = Figure(figsize=(14.0, 5.4), dpi=110, layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=(1.45, 1.1, 0.8))
    _draw_table(figure.add_subplot(grid[:, 0]), run)
    _draw_close_up(figure.add_subplot(grid[:, 1]), run)
    _draw_residuals(figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2]), run)
    figure.supxlabel(_moves(run), fontsize=9)
    figure.suptitle(_headline(run), fontsize=13, fontweight="bold")
    part = part_of(path)
    figure.savefig(part, format="png")
    part.replace(path)


def _scene_of(run: Run) -> ArrangementTrial:
    """Return the poses of all objects after each tap, true ones if they are known."""
    scene = ArrangementTrial(
        end="done" if run.reached else run.outcome,
        goals={one.name: one.goal for one in run.objects if one.goal is not None},
        outlines={one.name: np.asarray(one.outline).reshape(-1, 2) for one in run.objects},
        table=run.table_size,
    )
    scene.history.append({one.name: one.start for one in run.objects if one.start is not None})
    for tap in run.taps:
        after = tap.true_pose or (tap.measured if tap.seen else tap.before)
        scene.history.append({**scene.history[-1], tap.object_name: after})
    return scene


def _headline(run: Run) -> str:
    one = run.first
    taps = counted(len(run.taps), "tap")
    result = f"goal reached in {taps}" if run.reached else f"{run.outcome} after {taps}"
    if one.start is None or one.goal is None:
        return result
    return f"started {remaining_error(one.start, one.goal)} from the goal: {result}"


def _moves(run: Run) -> str:
    """Describe the displacement of each tap, or of the last taps of a long run."""
    parts = [
        f"tap {tap.number}: {motion(tap.before, tap.measured)}" for tap in run.taps[-MAX_IN_WORDS:]
    ]
    return "     ".join(parts)


def _seen(run: Run) -> list[TapRow]:
    """Return the taps after which the object was seen."""
    return [tap for tap in run.taps if tap.seen]


def _mm(pose: Pose) -> tuple[float, float]:
    return 1000 * pose.x, 1000 * pose.y


def _outline_at(run: Run, pose: Pose) -> Array:
    return 1000 * transform_points(pose, np.asarray(run.first.outline).reshape(-1, 2))


def _heading(run: Run, pose: Pose) -> Array:
    """Return a line from centre to rim along the object's x axis. The line shows the angle of a
    disk."""
    reach = max((math.hypot(x, y) for x, y in run.first.outline), default=0.0)
    return 1000 * transform_points(pose, [[0.0, 0.0], [reach, 0.0]])


def _draw_table(axes: Axes, run: Run) -> None:
    one = run.first
    length, width = run.table_size
    x, y = 500 * length, 500 * width
    axes.add_patch(Rectangle((-x, -y), 2 * x, 2 * y, facecolor=TABLE, edgecolor=LINE))
    poses = [(one.start, START, 1.0)] if one.start is not None else []
    # The first tap of a goal that a restarted planner resumed has a greater number than 1.
    poses += [
        (tap.measured, REST, 0.35 + 0.5 * tap.number / run.taps[-1].number) for tap in _seen(run)
    ]
    for pose, colour, alpha in poses:
        axes.add_patch(
            Polygon(_outline_at(run, pose), fill=False, edgecolor=colour, alpha=alpha, lw=1.2)
        )
        axes.plot(*_heading(run, pose).T, color=colour, alpha=alpha, lw=1.0)
    if one.goal is not None:
        at_goal = _outline_at(run, one.goal)
        axes.add_patch(
            Polygon(at_goal, facecolor=GOAL, alpha=0.15, edgecolor=GOAL, lw=2.0, ls="--")
        )
        axes.plot(*_heading(run, one.goal).T, color=GOAL, lw=2.0, ls="--")
    for name, tip in run.mounts:
        body = 1000 * transform_points(tip, MOUNT_MM / 1000)
        axes.add_patch(Polygon(body, facecolor=LINE, edgecolor=MUTED))
        behind = transform_points(tip, [[-NAME_BEHIND_MM / 1000, 0.0]])[0]
        axes.text(1000 * behind[0], 1000 * behind[1], name, ha="center", va="center", fontsize=7)
        x, y = np.maximum((x, y), np.abs(body).max(axis=0))
    numbered: list[Array] = []
    for tap in run.taps:
        _draw_strike(axes, tap.strike, tap.number, numbered)
    # Legend entries for the outlines.
    axes.plot([], [], color=START, label="start")
    axes.plot([], [], color=REST, label="at rest after a tap")
    axes.plot([], [], color=GOAL, ls="--", label="goal")
    axes.plot([], [], color=STRIKE, marker=">", label="strike, with the tap's number")
    _legend_below(axes)
    axes.set(title="the table from above", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    axes.set(xlim=(-x - 15, x + 15), ylim=(-y - 15, y + 15))


def _draw_strike(axes: Axes, strike: Pose, number: int, numbered: list[Array]) -> None:
    """Draw an arrow along the striker's travel, with its head at the object. ``numbered``: places
    of the numbers of earlier strikes, which the number keeps clear of; it is added."""
    along = np.array([math.cos(strike.theta), math.sin(strike.theta)])
    tip = 1000 * np.array([strike.x, strike.y])
    arrow = {"arrowstyle": "-|>", "color": STRIKE, "lw": 1.6}
    head, tail = (tip - length * along for length in (0, 45))
    axes.annotate("", xy=head.tolist(), xytext=tail.tolist(), arrowprops=arrow)
    place = tip - 54 * along
    while any(np.hypot(*(place - other)) < NUMBER_MM for other in numbered):
        place = place - 4 * along
    numbered.append(place)
    x, y = place.tolist()
    axes.text(x, y, str(number), color=STRIKE, ha="center", va="center", fontsize=10)


def _draw_close_up(axes: Axes, run: Run) -> None:
    one = run.first
    tolerance = 1000 * one.tolerance[0]
    ends = [pose for pose in (one.start, one.goal) if pose is not None]
    if one.goal is not None:
        axes.add_patch(Circle(_mm(one.goal), tolerance, facecolor=GOAL, alpha=0.2, edgecolor=GOAL))
        axes.plot(*_mm(one.goal), marker="+", color=GOAL, ms=14, mew=2)
        axes.annotate("goal", _mm(one.goal), (-8, -26), textcoords="offset points", color=GOAL)
    if one.start is not None:
        axes.plot(*_mm(one.start), marker="o", color=START, ms=6)
        axes.annotate("start", _mm(one.start), (-4, 10), textcoords="offset points", color=START)
    arrow = {"arrowstyle": "-|>", "color": REST, "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
    for tap in _seen(run):
        axes.annotate("", xy=_mm(tap.measured), xytext=_mm(tap.before), arrowprops=arrow)
        axes.plot(*_mm(tap.predicted), marker="x", color=WAITING, ms=6)
    # The taps that end at one place share one label.
    for place, numbers in _ends_of_taps(run).items():
        axes.annotate(numbers, place, (5, 6), textcoords="offset points", color=REST)
    axes.plot([], [], marker="x", ls="", color=WAITING, label="predicted end of a tap")
    axes.plot([], [], color=REST, label="measured move of a tap")
    _legend_below(axes)
    points = np.array([_mm(pose) for pose in ends] + [_mm(tap.measured) for tap in _seen(run)])
    if len(points):
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        half = max(float(np.max(np.ptp(points, axis=0))) / 2 * 1.35, 4 * tolerance, 1.0)
        (left, bottom), (right, top) = middle - half, middle + half
        axes.set(xlim=(left, right), ylim=(bottom, top))
    axes.set(
        title=f"path of the centre, tolerance {tolerance:g} mm",
        xlabel="x (mm)",
        ylabel="y (mm)",
        aspect="equal",
    )


def _legend_below(axes: Axes) -> None:
    """Put the legend below the axes, where it hides nothing."""
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=8)


def _ends_of_taps(run: Run) -> dict[tuple[float, float], str]:
    """Return the numbers of the taps that end at each place, in mm; ends that are too close for
    two labels count as one place."""
    poses = [pose for tap in _seen(run) for pose in (tap.before, tap.measured)]
    spans = np.ptp([_mm(pose) for pose in poses], axis=0) if poses else np.zeros(1)
    near, found = 0.15 * float(np.max(spans)), dict[tuple[float, float], list[int]]()
    for tap in _seen(run):
        here = _mm(tap.measured)
        place = next((each for each in found if math.dist(each, here) <= near), here)
        found.setdefault(place, []).append(tap.number)
    return {place: numbers_in_words(numbers) for place, numbers in found.items()}


def _draw_residuals(upper: Axes, lower: Axes, run: Run) -> None:
    one = run.first
    goal = one.goal
    starts = [one.start] if one.start is not None else []
    poses = [*starts, *(tap.measured for tap in _seen(run))] if goal is not None else []
    numbers = range(1 - len(starts), len(poses) + 1 - len(starts))
    distance = [1000 * pose.distance_to(goal) for pose in poses if goal is not None]
    rotation = [abs(math.degrees(pose.rotation_to(goal))) for pose in poses if goal is not None]
    series = (
        (upper, distance, 1000 * one.tolerance[0], "remaining distance (mm)"),
        (lower, rotation, math.degrees(one.tolerance[1]), "remaining rotation (deg)"),
    )
    for axes, values, limit, label in series:
        axes.axhspan(0, limit, color=GOAL, alpha=0.15)
        axes.plot(numbers, values, marker="o", color=REST)
        for number, value in zip(numbers, values, strict=True):
            if len(values) > MAX_LABELLED and number not in (numbers[0], numbers[-1]):
                continue
            axes.annotate(
                f"{value:.2f}", (number, value), (6, 4), textcoords="offset points", fontsize=8
            )
        axes.set(ylabel=label, xlabel="taps", xlim=(-0.3, 1.2 * len(run.taps) + 0.6))
        axes.set_ylim(0, 1.15 * max([*values, 2 * limit, 1.0]))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
