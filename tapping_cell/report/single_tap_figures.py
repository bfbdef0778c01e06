"""Figures of single-tap experiments, like figures 3 and 4 of the paper."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from tapping_cell.report.palette import INK, MUTED, PREDICTED, REST, STRIKE
from tapping_cell.report.single_tap import ProfileView, SingleTapReport
from tapping_cell.se2 import Array

RUNS = "single_tap_runs.png"
PROFILES = "single_tap_profiles.png"
RESIDUALS = "single_tap_residuals.png"
ERRORS = "single_tap_errors.png"
VALUES = "single_tap_values.png"

# Matplotlib before 3.7, as in Ubuntu 24.04, cannot place a legend outside the axes.
_BELOW = "outside lower center" if matplotlib.__version_info__ >= (3, 7) else "lower center"
_GRID: dict[str, Any] = {"alpha": 0.25, "linewidth": 0.6}
_MARGIN_MS = 10.0
_MARKS = "osD^vP*X<>"


def write_figures(
    report: SingleTapReport, folder: Path, names: Collection[str] | None = None
) -> list[Path]:
    """Draw the figures with these names, by default all, into an existing folder; return the files
    in the order of the page."""
    drawings = [
        (RUNS, (11.0, 4.6), _runs),
        (PROFILES, (11.0, 3.4 * max(len(report.profiles), 1)), _profiles),
        (RESIDUALS, (11.0, 4.2), _residuals),
        (ERRORS, (11.0, 4.0), _errors),
        (VALUES, (11.0, 3.2), _values),
    ]
    files = []
    for name, size, draw in drawings:
        if name == PROFILES and not report.profiles:
            continue
        if names is not None and name not in names:
            continue
        figure = Figure(figsize=size, dpi=110, layout="constrained")
        draw(figure, report)
        figure.savefig(folder / name)
        files.append(folder / name)
    return files


def _styles(report: SingleTapReport) -> dict[str, tuple[str, str]]:
    """Return colour and marker symbol of each run."""
    labels = dict.fromkeys(report.labels)
    return {
        label: (f"C{index % 10}", _MARKS[index % len(_MARKS)]) for index, label in enumerate(labels)
    }


def _runs(figure: Figure, report: SingleTapReport) -> None:
    """Draw figure 3: displacements (left) and initial velocities (right) of every trial."""
    left, right = figure.subplots(1, 2)
    seen, tapped, slid = report.measured, report.by_tapping, report.by_sliding
    names = np.array(report.labels)
    pairs = (
        (left, seen.distance, seen.rotation, tapped.distance, tapped.rotation, slid.distance,
         slid.rotation),
        (right, seen.speed, seen.spin, tapped.speed, tapped.spin, slid.speed, slid.spin),
    )  # fmt: skip
    for axes, x, y, tap_x, tap_y, slide_x, slide_y in pairs:
        for label, (colour, mark) in _styles(report).items():
            run = names == label
            axes.plot(x[run], y[run], mark, color=colour, ms=6, alpha=0.75, label=f"run {label}")
            axes.plot(slide_x[run], slide_y[run], "+", color=INK, ms=9, mew=1.0)
            if np.isfinite(tap_x[run]).any():
                # Average taps with positive and with negative rotation separately, because the mean
                # over both groups does not correspond to a real tap.
                for side in (y[run] > 0, y[run] <= 0):
                    if np.isfinite(tap_x[run][side]).any():
                        middle = np.nanmean(tap_x[run][side]), np.nanmean(tap_y[run][side])
                        axes.plot(*middle, mark, mfc="white", mec=colour, mew=2.2, ms=11)
        axes.axhline(0.0, color=MUTED, lw=0.8)
        axes.grid(**_GRID)
        axes.set_xlim(left=0)
    left.set(xlabel="displacement (mm)", ylabel="rotation (degrees)", title="Displacements")
    right.set(
        xlabel="initial speed (mm/s)", ylabel="initial spin (degrees/s)", title="Initial velocities"
    )
    handles, labels = left.get_legend_handles_labels()
    handles += [
        Line2D([], [], marker="+", color=INK, ls="", ms=9),
        Line2D([], [], marker="o", mfc="white", mec=INK, mew=2.2, ls="", ms=10),
    ]
    labels += [
        "calculated from the quantity in the other plot, for each trial",
        "mean prediction from the striker's motion",
    ]
    figure.legend(handles, labels, loc=_BELOW, ncols=4, fontsize=8, frameon=False)


def _profiles(figure: Figure, report: SingleTapReport) -> None:
    """Draw figure 4: measured and predicted velocity profiles of trials, with their poses."""
    grid = figure.subplots(len(report.profiles), 3, squeeze=False)
    for row, view in zip(grid, report.profiles, strict=True):
        _profile(row[0], row[1], row[2], view)
    handles = [
        Line2D([], [], marker="o", color=INK, ls="", ms=5),
        Line2D([], [], color=STRIKE),
        Line2D([], [], color=MUTED, ls="--"),
    ]
    labels = [
        "measured (velocities: differences of frames)",
        "predicted from the displacement",
        "predicted with a torque factor of 1",
    ]
    figure.legend(handles, labels, loc=_BELOW, ncols=3, fontsize=8, frameon=False)


def _profile(speed: Axes, spin: Axes, pose: Axes, view: ProfileView) -> None:
    for axes, plain, curve, seen in (
        (speed, view.plain_speed, view.curve_speed, view.seen_speed),
        (spin, view.plain_spin, view.curve_spin, view.seen_spin),
    ):
        axes.plot(view.plain_time, plain, "--", color=MUTED)
        axes.plot(view.curve_time, curve, color=STRIKE)
        axes.plot(view.rate_time, seen, "o", color=INK, ms=5)
    speed.set(ylabel="speed (mm/s)", title=view.title)
    spin.set(ylabel="spin (degrees/s)", title="spin")
    pose.plot(view.curve_time, view.curve_distance, color=STRIKE)
    pose.plot(view.seen_time, view.seen_distance, "o", color=INK, ms=5)
    pose.set(ylabel="distance (mm)", title="poses")
    turned = pose.twinx()
    turned.plot(view.curve_time, view.curve_rotation, color=STRIKE, alpha=0.5)
    turned.plot(view.seen_time, view.seen_rotation, "s", color=MUTED, ms=4)
    turned.set_ylabel("rotation (degrees), squares", color=MUTED)
    shown = np.concatenate([view.curve_time, view.plain_time, view.seen_time, view.rate_time])
    for axes in (speed, spin, pose):
        axes.set_xlabel("time from the impact (ms)")
        axes.set_xlim(float(np.min(shown)) - _MARGIN_MS, float(np.max(shown)) + _MARGIN_MS)
        axes.grid(**_GRID)


def _residuals(figure: Figure, report: SingleTapReport) -> None:
    """Draw for each trial the friction and the ratios of measured to calculated velocities."""
    left, middle, right = figure.subplots(1, 3)
    seen, slid, names = report.measured, report.by_sliding, np.array(report.labels)
    index = np.arange(1, len(names) + 1)
    columns = (
        (left, _percent(seen.speed, slid.speed), "initial speed: deviation from calculated"),
        (middle, _percent(seen.spin, slid.spin), "initial spin: deviation from calculated"),
        (right, 100 * (report.own_friction - 1), "friction: deviation from fit to all trials"),
    )
    for axes, values, title in columns:
        for label, (colour, mark) in _styles(report).items():
            run = names == label
            axes.plot(index[run], values[run], mark, color=colour, ms=5, label=f"run {label}")
        axes.axhline(0.0, color=MUTED, lw=0.8)
        axes.set(xlabel="trial", ylabel="%", title=title)
        axes.title.set_fontsize(10)
        axes.grid(**_GRID)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc=_BELOW, ncols=8, fontsize=8, frameon=False)


def _percent(seen: Array, calculated: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(100 * (seen / calculated - 1))


def _errors(figure: Figure, report: SingleTapReport) -> None:
    """Draw the errors of the four predictions of each run, in percent."""
    kinds = (
        ("sliding", "displacement\nfrom measured velocity"),
        ("inverse", "velocity\nfrom measured displacement"),
        ("impact", "velocity\nfrom the striker"),
        ("tap", "displacement\nfrom the striker"),
    )
    all_axes = figure.subplots(1, 4, sharey=True)
    place = np.arange(len(report.runs))
    for axes, (kind, title) in zip(all_axes, kinds, strict=True):
        values = np.array([getattr(run, kind) for run in report.runs])
        for shift, column, colour, word in (
            (-0.2, 0, REST, "translation"),
            (0.2, 1, PREDICTED, "rotation"),
        ):
            bars = axes.bar(place + shift, values[:, column], 0.38, color=colour, label=word)
            known = [f"{v:+.1f}" if np.isfinite(v) else "" for v in values[:, column]]
            axes.bar_label(bars, labels=known, fontsize=7, padding=2)
        axes.axhline(0.0, color=INK, lw=0.8)
        axes.set_xticks(place, [f"run {run.label}" for run in report.runs], fontsize=8)
        axes.set_title(title, fontsize=10)
        axes.grid(axis="y", **_GRID)
    largest = np.nanmax(np.abs([[*r.sliding, *r.inverse, *r.impact, *r.tap] for r in report.runs]))
    all_axes[0].set_ylim(-1.25 * max(largest, 1.0), 1.25 * max(largest, 1.0))
    all_axes[0].set_ylabel("prediction error for the run's mean (%)")
    handles, labels = all_axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc=_BELOW, ncols=2, fontsize=8, frameon=False)


def _values(figure: Figure, report: SingleTapReport) -> None:
    """Draw the fitted values and their intervals, relative to the previous values."""
    rows = [p for p in report.parameters if np.isfinite(p.low) and np.isfinite(p.old) and p.old]
    axes = figure.subplots()
    place = np.arange(len(rows))[::-1]
    for y, p in zip(place, rows, strict=True):
        low, value, high = (100 * (v / p.old - 1) for v in (p.low, p.value, p.high))
        axes.plot([low, high], [y, y], color=STRIKE, lw=3, solid_capstyle="butt")
        axes.plot(value, y, "o", color=STRIKE)
        axes.annotate(
            f"{p.value:.4g}  (was {p.old:.4g})",
            (high, float(y)),
            xytext=(8, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axes.axvline(0.0, color=INK, lw=1.0)
    axes.set_yticks(place, [p.name for p in rows])
    axes.set_xlabel("change from the old to the fitted value (%), with the 95 % interval")
    axes.grid(axis="x", **_GRID)
    axes.margins(x=0.25, y=0.15)
