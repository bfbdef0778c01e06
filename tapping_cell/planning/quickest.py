"""Which tap brings the object to its goal in the least time: taps that follow, and the arm's way.

Many taps are nearly as good as the method's own: where two are needed, the first may go almost
anywhere. Among them the one is chosen with the least expected time ::

    t(tap) + t(next) + (E[taps that follow] - P) t_mean,

where t(tap) is the arm's way to this strike, t(next) the way from there to the strike towards the
goal that follows with probability P = min(1, E[taps that follow]), less the mean way, and t_mean
the mean time of a tap.
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
"""Rotations that are tried, as shares of the most of each size."""


class NearTaps(NamedTuple):
    """Taps in all directions: commanded displacements (n, 3) and expected taps that follow (n,)."""

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
    """Taps of all directions and sizes, each with its best rotation; None while the method knows
    no values.

    Args:
        pose: of the object, (3,).
        left: goal less object, (3,).
        own: the method's tap.
        gains: what is known of the object.
        method: what the taps that follow are known from.
        settings: for which it was made.
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
    """The taps that a contact of the object gives, in the order of their expected time, (m, 3).

    ``space``: which taps can be struck; ``times``: of the arm's way; ``tip``: where the arm's tip
    stands, x, y, height, yaw in `table`. The others as for ``near_taps``.
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
    """Strike poses (n, 3) in these headings, as far from the middle of objects at (n, 3) as the
    strikes before were."""
    far = np.hypot(strikes[:, 0] - pose[0], strikes[:, 1] - pose[1])
    return np.stack(
        [
            after[:, 0] - far * np.cos(heading),
            after[:, 1] - far * np.sin(heading),
            wrap_angle(heading),
        ],
        axis=-1,
    )
