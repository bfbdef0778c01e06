"""The taps to try when the method's own cannot be struck, best first."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from tapping_cell.mechanics import Polygon, Tap
from tapping_cell.planning.free_space import PathLengths
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.interface import Array, Planner
from tapping_cell.se2 import wrap_angle

HEADINGS = 24
SHARES_OF_FIRST = (1.0, 0.7, 0.5, 0.3, 0.15)
SHARES_OF_LARGEST = (1.0, 0.6, 0.35, 0.2, 0.1, 0.05)
TURNS = (1.0, 0.5, 0.0, -0.5, -1.0)
CHUNK = 160


def alternative_taps(
    pose: Array,
    goal: Array,
    first: Array,
    gains: Gains,
    planner: Planner,
    paths: PathLengths,
    tap: Tap,
) -> Iterator[Array]:
    """Displacements to command, in chunks of shape (n, 3), best first.

    All directions, several distances (shares of the method's own choice ``first`` and of the
    largest tap) and rotations (shares of the cone). They are ranked by how many taps the method
    would need from where they lead, with the distance measured along the path around obstacles.
    """
    settings = planner.settings
    length = math.hypot(first[0], first[1]) * float(gains.value[0])
    sizes = np.clip(
        np.concatenate(
            [
                length * np.array(SHARES_OF_FIRST),
                settings.largest_distance * np.array(SHARES_OF_LARGEST),
            ]
        ),
        settings.smallest_distance,
        settings.largest_distance,
    )
    headings = math.atan2(first[1], first[0]) + np.arange(HEADINGS) * (2.0 * math.pi / HEADINGS)
    if isinstance(tap.body, Polygon):
        headings = np.concatenate([headings, _through_edges(tap, tap.body, float(pose[2]))])
    heading, size, share = (
        axis.ravel() for axis in np.meshgrid(headings, np.unique(sizes), TURNS, indexing="ij")
    )
    most = settings.cone_slope * size
    scale = 1.0 / float(gains.value[1])
    left = float(wrap_angle(goal[2] - pose[2])) * scale
    turn = np.where(share == 1.0, np.clip(left, -most, most), share * most)
    commanded = gains.command(size, turn, heading, pose[2], settings.cone_slope)
    after = pose + gains.predict(commanded, pose[2])
    path = paths.length(after[:, :2])
    remaining = wrap_angle(goal[2] - after[:, 2]) * scale
    reachable = np.isfinite(path)
    cost = np.where(
        reachable,
        planner.taps_to_go(np.where(reachable, path, 0.0), remaining)
        + 0.05 * size / settings.largest_distance,
        np.inf,
    )
    if isinstance(tap.body, Polygon):
        cost = cost + _indirect(after, goal, gains, planner, tap)
    order = np.argsort(cost, kind="stable")
    order = order[np.isfinite(cost[order])]
    for start in range(0, order.size, CHUNK):
        yield commanded[order[start : start + CHUNK]]


def _through_edges(tap: Tap, body: Polygon, orientation: float) -> Array:
    """Directions of travel, rad in `table`, that the edges pass on best: their normals, and half
    of the contact friction to both sides."""
    inward = np.arctan2(-body.edge_normals[:, 1], -body.edge_normals[:, 0]) + orientation
    aside = 0.5 * math.atan(tap.impact.friction) * np.array([-1.0, 0.0, 1.0])
    return np.asarray((inward[:, None] + aside).ravel())


def _indirect(after: Array, goal: Array, gains: Gains, planner: Planner, tap: Tap) -> Array:
    """One more tap where no contact of a polygon gives the rest in one: poses (n, 3) after a tap.

    The edges of a polygon pass on impulses within the contact's friction of their normals only,
    which a planning method does not know.
    """
    left = goal - after
    left[:, 2] = wrap_angle(left[:, 2])
    distance, turn, heading = gains.to_plan(left)
    settings = planner.settings
    near = (distance >= settings.smallest_distance) & (distance <= settings.largest_distance)
    commanded = gains.command(
        np.where(near, distance, 1.0), turn, heading, after[:, 2], settings.cone_slope
    )
    direct = tap.reachable(commanded, after)
    return np.where(near & ~direct, 1.0, 0.0)
