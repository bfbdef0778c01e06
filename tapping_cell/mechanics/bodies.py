"""Flat rigid bodies on a table: a disk, a thin ring, a convex polygon.

A body's frame has its origin at the centre of mass; angles are counter-clockwise from its x axis.
Lengths in m, masses in kg.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics.errors import InvalidBodyError, finite, positive
from tapping_cell.mechanics.planar import Array, cross, to_right, unit


class Body:
    """Common properties of all bodies: ``mass``, ``height`` and values derived from the shape."""

    # Name of the support's type, which selects the friction formula (see ``support_friction``).
    support: ClassVar[str]
    mass: float
    height: float

    @property
    def inertia(self) -> float:
        """Moment of inertia about the vertical through the centre of mass, in kg m^2."""
        raise NotImplementedError

    @property
    def support_radius(self) -> float:
        """Radius R of the (equivalent) support in the sliding equations, in m."""
        raise NotImplementedError

    @property
    def bounding_radius(self) -> float:
        """Maximum distance from the centre of mass to the boundary, in m."""
        raise NotImplementedError

    @property
    def radius_of_gyration(self) -> float:
        """sqrt(inertia / mass), in m."""
        return math.sqrt(self.inertia / self.mass)

    @property
    def gamma(self) -> float:
        """Ratio m R^2 / I with the support's radius R: 2 for a uniform disk, 1 for a thin ring."""
        return self.mass * self.support_radius**2 / self.inertia

    def boundary(self, angle: ArrayLike) -> Array:
        """Return the points (..., 2) on the boundary, in m, at the angles ``angle`` (rad) about the
        centre of mass."""
        raise NotImplementedError

    def normal(self, angle: ArrayLike) -> Array:
        """Return the outward unit normals (..., 2) at the points that :meth:`boundary` returns for
        these angles."""
        raise NotImplementedError


@dataclass(frozen=True)
class _Round(Body):
    radius: float
    mass: float
    height: float

    def __post_init__(self) -> None:
        _check_positive(self, radius="m", mass="kg", height="m")

    @property
    def support_radius(self) -> float:
        return self.radius

    @property
    def bounding_radius(self) -> float:
        return self.radius

    def boundary(self, angle: ArrayLike) -> Array:
        return self.radius * self.normal(angle)

    def normal(self, angle: ArrayLike) -> Array:
        return unit(np.asarray(angle, dtype=float))


class Disk(_Round):
    """A uniform disk: ``radius`` and ``height`` in m, ``mass`` in kg.

    Raises :class:`InvalidBodyError` for a value that is not finite and positive.
    """

    support: ClassVar[str] = "disk"

    @property
    def inertia(self) -> float:
        """Moment of inertia of a uniform disk, m R^2 / 2, in kg m^2."""
        return self.mass * self.radius**2 / 2


class Ring(_Round):
    """A thin ring supported on its whole rim: ``radius`` and ``height`` in m, ``mass`` in kg.

    Raises :class:`InvalidBodyError` for a value that is not finite and positive.
    """

    support: ClassVar[str] = "ring"

    @property
    def inertia(self) -> float:
        """Moment of inertia of a thin ring, m R^2, in kg m^2."""
        return self.mass * self.radius**2


@dataclass(frozen=True)
class Polygon(Body):
    """A uniform convex polygon supported on its whole face.

    ``vertices`` (N, 2) in m may be in clockwise or counter-clockwise order; they are stored
    counter-clockwise, with the centre of mass as origin. ``mass`` is in kg and ``height`` in m.
    Raises :class:`InvalidBodyError` for fewer than three vertices, a repeated vertex, a polygon
    that crosses itself or is not convex, zero area, and values that are not both finite and
    positive.
    """

    vertices: tuple[tuple[float, float], ...]
    mass: float
    height: float
    support: ClassVar[str] = "disk"

    def __post_init__(self) -> None:
        _check_positive(self, mass="kg", height="m")
        points = _convex(self.vertices)
        points = points - _area_moments(points)[1]
        object.__setattr__(self, "vertices", tuple((float(x), float(y)) for x, y in points))

    @cached_property
    def points(self) -> Array:
        """The vertices as an array (N, 2), counter-clockwise, in m."""
        return np.array(self.vertices)

    @cached_property
    def edge_normals(self) -> Array:
        """Outward unit normals (N, 2) of the edges; edge i runs from vertex i to i + 1."""
        edges = np.roll(self.points, -1, axis=0) - self.points
        tangents = edges / np.linalg.norm(edges, axis=1, keepdims=True)
        return to_right(tangents)

    @cached_property
    def edge_lengths(self) -> Array:
        """Lengths (N,) of the edges, in m."""
        return np.asarray(
            np.linalg.norm(np.roll(self.points, -1, axis=0) - self.points, axis=1), dtype=float
        )

    @cached_property
    def area(self) -> float:
        """Area of the face, in m^2."""
        return _area_moments(self.points)[0]

    @cached_property
    def second_moments(self) -> Array:
        """Mean of r r^T over the face, (2, 2), in m^2."""
        return _area_moments(self.points)[2]

    @property
    def inertia(self) -> float:
        """Moment of inertia: the mass times the mean of r^2 over the face, in kg m^2."""
        return self.mass * float(np.trace(self.second_moments))

    @property
    def support_radius(self) -> float:
        """Radius of the disk with the same radius of gyration, in m."""
        return math.sqrt(2.0) * self.radius_of_gyration

    @property
    def bounding_radius(self) -> float:
        """Maximum distance of a vertex from the centre of mass, in m."""
        return float(np.hypot(*self.points.T).max())

    def equivalent_disk(self) -> Disk:
        """Return the disk of the same mass, height and radius of gyration.

        For a square whose R omega is at most v at the launch, the disk's slide has errors of up to
        1 % of the distance and 4 % of the rotation, and it neglects a sideways drift of up to 1.5 %
        of the distance (tested). For elongated shapes the disk is a poor approximation.
        """
        return Disk(self.support_radius, self.mass, self.height)

    def boundary(self, angle: ArrayLike) -> Array:
        """Return the points at which rays from the centre of mass at the angles ``angle`` (rad)
        leave the face."""
        ray = unit(np.asarray(angle, dtype=float))
        return np.asarray(self._exit(ray)[0][..., None] * ray)

    def normal(self, angle: ArrayLike) -> Array:
        """Return the outward unit normals of the edges at the points that :meth:`boundary`
        returns."""
        edge = self._exit(unit(np.asarray(angle, dtype=float)))[1]
        return np.asarray(self.edge_normals[edge])

    def _exit(self, ray: Array) -> tuple[Array, NDArray[np.intp]]:
        """Compute the distances at which rays from the centre leave the face, and the indices of
        the edges that they cross."""
        closing = ray @ self.edge_normals.T
        support = np.einsum("ij,ij->i", self.points, self.edge_normals)
        with np.errstate(divide="ignore"):
            distance = np.where(closing > 0, support / np.where(closing > 0, closing, 1), np.inf)
        return distance.min(axis=-1), distance.argmin(axis=-1)


