"""Charts of the residual after each tap, of one run or of several."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tapping_cell.report.run import Run
from tapping_cell.report.svg import round_length


def residual_charts(runs: Sequence[Run], colours: Sequence[str]) -> list[dict[str, object]]:
    """Return a chart of the remaining distance and a chart of the remaining rotation, for the
    template ``parts.html``. Each chart has one line per run, in the colour of the run. The list is
    empty if no run has taps.

    The charts show the largest tolerance of the runs.
    """
    distances, rotations = [], []
    for run, colour in zip(runs, colours, strict=True):
        goal = run.first.goal
        if goal is None or run.first.start is None or not run.taps:
            # A run without taps has no curve. It is left out, because a large distance at its start
            # would only compress the scale.
            continue
        poses = [run.first.start, *(tap.measured for tap in run.taps)]
        distances.append((run.name, [1000 * pose.distance_to(goal) for pose in poses], colour))
        turns = [abs(math.degrees(pose.rotation_to(goal))) for pose in poses]
        rotations.append((run.name, turns, colour))
    if not distances:
        return []
    far, turned = (max(run.first.tolerance[axis] for run in runs) for axis in (0, 1))
    return [
        _chart("remaining distance (mm)", distances, 1000 * far),
        _chart("remaining rotation (deg)", rotations, math.degrees(turned)),
    ]


def _chart(
    label: str, lines: Sequence[tuple[str, Sequence[float], str]], limit: float
) -> dict[str, object]:
    """Compute a chart of lines over the number of taps, 420 units wide and 200 high.

    ``lines``: name, values (the first value is the one before the first tap) and colour of each
    line.
    """
    left, right, top, bottom = 46.0, 394.0, 14.0, 166.0
    most = max([limit * 1.5, *(v for _, values, _ in lines for v in values if math.isfinite(v))])
    step = round_length(most / 3)
    ticks = [step * index for index in range(math.floor(most / step + 1e-9) + 1)]
    most = max(most * 1.08, ticks[-1])
    last = max(len(values) - 1 for _, values, _ in lines)

    def x(index: int) -> float:
        return left + (right - left) * index / last

    def y(value: float) -> float:
        return top + (bottom - top) * (1 - value / most)

    points = [[(i, v) for i, v in enumerate(values) if math.isfinite(v)] for _, values, _ in lines]
    # With a single line, its points are labelled: all of them, or only the first and the last if
    # there are many.
    labelled = [(i, v) for i, v in points[0] if last < 8 or i in (0, last)]
    drawn = [
        (name, colour, [(x(i), y(v)) for i, v in known])
        for (name, _, colour), known in zip(lines, points, strict=True)
    ]
    return {
        "label": label,
        "axis": "taps",
        "tolerance": (y(limit), y(0)),
        "ticks": [(y(tick), tick) for tick in ticks],
        "counts": [(x(index), index) for index in range(0, last + 1, max(1, math.ceil(last / 10)))],
        "lines": drawn,
        "dots": [(colour, known) for _, colour, known in drawn],
        "labels": [
            (x(i) + (4 if i else 6), y(v) - 9, "end" if i == last else "start", v)
            for i, v in (labelled if len(lines) == 1 else [])
        ],
    }
