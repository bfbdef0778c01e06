"""First contact of a ball moving along a line with a body; all in the body's frame, in m."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics.bodies import Body, Polygon
from tapping_cell.mechanics.planar import Array, cross, to_left


class Contact(NamedTuple):
    """The first contact.

    ``travel`` is the ball's travel, in m, until the contact; it is negative if the ball starts
    inside the body. ``point`` (..., 2) is the contact point on the body in m, and ``normal`` (...,
    2) points into the body. If ``missed``, the other fields are arbitrary finite numbers.
    """

    missed: NDArray[np.bool_]
    travel: Array
    point: Array
    normal: Array


def first_contact(body: Body, tip_radius: float, start: Array, direction: Array) -> Contact:
    """Compute the contact of a ball of ``tip_radius`` that moves from ``start`` along
    ``direction``.

    ``start`` and ``direction`` are (..., 2) in the body's frame; ``direction`` has unit length. If
    the ball starts inside the body, the contact is where the ball's line of travel enters the body,
    so the travel is negative. A ball that is already past the body misses.
    """
    if isinstance(body, Polygon):
        return _polygon_contact(body, tip_radius, start, direction)
    reach = body.bounding_radius + tip_radius
    travel, hits = _enter_circle(start, direction, reach)
    normal = -(start + travel[..., None] * direction) / reach
    return Contact(~hits, travel, -body.bounding_radius * normal, normal)


def _polygon_contact(body: Polygon, tip: float, start: Array, direction: Array) -> Contact:
    """Compute the contact with a polygon.

    The polygon's outline, enlarged by the ball's radius, consists of shifted edges and of arcs
    about the corners. The contact is where the path of the ball's centre first meets this outline.
    """
    points, normals, lengths = body.points, body.edge_normals, body.edge_lengths
    from_vertex = start[..., None, :] - points
    closing = direction @ normals.T
    faces = closing < 0
    height = np.einsum("...ij,ij->...i", from_vertex, normals) - tip
    with np.errstate(divide="ignore", invalid="ignore"):
        edge_travel = np.where(faces, -height / np.where(faces, closing, 1.0), np.inf)
    tangents = to_left(normals)
    along = np.einsum("...ij,ij->...i", from_vertex, tangents) + np.where(
        faces, edge_travel, 0.0
    ) * (direction @ tangents.T)
    slack = 1e-12 * lengths
    edge_travel = np.where(
        faces & (along >= -slack) & (along <= lengths + slack), edge_travel, np.inf
    )
    corner_travel, corner_hits = _enter_circle(from_vertex, direction[..., None, :], tip)
    corner_travel = np.where(corner_hits, corner_travel, np.inf)
    edge, corner = edge_travel.argmin(axis=-1), corner_travel.argmin(axis=-1)
    first_edge, first_corner = edge_travel.min(axis=-1), corner_travel.min(axis=-1)
    # Where an edge meets the arc of a corner, the edge is preferred.
    by_edge = first_edge <= first_corner + 1e-12 * body.bounding_radius
    travel = np.where(by_edge, first_edge, first_corner)
    hits = np.isfinite(travel)
    travel = np.where(hits, travel, 0.0)
    centre = start + travel[..., None] * direction
    radius = tip if tip > 0 else 1.0
    corner_normal = (points[corner] - centre) / radius
    normal = np.where(by_edge[..., None], -normals[edge], corner_normal)
    # A ball that has already passed the whole body does not hit it.
    support = (np.einsum("...i,ji->...j", direction, points)).max(axis=-1) + tip
    hits &= np.einsum("...i,...i->...", start, direction) < support
    normal = np.where(hits[..., None], normal, -direction)
    return Contact(~hits, travel, centre + tip * normal, normal)


def _enter_circle(start: Array, direction: Array, radius: float) -> tuple[Array, NDArray[np.bool_]]:
    """Compute the travel until a point enters a circle about the origin, and whether it enters the
    circle."""
    nearest = -(start * direction).sum(axis=-1)
    offset = cross(start, direction)
    under = radius * radius - offset * offset
    half = np.sqrt(np.maximum(under, 0.0))
    hits = (under > 0) & (nearest + half > 0)
    return np.where(hits, nearest - half, 0.0), hits
