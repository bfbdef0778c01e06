"""Workspace: the table's edges and the keep-out areas, in the `table` frame.

Distances are signed: positive inside the table and outside every keep-out. Points have shape
(..., 2) in m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.interface import Array


@dataclass(frozen=True, slots=True)
class CircleArea:
    """A round keep-out, for example a clamp, a screw or a camera's foot. Centre and radius in m;
    ``name``: name of the object if the keep-out is an object."""

    x: float
    y: float
    radius: float
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse a circle that is not finite or has no size (PlanningError)."""
        if not (np.all(np.isfinite([self.x, self.y])) and 0.0 < self.radius < 10.0):
            raise PlanningError(
                f"keep-out circle {self}: all numbers must be finite, and the radius above 0"
            )

    def distance(self, points: ArrayLike) -> Array:
        """Return the distance from the points to the area, negative inside."""
        p = np.asarray(points, dtype=float)
        return np.asarray(np.hypot(p[..., 0] - self.x, p[..., 1] - self.y) - self.radius)


@dataclass(frozen=True, slots=True)
class PolygonArea:
    """A polygonal keep-out, convex or not. The corners, in m, are in order around the area.
    ``name``: name of the object if the keep-out is an object."""

    vertices: tuple[tuple[float, float], ...]
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse fewer than three corners or numbers that are not finite (PlanningError)."""
        if len(self.vertices) < 3 or not np.all(np.isfinite(self.vertices)):
            raise PlanningError(
                f"keep-out polygon with {len(self.vertices)} corners: it needs at least 3 corners, "
                "all of them finite"
            )

    def distance(self, points: ArrayLike) -> Array:
        """Return the distance from the points to the area, negative inside (by the even-odd
        rule)."""
        p = np.asarray(points, dtype=float)
        x, y = p[..., 0], p[..., 1]
        nearest = np.full(x.shape, np.inf)
        inside = np.zeros(x.shape, dtype=bool)
        corners = np.asarray(self.vertices, dtype=float)
        for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            ux, uy = bx - ax, by - ay
            along = np.clip(((x - ax) * ux + (y - ay) * uy) / (ux * ux + uy * uy or 1.0), 0.0, 1.0)
            nearest = np.minimum(nearest, np.hypot(x - ax - along * ux, y - ay - along * uy))
            if ay != by:
                crosses = (ay > y) != (by > y)
                inside ^= crosses & (x < ax + (y - ay) * ux / uy)
        return np.asarray(np.where(inside, -nearest, nearest))


KeepOut = CircleArea | PolygonArea


@dataclass(frozen=True, slots=True)
class Workspace:
    """The table and its obstacles.

    length, width: size of the table area along x and y, centred on the table's origin, m.
    edge_margin: minimum distance of the object's outline from an edge, m.
    keep_outs: areas that the object and the striker must not enter.
    keep_out_margin: minimum distance of the object and of the striker from a keep-out, m.
    overhang: largest distance of the striker beyond the edges, m.
    """

    length: float = 0.60
    width: float = 0.44
    edge_margin: float = 0.005
    keep_outs: tuple[KeepOut, ...] = ()
    keep_out_margin: float = 0.005
    overhang: float = 0.15

    def __post_init__(self) -> None:
        """Refuse sizes out of range (PlanningError names the value and the range)."""
        for name, low, high in (
            ("length", 0.05, 10.0),
            ("width", 0.05, 10.0),
            ("edge_margin", 0.0, 0.5),
            ("keep_out_margin", 0.0, 0.5),
            ("overhang", 0.0, 2.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise PlanningError(
                    f"Workspace.{name} is {value!r}, allowed: {low:g} to {high:g} m"
                )

    def edge_distance(self, points: ArrayLike) -> Array:
        """Return the distance to the nearest edge of the table, negative beyond it."""
        p = np.asarray(points, dtype=float)
        return np.asarray(
            np.minimum(self.length / 2 - np.abs(p[..., 0]), self.width / 2 - np.abs(p[..., 1]))
        )

    def keep_out_distance(self, points: ArrayLike) -> Array:
        """Return the distance to the nearest keep-out, negative inside; infinite if there is no
        keep-out."""
        p = np.asarray(points, dtype=float)
        nearest = np.full(p.shape[:-1], np.inf)
        for area in self.keep_outs:
            nearest = np.minimum(nearest, area.distance(p))
        return nearest

    def nearest_keep_out(self, point: ArrayLike) -> str:
        """Describe the keep-out nearest to a point (2,) in words; empty if there is none."""
        if not self.keep_outs:
            return ""
        nearest = min(self.keep_outs, key=lambda area: float(area.distance(point)))
        return f"the object '{nearest.name}'" if nearest.name else "a keep-out area"

    def others(self) -> str:
        """Return the names, for use in messages, of the keep-outs that are objects, such as "'a',
        'b'"; empty if there are none."""
        return ", ".join(f"'{area.name}'" for area in self.keep_outs if area.name)

    def object_clearance(self, points: ArrayLike) -> Array:
        """Return the largest radius with which an object centred at the points keeps the margins to
        the edges and the keep-outs."""
        return np.asarray(
            np.minimum(
                self.edge_distance(points) - self.edge_margin,
                self.keep_out_distance(points) - self.keep_out_margin,
            )
        )

    def striker_clearance(self, points: ArrayLike) -> Array:
        """Return the largest allowed radius of a part of the striker that is centred at the
        points."""
        return np.asarray(
            np.minimum(
                self.edge_distance(points) + self.overhang,
                self.keep_out_distance(points) - self.keep_out_margin,
            )
        )
