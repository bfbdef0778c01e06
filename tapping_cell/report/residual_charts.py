"""Charts of the residual after each tap, of one run or of several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from tapping_cell.report.palette import GOAL, INK, LINE, MUTED
from tapping_cell.report.run import Run
from tapping_cell.report.svg import round_length, stroke


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
        (label, _chart(lines, limit, label))
        for label, lines, limit in (
            ("remaining distance (mm)", distances, 1000 * far),
            ("remaining rotation (deg)", rotations, math.degrees(turned)),
        )
    ]


def _chart(
    values: Sequence[tuple[str, Sequence[float], str]],
    limit: float,
    label: str,
) -> str:
    """Draw lines over the number of taps; return the SVG element.

    ``values``: for each line its name, its values (the first is that before the first tap) and its
    colour.
    """
    wide, high, left, bottom, top = 420.0, 200.0, 46.0, 34.0, 14.0
    most = max([limit * 1.5, *(v for _, line, _ in values for v in line if math.isfinite(v))])
    step = round_length(most / 3)
    ticks = [step * index for index in range(math.floor(most / step + 1e-9) + 1)]
    most = max(most * 1.08, ticks[-1])
    last = max([1, *(len(line) - 1 for _, line, _ in values)])

    def x(index: float) -> float:
        return left + (wide - left - 26) * index / last

    def y(value: float) -> float:
        return top + (high - top - bottom) * (1 - value / most)

    parts = [
        f'<rect x="{left}" y="{y(limit):.1f}" width="{wide - left}" '
        f'height="{y(0) - y(limit):.1f}" fill="{GOAL}" fill-opacity="0.15"/>'
    ]
    for tick in ticks:
        parts.append(
            f'<line x1="{left}" x2="{wide}" y1="{y(tick):.1f}" y2="{y(tick):.1f}" '
            f'stroke="{LINE}"/>'
            f'<text x="{left - 6}" y="{y(tick):.1f}" text-anchor="end" dominant-baseline="central" '
            f'fill="{MUTED}">{tick:g}</text>'
        )
    for index in range(0, last + 1, max(1, math.ceil(last / 10))):
        parts.append(
            f'<text x="{x(index):.1f}" y="{high - bottom + 14}" text-anchor="middle" '
            f'fill="{MUTED}">{index}</text>'
        )
    for name, line, colour in values:
        known = [(x(i), y(v)) for i, v in enumerate(line) if math.isfinite(v)]
        path = " ".join(f"{px:.1f},{py:.1f}" for px, py in known)
        parts.append(
            f'<polyline points="{path}" {stroke(colour, 2)}>'
            f"<title>{escape(name)}</title></polyline>"
        )
        parts += [
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="3.4" fill="{colour}"/>' for px, py in known
        ]
        if len(values) == 1:
            parts += [
                f'<text x="{x(i) + (4 if i else 6):.1f}" y="{y(v) - 9:.1f}" fill="{INK}" '
                f'text-anchor="{"end" if i == last else "start"}">{v:.2f}</text>'
                for i, v in enumerate(line)
                if math.isfinite(v) and (len(line) < 9 or i in (0, len(line) - 1))
            ]
    parts.append(
        f'<text x="{(left + wide) / 2:.0f}" y="{high - 5}" text-anchor="middle" fill="{MUTED}">'
        "taps</text>"
    )
    return (
        f'<svg viewBox="0 0 {wide:.0f} {high:.0f}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )
