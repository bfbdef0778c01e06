"""Conversion of moves to timed points, for a controller that interpolates between these points.

A controller that receives positions and velocities interpolates between points with cubics. The
points of a move are the corners of its trapezoidal velocity profile. Between two corners the
acceleration is constant and the position a parabola, which a cubic with the same end conditions
reproduces exactly. A few points are therefore enough for the controller to execute the intended
move.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tapping_cell.hardware.dialect import StraightMove

Array = NDArray[np.float64]

MIN_TIME = 0.02
"""Minimum duration of a move, s; controllers reject two points with the same time."""

MIN_PIECE = 1e-3
"""Minimum duration of a segment of a move, s; shorter segments are merged with their neighbours."""
STRAIGHT = 1 - 1e-6
"""Two moves count as moves in the same direction, without a stop between them, if the cosine of the
angle between them is above this value."""

COURSE_SAMPLES = 200
"""Number of samples of a trajectory in the search for the point nearest to the arm."""
COURSE_WIDTH = 0.05
"""The arm is assumed to follow a trajectory if its distance from the trajectory is at most this
value, rad or m."""


@dataclass(frozen=True, slots=True)
class TrajectoryPoint:
    """Joint positions and velocities at a time in s from the start; rad and m."""

    time: float
    positions: tuple[float, ...]
    velocities: tuple[float, ...]


def straight_points(
    start: Sequence[float], moves: Sequence[StraightMove], max_acceleration: Sequence[float]
) -> tuple[TrajectoryPoint, ...]:
    """Return the points of straight moves that begin and end at rest; the start is not included.

    The arm does not stop between two moves in the same direction. It passes the point between them
    at the lower of the speeds of the two moves, or more slowly if a move is too short to reach this
    speed or to brake from it. ``moves``: targets in rad and m; the feed along the line is in the
    same unit per minute.
    ``max_acceleration``: limit of each joint, in rad/s^2 or m/s^2. Moves of zero length are left
    out.
    """
    legs = _legs(start, moves, max_acceleration)
    points: list[TrajectoryPoint] = []
    began = 0.0
    for leg, (entry, exit_) in zip(legs, _passing_speeds(legs), strict=True):
        for time, way, speed in _trapezoid(leg, entry, exit_):
            points.append(
                TrajectoryPoint(
                    began + time,
                    tuple(a + way * d for a, d in zip(leg.start, leg.direction, strict=True)),
                    tuple(speed * d for d in leg.direction),
                )
            )
        began = points[-1].time
    return tuple(points)


@dataclass(frozen=True, slots=True)
class _Leg:
    """One straight move along a unit direction, with its speed and acceleration limits."""

    start: tuple[float, ...]
    direction: tuple[float, ...]
    length: float
    speed: float
    acceleration: float


def _legs(
    start: Sequence[float], moves: Sequence[StraightMove], max_acceleration: Sequence[float]
) -> list[_Leg]:
    legs, here = [], tuple(start)
    for move in moves:
        ways = [b - a for a, b in zip(here, move.target, strict=True)]
        length = math.hypot(*ways)
        if length == 0:
            continue
        direction = tuple(way / length for way in ways)
        pull = min(a / abs(d) for d, a in zip(direction, max_acceleration, strict=True) if d)
        legs.append(_Leg(here, direction, length, move.feed / 60, pull))
        here = move.target
    return legs


def _passing_speeds(legs: Sequence[_Leg]) -> list[tuple[float, float]]:
    """Return the speeds at the beginning and the end of each leg."""
    corners = [0.0] * (len(legs) + 1)
    for index, (before, after) in enumerate(pairwise(legs), start=1):
        along = sum(a * b for a, b in zip(before.direction, after.direction, strict=True))
        # A very short move begins and ends at rest and takes the minimum duration, `MIN_TIME`.
        short = min(leg.length / leg.speed for leg in (before, after)) < MIN_TIME
        if along > STRAIGHT and not short:
            corners[index] = min(before.speed, after.speed)
    # Forward pass: limit each corner to a speed that can be reached; backward pass: to a speed from
    # which the arm can brake.
    for index, leg in enumerate(legs, start=1):
        reached = math.sqrt(corners[index - 1] ** 2 + 2 * leg.acceleration * leg.length)
        corners[index] = min(corners[index], reached)
    for index, leg in reversed(list(enumerate(legs))):
        stopped = math.sqrt(corners[index + 1] ** 2 + 2 * leg.acceleration * leg.length)
        corners[index] = min(corners[index], stopped)
    return list(pairwise(corners))


class Course:
    """A trajectory that was sent. It is used to estimate the arm's position between joint state
    messages."""

    def __init__(self, start: Sequence[float], points: Sequence[TrajectoryPoint]) -> None:
        still = (0.0,) * len(start)
        points = (TrajectoryPoint(0.0, tuple(start), still), *points)
        self._times = np.array([point.time for point in points])
        self._places = np.array([point.positions for point in points])
        self._speeds = np.array([point.velocities for point in points])
        self._samples: Array = np.linspace(0.0, points[-1].time, COURSE_SAMPLES, dtype=np.float64)
        self._track, _ = self.at(self._samples)

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions and velocities, with one row for each of ``times`` (s from the
        start)."""
        times = np.clip(times, 0.0, self._times[-1])
        after = np.clip(np.searchsorted(self._times, times, side="right"), 1, len(self._times) - 1)
        before = after - 1
        t = (times - self._times[before])[:, None]
        span = (self._times[after] - self._times[before])[:, None]
        v, w = self._speeds[before], self._speeds[after]
        # The acceleration is constant between two points.
        return self._places[before] + v * t + (w - v) * t**2 / (2 * span), v + (w - v) * t / span

    def after(
        self, positions: Sequence[float], duration: float
    ) -> tuple[tuple[float, ...], tuple[float, ...]] | None:
        """Return positions and velocities ``duration`` s after the point nearest to ``positions``;
        None if this point is farther than ``COURSE_WIDTH`` away."""
        distances = np.linalg.norm(self._track - np.asarray(positions), axis=1)
        nearest = int(np.argmin(distances))
        if not distances[nearest] <= COURSE_WIDTH:
            return None
        place, speeds = self.at(np.array([self._samples[nearest] + duration], dtype=np.float64))
        return tuple(place[0].tolist()), tuple(speeds[0].tolist())


