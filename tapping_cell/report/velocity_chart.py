"""Chart of the speed during one slide, measured and modelled, as in Figure 4 of Huang and Mason."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.report.palette import INK, PREDICTED, REST
from tapping_cell.report.run import Poses, TapRow
from tapping_cell.report.svg import round_length
from tapping_cell.se2 import Array

LEFT, RIGHT, TOP, BOTTOM = 46.0, 394.0, 14.0, 166.0
BEFORE_S = 0.2
"""Time before the reported release from which poses are used, s: the report arrives late."""
SLOWEST = 0.1
"""Share of the launch speed above which a measured speed counts for the time of the launch."""


def velocity_chart(tap: TapRow, recorded: Poses) -> dict[str, object] | None:
    """Return the chart of a tap for the template ``parts.html``; None if the slide was not seen.

    ``recorded``: poses of the object at times since the start of the run, s.
    """
    launch = tap.launch
    if not launch.is_known or not math.isfinite(tap.fired_at + tap.at_rest_at):
        return None
    duration = launch.speed / launch.deceleration
    model = launch.model_speed / launch.model_deceleration
    seen = _speeds(recorded, tap.fired_at - BEFORE_S, tap.at_rest_at)
    moving = seen[seen[:, 1] > SLOWEST * launch.speed]
    if not len(moving):
        return None
    # A uniformly slowed object has the measured speed at the mean time of two images.
    launched = np.median(moving[:, 0] - (launch.speed - moving[:, 1]) / launch.deceleration)
    seen[:, 0] -= launched
    seen = seen[(seen[:, 0] > -0.25 * duration) & (seen[:, 0] < 1.25 * max(duration, model))]
    last = 1.05 * max(duration, model, *seen[:, 0])
    first = min(0.0, *seen[:, 0])
    most = 1.08 * max(launch.speed, launch.model_speed, *seen[:, 1])

    def place(time: float, speed: float) -> tuple[float, float]:
        across = LEFT + (RIGHT - LEFT) * (time - first) / (last - first)
        return across, TOP + (BOTTOM - TOP) * (1.0 - speed / most)

    speeds, times = round_length(1e3 * most / 3.0), round_length(1e3 * last / 5.0)
    return {
        "label": "speed during the slide (mm/s)",
        "axis": "time since the launch (ms)",
        "tolerances": [],
        "ticks": [
            (place(0.0, 1e-3 * speeds * n)[1], speeds * n)
            for n in range(int(1e3 * most / speeds) + 1)
        ],
        "counts": [
            (place(1e-3 * times * n, 0.0)[0], f"{times * n:g}")
            for n in range(int(1e3 * last / times) + 1)
        ],
        "lines": [
            ("model", PREDICTED, [place(0.0, launch.model_speed), place(model, 0.0)]),
            ("launch and deceleration", REST, [place(0.0, launch.speed), place(duration, 0.0)]),
        ],
        "dots": [(INK, [place(time, speed) for time, speed in seen])],
        "labels": [],
    }


def _speeds(recorded: Poses, start: float, end: float) -> Array:
    """Return the mean time and the speed (n, 2), s and m/s, between successive poses."""
    rows = np.array([(at, pose.x, pose.y) for at, pose in recorded if start <= at <= end])
    rows = rows.reshape(-1, 3)
    rows = rows[np.diff(rows[:, 0], prepend=-np.inf) > 0.0]
    step = np.diff(rows, axis=0)
    return np.stack([rows[1:, 0] - step[:, 0] / 2.0, np.hypot(*step[:, 1:].T) / step[:, 0]], -1)
