"""Moves as timed points for a controller that interpolates in time.

A controller that gets positions and velocities joins its points by cubics. The points of a move
stand where its trapezoid of speed has its corners: between two of them the speed changes evenly,
the position is a parabola, and a cubic with the same ends is that parabola. So the controller makes
the move that is meant, with three numbers a joint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.hardware.dialect import StraightMove

LEAST_TIME = 0.02
"""Shortest time of a move, s: a controller takes no two points of one time."""


@dataclass(frozen=True, slots=True)
class TrajectoryPoint:
    """Where the joints are at a time from the start in s, and how fast; rad and m."""

    time: float
    positions: tuple[float, ...]
    velocities: tuple[float, ...]


def straight_points(
    start: Sequence[float], moves: Sequence[StraightMove], max_acceleration: Sequence[float]
) -> tuple[TrajectoryPoint, ...]:
    """The points after the start of moves that each begin and end at rest.

    ``moves``: targets in rad and m, the feed along the line in their unit a minute.
    ``max_acceleration`` in rad/s^2 or m/s^2 of each joint. Moves of no length are left out.
    """
    points: list[TrajectoryPoint] = []
    here, began = tuple(start), 0.0
    for move in moves:
        ways = [b - a for a, b in zip(here, move.target, strict=True)]
        length = math.hypot(*ways)
        if length == 0:
            continue
        for time, part, rate in _trapezoid(length, move.feed / 60, ways, max_acceleration):
            points.append(
                TrajectoryPoint(
                    began + time,
                    tuple(a + part * way for a, way in zip(here, ways, strict=True)),
                    tuple(rate * way for way in ways),
                )
            )
        here, began = move.target, points[-1].time
    return tuple(points)


def brake_point(
    positions: Sequence[float], velocities: Sequence[float], max_acceleration: Sequence[float]
) -> TrajectoryPoint:
    """Where joints that move come to rest, all at once, the fastest at its full deceleration."""
    slowest = max(abs(v) / a for v, a in zip(velocities, max_acceleration, strict=True))
    duration = max(slowest, LEAST_TIME)
    return TrajectoryPoint(
        duration,
        tuple(p + v * duration / 2 for p, v in zip(positions, velocities, strict=True)),
        (0.0,) * len(positions),
    )


def _trapezoid(
    length: float, speed: float, ways: Sequence[float], max_acceleration: Sequence[float]
) -> list[tuple[float, float, float]]:
    """Corners after the start: time in s, part of the way in [0, 1], its rate of change in 1/s."""
    pull = min(a / abs(way) for way, a in zip(ways, max_acceleration, strict=True) if way)
    cruise = speed / length
    ramp = min(cruise / pull, math.sqrt(1 / pull))
    peak = pull * ramp
    even = max((1 - peak * ramp) / peak, 0.0)
    total = 2 * ramp + even
    if total < LEAST_TIME:
        return [(LEAST_TIME, 1.0, 0.0)]
    corners = [(ramp, peak * ramp / 2, peak)]
    if even > 1e-3:
        corners.append((ramp + even, 1 - peak * ramp / 2, peak))
    return [*corners, (total, 1.0, 0.0)]