def _check_positive(body: Body, **units: str) -> None:
    """Convert these attributes of a body to float; raise an exception unless all are positive."""
    for name, unit_name in units.items():
        title = f"{type(body).__name__.lower()} {name}"
        value = positive(title, getattr(body, name), unit_name, InvalidBodyError)
        object.__setattr__(body, name, value)


def _convex(vertices: Iterable[Iterable[float]]) -> Array:
    """Return the vertices as a validated, counter-clockwise array."""
    try:
        raw = np.array([tuple(v) for v in vertices], dtype=float)
    except (TypeError, ValueError) as problem:
        raise InvalidBodyError(
            f"polygon vertices are {vertices!r}; they must be pairs of numbers, shape (N, 2)."
        ) from problem
    if raw.ndim != 2 or raw.shape[1] != 2 or raw.shape[0] < 3:
        raise InvalidBodyError(
            f"polygon vertices have shape {raw.shape}; they must be (N, 2) with N at least 3."
        )
    points = finite("polygon vertices", raw, "m", InvalidBodyError)
    points = points - points.mean(axis=0)  # moments about a distant origin lose accuracy
    edges = np.roll(points, -1, axis=0) - points
    lengths = np.hypot(*edges.T)
    size = float(lengths.max())
    if lengths.min() <= 1e-9 * size:
        i = int(lengths.argmin())
        raise InvalidBodyError(
            f"polygon vertex {i} at {raw[i].tolist()} m appears twice; delete it. The outline is "
            "closed without a repetition of its first vertex."
        )
    following = np.roll(edges, -1, axis=0)
    turn = np.arctan2(cross(edges, following), np.einsum("ij,ij->i", edges, following))
    corner = np.roll(np.arange(len(points)), -1)
    if turn.sum() < 0:
        points = points[::-1]
        turn, corner = -turn[::-1], corner[::-1]
    straight = 1e-9
    if turn.min() < -straight or turn.max() > math.pi - straight:
        i = int(turn.argmin() if turn.min() < -straight else turn.argmax())
        raise InvalidBodyError(
            f"polygon turns by {math.degrees(turn[i]):.6g} degrees at vertex {corner[i]} "
            f"{raw[corner[i]].tolist()}, counted from 0; a convex polygon turns by 0 to 180 "
            "degrees at each vertex; give the vertices in their order along the outline."
        )
    winding = turn.sum() / (2 * math.pi)
    if abs(winding - 1) > 1e-6:
        raise InvalidBodyError(
            f"polygon winds {winding:.3g} times around its centre, so its edges cross; give the "
            "vertices in their order along the outline."
        )
    area = _area_moments(points)[0]
    if area <= 1e-12 * size**2:
        raise InvalidBodyError(f"polygon area is {area:.3g} m^2; it must be above 0.")
    return np.asarray(points)


def _area_moments(points: Array) -> tuple[float, Array, Array]:
    """Compute area, centroid and mean of r r^T about the origin, by sums over the triangles between
    the origin and the edges."""
    following = np.roll(points, -1, axis=0)
    double = cross(points, following)
    area = float(double.sum() / 2)
    total = points + following
    centroid = double @ total / (6 * area)
    outer = (
        np.einsum("ni,nj->nij", points, points)
        + np.einsum("ni,nj->nij", following, following)
        + np.einsum("ni,nj->nij", total, total)
    )
    moments = np.einsum("n,nij->ij", double, outer) / (24 * area)
    return area, centroid, moments
