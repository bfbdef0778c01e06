"""Analysis of a track of poses without a model: start, end and line of the slide, and
disturbances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tapping_cell.calibration.trials import Track, Trial
from tapping_cell.se2 import Array

# A sample may be at rest if its distance from the start or the end of the slide is less than this
# fraction of the displacement.
_EDGE = 0.02
_NOISE = 8.0  # standard deviations
_MIN_MOTION = 0.0002  # m: minimum displacement
_GAP = 1.6  # maximum time between two samples, in camera periods


class Rejection(NamedTuple):
    """Reason why a trial or its track cannot be used, as a keyword and a sentence."""

    reason: str
    sentence: str


@dataclass(frozen=True, slots=True, eq=False)
class Slide:
    """A track as a slide along a line: arrays (n,) relative to the start, and initial estimates.

    ``time`` is in s, ``along`` in m and ``rotation`` in rad. ``distance_std`` and ``rotation_std``
    (n,) are the standard deviations of each sample. ``impact`` (s) and ``deceleration`` (m/s^2) are
    estimated from the track alone. ``moving`` is the number of samples in the slide. ``heading`` is
    the direction of travel in the object frame halfway through the rotation. ``exposure`` (s) is
    the exposure time of one sample.
    """

    time: Array
    along: Array
    rotation: Array
    distance_std: Array
    rotation_std: Array
    displacement: float
    turned: float
    direction: float
    impact: float
    deceleration: float
    moving: int
    heading: float
    exposure: float = 0.0


def slide_of(
    trial: Trial, position_std: float, rotation_std: float, rate: float, exposure: float = 0.0
) -> Slide | Rejection:
    """Extract the slide from a trial's track, or return the reason why the track is unusable.

    ``position_std`` (m) and ``rotation_std`` (rad) apply to samples without their own standard
    deviations. ``rate`` (Hz) and ``exposure`` (s) are those of the camera.
    """
    track = trial.track
    if track is None or track.time.size < 4:
        return Rejection("short track", "the track has fewer than four samples")
    noise = np.where(np.isfinite(track.position_std), track.position_std, position_std)
    turn_noise = np.where(np.isfinite(track.rotation_std), track.rotation_std, rotation_std)
    floor = _NOISE * float(np.median(noise))
    places = np.stack([track.x, track.y], axis=1)
    start, end = _rest(places[:2], floor), _rest(places[-2:], floor)
    if start is None or end is None:
        return Rejection(
            "not at rest",
            "the object moves at the start or at the end of the track; record from before the tap "
            "until the object is at rest",
        )
    moved = end - start
    distance = float(np.hypot(*moved))
    too_short = Rejection("missed", f"the object moved by only {1e3 * distance:.3g} mm")
    if distance < max(_MIN_MOTION, floor):
        return too_short
    direction = moved / distance
    along = (places - start) @ direction
    across = (places - start) @ np.array([-direction[1], direction[0]])
    edge = max(_EDGE * distance, floor)
    begun = np.flatnonzero(along > edge)
    waiting = np.flatnonzero(along < distance - edge)
    if not begun.size or not waiting.size:
        return too_short
    first, last = int(begun[0]), int(waiting[-1])
    problem = _disturbed(track, along, across, (first, last), edge, rate)
    if problem is not None:
        return problem
    # The mean of the samples at rest is more accurate than one sample.
    before, after = slice(0, max(first - 1, 1)), slice(min(last + 2, along.size - 1), None)
    origin = float(np.mean(along[before]))
    angle = float(np.mean(track.theta[before]))
    along, rotation = along - origin, track.theta - angle
    displacement, turned = float(np.mean(along[after])), float(np.mean(rotation[after]))
    inside = slice(first, last + 1)
    impact, deceleration = _guess(track.time[inside], along[inside], displacement)
    period = 1.0 / rate
    impact = min(max(impact, float(track.time[first]) - 1.5 * period), float(track.time[first]))
    return Slide(
        time=track.time,
        along=along,
        rotation=rotation,
        distance_std=noise,
        rotation_std=turn_noise,
        displacement=displacement,
        turned=turned,
        direction=math.atan2(direction[1], direction[0]),
        impact=impact,
        deceleration=deceleration,
        moving=max(last - first + 1, 0),
        heading=math.atan2(direction[1], direction[0]) - angle - turned / 2,
        exposure=exposure,
    )


def _rest(places: Array, floor: float) -> Array | None:
    if float(np.max(np.ptp(places, axis=0))) > floor:
        return None
    return np.asarray(places.mean(axis=0))


def _disturbed(
    track: Track,
    along: Array,
    across: Array,
    motion: tuple[int, int],
    edge: float,
    rate: float,
) -> Rejection | None:
    """Detect gaps in the track and motions that a single tap does not cause."""
    first, last = motion
    steps = np.diff(track.time)
    during = slice(max(first - 1, 0), min(last + 1, steps.size))
    longest = float(np.max(steps[during], initial=0.0))
    if longest * rate > _GAP:
        return Rejection(
            "gap",
            f"the track has no sample for {1e3 * longest:.0f} ms ({longest * rate:.1f} periods "
            "of the camera) while the object slides",
        )
    side = float(np.max(np.abs(across)))
    reach = float(along[-1])
    if side > max(2 * edge, 0.1 * reach):
        return Rejection(
            "disturbed",
            f"the object deviates by {1e3 * side:.3g} mm from the straight line between its start "
            "and its end; was it pushed?",
        )
    velocity = np.diff(along[max(first, 0) : last + 2]) / steps[max(first, 0) : last + 1]
    if velocity.size >= 2:
        # Friction never increases the speed; the limit allows for the noise of both samples.
        slack = 2 * edge * rate / _NOISE + 0.1 * velocity[:-1].max()
        faster = np.diff(velocity) > slack
        if faster.any():
            when = float(track.time[first + 1 + int(np.flatnonzero(faster)[0])] - track.time[0])
            return Rejection(
                "disturbed",
                f"the object accelerates again {when:.3f} s after the track's first sample; "
                "was it pushed or hit twice?",
            )
    return None


def _guess(time: Array, along: Array, displacement: float) -> tuple[float, float]:
    """Estimate the time of the impact and the deceleration.

    At constant deceleration, the square root of the remaining distance decreases linearly with
    time.
    """
    left = np.sqrt(np.maximum(displacement - along, 0.0))
    if time.size < 2 or not left[0] > left[-1]:
        deceleration = 1.5
        stop = float(time[0]) + math.sqrt(2.0 / deceleration) * float(left[0])
    else:
        slope, intercept = np.polyfit(time - time[0], left, 1)
        slope = min(float(slope), -1e-3)
        deceleration = 2 * slope**2
        stop = float(time[0]) - float(intercept) / slope
    return stop - math.sqrt(2 * displacement / deceleration), deceleration
