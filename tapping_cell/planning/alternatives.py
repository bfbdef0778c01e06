"""Alternative taps, best first, for use if the tap that the planning method chooses is not
possible."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Polygon, Tap
from tapping_cell.planning.free_space import PathLengths
from tapping_cell.planning.gains import Gains, command_of, plan_rotation, prediction_of
from tapping_cell.planning.interface import Array, Planner
from tapping_cell.planning.visited import VisitedPoses
from tapping_cell.se2 import wrap_angle

HEADINGS = 24
SHARES_OF_FIRST = np.array([1.0, 0.7, 0.5, 0.3, 0.15])
SHARES_OF_LARGEST = np.array([1.0, 0.6, 0.35, 0.2, 0.1, 0.05])
TURNS = (1.0, 0.5, 0.0, -0.5, -1.0)
"""Rotations tried, as shares of the largest; in place of 1, the residual if it is smaller."""
CHUNK = 160

LEAST = 80
"""Minimum number of safe candidates in the first chunk. It is doubled for each further chunk,
because checking many candidates takes hardly longer than checking few."""

Strikeable = Callable[[Array, Array], NDArray[np.bool_]]
"""Function that returns which displacements (n, 3) of objects at poses (n, 3) are possible,
(n,)."""

Selection = Callable[[Array], NDArray[np.bool_]]
"""Function that returns which displacements (n, 3) from the present pose remain candidates,
(n,)."""


def alternative_taps(
    pose: Array,
    goal: Array,
    first: Array,
    gains: Gains,
    planner: Planner,
    paths: PathLengths,
    tap: Tap,
    strikeable: Strikeable,
    visited: VisitedPoses | None = None,
    safe: Selection | None = None,
    possible: Selection | None = None,
) -> Iterator[Ranked]:
    """Generate alternative displacements to command, in chunks, best first.

    The candidates cover all directions, several distances (shares of the method's own choice
    ``first`` and of the largest tap) and several rotations (shares of the cone). The candidates are
    ranked by the number of taps that the method needs after them. This number is computed from the
    length of the path around obstacles. One tap is added to this number if, after the candidate,
    the goal is near enough for one tap but that tap is not possible.
    ``visited``: poses from which the object was tapped before, with their stored costs; a candidate
    that ends near such a pose is assigned at least this cost. ``safe``: function that returns which
    displacements (n, 3) may be commanded. ``possible``: function that returns which of these the
    striker can make. Each slower check is applied only to the candidates that passed the faster
    checks.
    """
    learnt = gains.value
    made = candidate_taps(pose, goal, first, learnt, planner, paths.length, tap)
    order = np.argsort(made.cost, kind="stable")
    order = order[np.isfinite(made.cost[order])]
    waiting, waiting_cost = order[:0], made.cost[:0]
    start, least = 0, LEAST
    while start < order.size:
        parts, count = [], 0
        while start < order.size and count < least:
            block = order[start : start + CHUNK]
            start += CHUNK
            parts.append(block if safe is None else block[safe(made.commanded[block])])
            count += parts[-1].size
        least *= 2
        part = np.concatenate(parts)
        if possible is not None:
            part = part[possible(made.commanded[part])]
        cost = made.cost[part] + indirect(made.after[part], goal, learnt, planner, strikeable)
        if visited is not None:
            cost += visited.extra(made.after[part], cost)
        waiting = np.concatenate([waiting, part])
        waiting_cost = np.concatenate([waiting_cost, cost])
        # A candidate is returned as soon as no unchecked candidate can be better.
        following = order[start : start + 1]
        ready = waiting_cost <= made.cost[following].min(initial=np.inf)
        rank = np.argsort(waiting_cost[ready], kind="stable")
        if rank.size:
            yield Ranked(made.commanded[waiting[ready][rank]], waiting_cost[ready][rank])
        waiting, waiting_cost = waiting[~ready], waiting_cost[~ready]


class Ranked(NamedTuple):
    """Displacements to command, (n, 3), and the estimated number of further taps after each,
    (n,)."""

    commanded: Array
    cost: Array


class Candidates(NamedTuple):
    """Candidates that can replace the tap chosen by the method; m is their number for each pose.

    commanded: displacements, (..., m, 3). after: poses after the taps, (..., m, 3). cost: lower
    bound of the number of taps after each candidate, (..., m); infinite if no path leads from the
    pose after the candidate to the goal.
    """

    commanded: Array
    after: Array
    cost: Array


def candidate_taps(
    pose: Array,
    goal: Array,
    first: Array,
    learnt: Array,
    planner: Planner,
    path: Callable[[Array], Array],
    tap: Tap,
) -> Candidates:
    """Return the candidates for ``alternative_taps``, for poses, goals and first choices (..., 3).

    learnt: ``Gains.value``, (..., 6). path: function that returns the lengths, in metres, of the
    paths from m points per pose, (..., m, 2), to the goal.
    """
    settings = planner.settings
    length = np.hypot(first[..., 0], first[..., 1]) * learnt[..., 0]
    shares = np.broadcast_to(SHARES_OF_LARGEST, (*length.shape, len(SHARES_OF_LARGEST)))
    sizes = np.clip(
        np.concatenate(
            [length[..., None] * SHARES_OF_FIRST, settings.largest_distance * shares], axis=-1
        ),
        settings.smallest_distance,
        settings.largest_distance,
    )
    turns = np.arange(HEADINGS) * (2.0 * math.pi / HEADINGS)
    headings = np.arctan2(first[..., 1], first[..., 0])[..., None] + turns
    if isinstance(tap.body, Polygon):
        headings = np.concatenate([headings, _through_edges(tap, tap.body, pose[..., 2])], axis=-1)
    shape = (*length.shape, headings.shape[-1], sizes.shape[-1], len(TURNS))
    flat = (*length.shape, -1)
    heading = np.broadcast_to(headings[..., :, None, None], shape).reshape(flat)
    size = np.broadcast_to(sizes[..., None, :, None], shape).reshape(flat)
    turn_share = np.broadcast_to(np.array(TURNS), shape).reshape(flat)
    each, start = learnt[..., None, :], pose[..., None, :]
    most = settings.cone_slope * size
    left = wrap_angle(goal[..., 2] - pose[..., 2])[..., None] / each[..., 1]
    turn = np.where(turn_share == 1.0, np.clip(left, -most, most), turn_share * most)
    commanded = command_of(each, size, turn, heading, start[..., 2], settings.cone_slope)
    after = start + prediction_of(each, commanded, start[..., 2])
    way = path(after[..., :2])
    remaining = plan_rotation(
        wrap_angle(goal[..., None, 2] - after[..., 2]), each[..., 1], settings.stopping.rotation
    )
    reachable = np.isfinite(way)
    taps = planner.taps_to_go(np.where(reachable, way, 0.0), remaining)
    # Of equally good taps, prefer the shortest.
    cost = np.where(reachable, taps + 0.05 * size / settings.largest_distance, np.inf)
    return Candidates(commanded, after, cost)


def _through_edges(tap: Tap, body: Polygon, orientation: Array) -> Array:
    """Return the directions of travel, rad in `table`, that suit a polygon's edges best: each
    edge's normal, and the directions half a friction angle to either side of it. Orientations (...)
    give (..., directions)."""
    inward = np.arctan2(-body.edge_normals[:, 1], -body.edge_normals[:, 0])
    aside = 0.5 * math.atan(tap.impact.friction) * np.array([-1.0, 0.0, 1.0])
    return np.asarray(orientation[..., None] + (inward[:, None] + aside).ravel())


def indirect(
    after: Array,
    goal: Array,
    learnt: Array,
    planner: Planner,
    strikeable: Strikeable,
) -> Array:
    """Return the extra taps for poses (..., 3) after a tap: 1 if the goal is near enough for one
    tap but this tap is not possible, else 0.

    ``strikeable`` applies constraints that a planning method ignores: the edges of a polygon
    transmit only impulses inside the friction cone, and other objects may obstruct the arm and the
    tool. ``learnt``: ``Gains.value``.
    """
    left = goal - after
    distance = np.hypot(left[..., 0], left[..., 1])
    turn = wrap_angle(left[..., 2]) / learnt[..., 1]
    heading = np.arctan2(left[..., 1], left[..., 0])
    settings = planner.settings
    near = (distance >= settings.smallest_distance) & (distance <= settings.largest_distance)
    commanded = command_of(
        learnt, np.where(near, distance, 1.0), turn, heading, after[..., 2], settings.cone_slope
    )
    direct = np.zeros(near.shape, dtype=bool)
    direct[near] = strikeable(after[near], commanded[near])
    return np.where(near & ~direct, 1.0, 0.0)
