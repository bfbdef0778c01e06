"""Page, table and figures that put the numbers of the paper beside those of this software."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tapping_cell.durable_file import replace_text
from tapping_cell.report.palette import GOAL, PREDICTED, REST
from tapping_cell.report.photograph import data_url
from tapping_cell.report.rendering import render

PAGE, TABLE = "paper.html", "paper.csv"
SAMPLE = "95 %"
"""The range of a number is its 95 % interval."""
RUNS_RANGE = "smallest and largest run"
"""The range of a number is that of the runs of which it is the mean."""
MOST_TAPS = 5
"""Number of taps that runs of the paper did not exceed."""
Results = Mapping[str, Mapping[str, Any]]
_BAND: dict[str, Any] = {"color": "#f4d7d5", "lw": 0}


@dataclass(frozen=True, slots=True)
class Row:
    """One number of the paper and the same number here.

    paper: as the paper states it. value, low, high: number here and a range, in ``unit``; interval:
    what the range is, ``SAMPLE``, ``RUNS_RANGE`` or empty. Without a range, low and high are NaN.
    why: why the two differ. command: the command that repeats the number.
    """

    section: str
    quantity: str
    unit: str
    paper: str
    value: float
    low: float
    high: float
    interval: str
    why: str
    command: str

    @property
    def here(self) -> str:
        """The number here and its interval as text."""
        if not self.interval:
            return f"{self.value:.3g} {self.unit}".strip()
        width = self.high - self.low
        # Two digits of the interval's width are significant.
        digits = max(0, 1 - math.floor(math.log10(width))) if width > 0.0 else 1
        digits = {"taps": 2, "%": min(digits, 1)}.get(self.unit, digits)
        value, low, high = (f"{x:.{digits}f}" for x in (self.value, self.low, self.high))
        of_runs = ", runs" if self.interval == RUNS_RANGE else ""
        return f"{value} {self.unit}".strip() + f" ({low}\u00a0to\u00a0{high}{of_runs})"


def write_page(
    folder: Path,
    rows: Sequence[Row],
    figures: Sequence[tuple[str, Sequence[tuple[Path, str]]]],
    provenance: Mapping[str, str],
) -> Path:
    """Write ``paper.html`` and ``paper.csv``; return the page.

    ``figures``: for each heading the images, with their captions. ``provenance``: version, date,
    seed and trials, further columns of the table.
    """
    text = io.StringIO(newline="")
    table = csv.writer(text)
    table.writerow([*(field.name for field in fields(Row)), *provenance])
    table.writerows((*astuple(row), *provenance.values()) for row in rows)
    replace_text(folder / TABLE, text.getvalue())
    sections: dict[str, list[tuple[str, ...]]] = {}
    for row in rows:
        sections.setdefault(row.section, []).append((row.quantity, row.paper, row.here, row.why))
    page = folder / PAGE
    replace_text(
        page,
        render(
            "paper.html",
            sections=sections,
            figures=[
                (title, [(data_url("image/png", file.read_bytes()), text) for file, text in shown])
                for title, shown in figures
            ],
            commands=[(row.quantity, row.command) for row in rows],
            provenance=provenance,
        ),
    )
    return page


def draw_planners(results: Results, path: Path) -> None:
    """Draw the mean taps of the paper's methods for both meanings of "the goal can be reached"."""
    figure, axis = _figure((5.5, 3.9))
    names = ("exact", "conservative", "multi")
    _grouped(
        axis,
        names,
        {
            "a tap must reach the goal itself": (REST, [results[name] for name in names]),
            "a tap must reach the tolerance": (
                PREDICTED,
                [results.get(f"{name}, tolerant") for name in names],
            ),
        },
    )
    _band(axis, 4.8, 5.2, "paper, conservative: about 5 taps")
    axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1))
    figure.savefig(path)


def draw_rounding(results: Results, path: Path) -> None:
    """Draw the mean taps with a rounded striker pose, in the paper's cell and in this one."""
    figure, axis = _figure((5.5, 3.9))
    steps = ("none", "10 mm, 5 deg", "15 mm, 10 deg")
    _grouped(
        axis,
        steps,
        {
            "assumed cell of the paper, exact": (
                REST,
                [results[f"rounding {s}, theirs"] for s in steps],
            ),
            "this cell, optimal": (GOAL, [results[f"rounding {s}, ours"] for s in steps]),
        },
    )
    axis.set_xlabel("rounding of the striker's pose")
    _band(axis, 5.0, 6.0, "paper: 5 to 6 taps")
    axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
    figure.savefig(path)


