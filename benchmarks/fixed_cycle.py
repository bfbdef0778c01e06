"""Time per goal and per tap of the positioning cell with fixed tappers, in the running graph.

Goals are at random places of the working disc, or at its centre, and rotated by up to 10, 30 and 90
degrees relative to the object's current pose. A goal lasts from its acceptance to its end. The time
before the first tap, in which the planner waits for an image and computes the first plan, is
included. A tap lasts from its command to the next command: the shot, the object's slide, the images
of the object at rest, and the decision.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from benchmarks.cycle import Stopwatch, in_graph
from tapping_cell.configuration.cell import load_cell
from tapping_cell.configuration.files import shared_folder
from tapping_cell.se2 import Pose, wrap_angle

DEFAULT_COUNT = 20
ANGLES_DEG = (10.0, 30.0, 90.0)
CELL = shared_folder() / "positioning_cell" / "cell.yaml"
SEED = 1


def measure(count: int = DEFAULT_COUNT) -> dict[str, Any]:
    """Return durations (s) and taps of ``count`` goals for each maximum angle, with goals anywhere
    in the disc and with goals at its centre."""
    return {
        "anywhere": {a: _summary(_run(count, math.radians(a))) for a in ANGLES_DEG},
        "centre": {a: _summary(_run(2 * count, math.radians(a), True), 2) for a in ANGLES_DEG},
        "load": os.getloadavg()[0],
    }


def _run(count: int, angle: float, to_centre: bool = False) -> Stopwatch:
    """Run goals anywhere in the working disc; with ``to_centre``, every second goal is at its
    centre."""
    x, y, radius = load_cell(CELL).fixed_tappers.working_area
    random = np.random.default_rng(SEED)

    def next_goal(here: Pose, number: int) -> Pose:
        distance = radius * math.sqrt(random.random())
        if to_centre and number % 2:
            distance = 0.0
        bearing = random.uniform(-math.pi, math.pi)
        return Pose(
            x + distance * math.cos(bearing),
            y + distance * math.sin(bearing),
            float(wrap_angle(here.theta + random.uniform(-angle, angle))),
        )

    return in_graph(count, next_goal, CELL)


def _summary(watch: Stopwatch, every: int = 1) -> dict[str, Any]:
    """Return the mean duration and the mean number of taps of the goals, and the mean times of the
    taps. If ``every`` is 2, the values for goals are means over every second goal only; the values
    for taps are always means over all taps."""
    goal = np.array([seconds for seconds, _ in watch.goals])
    taps = np.array([number for _, number in watch.goals])
    cycle = np.array([tap.done - tap.commanded for tap in watch.taps])
    besides_taps = float((goal.sum() - cycle.sum()) / len(goal))
    goal, taps = goal[every - 1 :: every], taps[every - 1 :: every]
    return {
        "goals": len(goal),
        "goal": float(goal.mean()),
        "longest": float(goal.max()),
        "taps": float(taps.mean()),
        "before_first_tap": besides_taps,
        "tap": float(cycle.mean()),
        "shot": float(np.nanmean([tap.reported - tap.commanded for tap in watch.taps])),
        "slide": float(np.nanmean([tap.at_rest - tap.reported for tap in watch.taps])),
        "images": float(np.nanmean([tap.observed - tap.at_rest for tap in watch.taps])),
        "decision": float(np.nanmean([tap.done - tap.observed for tap in watch.taps])),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = [
        f"{'goals':<9s}{'start angle':>11s}{'count':>7s}{'s a goal':>10s}{'longest':>9s}"
        f"{'taps':>7s}{'before 1st tap':>16s}{'s a tap':>9s}{'shot':>7s}{'slide':>7s}{'images':>8s}"
        f"{'decision':>10s}"
    ]
    rows += [
        f"{place:<9s}{angle:7.0f} deg{part['goals']:7d}{part['goal']:10.2f}{part['longest']:9.2f}"
        f"{part['taps']:7.2f}{part['before_first_tap']:16.2f}{part['tap']:9.2f}{part['shot']:7.2f}"
        f"{part['slide']:7.2f}{part['images']:8.2f}{part['decision']:10.3f}"
        for place in ("anywhere", "centre")
        for angle, part in report[place].items()
    ]
    return [*rows, f"load {report['load']:.1f} on {os.cpu_count()} cores"]
