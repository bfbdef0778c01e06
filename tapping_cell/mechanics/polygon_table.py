"""Sliding of a polygon from a table: a million slides per second instead of thousands.

In units of the radius of gyration rho and of the deceleration mu g, a slide depends on three
numbers: the direction alpha of the launch in the body, the angle phi = atan(rho omega / v) for the
ratio of spin to speed, and the size s = N^2 / (mu g rho) with N^2 = v^2 + rho^2 omega^2. The size
determines how much the body rotates while it slides. The table holds four functions of alpha, phi
and s, in the axes of the launch:

    along = (N^2 / mu g) A,  left = (N^2 / mu g) L,
    rotation = (omega N / mu g) B,  duration = (N / mu g) D.

For each function, the table stores the difference from the same function of the equivalent disk.
The disk's function contains the part that is not smooth. The table is filled from slow to fast
launches. For a launch of size s, the equations of motion are integrated for a short distance. The
state that is reached is equivalent to a launch of a smaller size. The values for this launch are
already in the table (a semi-Lagrangian scheme). The table is filled with cubic interpolation on a
coarse grid and read with linear interpolation on a finer grid.

The table ends at ``LARGEST_SIZE``. For the paper's objects, this size corresponds to a slide of 100
to 200 mm. A faster launch is integrated by the equations of motion until it is within the table.

Accuracy: 1e-3 of the displacement and 1e-2 of the duration.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from tapping_cell.mechanics.bodies import Polygon
from tapping_cell.mechanics.planar import Array, rotate, turn
from tapping_cell.mechanics.polygon_sliding import PolygonSlide, runge_kutta
from tapping_cell.mechanics.round_sliding import RoundSlide
from tapping_cell.mechanics.slide_table import slide_table

LARGEST_SIZE = 8.0
"""Maximum size s in the table."""

_SIZES = 49
_SIZE_GRADE = 2.0
_LAST_LEVEL = LARGEST_SIZE / (LARGEST_SIZE + _SIZE_GRADE)
_RATIOS = 65
"""Number of values of phi, from pure spin in one direction to pure spin in the other."""
_DIRECTIONS = 72
"""Number of values of alpha for a full turn. For a polygon with rotational symmetry, the table
covers only one period of the symmetry, with fewer values."""
_FEWEST_DIRECTIONS = 12
_FINER = 2
_EDGE = 8
"""Number of directions repeated beyond both ends for the cubic interpolation."""
_STEP = 0.15
_STEPS_TO_REST = 60
_SLOW = 1e-6
_TINY = 1e-12
_FEW_TABLES = 8


class PolygonTable:
    """Displacements of launches of one polygon shape at one torque factor, with rho = mu g = 1."""

    def __init__(self, points: Array, torque_factor: float) -> None:
        """Create the table from the vertices ``points`` (n, 2) in units of the radius of
        gyration."""
        unit = Polygon(tuple(map(tuple, points.tolist())), 1.0, 1.0)
        self._disk = RoundSlide(
            slide_table(unit.support, torque_factor * unit.gamma), 1.0, unit.support_radius
        )
        self._slide = PolygonSlide(unit, 1.0, torque_factor, self._disk)
        self._fold = symmetry(unit)
        count = max(_FEWEST_DIRECTIONS, _DIRECTIONS // self._fold)
        self._shape = _SIZES, _FINER * (_RATIOS - 1) + 1, _FINER * count + 1
        self._table = np.ascontiguousarray(self._finer(self._filled(count)).reshape(4, -1).T)

    def slide(self, twist: Array) -> tuple[Array, Array]:
        """Compute displacements (n, 3) and durations (n,) of launches (n, 3)."""
        beyond = (twist * twist).sum(axis=1) > LARGEST_SIZE
        if not beyond.any():
            return self._lookup(twist)
        moved, duration = self._lookup(np.where(beyond[:, None], 0.0, twist))
        moved[beyond], duration[beyond] = self._slide_into(twist[beyond])
        return moved, duration

    def _slide_into(self, twist: Array) -> tuple[Array, Array]:
        """Compute displacements (n, 3) and durations (n,) of launches beyond the table."""
        square = (twist * twist).sum(axis=1)
        major = np.sqrt(square)
        length = 0.5 * np.log(square / LARGEST_SIZE)
        # The number of steps grows with the size, because a faster body rotates more in a step of
        # the same length.
        steps = math.ceil(float((length * square).max()) / (LARGEST_SIZE * _STEP))
        unit, state = self._advance(twist.T / major, square, length / steps, steps)
        before, turned = square * state[:3], square * state[2]
        # Stay slightly below the limit of the table, so that rounding errors do not exceed it.
        launch = (1.0 - _TINY) * math.sqrt(LARGEST_SIZE) * unit.T
        after, duration = self._lookup(turn(launch, -turned))
        return before.T + turn(after, turned), major * state[3] + duration

    def _lookup(self, twist: Array) -> tuple[Array, Array]:
        """Look up displacements (n, 3) and durations (n,) of launches up to ``LARGEST_SIZE``."""
        vx, vy, spin = twist.T
        speed = np.hypot(vx, vy)
        square = speed * speed + spin * spin
        major = np.sqrt(square)
        factors = self._factors(np.arctan2(spin, speed), np.arctan2(vy, vx), square)
        along, left = square * factors[0], square * factors[1]
        still = speed == 0.0
        safe = np.where(still, 1.0, speed)
        ex, ey = np.where(still, 1.0, vx / safe), vy / safe
        moved = np.stack(
            [ex * along - ey * left, ey * along + ex * left, major * spin * factors[2]], axis=-1
        )
        return moved, major * factors[3]

    def _factors(self, phi: Array, alpha: Array, size: Array) -> Array:
        """Look up A, L, B and D, (4, n), by linear interpolation."""
        levels, ratios, directions = self._shape
        turn = alpha * (self._fold * (directions - 1) / (2 * math.pi))
        turn -= (directions - 1) * np.floor(turn / (directions - 1))
        places = (
            size / (size + _SIZE_GRADE) * ((levels - 1) / _LAST_LEVEL),
            (phi + math.pi / 2) * ((ratios - 1) / math.pi),
            turn,
        )
        rows = [
            np.minimum(p.astype(np.intp), n - 2) for p, n in zip(places, self._shape, strict=True)
        ]
        share = [place - row for place, row in zip(places, rows, strict=True)]
        base = (rows[0] * ratios + rows[1]) * directions + rows[2]
        found = np.zeros((phi.size, 4))
        for level, size_weight in ((0, 1 - share[0]), (ratios * directions, share[0])):
            for ratio, ratio_weight in ((0, 1 - share[1]), (directions, share[1])):
                weight = size_weight * ratio_weight
                at = base + (level + ratio)
                found += self._table.take(at, axis=0) * (weight * (1 - share[2]))[:, None]
                found += self._table.take(at + 1, axis=0) * (weight * share[2])[:, None]
        return np.asarray(found.T + self._disk_factors(phi))

    def _disk_factors(self, phi: Array) -> Array:
        """Compute A, L, B and D of the equivalent disk, (4, n)."""
        cos, sin = np.maximum(np.cos(phi), _TINY), np.sin(phi)
        sin = np.where(np.abs(sin) < _TINY, _TINY, sin)
        distance, rotation, duration = self._disk.rest(cos, sin)
        return np.stack([distance, np.zeros_like(cos), rotation / sin, duration])

    def _filled(self, count: int) -> Array:
        """Compute the values on the coarse grid, (4, sizes, ratios, directions)."""
        directions = np.arange(count) * (2 * math.pi / self._fold / count)
        ratios = np.linspace(-math.pi / 2, math.pi / 2, _RATIOS)
        ratios = np.clip(ratios, _SLOW - math.pi / 2, math.pi / 2 - _SLOW)
        ratios[_RATIOS // 2] = _SLOW
        phi, alpha = (axis.ravel() for axis in np.meshgrid(ratios, directions, indexing="ij"))
        levels = np.linspace(0.0, _LAST_LEVEL, _SIZES)
        sizes = _SIZE_GRADE * levels / (1.0 - levels)
        table = np.empty((4, _SIZES, _RATIOS, count))
        for index, size in enumerate(sizes.tolist()):
            # A slide is integrated until it reaches the previous size, whose values are known. For
            # the first two sizes it is integrated until the object rests: the first size is 0 and
            # has no previous size, and a slide of the second size reaches size 0 only at rest.
            known = table[:, index - 1] if index > 1 else None
            length = 0.5 * math.log(size / sizes[index - 1]) if index > 1 else 0.0
            level = self._level(phi, alpha, size, length, known)
            table[:, index] = level.reshape(4, _RATIOS, count)
        return table

    def _level(
        self, phi: Array, alpha: Array, size: float, length: float, known: Array | None
    ) -> Array:
        """Compute the values of one size on the grid.

        ``known`` holds the values of the smaller size that is reached when the logarithm of N has
        decreased by ``length``; if it is None, the motion is integrated until the object rests.
        """
        unit = np.stack([np.cos(phi) * np.cos(alpha), np.cos(phi) * np.sin(alpha), np.sin(phi)])
        steps = _STEPS_TO_REST if known is None else max(1, math.ceil(length / _STEP))
        step = _STEP if known is None else length / steps
        end, moved = self._advance(unit, size, step, steps)
        if known is not None:
            turned = size * moved[2]
            vx, vy = rotate(end[:2].T, -turned).T
            speed = np.hypot(vx, vy)
            a, left, b, d = self._cubic(np.arctan2(end[2], speed), np.arctan2(vy, vx), known)
            ex, ey = vx / speed, vy / speed
            rest = np.stack([ex * a - ey * left, ey * a + ex * left, end[2] * b], axis=-1)
            moved[:3] += math.exp(-2 * length) * turn(rest, turned).T
            moved[3] += math.exp(-length) * d
        along, left = rotate(moved[:2].T, -alpha).T
        made = np.stack([along, left, moved[2] / np.sin(phi), moved[3]])
        return np.asarray(made - self._disk_factors(phi))

    def _advance(
        self, unit: Array, size: float | Array, step: float | Array, steps: int
    ) -> tuple[Array, Array]:
        """Integrate the slide over steps of the logarithm of N.

        Returns the velocity (3, n) after the steps, scaled to unit length and in the axes of the
        start, and an array (4, n) of the displacement divided by N^2 and the time divided by N.
        Sizes and steps are scalars or (n,).
        """

        def slope(length: float | Array, unit: Array, state: Array) -> tuple[Array, Array]:
            force, loss = self._slide.rates(unit, size * state[2])
            left = np.exp(-length)
            time = left / loss
            return unit - force / loss, np.stack([*(unit * (left * time)), time])

        state: Array = np.zeros((4, unit.shape[1]))
        for index in range(steps):
            unit, state = runge_kutta(slope, index * step, step, unit, state)
        return unit, state

    def _cubic(self, phi: Array, alpha: Array, known: Array) -> Array:
        """Interpolate A, L, B and D, (4, n), in the values of one size (4, ratios, directions)."""
        from scipy.ndimage import map_coordinates  # not at the top: most nodes never use it

        count = known.shape[2]
        turn = alpha * (self._fold * count / (2 * math.pi))
        turn -= count * np.floor(turn / count)
        place = [(phi + math.pi / 2) * ((_RATIOS - 1) / math.pi), turn + _EDGE]
        found = [map_coordinates(part, place, order=3, mode="nearest") for part in _around(known)]
        return np.asarray(np.stack(found) + self._disk_factors(phi))

    def _finer(self, table: Array) -> Array:
        """Interpolate the coarse table to the finer grid. In the finer grid, the last direction
        repeats the first."""
        from scipy.ndimage import map_coordinates

        _, ratios, directions = self._shape
        grid = np.meshgrid(
            np.linspace(0, _RATIOS - 1, ratios),
            np.linspace(0, table.shape[3], directions) + _EDGE,
            indexing="ij",
        )
        return np.stack(
            [
                [map_coordinates(level, grid, order=3, mode="nearest") for level in part]
                for part in _around(table)
            ]
        )


def _around(table: Array) -> Array:
    """Extend a table periodically: repeat some directions beyond both ends."""
    return np.concatenate([table[..., -_EDGE:], table, table[..., : _EDGE + 1]], axis=-1)


def symmetry(polygon: Polygon) -> int:
    """Count the rotations, up to a full turn, that map a polygon onto itself."""
    points = polygon.points
    near = 1e-9 * polygon.bounding_radius
    for fold in range(len(points), 1, -1):
        if len(points) % fold:
            continue
        cos, sin = math.cos(2 * math.pi / fold), math.sin(2 * math.pi / fold)
        turned = points @ np.array([[cos, sin], [-sin, cos]])
        off = turned - np.roll(points, -(len(points) // fold), axis=0)
        if float(np.hypot(off[:, 0], off[:, 1]).max()) < near:
            return fold
    return 1


@lru_cache(maxsize=_FEW_TABLES)
def _kept(points: tuple[tuple[float, float], ...], torque_factor: float) -> PolygonTable:
    return PolygonTable(np.array(points), torque_factor)


class TabulatedPolygonSlide(PolygonSlide):
    """Slides of one polygon from its table."""

    _chunk = 16384
    """Number of slides looked up at once, chosen so that they fit in the cache."""
    _inverse_tolerance = 1e-7
    """Relative error below which the inverse makes one last step, which reduces the error to 1e-8,
    far below the error of the table."""
    _inverse_limit = 1e-3
    """Relative error that is accepted if the inverse does not converge: the error of the table.
    Beyond the table, an exact solution may not exist, because slides jump by up to 1e-4 of their
    size where the number of integration steps changes."""

    def __init__(
        self, polygon: Polygon, deceleration: float, torque_factor: float, disk: RoundSlide
    ) -> None:
        """Create the table, or take the cached one for this shape and torque factor."""
        super().__init__(polygon, deceleration, torque_factor, disk)
        rho = polygon.radius_of_gyration
        # Normalised and rounded, so that equal shapes of any scale or position use the same table.
        shape = tuple(map(tuple, np.round(polygon.points / rho, 10).tolist()))
        self._table = _kept(shape, round(torque_factor, 10))
        self._unit_speed = math.sqrt(deceleration * rho)
        self._unit_time = math.sqrt(rho / deceleration)

    def _slide_part(self, twist: Array) -> tuple[Array, Array]:
        scale = np.array([1.0, 1.0, self._gyration]) / self._unit_speed
        reduced, time = self._table.slide(twist * scale)
        return reduced * np.array([self._gyration, self._gyration, 1.0]), time * self._unit_time
