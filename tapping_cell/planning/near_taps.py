"""Choice, among taps of all directions, of the tap that brings an object to its goal soonest.

Many taps are nearly as good as the tap that the method chooses: if two taps are needed, the first
may lead almost anywhere. The tap with the least expected time is chosen ::

    t(tap) + E[taps that follow] t_mean + P (t(next) - t_way).

t(tap) is the duration of the arm's motion to this strike, and t(next) that of the motion from there
to the strike towards the goal. P is the probability that the strike towards the goal is the next
one. t_way is the mean duration of the arm's motions to a strike, and t_mean the mean duration of a
tap.
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
from tapping_cell.se2 import unit_vectors

DIRECTIONS: Array = np.arange(24, dtype=np.float64) * (2.0 * math.pi / 24)
SIZE_RATIO = 1.35
SHARES = np.array([-1.0, -0.5, 0.5, 1.0])
"""Rotations that are tried for each size, as shares of the largest rotation."""


class NearTaps(NamedTuple):
    """Taps in all directions: commanded displacements (n, 3), and the expected number of further
    taps after each (n,)."""

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
    """Return taps of all directions and sizes, each with its best rotation; None while the method
    has no solution.

    Args:
        pose: pose of the object, (3,).
        left: goal minus object, (3,).
        own: tap chosen by the method.
        gains: learnt gains of the object.
        method: planning method that provides the expected number of following taps.
        settings: settings of the method.
    """
    box = settings.stopping.rotation
    distance, rotation, heading = (float(number) for number in gains.to_plan(left, box))
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
        gains.from_plan(left, turns[best].ravel(), box),
        (heading + DIRECTIONS[direction]).ravel(),
        pose[2],
        settings.cone_slope,
    )
    return NearTaps(commanded, expected)


def best_first(
    pose: Array,
    left: Array,
    taps: NearTaps,
    gains: Gains,
    space: StrikeSpace,
    times: TapTimes,
    tip: Array,
) -> Array:
    """Return the possible taps in the order of their expected times, (m, 3).

    After some of these taps, the arm or the tool cannot make a second tap straight to the goal. The
    cost of such a first tap is increased by the probability that the next tap would be the straight
    one.

    ``space``: strike space; ``times``: durations of the arm's motions; ``tip``: pose of the arm's
    tip, x, y, height, yaw in `table`. The other arguments are as for ``near_taps``.
    """
    commanded, follow = taps.commanded, taps.follow
    after = gains.predict(commanded, pose[2])
    following = _strikes_to_goal(pose + after, left - after, space)
    clearance = np.any(space.elbows(following), axis=-1) & space.tool_is_clear(following)
    # Probability that the next tap goes straight to the goal: 1 if one tap follows, 0 if two or
    # more follow, because the first of these may go in any direction.
    direct = np.clip(np.minimum(follow, 2.0 - follow), 0.0, 1.0)
    cost = follow + np.where(clearance, 0.0, direct)
    possible, strikes = space.strike_poses(pose, commanded)
    next_way = times.between(strikes, following) - times.mean_way
    seconds = times.to_strikes(tip, strikes) + cost * times.mean_tap + direct * next_way
    seconds = np.where(possible, seconds, np.inf)
    order = np.argsort(seconds, kind="stable")
    chosen: Array = commanded[order[np.isfinite(seconds[order])]]
    return chosen


def _sizes(settings: PlannerSettings, distance: float, own: float) -> Array:
    least, most = settings.smallest_distance, settings.largest_distance
    count = math.ceil(math.log(most / least) / math.log(SIZE_RATIO)) + 1
    grid = np.minimum(least * SIZE_RATIO ** np.arange(count), most)
    return np.asarray(np.unique(np.clip([*grid, distance, own], least, most)), dtype=float)


def _strikes_to_goal(pose: Array, left: Array, space: StrikeSpace) -> Array:
    """Return approximate tip poses (n, 3) at rest for tapping objects at ``pose`` (n, 3) straight
    towards the goal; ``left``: residuals (n, 3)."""
    far = space.object_radius + space.tip_radius + space.settings.standoff
    heading = np.arctan2(left[:, 1], left[:, 0])
    return np.column_stack([pose[:, :2] - far * unit_vectors(heading), heading])
