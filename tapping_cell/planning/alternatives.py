"""The taps to try when the method's own cannot be struck, best first."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Polygon, Tap
from tapping_cell.planning.free_space import PathLengths
from tapping_cell.planning.gains import Gains, command_of, prediction_of
from tapping_cell.planning.interface import Array, Planner
from tapping_cell.se2 import wrap_angle

HEADINGS = 24
SHARES_OF_FIRST = np.array([1.0, 0.7, 0.5, 0.3, 0.15])
SHARES_OF_LARGEST = np.array([1.0, 0.6, 0.35, 0.2, 0.1, 0.05])
TURNS = (1.0, 0.5, 0.0, -0.5, -1.0)
CHUNK = 160

Strikeable = Callable[[Array, Array], NDArray[np.bool_]]
"""Which displacements (n, 3) can be struck, each from a pose (n, 3) of its own."""


def alternative_taps(
    pose: Array,
    goal: Array,
    first: Array,
    gains: Gains,
    planner: Planner,
    paths: PathLengths,
    tap: Tap,
    strikeable: Strikeable,
) -> Iterator[Array]:
    """Displacements to command, in chunks of shape (n, 3), best first.

    All directions, several distances (shares of the method's own choice ``first`` and of the
    largest tap) and rotations (shares of the cone). They are ranked by how many taps the method
    would need from where they lead, with the distance measured along the path around obstacles; one
    more where the goal is near and the tap that would end there cannot be struck.
    """
    number = gains.value
    made = candidate_taps(pose, goal, first, number, planner, paths.length, tap)
    order = np.argsort(made.cost, kind="stable")
    order = order[np.isfinite(made.cost[order])]
    waiting, waiting_cost = order[:0], made.cost[:0]
    for start in range(0, order.size, CHUNK):
        part = order[start : start + CHUNK]
        cost = made.cost[part] + indirect(made.after[part], goal, number, planner, strikeable)
        waiting = np.concatenate([waiting, part])
        waiting_cost = np.concatenate([waiting_cost, cost])
        # Those that no candidate further on can come before.
        following = order[start + CHUNK : start + CHUNK + 1]
        ready = waiting_cost <= made.cost[following].min(initial=np.inf)
        rank = np.argsort(waiting_cost[ready], kind="stable")
        if rank.size:
            yield made.commanded[waiting[ready][rank]]
        waiting, waiting_cost = waiting[~ready], waiting_cost[~ready]


class Candidates(NamedTuple):
    """Taps that may replace a method's own, m of them for each pose.

    commanded: (..., m, 3). after: (..., m, 3), the poses they lead to. cost: (..., m), taps with
    this one and from there on, at least; infinite where nothing leads on.
    """

    commanded: Array
    after: Array
    cost: Array


def candidate_taps(
    pose: Array,
    goal: Array,
    first: Array,
    number: Array,
    planner: Planner,
    path: Callable[[Array], Array],
    tap: Tap,
) -> Candidates:
    """What ``alternative_taps`` ranks, for poses, goals and first choices (..., 3).

    number: ``Gains.value``, (..., 6). path: length of the way from places (..., m, 2) to the goal.
    """
    settings = planner.settings
    length = np.hypot(first[..., 0], first[..., 1]) * number[..., 0]
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
    share = np.broadcast_to(np.array(TURNS), shape).reshape(flat)
    known, start = number[..., None, :], pose[..., None, :]
    most = settings.cone_slope * size
    scale = 1.0 / known[..., 1]
    left = wrap_angle(goal[..., 2] - pose[..., 2])[..., None] * scale
    turn = np.where(share == 1.0, np.clip(left, -most, most), share * most)
    commanded = command_of(known, size, turn, heading, start[..., 2], settings.cone_slope)
    after = start + prediction_of(known, commanded, start[..., 2])
    way = path(after[..., :2])
    remaining = wrap_angle(goal[..., None, 2] - after[..., 2]) * scale
    reachable = np.isfinite(way)
    taps = planner.taps_to_go(np.where(reachable, way, 0.0), remaining)
    cost = np.where(reachable, taps + 0.05 * size / settings.largest_distance, np.inf)
    return Candidates(commanded, after, cost)


def _through_edges(tap: Tap, body: Polygon, orientation: Array) -> Array:
    """Directions of travel, rad in `table`, that the edges pass on best: their normals, and half
    of the contact friction to both sides; (..., directions) for orientations (...)."""
    inward = np.arctan2(-body.edge_normals[:, 1], -body.edge_normals[:, 0])
    aside = 0.5 * math.atan(tap.impact.friction) * np.array([-1.0, 0.0, 1.0])
    return np.asarray(orientation[..., None] + (inward[:, None] + aside).ravel())


def indirect(
    after: Array,
    goal: Array,
    number: Array,
    planner: Planner,
    strikeable: Strikeable,
) -> Array:
    """One more tap where the rest cannot be struck in one: poses (..., 3) after a tap.

    ``strikeable`` tells what a planning method does not know: the
    edges of a polygon pass on impulses within the contact's friction of their normals only, and
    beside another object there may be no room for arm and tool. ``number``: ``Gains.value``.
    """
    left = goal - after
    distance = np.hypot(left[..., 0], left[..., 1])
    turn = wrap_angle(left[..., 2]) / number[..., 1]
    heading = np.arctan2(left[..., 1], left[..., 0])
    settings = planner.settings
    near = (distance >= settings.smallest_distance) & (distance <= settings.largest_distance)
    commanded = command_of(
        number, np.where(near, distance, 1.0), turn, heading, after[..., 2], settings.cone_slope
    )
    direct = np.zeros(near.shape, dtype=bool)
    direct[near] = strikeable(after[near], commanded[near])
    return np.where(near & ~direct, 1.0, 0.0)
