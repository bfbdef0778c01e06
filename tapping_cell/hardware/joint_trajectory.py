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

import numpy as np
from numpy.typing import NDArray

from tapping_cell.hardware.dialect import StraightMove

Array = NDArray[np.float64]

LEAST_TIME = 0.02
"""Shortest time of a move, s: a controller takes no two points of one time."""

COURSE_SAMPLES = 200
"""Places of a trajectory of which the one nearest to the arm is looked for."""
COURSE_WIDTH = 0.05
"""An arm further from its trajectory than this is not on it, rad or m."""


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


class Course:
    """A trajectory that was sent, to know where an arm is on it while nobody hears of it."""

    def __init__(self, start: Sequence[float], points: Sequence[TrajectoryPoint]) -> None:
        still = (0.0,) * len(start)
        points = (TrajectoryPoint(0.0, tuple(start), still), *points)
        self._times = np.array([point.time for point in points])
        self._places = np.array([point.positions for point in points])
        self._speeds = np.array([point.velocities for point in points])
        self._samples: Array = np.linspace(0.0, points[-1].time, COURSE_SAMPLES, dtype=np.float64)
        self._track, _ = self.at(self._samples)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Positions and velocities at times from the start in s, a row each."""
        times = np.clip(times, 0.0, self._times[-1])
        after = np.clip(np.searchsorted(self._times, times, side="right"), 1, len(self._times) - 1)
        before = after - 1
        t = (times - self._times[before])[:, None]
        span = (self._times[after] - self._times[before])[:, None]
        v, w = self._speeds[before], self._speeds[after]
        # The speed changes evenly between two points.
        return self._places[before] + v * t + (w - v) * t**2 / (2 * span), v + (w - v) * t / span

    def after(
        self, positions: Sequence[float], duration: float
    ) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Positions and velocities ``duration`` s after the arm was near some; None beside it."""
        distances = np.linalg.norm(self._track - np.asarray(positions), axis=1)
        nearest = int(np.argmin(distances))
        if not distances[nearest] <= COURSE_WIDTH:
            return None
        place, speeds = self.at(np.array([self._samples[nearest] + duration], dtype=np.float64))
        return tuple(place[0].tolist()), tuple(speeds[0].tolist())


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
