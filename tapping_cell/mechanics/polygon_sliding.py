"""Sliding of a convex polygon with uniform pressure, by numerical integration.

A polygon's friction depends on the direction of travel in the body, and the body rotates as it
slides. A table in one variable, as for a round body, is therefore not enough. The friction itself
has a closed form. With the instantaneous centre of rotation c, every point r moves at right angles
to r - c, and over a face of area A

    mean of (r - c) / |r - c|  = (1 / A) sum over edges of n J,   J = int |r - c| ds,
    mean of |r - c|            = (1 / 3 A) sum of d J,            d = (edge - c) . n,
    2 J = s2 r2 - s1 r1 + d^2 ln((r1 + r2 + L) / (r1 + r2 - L)),

by the divergence theorem, as in Goyal, Ruina and Papadopoulos (Wear 143, 1991). The classic
Runge-Kutta method integrates the motion over the logarithm of the velocity's magnitude, because a
slide is smooth in this variable until its end. Compared with a brute-force sum over a grid of
friction points, the relative error is 1e-4. The tests require only 1e-3, because the grid in the
tests is no more accurate. The relative error of the inverse is 1e-11.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics.bodies import Polygon
from tapping_cell.mechanics.errors import MechanicsError, finite
from tapping_cell.mechanics.planar import Array, cross, rotate
from tapping_cell.mechanics.round_sliding import RoundSlide
from tapping_cell.mechanics.slide_results import Launch, Profile, Rest

_STEP = 0.08
_STEPS = 80
# Ratio of speed to spin, in multiples of the radius of gyration, above which quadrature replaces
# the closed form. The rounding error of the closed form grows with the cube of this ratio and is
# 1e-11 at this value. Above this value, the integrand is so smooth that a few points give full
# accuracy.
_FAR = 50.0
_FAR_POINTS = 4
_TINY = 1e-300
_INVERSE_STEPS = 40
_SIMPLE_STEPS = 400
# The tolerance of a component of a displacement is relative to the component or to this fraction of
# the largest component, whichever is larger.
_SMALLEST_SHARE = 1e-3


class PolygonSlide:
    """Slides of one polygon, in the body's axes at the launch. ``deceleration`` is mu g in
    m/s^2."""

    _chunk = 512
    """Number of slides computed at once."""
    _inverse_tolerance = 5e-11
    """Relative error of a displacement below which the inverse makes only one more step."""
    _inverse_limit = 5e-11
    """Relative error of a displacement that is accepted if the inverse does not converge."""

    def __init__(
        self, polygon: Polygon, deceleration: float, torque_factor: float, disk: RoundSlide
    ) -> None:
        """Prepare the edges and the quadrature; ``disk`` is the slide of the equivalent disk."""
        self._disk = disk
        self._deceleration = deceleration
        self._torque_factor = torque_factor
        self._gyration = polygon.radius_of_gyration
        self._start = polygon.points.T[:, :, None]
        self._length = polygon.edge_lengths[:, None]
        normal = polygon.edge_normals.T[:, :, None]
        self._tangent = np.stack([-normal[1], normal[0]])
        self._area = polygon.area
        self._points, self._weights = _quadrature(polygon)

    def rest(self, speed: ArrayLike, spin: ArrayLike, direction: ArrayLike = 0.0) -> Rest:
        """Compute where and when slides with these launch velocities end, with the drift to the
        left of ``direction``."""
        v, w, a = _broadcast(("speed", speed), ("spin", spin), ("direction", direction))
        moved, duration = self._slide(_twists(v.ravel(), w.ravel(), a.ravel()))
        along, left = rotate(moved, -a.ravel()).T
        values = [_scalar(x.reshape(v.shape)) for x in (along, moved[:, 2], duration, left)]
        result = Rest(*values[:3])
        result.lateral = values[3]
        return result

    def launch(
        self, distance: ArrayLike, rotation: ArrayLike, direction: ArrayLike = 0.0
    ) -> Launch:
        """Compute the launches along ``direction`` that end after these displacements."""
        x, theta, a = _broadcast(
            ("distance", distance), ("rotation", rotation), ("direction", direction)
        )
        angle = a.ravel()
        target = np.stack([x.ravel(), theta.ravel()], axis=1)

        def twists(z: Array, rows: NDArray[np.intp]) -> Array:
            speed, spin = self._disk.launch(z[:, 0], z[:, 1])
            return _twists(np.asarray(speed), np.asarray(spin), angle[rows])

        def forward(z: Array, rows: NDArray[np.intp]) -> Array:
            moved, _ = self._slide(twists(z, rows))
            return np.stack([rotate(moved, -angle[rows])[:, 0], moved[:, 2]], axis=1)

        scale = self._scale(x.ravel(), theta.ravel())[:, 1:]
        nearby = invert(forward, target, scale, self._inverse_tolerance, self._inverse_limit)
        twist = twists(nearby, np.arange(angle.size))
        speed = rotate(twist, -angle)[:, 0]
        return Launch(_scalar(speed.reshape(x.shape)), _scalar(twist[:, 2].reshape(x.shape)))

    def displace(self, twist: Array) -> Array:
        """Compute the displacements (n, 3) caused by launches (n, 3)."""
        return self._slide(twist)[0]

    def twist_for(self, displacement: Array) -> Array:
        """Compute the launches (n, 3) that cause displacements (n, 3)."""
        scale = self._scale(np.hypot(displacement[:, 0], displacement[:, 1]), displacement[:, 2])
        nearby = invert(
            lambda z, _: self.displace(self._disk.twist_for(z)),
            displacement,
            scale,
            self._inverse_tolerance,
            self._inverse_limit,
        )
        return self._disk.twist_for(nearby)

    def profile(self, speed: Array, spin: Array, direction: Array, times: Array) -> Profile:
        """Compute the motion of launches (n,) along the directions at times (k,); results (n,
        k)."""
        velocity, moved = self._path(_twists(speed, spin, direction), times)
        return Profile(
            times=times,
            speed=rotate(velocity, -direction[:, None])[..., 0],
            spin=velocity[..., 2],
            distance=rotate(moved, -direction[:, None])[..., 0],
            rotation=moved[..., 2],
        )

    def _scale(self, distance: Array, rotation: Array) -> Array:
        """Return the scales (n, 3) by which the inverse divides the components of displacements."""
        x, s = np.abs(distance), np.abs(self._gyration * rotation)
        least = np.where((x > 0) | (s > 0), _SMALLEST_SHARE * np.maximum(x, s), 1.0)
        x, s = np.maximum(x, least), np.maximum(s, least)
        return np.stack([x, x, s / self._gyration], axis=1)

    def _slide(self, twist: Array) -> tuple[Array, Array]:
        """Compute displacements (n, 3), m and rad, and durations (n,) of launches (n, 3), m/s and
        rad/s."""
        moved, duration = np.empty(twist.shape), np.empty(len(twist))
        for begin in range(0, len(twist), self._chunk):
            part = slice(begin, begin + self._chunk)
            moved[part], duration[part] = self._slide_part(twist[part])
        return moved, duration

    def _slide_part(self, twist: Array) -> tuple[Array, Array]:
        """Compute :meth:`_slide` for at most ``_chunk`` launches."""
        state, _ = self._integrate(twist)
        return state[:3].T, state[3]

    def _path(self, twist: Array, times: Array) -> tuple[Array, Array]:
        """Compute velocities and displacements, each (n, k, 3), of launches (n, 3) at times
        (k,)."""
        velocity = np.zeros((len(twist), times.size, 3))
        moved = np.zeros_like(velocity)
        final, steps = self._integrate(twist)
        knots = np.stack([step[0] for step in steps] + [final])  # (steps + 1, 4, n)
        speeds = np.stack([step[1] for step in steps] + [np.zeros_like(final[:3])])
        for i in range(len(twist)):
            t = knots[:, 3, i]
            if t[-1] <= 0:
                continue
            at = np.minimum(times, t[-1])
            row = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
            width = t[row + 1] - t[row]
            u = (at - t[row]) / np.where(width > 0, width, 1.0)
            v0, v1 = speeds[row, :, i].T, speeds[row + 1, :, i].T
            x0, x1 = knots[row, :3, i].T, knots[row + 1, :3, i].T
            # Cubic interpolation of the displacement, with the velocities at the knots as slopes.
            a = v0 * width
            c = 3 * (x1 - x0) - (2 * v0 + v1) * width
            d = 2 * (x0 - x1) + (v0 + v1) * width
            moved[i] = (x0 + u * (a + u * (c + u * d))).T
            rate = (a + u * (2 * c + 3 * u * d)) / np.where(width > 0, width, 1.0)
            velocity[i] = np.where(times[:, None] >= t[-1], 0.0, rate.T)
        return velocity, moved

    def friction(self, vx: Array, vy: Array, spin: Array) -> tuple[Array, Array, Array]:
        """Compute the means, over the face, of the unit vector of motion (x, y) and of its moment
        (m).

        The arguments are the velocities (n,) of the centre of mass in the body's axes and the spins
        (n,); at least one of the three must differ from zero. The friction force is -mu m g times
        the first two means; the torque is -mu m g times the third.
        """
        speed = np.hypot(vx, vy)
        far = speed > _FAR * self._gyration * np.abs(spin)
        safe = np.where(far, 1.0, spin)
        cx, cy = np.where(far, 0.0, -vy) / safe, np.where(far, 0.0, vx) / safe
        tx, ty = self._tangent
        x, y = self._start[0] - cx, self._start[1] - cy
        height = x * ty - y * tx
        along = x * tx + y * ty
        here = np.sqrt(x * x + y * y)
        there = np.roll(here, -1, axis=0)
        both = here + there
        length = self._length
        logarithm = np.log((both + length) / np.maximum(both - length, _TINY))
        integral = ((along + length) * there - along * here + height * height * logarithm) / 2
        sign = np.sign(spin) / self._area
        mean_x, mean_y = sign * (integral * tx).sum(axis=0), sign * (integral * ty).sum(axis=0)
        moment = sign * (height * integral).sum(axis=0) / 3 + cx * mean_y - cy * mean_x
        if far.any():
            outer = self._far_friction(vx[far], vy[far], spin[far])
            mean_x[far], mean_y[far], moment[far] = outer
        return mean_x, mean_y, moment

    def _far_friction(self, vx: Array, vy: Array, spin: Array) -> tuple[Array, Array, Array]:
        """Compute the friction as :meth:`friction` does, but by quadrature, with formulas that
        remain accurate down to zero spin."""
        speed = np.hypot(vx, vy)
        q = spin / speed
        ex, ey = vx / speed, vy / speed
        x, y = self._points
        # Per unit of the centre's travel, a point moves 1 + q a forwards and q b to the left.
        b = x * ex + y * ey
        a = x * ey - y * ex
        ahead, left = 1 + q * a, q * b
        square = left * left
        size = np.sqrt(ahead * ahead + square)
        left /= size
        ahead += size
        ahead *= size
        square /= ahead  # 1 minus the forward component of the unit vector of motion
        loss, turn = -(self._weights @ square), self._weights @ left
        b *= left
        a *= square
        b -= a
        moment = self._weights @ b
        return ex * (1 + loss) - ey * turn, ey * (1 + loss) + ex * turn, moment

    def rates(self, unit: Array, angle: Array) -> tuple[Array, Array]:
        """Compute the friction (3, n) on a body, and the component of this friction along the
        velocity.

        ``unit`` is the velocity (vx, vy, gyration * omega), scaled to unit length, in the axes of
        the launch. The body has rotated by ``angle`` since the launch.
        """
        cos, sin = np.cos(angle), np.sin(angle)
        mean_x, mean_y, moment = self.friction(
            cos * unit[0] + sin * unit[1], cos * unit[1] - sin * unit[0], unit[2] / self._gyration
        )
        force = np.stack(
            [
                cos * mean_x - sin * mean_y,
                sin * mean_x + cos * mean_y,
                self._torque_factor * moment / self._gyration,
            ]
        )
        return force, (force * unit).sum(axis=0)

    def _integrate(self, twist: Array) -> tuple[Array, list[tuple[Array, Array]]]:
        """Integrate launches to rest. Return the final (dx, dy, dtheta, t), (4, n), and the (state,
        velocity) at each step."""
        scale = np.array([1.0, 1.0, self._gyration])[:, None]
        start = twist.T * scale
        size0 = np.sqrt((start**2).sum(axis=0))
        moving = size0 > 0
        unit: Array = np.where(moving, start / np.where(moving, size0, 1.0), [[1.0], [0.0], [0.0]])
        per_size = size0 / self._deceleration

        def slope(length: float, unit: Array, state: Array) -> tuple[Array, Array]:
            force, loss = self.rates(unit, state[2])
            size = np.exp(-length)
            time = per_size * size / loss
            return unit - force / loss, np.stack([*(unit / scale * size0 * size * time), time])

        state: Array = np.zeros((4, len(twist)))
        steps: list[tuple[Array, Array]] = []
        for i in range(_STEPS):
            at = i * _STEP
            steps.append((state, unit / scale * (size0 * np.exp(-at))))
            unit, state = runge_kutta(slope, at, _STEP, unit, state)
        # The last part of the motion, a few millionths of the displacement, is computed with
        # constant friction.
        size = np.exp(-_STEPS * _STEP)
        _, loss = self.rates(unit, state[2])
        time = per_size * size / loss
        tail = np.stack([*(unit / scale * size0 * size * time / 2), time])
        return np.asarray(np.where(moving, state + tail, 0.0)), steps


def runge_kutta(
    slope: Callable[[Any, Array, Array], tuple[Array, Array]],
    at: float | Array,
    step: float | Array,
    unit: Array,
    state: Array,
) -> tuple[Array, Array]:
    """Advance a unit vector (3, n) and a state (4, n) by one step of the classic Runge-Kutta
    method. ``slope`` computes the derivatives of both from three arguments: the integration
    variable (``at`` at the beginning of the step), the unit vector and the state."""
    a, p = slope(at, unit, state)
    b, q = slope(at + step / 2, unit + step / 2 * a, state + step / 2 * p)
    c, r = slope(at + step / 2, unit + step / 2 * b, state + step / 2 * q)
    d, s = slope(at + step, unit + step * c, state + step * r)
    unit = unit + step / 6 * (a + 2 * b + 2 * c + d)
    unit = unit / np.sqrt((unit**2).sum(axis=0))
    return unit, state + step / 6 * (p + 2 * q + 2 * r + s)


def invert(
    forward: Callable[[Array, NDArray[np.intp]], Array],
    target: Array,
    scale: Array,
    tolerance: float,
    limit: float,
) -> Array:
    """Solve forward(z, rows) = target[rows], (n, k), by Broyden's method; ``forward`` must be close
    to the identity.

    ``scale`` (n, k) normalises the columns. A row within ``tolerance`` takes one last step, which
    reduces its error further. Broyden's method may cycle at a kink of ``forward``, for example
    between two cells of a table; such rows are solved by a fixed-point iteration, which is slow but
    reliable. ``forward`` may jump at the solution, for example where its number of integration
    steps changes; in this case, rows within ``limit`` are accepted. Raises :class:`MechanicsError`
    if a row does not converge.
    """
    goal = target / scale
    z = goal.copy()
    rows: NDArray[np.intp] = np.arange(len(goal))
    residual = forward(z * scale, rows) / scale - goal
    inverse = np.broadcast_to(np.eye(goal.shape[1]), (*goal.shape, goal.shape[1])).copy()
    error = np.full(len(goal), np.inf)
    for _ in range(_INVERSE_STEPS):
        # A row within the tolerance takes one last step, which reduces its error to rounding
        # errors.
        left = error > tolerance
        rows, residual, inverse = rows[left], residual[left], inverse[left]
        error = np.abs(residual).max(axis=1, initial=0.0)
        if not rows.size:
            return z * scale
        step = -np.einsum("nij,nj->ni", inverse, residual)
        z[rows] += step
        fresh = forward(z[rows] * scale[rows], rows) / scale[rows] - goal[rows]
        change = fresh - residual
        image = np.einsum("nij,nj->ni", inverse, change)
        across = np.einsum("ni,nij->nj", step, inverse)
        bottom = (across * change).sum(axis=1)
        bottom = np.where(np.abs(bottom) > _TINY, bottom, np.inf)
        inverse += (step - image)[:, :, None] * across[:, None, :] / bottom[:, None, None]
        residual = fresh
    z[rows] = goal[rows]
    for _ in range(_SIMPLE_STEPS):
        residual = forward(z[rows] * scale[rows], rows) / scale[rows] - goal[rows]
        if np.abs(residual).max() <= tolerance:
            return z * scale
        z[rows] -= residual
    if np.abs(residual).max() <= limit:
        return z * scale
    raise MechanicsError(
        "the initial velocity of the polygon for this displacement was not found: the relative "
        f"error of the displacement is {float(np.abs(residual).max()):.3g} after {_SIMPLE_STEPS} "
        f"steps (limit {limit:g})."
    )


def _quadrature(polygon: Polygon) -> tuple[Array, Array]:
    """Return points (2, k, 1) and weights (k,) for the mean over the face, by Gauss quadrature in
    the triangles from the centre to the edges."""
    roots, halves = np.polynomial.legendre.leggauss(_FAR_POINTS)
    nodes, weights = (roots + 1) / 2, halves / 2
    a, b = polygon.points, np.roll(polygon.points, -1, axis=0)
    double = cross(a, b)
    chord = a[:, None, :] + (b - a)[:, None, :] * nodes[:, None]
    points = chord[:, :, None, :] * nodes[:, None]
    mass = double[:, None, None] * weights[:, None] * (weights * nodes) / polygon.area
    return points.reshape(-1, 2).T[:, :, None], mass.ravel()


def _broadcast(*named: tuple[str, ArrayLike]) -> list[Array]:
    return list(np.broadcast_arrays(*(finite(name, value) for name, value in named)))


def _twists(speed: Array, spin: Array, direction: Array) -> Array:
    return np.stack([speed * np.cos(direction), speed * np.sin(direction), spin], axis=-1)


def _scalar(values: Array) -> float | Array:
    return float(values) if values.ndim == 0 else values
