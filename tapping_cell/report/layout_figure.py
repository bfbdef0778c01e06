"""Drawing of a cell with fixed tappers: their lines, strokes, reach and dead zones."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import numpy as np

from tapping_cell.configuration.assembly import make_fixed_space
from tapping_cell.configuration.cell import Cell
from tapping_cell.planning.coverage import coverage

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Circle


def draw_layout(cell: Cell, path: Path) -> None:
    """Write the drawing of a cell's fixed tappers; the file suffix determines the format.

    Raises:
        ConfigurationError: the cell has an arm.
    """
    space = make_fixed_space(cell)
    cover = coverage(space)
    points, count = 1e3 * cover.points, cover.reached.sum(axis=1)
    figure, axes = plt.subplots(figsize=(7.6, 6.6), constrained_layout=True)
    levels = np.arange(len(space.tappers) + 2) - 0.5
    shown = axes.scatter(
        points[:, 0],
        points[:, 1],
        c=count,
        s=22,
        marker="s",
        cmap=plt.get_cmap("viridis", len(levels) - 1),
        vmin=levels[0],
        vmax=levels[-1],
        linewidths=0,
    )
    figure.colorbar(shown, ax=axes, label="tappers that reach an object here", shrink=0.8)
    dead = points[cover.dead]
    if dead.size:
        axes.scatter(
            dead[:, 0],
            dead[:, 1],
            c="crimson",
            s=14,
            marker="x",
            label="no tap leads inward",
        )
    area = space.area
    axes.add_patch(Circle((1e3 * area.x, 1e3 * area.y), 1e3 * area.radius, fill=False, lw=1.5))
    for tapper in space.tappers:
        mount, stroke = tapper.mount, 1e3 * tapper.stroke
        x, y = 1e3 * mount.x, 1e3 * mount.y
        along = np.array([math.cos(mount.theta), math.sin(mount.theta)])
        end = np.array([x, y]) + stroke * along
        axes.plot([x, end[0]], [y, end[1]], color="0.25", lw=0.8, ls="--", zorder=3)
        axes.annotate(
            "",
            xy=(x + 28.0 * along[0], y + 28.0 * along[1]),
            xytext=(x, y),
            arrowprops={"arrowstyle": "-|>", "lw": 2.0, "color": "tab:orange"},
            zorder=4,
        )
        label = np.array([x, y]) - 16.0 * along
        axes.text(label[0], label[1], tapper.name, ha="center", va="center", fontsize=8)
    outline = 1e3 * np.array([*cell.outline(), cell.outline()[0]])
    axes.plot(
        outline[:, 0] + 1e3 * area.x,
        outline[:, 1] + 1e3 * area.y,
        color="white",
        lw=1.2,
        label="the object",
    )
    axes.set_aspect("equal")
    axes.margins(0.1)
    axes.set_xlabel("x in mm")
    axes.set_ylabel("y in mm")
    share = 100.0 * float(np.mean(cover.dead))
    axes.set_title(
        f"{cell.file.name}: {len(space.tappers)} tappers, working area of "
        f"{1e3 * area.radius:.0f} mm radius, {share:.1f} % dead zone"
    )
    figure.savefig(path, dpi=120)
    plt.close(figure)
