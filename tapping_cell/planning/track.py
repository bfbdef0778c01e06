"""Track of a slide: poses that the camera measured while the object moved, and what they tell."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.mechanics import Polygon, Sliding
from tapping_cell.mechanics.slide_track import Launch, Poses, decay_of, launch_of
from tapping_cell.planning.gains import Slid
from tapping_cell.planning.interface import Array
from tapping_cell.se2 import Pose, wrap_angle

ASIDE = 0.15
"""Largest deviation of a pose from the straight line of the slide, as a share of its length, beside
five standard deviations. The object was bumped if it deviates more."""

LEAST_POSES = 3


class Track(NamedTuple):
    """Poses (n, 3) measured at the times (n,), s, from any origin, m and rad in `table`.

    deviations: (n, 2), standard deviations of position and angle.
    """

    time: Array
    poses: Array
    deviations: Array


def poses_of(track: Track, before: ArrayLike, after: ArrayLike) -> Poses | None:
    """Return the poses relative to the start of the slide between the poses at rest ``before`` and
    ``after`` (3,). Return None if there are too few, or if the slide is not a straight line."""
    start, end = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
    line = end[:2] - start[:2]
    length = math.hypot(line[0], line[1])
    if len(track.time) < LEAST_POSES or not length > 0.0:
        return None
    way = track.poses[:, :2] - start[:2]
    aside = np.abs(way @ np.array([-line[1], line[0]])) / length
    if np.any(aside > ASIDE * length + 5.0 * track.deviations[:, 0]):
        return None
    return Poses(
        track.time,
        way @ line / length,
        wrap_angle(track.poses[:, 2] - start[2]),
        track.deviations[:, 0],
        track.deviations[:, 1],
    )


def launch_from(
    track: Track, before: ArrayLike, after: ArrayLike, sliding: Sliding
) -> Launch | None:
    """Return the launch of a slide; None if the track does not show it. Arguments as for
    ``poses_of``; ``sliding``: the model of the slide."""
    poses = poses_of(track, before, after)
    if poses is None:
        return None
    start, end = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
    body = sliding.body
    return launch_of(
        poses,
        math.hypot(*(end[:2] - start[:2])),
        float(wrap_angle(end[2] - start[2])),
        sliding.friction * sliding.gravity,
        decay_of(body.gamma, sliding.torque_factor),
    )


def slid_of(launch: Launch, before: ArrayLike, after: ArrayLike, sliding: Sliding) -> Slid | None:
    """Return what the model predicts for a launch (see ``launch_from``); None if its speed is
    unknown."""
    if not math.isfinite(launch.speed):
        return None
    start, end = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
    spin = float(np.nan_to_num(launch.spin))
    heading = math.atan2(end[1] - start[1], end[0] - start[0]) - start[2]
    rest = _quick(sliding).rest(float(launch.speed), spin, heading)
    slope = float(rest.rotation) / float(rest.distance) if math.isfinite(launch.spin) else math.nan
    return Slid(
        np.asarray(rest.distance, dtype=float),
        np.asarray(slope),
        2.0 * launch.speed_std,  # the distance grows with the square of the speed
        launch.spin_std,
    )


class Launched(NamedTuple):
    """Launch of a tapped object, measured and modelled.

    poses: number of poses of the track. speed, spin: m/s and rad/s. deceleration: mean over the
    slide, m/s^2. deviations: standard deviations of these three. model: the same three numbers for
    the displacement that was requested from the model. NaN if unknown.
    """

    poses: int
    speed: float
    spin: float
    deceleration: float
    deviations: tuple[float, float, float]
    model: tuple[float, float, float]


def launched_of(
    launch: Launch, poses: int, commanded: Pose, orientation: float, sliding: Sliding
) -> Launched:
    """Compare a launch in a track of ``poses`` poses with that of the displacement ``commanded``, m
    and rad in `table`, of an object with this orientation (rad)."""
    model, heading = _quick(sliding), math.atan2(commanded.y, commanded.x) - orientation
    distance = math.hypot(commanded.x, commanded.y)
    speed, spin = model.launch(distance, commanded.theta, heading)
    duration = model.rest(speed, spin, heading).duration
    slowing = float(launch.speed / launch.duration)
    return Launched(
        poses,
        float(launch.speed),
        float(launch.spin),
        slowing,
        (
            float(launch.speed_std * launch.speed),
            float(math.hypot(launch.spin_std, launch.speed_std) * abs(launch.spin)),
            float(2.0 * launch.speed_std) * slowing,
        ),
        (float(speed), float(spin), float(speed / duration)),
    )


def _quick(sliding: Sliding) -> Sliding:
    return sliding.approximated() if isinstance(sliding.body, Polygon) else sliding
