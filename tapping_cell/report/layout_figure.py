"""Drawing of a cell with fixed tappers: their lines, strokes, reach and dead zones."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tapping_cell.configuration.assembly import make_fixed_space
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning.coverage import coverage


def draw_layout(cell: Cell, path: Path) -> None:
    """Write the drawing of a cell's fixed tappers; the file suffix determines the format.

    Raises:
        ConfigurationError: the cell has an arm.
    """
    space = make_fixed_space(cell)
    cover = coverage(space)
    points, count = 1e3 * cover.points, cover.reached.sum(axis=1)
    figure = Figure(figsize=(7.6, 6.6), layout="constrained")
    axes = figure.subplots()
    levels = np.arange(len(space.tappers) + 2) - 0.5
    shown = axes.scatter(
        points[:, 0],
        points[:, 1],
        c=count,
        s=22,
        marker="s",
        cmap=colormaps["viridis"].resampled(len(levels) - 1),
        vmin=levels[0],
        vmax=levels[-1],
        linewidths=0,
    )
    figure.colorbar(shown, ax=axes, label="tappers that reach an object here", shrink=0.8)
    dead = points[cover.dead]
    if dead.size:
        x, y = dead.T
        axes.scatter(x, y, c="crimson", s=14, marker="x", label="no tap leads inward")
    area = space.area
    axes.add_patch(Circle((1e3 * area.x, 1e3 * area.y), 1e3 * area.radius, fill=False, lw=1.5))
    for tapper in space.tappers:
        mount, stroke = tapper.mount, 1e3 * tapper.stroke
        tip = 1e3 * np.array([mount.x, mount.y])
        along = np.array([math.cos(mount.theta), math.sin(mount.theta)])
        line = np.array([tip, tip + stroke * along])
        axes.plot(*line.T, color="0.25", lw=0.8, ls="--", zorder=3)
        axes.annotate(
            "",
            xy=(tip + 28.0 * along).tolist(),
            xytext=tip.tolist(),
            arrowprops={"arrowstyle": "-|>", "lw": 2.0, "color": "tab:orange"},
            zorder=4,
        )
        x, y = (tip - 16.0 * along).tolist()
        axes.text(x, y, tapper.name, ha="center", va="center", fontsize=8)
    corners = np.array([*cell.outline(), cell.outline()[0]])
    outline = 1e3 * (corners + np.array([area.x, area.y]))
    axes.plot(*outline.T, color="white", lw=1.2, label="the object")
    axes.margins(0.1)
    axes.set(
        aspect="equal",
        xlabel="x in mm",
        ylabel="y in mm",
        title=f"{cell.file.name}: {len(space.tappers)} tappers, working area of "
        f"{1e3 * area.radius:.0f} mm radius, {100.0 * np.mean(cover.dead):.1f} % dead zone",
    )
    figure.savefig(path, dpi=120)
