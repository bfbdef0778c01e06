"""Results of a sweep: a table of all points and a plot of taps and true success rate."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tapping_cell.durable_file import replace_text

Row = tuple[Mapping[str, float | str], Mapping[str, Any]]
COLUMNS = (
    "mean_taps",
    "mean_low",
    "mean_high",
    "p90_taps",
    "done_percent",
    "truly_inside_percent",
    "trials_per_second",
)


def sweep_numbers(figures: Mapping[str, Any]) -> dict[str, float]:
    """Return the values of ``COLUMNS`` for one point."""
    taps = figures["taps"]
    low, high = taps["mean_interval"]
    numbers = (
        taps["mean"],
        low,
        high,
        taps.get("p90", float("nan")),
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
            f"| {' | '.join(values)} | {n['mean_taps']:.3f} ({n['mean_low']:.3f} to"
            f" {n['mean_high']:.3f}) | {n['p90_taps']:.0f} | {n['done_percent']:.1f} % |"
            f" {n['truly_inside_percent']:.2f} % |"
        )
    return "\n".join(lines)


def write_sweep(folder: Path, rows: Sequence[Row]) -> None:
    """Write ``sweep.csv``, ``sweep.md`` and ``sweep.png``; the x axis is the first parameter."""
    names = list(rows[0][0])
    table = io.StringIO(newline="")
    writer = csv.writer(table)
    writer.writerow([*names, *COLUMNS])
    for point, figures in rows:
        writer.writerow([*point.values(), *sweep_numbers(figures).values()])
    replace_text(folder / "sweep.csv", table.getvalue())
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
