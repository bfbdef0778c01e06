"""Charts of the residual after each tap, of one run or of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.report.run import Run
from tapping_cell.report.svg import round_length


def residual_charts(runs: Sequence[Run], colours: Sequence[str]) -> list[dict[str, object]]:
    """Return a chart of the remaining distance and a chart of the remaining rotation, for the
    template ``parts.html``. Each chart has one line per run, in the colour of the run. The list is
    empty if no run has taps.

    The area within the tolerance is filled. If the runs' tolerances differ, each run has a dashed
    line at its own instead.
    """
    distances, rotations = [], []
    for run, colour in zip(runs, colours, strict=True):
        goal = run.first.goal
        if goal is None or run.first.start is None or not run.taps:
            # A run without taps has no curve. It is left out, because a large distance at its start
            # would only compress the scale.
            continue
        poses = [run.first.start, *(tap.measured for tap in run.taps)]
        far, turn = run.first.tolerance
        moved = [1000 * pose.distance_to(goal) for pose in poses]
        distances.append(_Line(run.name, moved, colour, 1000 * far))
        turns = [abs(math.degrees(pose.rotation_to(goal))) for pose in poses]
        rotations.append(_Line(run.name, turns, colour, math.degrees(turn)))
    if not distances:
        return []
    return [
        _chart("remaining distance (mm)", distances),
        _chart("remaining rotation (deg)", rotations),
    ]


@dataclass(frozen=True, slots=True)
class _Line:
    """Values of one run, the first before the first tap, and the run's tolerance."""

    name: str
    values: Sequence[float]
    colour: str
    limit: float


def _chart(label: str, lines: Sequence[_Line]) -> dict[str, object]:
    """Compute a chart of lines over the number of taps, 420 units wide and 200 high."""
    left, right, top, bottom = 46.0, 394.0, 14.0, 166.0
    limits = {line.limit for line in lines}
    measured = [value for line in lines for value in line.values if math.isfinite(value)]
    most = max(1.5 * max(limits), *measured)
    step = round_length(most / 3)
    ticks = [step * index for index in range(math.floor(most / step + 1e-9) + 1)]
    most = max(most * 1.08, ticks[-1])
    last = max(len(line.values) - 1 for line in lines)

    def x(index: int) -> float:
        return left + (right - left) * index / last

    def y(value: float) -> float:
        return top + (bottom - top) * (1 - value / most)

    points = [[(i, v) for i, v in enumerate(line.values) if math.isfinite(v)] for line in lines]
    # With a single line, its points are labelled: all of them, or only the first and the last if
    # there are many.
    labelled = [(i, v) for i, v in points[0] if last < 8 or i in (0, last)]
    drawn = [
        (line.name, line.colour, [(x(i), y(v)) for i, v in known])
        for line, known in zip(lines, points, strict=True)
    ]
    return {
        "label": label,
        "axis": "taps",
        "zero": y(0),
        "tolerances": [(y(line.limit), line.colour) for line in lines]
        if len(limits) > 1
        else [(y(limit), "") for limit in limits],
        "ticks": [(y(tick), tick) for tick in ticks],
        "counts": [(x(index), index) for index in range(0, last + 1, max(1, math.ceil(last / 10)))],
        "lines": drawn,
        "dots": [(colour, known) for _, colour, known in drawn],
        "labels": [
            (x(i) + (4 if i else 6), y(v) - 9, "end" if i == last else "start", v)
            for i, v in (labelled if len(lines) == 1 else [])
        ],
    }
