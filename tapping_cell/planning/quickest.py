"""Choice of the tap that reaches the goal in the least expected time, including arm motions.

Many taps are almost as good as the method's own tap. For example, if two taps are needed, the first
may go almost anywhere. Among these taps the one with the least expected time is chosen ::

    t(tap) + P (t(next) - t_way) + E[following taps] t_mean.

t(tap) is the time of the arm's motion to this strike. t(next) is the time from there to the next
strike, which is directed towards the goal and has the probability P = min(1, E[following taps]).
t_way is the mean time of the arm's motion and t_mean the mean time of a tap.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tapping_cell.planning.gains import Gains
from tapping_cell.planning.interface import Array, Taps, TapValues
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.strike import StrikeSpace
from tapping_cell.planning.tap_times import TapTimes
from tapping_cell.se2 import wrap_angle

DIRECTIONS: Array = np.arange(24, dtype=np.float64) * (2.0 * math.pi / 24)
SIZE_RATIO = 1.35
SHARES = np.array([-1.0, -0.5, 0.5, 1.0])
"""Rotations that are tried, as shares of the largest rotation of each size."""


class NearTaps(NamedTuple):
    """Taps in all directions: commanded displacements (n, 3) and expected following taps (n,)."""

    commanded: Array
    follow: Array


def near_taps(
    pose: Array,
    left: Array,
    own: Taps,
    gains: Gains,
    method: TapValues,
    settings: PlannerSettings,
) -> NearTaps | None:
    """Taps of all directions and sizes, each with its best rotation; None while the method has no
    values.

    Args:
        pose: pose of the object, (3,).
        left: goal minus object, (3,).
        own: tap chosen by the method.
        gains: learnt gains of the object.
        method: planning method that provides the expected number of following taps.
        settings: settings of the method.
    """
    distance, rotation, heading = (float(number) for number in gains.to_plan(left))
    sizes = _sizes(settings, distance, abs(float(own.distance)))
    most = settings.cone_slope * sizes
    turns = np.unique([0.0, rotation, float(own.rotation), *np.outer(most, SHARES).ravel()])
    follow = method.taps_after(distance, rotation, DIRECTIONS, sizes, turns)
    if follow is None:
        return None
    best = np.argmin(follow, axis=2)
    direction, size = np.indices(best.shape)
    expected = follow[direction, size, best].ravel()
    commanded = gains.command(
        sizes[size].ravel(),
        turns[best].ravel(),
        (heading + DIRECTIONS[direction]).ravel(),
        pose[2],
        settings.cone_slope,
    )
    return NearTaps(commanded, expected)


def quickest_first(
    pose: Array,
    left: Array,
    taps: NearTaps,
    gains: Gains,
    space: StrikeSpace,
    times: TapTimes,
    tip: Array,
) -> Array:
    """Return the taps that are possible with some contact, in order of expected time, (m, 3).

    ``space``: strike space; ``times``: durations of the arm's motions; ``tip``: pose of the arm's
    tip, x, y, height, yaw in `table`. The other arguments are as for ``near_taps``.
    """
    possible, strikes = space.strike_poses(pose, taps.commanded)
    commanded, follow, strikes = taps.commanded[possible], taps.follow[possible], strikes[possible]
    after = gains.predict(commanded, pose[2])
    onwards = np.arctan2(left[1] - after[:, 1], left[0] - after[:, 0])
    seconds = times.to_strikes(tip, strikes) + follow * times.mean_tap
    next_way = times.between(strikes, _behind(pose + after, onwards, strikes, pose))
    seconds += np.minimum(follow, 1.0) * (next_way - times.mean_way)
    order = np.argsort(seconds, kind="stable")
    chosen: Array = commanded[order[np.isfinite(seconds[order])]]
    return chosen


def _sizes(settings: PlannerSettings, distance: float, own: float) -> Array:
    least, most = settings.smallest_distance, settings.largest_distance
    count = math.ceil(math.log(most / least) / math.log(SIZE_RATIO)) + 1
    grid = np.minimum(least * SIZE_RATIO ** np.arange(count), most)
    return np.asarray(np.unique(np.clip([*grid, distance, own], least, most)), dtype=float)


def _behind(after: Array, heading: Array, strikes: Array, pose: Array) -> Array:
    """Strike poses (n, 3) with these headings, at the same distance from the object's centre as the
    previous strikes; ``after``: object poses (n, 3)."""
    far = np.hypot(strikes[:, 0] - pose[0], strikes[:, 1] - pose[1])
    return np.stack(
        [
            after[:, 0] - far * np.cos(heading),
            after[:, 1] - far * np.sin(heading),
            wrap_angle(heading),
        ],
        axis=-1,
    )