def brake_point(
    positions: Sequence[float], velocities: Sequence[float], max_acceleration: Sequence[float]
) -> TrajectoryPoint:
    """Return the point at which an arm that brakes now comes to rest. All joints stop at the same
    time, after the longest braking time of any joint."""
    slowest = max(abs(v) / a for v, a in zip(velocities, max_acceleration, strict=True))
    duration = max(slowest, MIN_TIME)
    return TrajectoryPoint(
        duration,
        tuple(p + v * duration / 2 for p, v in zip(positions, velocities, strict=True)),
        (0.0,) * len(positions),
    )


def _trapezoid(leg: _Leg, entry: float, exit_: float) -> list[tuple[float, float, float]]:
    """Return the corners after the start: time in s, distance in rad or m, speed along it."""
    pull = leg.acceleration
    # If the leg is too short to reach its speed, the two ramps meet at this lower speed.
    peak = min(leg.speed, math.sqrt((2 * pull * leg.length + entry**2 + exit_**2) / 2))
    first, last = (peak - entry) / pull, (peak - exit_) / pull
    ramps = (peak + entry) / 2 * first + (peak + exit_) / 2 * last
    even = max((leg.length - ramps) / peak, 0.0)
    total = first + even + last
    if total < MIN_TIME and entry == exit_ == 0.0:
        return [(MIN_TIME, leg.length, 0.0)]
    corners = [
        (first, (peak + entry) / 2 * first, peak),
        (first + even, leg.length - (peak + exit_) / 2 * last, peak),
    ]
    kept, before = [], 0.0
    for corner in corners:
        if min(corner[0] - before, total - corner[0]) > MIN_PIECE:
            kept.append(corner)
            before = corner[0]
    return [*kept, (total, leg.length, exit_)]
