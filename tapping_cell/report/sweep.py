"""Results of a sweep: a table of all points and a plot of taps and true success rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tapping_cell.durable_file import replace_text
from tapping_cell.report.tables import TRIALS, write_table, write_trials

SWEEP = "sweep.csv"
Row = tuple[Mapping[str, float | str], Mapping[str, Any]]
POINT_COLUMNS = {
    "planner": "method",
    "friction": "friction",
    "tolerance": "tolerance_mm_deg",
    "distance-scatter": "distance_scatter_percent",
    "rotation-scatter": "rotation_scatter_percent",
    "direction-scatter": "direction_scatter_deg",
    "position-floor": "position_floor_mm",
    "angle-floor": "angle_floor_deg",
    "camera-noise": "camera_noise_mm_deg",
    "camera-position-noise": "camera_position_noise_mm",
    "camera-angle-noise": "camera_angle_noise_deg",
    "distance-bias": "distance_bias_percent",
    "rotation-bias": "rotation_bias_percent",
    "round-position": "round_position_mm",
    "round-angle": "round_angle_deg",
    "box": "box",
}
"""For each parameter of a sweep, its column in the tables."""
COLUMNS = {
    "mean_taps": "mean number of taps; with endless trials a lower bound",
    "mean_low": "lower end of its 95 % interval",
    "mean_high": "upper end of its 95 % interval",
    "p90_taps": "number of taps within which 90 % of the trials ended",
    "endless_percent": "trials aborted after `--most-taps`, which they count as, of all",
    "done_percent": "trials that ended at the goal according to the planner, of all",
    "truly_inside_percent": "trials in which the true pose is inside the tolerance, of those done",
    "trials_per_second": "speed of the simulation",
}
"""Columns of ``sweep.csv`` and their meanings, after those of the swept parameters."""


def sweep_numbers(figures: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of ``COLUMNS`` for one point."""
    taps = figures["taps"]
    low, high = taps["mean_interval"]
    numbers = (
        taps["mean"],
        low,
        high,
        taps.get("p90", float("nan")),
        100 * figures["endless"] / figures["trials"],
        100 * figures["success_rate"],
        100 * figures["truly_inside_rate"],
        figures["trials_per_second"],
    )
    return dict(zip(COLUMNS, numbers, strict=True))


def sweep_table(rows: Sequence[Row]) -> str:
    """Return a Markdown table with one row per point."""
    names = list(rows[0][0])
    lines = [
        "| "
        + " | ".join(
            [
                *names,
                "mean taps",
                "90 % of runs within (taps)",
                "reached, of all",
                "truly inside, of reached",
            ]
        )
        + " |",
        "| " + " | ".join(["---"] * (len(names) + 4)) + " |",
    ]
    for point, figures in rows:
        n = sweep_numbers(figures)
        values = [_text(point[name]) for name in names]
        lines.append(
            f"| {' | '.join(values)} | {_mean_text(n)} | {n['p90_taps']:.0f} |"
            f" {n['done_percent']:.1f} % |"
            f" {n['truly_inside_percent']:.2f} % |"
        )
    return "\n".join(lines)


def _mean_text(numbers: Mapping[str, float]) -> str:
    """Return the mean and its interval. Of aborted trials only the limit is known."""
    if numbers["endless_percent"]:
        share = numbers["endless_percent"]
        return f"at least {numbers['mean_taps']:.3f} ({share:.1f} % endless)"
    return f"{numbers['mean_taps']:.3f} ({numbers['mean_low']:.3f} to {numbers['mean_high']:.3f})"


def write_sweep(
    folder: Path, rows: Sequence[Row], trials: Sequence[Mapping[str, Sequence[Any]]]
) -> None:
    """Write ``sweep.csv``, ``trials.csv``, ``sweep.md`` and ``sweep.png``; the x axis is the first
    parameter. ``trials``: the ``trial_columns`` of each row."""
    names = list(rows[0][0])
    points = [{POINT_COLUMNS[name]: value for name, value in point.items()} for point, _ in rows]
    lines = [
        {**point, **sweep_numbers(figures)}
        for point, (_, figures) in zip(points, rows, strict=True)
    ]
    write_table(folder / SWEEP, {name: [line[name] for line in lines] for name in lines[0]})
    write_trials(folder / TRIALS, list(zip(points, trials, strict=True)))
    replace_text(folder / "sweep.md", sweep_table(rows) + "\n")
    _plot(names, rows).savefig(folder / "sweep.png", dpi=120)


def _plot(names: Sequence[str], rows: Sequence[Row]) -> Figure:
    first, others = names[0], names[1:]
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    taps, truth = figure.subplots(1, 2)
    curves: dict[str, list[Row]] = {}
    for row in rows:
        label = ", ".join(f"{name} {_text(row[0][name])}" for name in others)
        curves.setdefault(label, []).append(row)
    for label, points in curves.items():
        x: Any = [point[first] for point, _ in points]
        numbers = [sweep_numbers(figures) for _, figures in points]
        mean = [n["mean_taps"] for n in numbers]
        error = [n["mean_taps"] - n["mean_low"] for n in numbers]
        taps.errorbar(x, mean, yerr=error, marker="o", capsize=3, label=label or None)
        inside = [n["truly_inside_percent"] for n in numbers]
        truth.plot(x, inside, marker="o", label=label or None)
    for axes, title in ((taps, "mean taps"), (truth, "truly inside, % of those done")):
        axes.set(xlabel=first.replace("-", " "), ylabel=title)
        axes.grid(alpha=0.3)
    taps.set_ylim(bottom=0.0)
    if others:
        taps.legend(fontsize="small")
    return figure


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"
