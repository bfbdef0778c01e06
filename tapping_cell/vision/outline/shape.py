"""Outlines of objects without a marker: a disk or a convex polygon, optionally with a dot.

All coordinates are in the object's frame, in m. If an outline is symmetric under a rotation (a
disk, a square, a rectangle), an off-centre dot is needed to define its angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.vision.camera import Array

_SAME = 0.03
"""Difference (rms, relative to the mean radius) between an outline and the rotated outline, below
which the outline counts as symmetric under this rotation. The manufacturing tolerance is a tenth of
this value. The remainder allows for hidden parts of the rim."""
ANGLES = 720
"""Number of angles at which radii of a rim are compared."""
_MIN_DOT = 0.002
"""Minimum radius (m) of a dot, and its minimum distance from the rim: three pixels each."""


class OutlineError(ValueError):
    """An outline that cannot be detected or has no defined angle; the message gives the reason."""


def signed_area(corners: Array) -> float:
    """Area of the polygon with these corners (N, 2), in m^2 for corners in m; negative if they are
    listed clockwise."""
    return 0.5 * float(_cross(corners, np.roll(corners, -1, axis=0)).sum())


def centroid(corners: Array) -> Array:
    """Return the centroid (2,) of the polygon with corners (N, 2)."""
    following = np.roll(corners, -1, axis=0)
    cross = _cross(corners, following)
    return np.asarray(((corners + following) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum()))


@dataclass(frozen=True, slots=True)
class Dot:
    """A round dot on the top: radius and centre in m. ``brighter`` is True if it is brighter than
    the top, False if it is darker."""

    radius: float
    offset: tuple[float, float]
    brighter: bool


@dataclass(frozen=True, slots=True)
class ObjectOutline:
    """Visible outline of an object without a marker.

    It is a disk of ``radius`` or a convex polygon of ``vertices`` (counter-clockwise) in m. Its top
    is ``height`` m above the table, with the standard deviation ``height_tolerance``. ``brighter``
    is True if the top is brighter than the table, False if it is darker.
    """

    height: float
    brighter: bool
    radius: float | None = None
    vertices: tuple[tuple[float, float], ...] | None = None
    dot: Dot | None = None
    height_tolerance: float = 0.0

    def __post_init__(self) -> None:
        """Raise OutlineError, with the value and a remedy, if the outline cannot be detected."""
        if (self.radius is None) == (self.vertices is None):
            raise OutlineError(
                "the outline must be either a disk (radius) or a polygon (vertices), but "
                + ("neither is given" if self.radius is None else "both are given")
            )
        if self.vertices is not None:
            _check_convex(np.array(self.vertices))
            # Callers may pass a list; it is converted to a tuple, which is hashable.
            corners = tuple((float(x), float(y)) for x, y in self.vertices)
            object.__setattr__(self, "vertices", corners)
        turns = self.turns()
        if self.dot is None:
            if len(turns) != 1:
                what = "any turn" if not turns else f"a turn of {math.degrees(turns[1]):.0f} deg"
                raise OutlineError(
                    f"the outline looks the same after {what}, so its angle cannot be "
                    "determined: add an off-centre dot ('outline.dot') or a marker"
                )
            return
        self._check_dot(self.dot, turns)

    def _check_dot(self, dot: Dot, turns: tuple[float, ...]) -> None:
        if dot.radius < _MIN_DOT:
            raise OutlineError(
                f"the dot's radius is {dot.radius * 1e3:.1f} mm, but must be at least "
                f"{_MIN_DOT * 1e3:.0f} mm to be seen"
            )
        distance = float(self.distance(np.array([dot.offset]))[0][0])
        if distance > -(dot.radius + _MIN_DOT):
            raise OutlineError(
                f"the dot comes within {max(0.0, -distance - dot.radius) * 1e3:.1f} mm of the rim; "
                f"keep at least {_MIN_DOT * 1e3:.0f} mm between them"
            )
        if len(turns) == 1:
            return
        apart = math.hypot(*(np.array(dot.offset) - self.middle))
        if turns:
            apart *= 2.0 * math.sin(0.5 * min(turns[1], 2.0 * math.pi - turns[-1]))
        if apart < 1.5 * dot.radius:
            raise OutlineError(
                f"the dot is only {apart * 1e3:.1f} mm from "
                + (
                    "where it would be after a turn that leaves the outline unchanged"
                    if turns
                    else "the centre of the round outline"
                )
                + f" (at least {1.5 * dot.radius * 1e3:.1f} mm are needed to determine the angle); "
                "put the dot farther from the centre"
            )

    @property
    def middle(self) -> Array:
        """Centre (2,) of the area in m, which is the centre of symmetry of a symmetric outline."""
        if self.vertices is None:
            return np.zeros(2)
        return centroid(np.array(self.vertices))

    @property
    def area(self) -> float:
        """Area of the top in m^2."""
        if self.vertices is None:
            assert self.radius is not None
            return math.pi * self.radius**2
        return signed_area(np.array(self.vertices))

    @property
    def reach(self) -> float:
        """Maximum distance of the outline from its centre, in m."""
        return _reach(self)

    def points(self, count: int = 72) -> Array:
        """Corners of the polygon, or ``count`` points of the disk's rim, (N, 2)."""
        if self.vertices is not None:
            return np.array(self.vertices)
        assert self.radius is not None
        angle = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
        return self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def distance(self, points: ArrayLike) -> tuple[Array, Array]:
        """Distance of points (..., 2) from the outline in m, negative inside, and its gradient
        (..., 2)."""
        p = np.asarray(points, dtype=float)
        distance, nx, ny = self.distance_at(p[..., 0], p[..., 1])
        return distance, np.stack([nx, ny], axis=-1)

    def distance_at(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Compute :meth:`distance` for points with the coordinates ``x`` and ``y``. Return the
        distance and its derivatives with respect to x and y."""
        if self.vertices is None:
            assert self.radius is not None
            length = np.sqrt(x * x + y * y)
            inverse = 1.0 / np.maximum(length, 1e-12)
            return length - self.radius, x * inverse, y * inverse
        normals, offsets = self.sides()
        distance = np.full(x.shape, -np.inf)
        nearest = np.zeros(x.shape, dtype=np.intp)
        for side, ((nx, ny), offset) in enumerate(zip(normals.tolist(), offsets, strict=True)):
            outside = nx * x + ny * y - offset
            nearest[outside > distance] = side
            np.maximum(distance, outside, out=distance)
        return distance, normals[nearest, 0], normals[nearest, 1]

    def sides(self) -> tuple[Array, Array]:
        """Outward normals (K, 2) of the polygon's sides, and their distances (K,) from the
        origin."""
        assert self.vertices is not None
        return _sides(self.vertices)

    def radii(self, count: int = ANGLES) -> Array:
        """Distances (count,) of the rim from the centre, at angles from 0 to a full turn, in m."""
        angle = np.linspace(0.0, 2.0 * math.pi, count, endpoint=False)
        direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        if self.vertices is None:
            assert self.radius is not None
            return np.full(count, self.radius)
        normals, offsets = self.sides()
        facing = direction @ normals.T
        clearance = offsets - normals @ self.middle
        with np.errstate(divide="ignore"):
            return np.asarray(np.where(facing > 1e-12, clearance / facing, np.inf).min(axis=1))

    def turns(self) -> tuple[float, ...]:
        """Rotations (rad, from 0 to a full turn) under which the outline is unchanged; empty if it
        is unchanged under every rotation."""
        return _turns(self)


@lru_cache(maxsize=64)
def _sides(vertices: tuple[tuple[float, float], ...]) -> tuple[Array, Array]:
    p = np.array(vertices)
    along = np.roll(p, -1, axis=0) - p
    normals = np.stack([along[:, 1], -along[:, 0]], axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals, (normals * p).sum(axis=1)


@lru_cache(maxsize=64)
def _reach(outline: ObjectOutline) -> float:
    return float(np.linalg.norm(outline.points() - outline.middle, axis=1).max())


@lru_cache(maxsize=64)
def _turns(outline: ObjectOutline) -> tuple[float, ...]:
    radii = outline.radii()
    differences = turn_differences(radii, radii) / float(radii.mean())
    same = differences < _SAME
    if same.all():
        return ()
    lowest = (differences <= np.roll(differences, 1)) & (differences <= np.roll(differences, -1))
    step = 2.0 * math.pi / len(differences)
    chosen = [float(k) * step for k in np.flatnonzero(lowest & same)]
    return tuple(turn for turn in chosen if turn == 0.0 or min(turn, 2 * math.pi - turn) > 0.05)


def turn_differences(radii: Array, model: Array) -> Array:
    """Return for every k from 0 to N - 1 the root mean square difference, in m, between radii (N,)
    and the radii (N,) of a model that is rotated by k / N of a full turn."""
    spectrum = np.fft.rfft(radii) * np.conj(np.fft.rfft(model))
    product = np.fft.irfft(spectrum, len(radii)) / len(radii)
    square = float((radii**2).mean() + (model**2).mean())
    return np.asarray(np.sqrt(np.maximum(square - 2.0 * product, 0.0)))


def turns_left(corners: Array) -> bool:
    """Return whether a polygon with corners (N, 2) turns to the left at each corner."""
    along = np.roll(corners, -1, axis=0) - corners
    return bool(np.all(_cross(along, np.roll(along, -1, axis=0)) > 0.0))


def _cross(first: Array, second: Array) -> Array:
    return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])


def _check_convex(vertices: Array) -> None:
    if len(vertices) < 3:
        raise OutlineError(f"a polygon needs 3 corners or more; {len(vertices)} given")
    if not turns_left(vertices):
        raise OutlineError(
            "the polygon must be convex, its corners must be in counter-clockwise order, and no "
            "three successive corners may lie on a line"
        )
