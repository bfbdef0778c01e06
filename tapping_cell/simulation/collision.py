"""Collisions between objects on the table: the gap between two outlines, and the impact.

The impact is perfectly inelastic along the contact normal and frictionless along the tangent, so
afterwards the two contact points have the same velocity along the normal. The impact uses the
objects' masses, moments of inertia and lever arms, so a collision rotates each object whose centre
of mass is not on the line of the contact normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Disk, Polygon, Ring
from tapping_cell.simulation.sliding import Motion

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A convex object seen from above: all points within ``radius`` m of the hull of ``corners``.

    ``corners``: (n, 2) relative to the centre of mass, m, counter-clockwise. A disk has one corner,
    its centre. ``mass`` in kg, ``inertia`` in kg m^2 about the centre of mass.
    """

    corners: Array
    radius: float
    mass: float
    inertia: float
    reach: float = field(init=False)
    """Maximum distance of the outline from the centre of mass, m."""

    def __post_init__(self) -> None:
        """Compute ``reach`` only once, because every step of a slide uses it."""
        reach = float(np.hypot(*self.corners.T).max()) + self.radius
        object.__setattr__(self, "reach", reach)

    @classmethod
    def of(cls, body: Disk | Ring | Polygon, centre: tuple[float, float], inertia: float) -> Solid:
        """Create a solid from a body; ``centre``: centre of mass in the body's frame, m."""
        if isinstance(body, Polygon):
            return cls(np.asarray(body.points) - np.array(centre), 0.0, body.mass, inertia)
        return cls(-np.array([centre]), body.radius, body.mass, inertia)

    def at(self, motion: Motion) -> Array:
        """Return the corners in ``table``, (n, 2), m."""
        cos, sin = math.cos(motion.theta), math.sin(motion.theta)
        turn = np.array([[cos, -sin], [sin, cos]])
        return np.asarray(self.corners @ turn.T + np.array([motion.x, motion.y]))


class Gap(NamedTuple):
    """Smallest distance between two solids (m, negative if they overlap), the unit normal from the
    first to the second solid, and the contact point."""

    distance: float
    normal: tuple[float, float]
    place: tuple[float, float]


def gap_between(first: Solid, second: Solid, here: Motion, there: Motion) -> Gap:
    """Return the gap between two solids at their current poses."""
    p, q = first.at(here), second.at(there)
    from_q, from_p = _separation(p, q), _separation(q, p)
    best = max(
        (side for side in (from_q, from_p) if side is not None),
        key=lambda side: side[0],
        default=None,
    )
    if best is not None and best[0] <= 0.0:
        # The convex hulls overlap: separate them along the edge normal with the smallest overlap.
        depth, normal, corner = best
        sign = -1.0 if best is from_q else 1.0
        along = (sign * float(normal[0]), sign * float(normal[1]))
        return Gap(
            depth - first.radius - second.radius, along, (float(corner[0]), float(corner[1]))
        )
    one, other = _nearest_points(p, q)
    way = other - one
    distance = float(np.hypot(*way))
    if distance == 0.0:
        way = np.array([there.x - here.x, there.y - here.y])
    length = float(np.hypot(*way))
    # The direction is arbitrary if two disks are concentric.
    normal = way / length if length > 0.0 else np.array([1.0, 0.0])
    place = one + normal * first.radius
    return Gap(
        distance - first.radius - second.radius,
        (float(normal[0]), float(normal[1])),
        (float(place[0]), float(place[1])),
    )


def impact(
    first: Solid, second: Solid, here: Motion, there: Motion, gap: Gap
) -> tuple[Motion, Motion, float] | None:
    """Return both motions after the impact and the closing speed (m/s); None if the solids move
    apart."""
    (nx, ny), (x, y) = gap.normal, gap.place
    lever = (x - here.x) * ny - (y - here.y) * nx
    other_lever = (x - there.x) * ny - (y - there.y) * nx
    closing = (
        (here.vx - there.vx) * nx
        + (here.vy - there.vy) * ny
        + here.omega * lever
        - there.omega * other_lever
    )
    if closing <= 0.0:
        return None
    impulse = closing / (
        1 / first.mass
        + 1 / second.mass
        + lever**2 / first.inertia
        + other_lever**2 / second.inertia
    )
    return (
        here._replace(
            vx=here.vx - impulse * nx / first.mass,
            vy=here.vy - impulse * ny / first.mass,
            omega=here.omega - impulse * lever / first.inertia,
        ),
        there._replace(
            vx=there.vx + impulse * nx / second.mass,
            vy=there.vy + impulse * ny / second.mass,
            omega=there.omega + impulse * other_lever / second.inertia,
        ),
        closing,
    )


def _separation(points: Array, polygon: Array) -> tuple[float, Array, Array] | None:
    """Apply the separating axis theorem to the edge normals of ``polygon``: return the largest
    separation of the points from an edge, the outward normal of this edge, and the nearest point.
    None for a polygon without edges."""
    if polygon.shape[0] < 3:
        return None
    edges = np.roll(polygon, -1, axis=0) - polygon
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=-1)
    normals /= np.hypot(normals[:, 0], normals[:, 1])[:, None]
    heights = np.einsum("pei,ei->ep", points[:, None, :] - polygon[None, :, :], normals)
    lowest = heights.min(axis=1)
    edge = int(lowest.argmax())
    return float(lowest[edge]), normals[edge], points[int(heights[edge].argmin())]


def _nearest_points(p: Array, q: Array) -> tuple[Array, Array]:
    """Return the nearest points of two convex hulls that do not overlap."""
    one, other, away = _to_edges(p, q)
    back, there, length = _to_edges(q, p)
    return (one, other) if away <= length else (there, back)


def _to_edges(points: Array, polygon: Array) -> tuple[Array, Array, float]:
    """Return the one of ``points`` that is nearest to an edge of ``polygon``, the nearest point on
    this edge, and the distance between the two."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    lengths = np.maximum((edges**2).sum(axis=-1), 1e-18)
    offsets = points[:, None, :] - polygon[None, :, :]
    shares = np.clip((offsets * edges).sum(axis=-1) / lengths, 0.0, 1.0)
    places = polygon[None, :, :] + shares[..., None] * edges[None, :, :]
    away = np.hypot(*np.moveaxis(points[:, None, :] - places, -1, 0))
    which, edge = np.unravel_index(int(away.argmin()), away.shape)
    return points[which], places[which, edge], float(away[which, edge])
