"""Charts of the residual after each tap, of one run or of several."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.report.run import Run
from tapping_cell.report.svg import chart


def residual_charts(runs: Sequence[Run], colours: Sequence[str]) -> list[tuple[str, str]]:
    """Plot remaining distance and rotation of each run in its colour. Return labels and drawings;
    none without taps.

    The charts show the largest tolerance of the runs.
    """
    distances, rotations = [], []
    for run, colour in zip(runs, colours, strict=True):
        goal = run.goal
        if goal is None or run.start is None or not run.taps:
            # A run without taps has no curve. It is left out, because a large distance at its start
            # would only compress the scale.
            continue
        poses = [run.start, *(tap.measured for tap in run.taps)]
        distances.append((run.name, [1000 * pose.distance_to(goal) for pose in poses], colour))
        turns = [abs(math.degrees(pose.rotation_to(goal))) for pose in poses]
        rotations.append((run.name, turns, colour))
    if not distances:
        return []
    far, turned = (max(run.tolerance[axis] for run in runs) for axis in (0, 1))
    return [
        (label, chart(lines, limit, label))
        for label, lines, limit in (
            ("remaining distance (mm)", distances, 1000 * far),
            ("remaining rotation (deg)", rotations, math.degrees(turned)),
        )
    ]
