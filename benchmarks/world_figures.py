"""Draw the effect of each supplied world on taps: ``python -m benchmarks.world_figures``.

The figure shows the same twelve taps around the disk in a world without errors (grey) and in the
world of a file of ``config/truth`` (blue), with the path of the object's origin and its final
x axis.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.schema import load
from tapping_cell.se2 import Pose
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World

FILE = Path("docs/images/simulated_worlds.png")
_START = (0.0, 0.0, 0.0)
_HEADINGS = np.arange(12) * math.tau / 12
_INCIDENCE = math.radians(25)
_SPEED = 0.85
_TICK = 8.0
_PICTURES_S = 1 / 60


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the figure and return exit code 0."""
    parser = argparse.ArgumentParser(
        allow_abbrev=False,
        prog="python -m benchmarks.world_figures",
        description=__doc__.splitlines()[0],
    )
    parser.add_argument("--output", type=Path, default=FILE, help=f"default: {FILE}")
    output = parser.parse_args(arguments).output
    files = sorted((shared_folder() / "truth").glob("*.yaml"))
    columns = 4
    rows = math.ceil(len(files) / columns)
    figure = Figure(figsize=(3.0 * columns, 2.9 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, sharex=True, sharey=True).ravel()
    for axis, path in zip(axes, files, strict=False):
        _draw(axis, path.stem, load(TruthFile, path))
    for axis in axes[len(files) :]:
        axis.axis("off")
    figure.supxlabel("x in mm")
    figure.supylabel("y in mm")
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=90)
    print(output)
    return 0


def _draw(axis: Axes, name: str, truth: TruthFile) -> None:
    axis.set_aspect("equal")
    ways, turns = [], []
    for world, colour, width in ((TruthFile(_START), "0.65", 2.5), (truth, "tab:blue", 1.2)):
        paths = [1e3 * _path(replace(world, object_start=_START), float(a)) for a in _HEADINGS]
        ways.append(sum(math.hypot(path[-1, 0], path[-1, 1]) for path in paths))
        turns.append(sum(path[-1, 2] for path in paths))
        for path in paths:
            axis.plot(path[:, 0], path[:, 1], color=colour, linewidth=width)
            x, y, angle = path[-1, 0], path[-1, 1], path[-1, 2] / 1e3
            tick = [x + _TICK * math.cos(angle)], [y + _TICK * math.sin(angle)]
            axis.plot([x, *tick[0]], [y, *tick[1]], color=colour, linewidth=width)
    axis.set_title(
        f"{name.replace('_', ' ')}\nmean distance x {ways[1] / ways[0]:.2f}, "
        f"turn x {turns[1] / turns[0]:.2f}",
        fontsize=9,
    )


def _path(truth: TruthFile, heading: float) -> np.ndarray:
    """Return the poses of the object during one tap, shape (n, 3)."""
    cell = load_cell()
    tapper = cell.file.tapper
    body = cell.object.body()
    world = World(cell.object, tapper.striker(), 0.05, truth, 1)
    world.advance(0.0)
    away = body.bounding_radius + tapper.tip_radius
    contact = Pose(-away * math.cos(heading), -away * math.sin(heading), heading + _INCIDENCE)
    now = 0.0
    world.strike(contact @ Pose(-0.01, 0.0, 0.0), cell.object.height / 2, _SPEED, now)
    poses = [world.pose]
    while not world.at_rest:
        now += _PICTURES_S
        world.advance(now)
        poses.append(world.pose)
    return np.array([[pose.x, pose.y, pose.theta] for pose in poses])


if __name__ == "__main__":
    sys.exit(main())