def draw_changes(steps: Sequence[tuple[str, Mapping[str, Any]]], path: Path) -> None:
    """Draw how the mean number of taps falls from the paper's cell to this one; each step adds one
    change to the steps above it."""
    figure, axis = _figure((9.0, 0.9 + 0.42 * len(steps)))
    places = list(range(len(steps)))
    means = [figures["taps"]["mean"] for _, figures in steps]
    axis.barh(places, means, color=REST, xerr=_errors([figures for _, figures in steps]))
    for place, mean, (_, figures) in zip(places, means, steps, strict=True):
        text = f"{mean:.2f}; {100.0 * figures['truly_inside_rate']:.1f} % inside"
        axis.text(0.08, place, text, va="center", fontsize=9, color="white")
    axis.axvspan(4.8, 5.2, zorder=0, label="paper: about 5 taps", **_BAND)
    axis.set_yticks(places, [name for name, _ in steps])
    axis.invert_yaxis()
    axis.set(xlabel="mean taps; percentage of final poses inside the tolerance", xlim=(0, 5.5))
    axis.legend(fontsize=8, loc="lower right", bbox_to_anchor=(0.87, 0.0))
    figure.savefig(path)


def draw_causes(
    noise: Sequence[float], curves: Mapping[str, Sequence[Mapping[str, Any]]], path: Path
) -> None:
    """Draw, over the camera's noise (m) and for errors of the model, the mean taps of ``exact`` and
    the percentage of its runs that stay within the number of taps of the paper."""
    figure = Figure(figsize=(9.0, 4.2), dpi=110, layout="constrained")
    mean, share = figure.subplots(1, 2)
    x = 1e3 * np.asarray(noise)
    for colour, (name, row) in zip((GOAL, REST, PREDICTED), curves.items(), strict=True):
        means = [figures["taps"]["mean"] for figures in row]
        mean.errorbar(x, means, yerr=_errors(row), marker="o", color=colour, label=name)
        within = [_percent_within(figures["taps"]["histogram"], MOST_TAPS) for figures in row]
        share.plot(x, within, marker="o", color=colour)
    mean.set(ylabel="mean taps", ylim=(0, None))
    share.set(ylabel=f"runs of at most {MOST_TAPS} taps (%)", ylim=(0, 103))
    for axis in (mean, share):
        axis.set(xlabel="standard deviation of the measured position (mm)")
        axis.grid(alpha=0.3)
    mean.legend(fontsize=8, loc="lower right")
    figure.savefig(path)


def _percent_within(histogram: Mapping[str, int], most: int) -> float:
    within = sum(count for taps, count in histogram.items() if int(taps) <= most)
    return 100 * within / sum(histogram.values())


def _figure(size: tuple[float, float]) -> tuple[Figure, Axes]:
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    return figure, figure.subplots()


def _grouped(
    axis: Axes,
    names: Sequence[str],
    groups: Mapping[str, tuple[str, Sequence[Mapping[str, Any] | None]]],
) -> None:
    width = 0.8 / len(groups)
    for index, (label, (colour, row)) in enumerate(groups.items()):
        known = [(place, figures) for place, figures in enumerate(row) if figures is not None]
        x = [place + (index - (len(groups) - 1) / 2) * width for place, _ in known]
        bars = axis.bar(
            x,
            [figures["taps"]["mean"] for _, figures in known],
            0.9 * width,
            yerr=_errors([figures for _, figures in known]),
            color=colour,
            label=label,
        )
        axis.bar_label(bars, fmt="%.2f", fontsize=8, padding=3)
    axis.set_xticks(range(len(names)), list(names))
    axis.set(ylabel="mean taps", xlim=(-0.6, len(names) - 0.4), ylim=(0, 7))


def _band(axis: Axes, low: float, high: float, label: str) -> None:
    axis.axhspan(low, high, zorder=0, label=label, **_BAND)


def _errors(rows: Sequence[Mapping[str, Any]]) -> list[float]:
    return [figures["taps"]["mean_interval"][1] - figures["taps"]["mean"] for figures in rows]
