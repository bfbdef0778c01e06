"""Maps of tappable places for one object among others, and queries on these maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from tapping_cell.planning.arrangement.interface import Body
from tapping_cell.planning.free_space import FreeSpace, PathLengths
from tapping_cell.planning.interface import Array
from tapping_cell.planning.workspace import CircleArea, KeepOut
from tapping_cell.se2 import Pose

KEPT = 300
"""Maximum number of cached maps; a map takes about 60 kB."""


class AmongOthers:
    """Creates and caches maps of tappable places; every query is about one object among others."""

    def __init__(self) -> None:
        self._maps: dict[tuple[FreeSpace, frozenset[CircleArea]], FreeSpace] = {}
        self._paths: dict[tuple[FreeSpace, frozenset[CircleArea], float, float], PathLengths] = {}

    def map(self, body: Body, others: Iterable[CircleArea]) -> FreeSpace:
        """Return the map of an object's tappable places if the areas ``others`` of the table are
        occupied."""
        areas = frozenset(others)
        key = (body.free, areas)
        if key not in self._maps:
            if len(self._maps) >= KEPT:
                del self._maps[next(iter(self._maps))]
            # Sorted, so that the map does not depend on the order of the set, which varies with the
            # hash seed.
            ordered: list[KeepOut] = [*sorted(areas, key=_order)]
            self._maps[key] = body.free.among(ordered)
        return self._maps[key]

    def path(self, body: Body, others: Iterable[CircleArea], start: Pose, end: Pose) -> float:
        """Return the length of the path through tappable places between two poses, m; inf if there
        is no path."""
        areas = frozenset(others)
        key = (body.free, areas, end.x, end.y)
        if key not in self._paths:
            if len(self._paths) >= KEPT:
                del self._paths[next(iter(self._paths))]
            self._paths[key] = self.map(body, areas).to_goal(np.array([end.x, end.y]))
        paths = self._paths[key]
        if not paths.reachable(start):
            return float("inf")
        return float(paths.length(np.array([start.x, start.y])))

    def fits(self, body: Body, others: Iterable[CircleArea], pose: Pose) -> bool:
        """Return whether a pose of the object is tappable."""
        return bool(self.map(body, others).contains(np.array([pose.x, pose.y])))

    def in_largest_region(self, body: Body, others: Iterable[CircleArea], pose: Pose) -> bool:
        """Return whether a pose is in the largest connected region of tappable places."""
        free = self.map(body, others)
        if not bool(free.contains(np.array([pose.x, pose.y]))):
            return False
        counts = np.bincount(free.regions)
        counts[0] = 0
        cell, offset = free.nearest_cells(np.array([pose.x, pose.y]))
        return bool(np.isfinite(offset) and free.regions[cell] == int(np.argmax(counts)))

    def places(self, body: Body, others: Iterable[CircleArea], pose: Pose) -> Array:
        """Return the centres (n, 2) of the tappable cells that can be reached from a pose."""
        free = self.map(body, others)
        cell, offset = free.nearest_cells(np.array([pose.x, pose.y]))
        if not np.isfinite(offset):
            return np.zeros((0, 2))
        mine = free.regions == free.regions[cell]
        return np.asarray(free.centres.reshape(-1, 2)[mine])


def gap(first: CircleArea, second: CircleArea) -> float:
    """Return the gap between two bounding circles, m; negative if they overlap."""
    apart = float(np.hypot(first.x - second.x, first.y - second.y))
    return apart - first.radius - second.radius


def bodies_among(bodies: Sequence[Body], obstacles: Sequence[KeepOut]) -> tuple[Body, ...]:
    """Return copies of the objects. The maps of the copies also contain the fixed keep-outs
    ``obstacles``."""
    if not obstacles:
        return tuple(bodies)
    made: dict[FreeSpace, FreeSpace] = {}
    for body in bodies:
        if body.free not in made:
            made[body.free] = body.free.among(obstacles)
    return tuple(replace(body, free=made[body.free]) for body in bodies)


def areas_of(
    bodies: Iterable[Body], poses: Mapping[str, Pose], without: Iterable[str] = ()
) -> list[CircleArea]:
    """Return the bounding circles of the objects at these poses, except those in ``without``."""
    left_out = frozenset(without)
    return [body.area(poses[body.name]) for body in bodies if body.name not in left_out]


def _order(area: CircleArea) -> tuple[float, float, float, str]:
    return (area.x, area.y, area.radius, area.name)
