"""Figures of the mechanics: the reachable cone and the velocities of a slide, in mm and degrees."""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tapping_cell.mechanics import Sliding, Tap
from tapping_cell.mechanics.sensitivity import norm, sensitivity
from tapping_cell.report.palette import REST, STRIKE

CONE = "mechanics_cone.png"
VELOCITIES = "mechanics_velocities.png"

_FARTHEST = 0.030
_GRID = 61


def write_figures(
    tap: Tap, folder: Path, names: Collection[str] = (CONE, VELOCITIES)
) -> list[Path]:
    """Draw the figures with these names into ``folder``: the cone of ``tap``, and velocities while
    its object slides. Return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, draw in ((CONE, _cone), (VELOCITIES, _velocities)):
        if name not in names:
            continue
        figure = Figure(figsize=(9.0, 4.2), layout="constrained")
        draw(figure, tap)
        figure.savefig(folder / name, dpi=110)
        files.append(folder / name)
    return files


def _cone(figure: Figure, tap: Tap) -> None:
    """Draw the reachable cone of one tap (left) and the norm of its Jacobian (right)."""
    reach, gain = figure.subplots(1, 2)
    slope = tap.cone_slope
    distance = np.array([0.0, _FARTHEST])
    for sign in (1, -1):
        reach.fill_between(
            sign * distance * 1e3,
            -np.degrees(slope * distance),
            np.degrees(slope * distance),
            color=REST,
            alpha=0.15 if sign > 0 else 0.07,
            label="one tap forward" if sign > 0 else "one tap backward",
        )
    least = tap.smallest_distance * 1e3
    reach.axvspan(-least, least, color="grey", alpha=0.25, label=f"below {least:g} mm")
    reach.plot(10, 3, "o", color=REST, label="10 mm, 3 degrees: one tap")
    reach.plot(10, 10, "X", color=STRIKE, label="10 mm, 10 degrees: the paper's task")
    reach.set(
        xlabel="distance (mm)",
        ylabel="rotation (degrees)",
        title=f"Reachable cone, {math.degrees(slope) / 1e3:.3f} degrees/mm",
    )
    reach.set_ylim(-12, 12)
    reach.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)

    far = np.linspace(tap.smallest_distance, 2 * _FARTHEST, _GRID)
    share = np.linspace(0.0, 0.99, _GRID)
    x, s = np.meshgrid(far, share)
    taps = np.stack([x, np.zeros_like(x), s * slope * x], axis=-1)
    norms = norm(sensitivity(tap, taps).physical)
    filled = gain.contourf(1e3 * x, 100 * s, norms, levels=np.arange(0, 2.01, 0.2), cmap="viridis")
    lines = gain.contour(1e3 * x, 100 * s, norms, levels=[1.0], colors="white")
    gain.clabel(lines, fmt="1", fontsize=9)
    gain.set(
        xlabel="distance (mm)",
        ylabel="share of the cone's rotation (%)",
        title="Norm of the Jacobian (white: 1)",
    )
    figure.colorbar(filled, ax=gain)


def _velocities(figure: Figure, tap: Tap) -> None:
    """Draw the velocities in the paper's tap over time (left). Draw the ratio of the velocities
    over time for different initial values (right)."""
    left, right = figure.subplots(1, 2)
    sliding = tap.sliding
    speed, spin = (float(value) for value in sliding.launch(0.010, math.radians(3.0)))
    plain = Sliding(sliding.body, sliding.friction, 1.0, sliding.gravity)
    turning = left.twinx()
    for model, style in ((sliding, "-"), (plain, "--")):
        times = _times(model, speed, spin)
        profile = model.profile(speed, spin, times)
        name = f"torque factor {model.torque_factor:g}"
        left.plot(1e3 * times, 1e3 * profile.speed, style, color=REST, label=f"v, {name}")
        left.plot([], [], style, color=STRIKE, label=f"omega, {name}")
        turning.plot(1e3 * times, np.degrees(profile.spin), style, color=STRIKE)
    left.set(xlabel="time (ms)", ylabel="v (mm/s)", title="Velocities of a tap of 10 mm, 3 degrees")
    turning.set_ylabel("omega (degrees/s)")
    turning.set_ylim(bottom=0)
    left.set_ylim(bottom=0)
    left.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    _ratios(right, sliding)


def _ratios(axes: Axes, sliding: Sliding) -> None:
    radius = sliding.body.support_radius
    for index, kappa in enumerate((0.5, 1.0, 1.5, sliding.torque_factor)):
        model = Sliding(sliding.body, sliding.friction, kappa, sliding.gravity)
        for start in (0.2, 1.0, 5.0):
            spin = 0.2 / (start * radius)
            times = _times(model, 0.2, spin)
            profile = model.profile(0.2, spin, times)
            axes.plot(
                100 * times / times[-1],
                profile.speed / (radius * profile.spin),
                color=f"C{index}",
                label=f"torque factor {kappa:g}" if start == 1.0 else None,
            )
    axes.set(
        xlabel="share of the slide's duration (%)",
        ylabel="v / (R omega)",
        yscale="log",
        title="The final ratio does not depend\non the initial velocities",
    )
    axes.set_ylim(0.02, 50)
    axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)


def _times(sliding: Sliding, speed: float, spin: float) -> NDArray[np.float64]:
    duration = float(sliding.rest(speed, spin).duration)
    # The times are denser near the end, but exclude the end itself, where the ratio is 0 / 0.
    return np.asarray(duration * (1 - np.linspace(1.0, 0.02, 300) ** 2))
