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
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tapping_cell.hardware.dialect import StraightMove

Array = NDArray[np.float64]

LEAST_TIME = 0.02
"""Shortest time of a move, s: a controller takes no two points of one time."""

LEAST_PIECE = 1e-3
"""A part of a move that takes less is left to its neighbours, s."""
STRAIGHT = 1 - 1e-6
"""Cosine of the angle between two moves that count as one line."""

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
    """The points after the start of straight moves that begin and end at rest.

    Between two moves that go on in one direction the arm does not stop: it passes at the lower of
    their speeds, or at what the ways before and behind allow. ``moves``: targets in rad and m, the
    feed along the line in their unit a minute. ``max_acceleration`` in rad/s^2 or m/s^2 of each
    joint. Moves of no length are left out.
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
    """One straight move: the way along a unit direction, and what bounds it."""

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
    """Speeds at the beginning and the end of each leg."""
    corners = [0.0] * (len(legs) + 1)
    for index, (before, after) in enumerate(pairwise(legs), start=1):
        along = sum(a * b for a, b in zip(before.direction, after.direction, strict=True))
        # Very short moves are given their least time, from rest to rest.
        short = min(leg.length / leg.speed for leg in (before, after)) < LEAST_TIME
        if along > STRAIGHT and not short:
            corners[index] = min(before.speed, after.speed)
    # What can be reached from rest behind, and from where one can come to rest before.
    for index, leg in enumerate(legs, start=1):
        reached = math.sqrt(corners[index - 1] ** 2 + 2 * leg.acceleration * leg.length)
        corners[index] = min(corners[index], reached)
    for index, leg in reversed(list(enumerate(legs))):
        stopped = math.sqrt(corners[index + 1] ** 2 + 2 * leg.acceleration * leg.length)
        corners[index] = min(corners[index], stopped)
    return list(pairwise(corners))


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


def _trapezoid(leg: _Leg, entry: float, exit_: float) -> list[tuple[float, float, float]]:
    """Corners after the start: time in s, way in rad or m, speed along it."""
    pull = leg.acceleration
    # Where there is no room for the leg's speed, the two ramps meet at this one.
    peak = min(leg.speed, math.sqrt((2 * pull * leg.length + entry**2 + exit_**2) / 2))
    first, last = (peak - entry) / pull, (peak - exit_) / pull
    ramps = (peak + entry) / 2 * first + (peak + exit_) / 2 * last
    even = max((leg.length - ramps) / peak, 0.0)
    total = first + even + last
    if total < LEAST_TIME and entry == exit_ == 0.0:
        return [(LEAST_TIME, leg.length, 0.0)]
    corners = [
        (first, (peak + entry) / 2 * first, peak),
        (first + even, leg.length - (peak + exit_) / 2 * last, peak),
    ]
    kept, before = [], 0.0
    for corner in corners:
        if min(corner[0] - before, total - corner[0]) > LEAST_PIECE:
            kept.append(corner)
            before = corner[0]
    return [*kept, (total, leg.length, exit_)]
