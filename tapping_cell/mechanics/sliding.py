"""How far a launched body slides and turns, and the launch that makes a wanted displacement.

The equations, with R the radius of the support, gamma = m R^2 / I, mu the friction with the table
and kappa the torque factor of Huang and Mason (section 3.1.2):

    dv/dt = -mu g F,   d omega/dt = -kappa gamma (mu g / R) T.

``support_friction`` gives F and T, ``slide_table`` the solution. Everything is in SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics.bodies import Body
from tapping_cell.mechanics.errors import InvalidParameter, finite, positive
from tapping_cell.mechanics.slide_table import SlideTable, slide_table

Array = NDArray[np.float64]

STANDARD_GRAVITY = 9.81
_PROFILE_STEP = 0.04
# Below this share of the duration the ratio of spin and speed stands still to 1e-7 of itself.
_PROFILE_END = -20.0


class _RestFields(NamedTuple):
    distance: float | Array
    rotation: float | Array
    duration: float | Array


class Rest(_RestFields):
    """A slide's end: ``distance`` along the launch in m, ``rotation`` in rad, ``duration`` in s.

    It unpacks into these three. ``lateral`` is the drift to the left of the launch in m: 0 for
    bodies whose friction is the same in all directions.
    """

    lateral: float | Array = 0.0


class Launch(NamedTuple):
    """Velocity with which a slide begins: ``speed`` in m/s, ``spin`` in rad/s."""

    speed: float | Array
    spin: float | Array


class Profile(NamedTuple):
    """A slide in time: arrays of shape (shape of the launches..., shape of the times...).

    ``speed`` in m/s and ``spin`` in rad/s at the times, ``distance`` in m and ``rotation`` in rad
    covered until then.
    """

    times: Array
    speed: Array
    spin: Array
    distance: Array
    rotation: Array


@dataclass(frozen=True)
class Sliding:
    """Sliding of one body on one table.

    ``friction`` is the coefficient with the table, ``torque_factor`` kappa (1 for the plain
    theory), ``gravity`` in m/s^2. Raises :class:`InvalidParameter` for a value that is not finite
    and positive.

    Accuracy of ``rest`` against a tight integration: 1e-9 relative in distance, rotation and
    duration for a disk or a ring at torque factors of 0.2 to 5 (tested at 1e-8; 2e-8 from 0.05
    to 20), for every mix of speed and spin. ``launch`` undoes ``rest`` to rounding.
    """

    body: Body
    friction: float
    torque_factor: float = 1.0
    gravity: float = STANDARD_GRAVITY
    table: SlideTable = field(init=False, repr=False, compare=False)
    _deceleration: float = field(init=False, repr=False, compare=False)
    _radius: float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name, unit in (("friction", ""), ("torque_factor", ""), ("gravity", "m/s^2")):
            value = positive(name.replace("_", " "), getattr(self, name), unit)
            object.__setattr__(self, name, value)
        table = slide_table(self.body.support, self.torque_factor * self.body.gamma)
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "_deceleration", self.friction * self.gravity)
        object.__setattr__(self, "_radius", self.body.support_radius)

    def rest(self, speed: ArrayLike, spin: ArrayLike) -> Rest:
        """Where a launch ends: ``speed`` in m/s, ``spin`` in rad/s, either sign, broadcast.

        Distance and rotation have the signs of speed and spin. Scalars give floats. Raises
        :class:`InvalidParameter` for values that are not finite.
        """
        if isinstance(speed, (float, int)) and isinstance(spin, (float, int)):
            v, w = float(speed), float(spin)
            if not math.isfinite(v + w):
                raise _not_finite("speed and spin", v, w)
            travel, rim_travel, time = self.table.rest(v, w * self._radius)
            g = self._deceleration
            return Rest(travel / g, rim_travel / (g * self._radius), time / g)
        v_all, w_all = np.broadcast_arrays(
            np.asarray(speed, dtype=float), np.asarray(spin, dtype=float)
        )
        rim = w_all.ravel() * self._radius
        travel_all, rim_all, time_all = self.table.rest_many(v_all.ravel(), rim)
        travel_all *= 1 / self._deceleration
        rim_all *= 1 / (self._deceleration * self._radius)
        time_all *= 1 / self._deceleration
        shape = v_all.shape
        return Rest(travel_all.reshape(shape), rim_all.reshape(shape), time_all.reshape(shape))

    def launch(self, distance: ArrayLike, rotation: ArrayLike) -> Launch:
        """The launch that ends after ``distance`` (m) and ``rotation`` (rad), either sign.

        The inverse of :meth:`rest`; every pair is reachable by sliding alone. Raises
        :class:`InvalidParameter` for values that are not finite.
        """
        g = self._deceleration
        if isinstance(distance, (float, int)) and isinstance(rotation, (float, int)):
            x, theta = float(distance), float(rotation)
            if not math.isfinite(x + theta):
                raise _not_finite("distance and rotation", x, theta)
            v, s = self.table.launch(x * g, theta * (g * self._radius))
            return Launch(v, s / self._radius)
        x_all, theta_all = np.broadcast_arrays(
            np.asarray(distance, dtype=float), np.asarray(rotation, dtype=float)
        )
        speed, rim = self.table.launch_many(
            x_all.ravel() * g, theta_all.ravel() * (g * self._radius)
        )
        rim *= 1 / self._radius
        return Launch(speed.reshape(x_all.shape), rim.reshape(x_all.shape))

    def displace(self, twist: ArrayLike) -> Array:
        """The displacement (dx, dy, dtheta) that a launch makes, (..., 3).

        ``twist`` (..., 3) is the launch's (vx, vy, omega) in m/s and rad/s; it and the result are
        in the axes that the body's frame has at the launch.
        """
        t = finite("twist", twist)
        speed = np.hypot(t[..., 0], t[..., 1])
        distance, rotation, _ = self.rest(speed, t[..., 2])
        per_speed = distance / np.where(speed > 0, speed, 1.0)
        return np.stack([per_speed * t[..., 0], per_speed * t[..., 1], rotation], axis=-1)

    def twist_for(self, displacement: ArrayLike) -> Array:
        """The twist (..., 3) whose :meth:`displace` is ``displacement`` (..., 3)."""
        d = finite("displacement", displacement)
        distance = np.hypot(d[..., 0], d[..., 1])
        speed, spin = self.launch(distance, d[..., 2])
        per_distance = speed / np.where(distance > 0, distance, 1.0)
        return np.stack([per_distance * d[..., 0], per_distance * d[..., 1], spin], axis=-1)

    def profile(self, speed: ArrayLike, spin: ArrayLike, times: ArrayLike) -> Profile:
        """Velocities and displacement at ``times`` (s, from the launch, not negative).

        Results have the shape of the broadcast launches followed by that of the times. Accuracy
        1e-7 of the start's values. Raises :class:`InvalidParameter` for values that are not
        finite and for a negative time.
        """
        v0, w0 = np.broadcast_arrays(finite("speed", speed, "m/s"), finite("spin", spin, "rad/s"))
        t = finite("times", times, "s")
        if t.size and t.min() < 0:
            raise InvalidParameter(f"times begin at {t.min():g} s; they must be 0 or more.")
        shape = v0.shape + t.shape
        s0 = w0.ravel() * self._radius
        v, s = _slow_down(self.table, v0.ravel(), s0, t.ravel() * self._deceleration)
        all_travel, all_rim, _ = self.table.rest_many(v0.ravel(), s0)
        left, rim_left, _ = self.table.rest_many(v.ravel(), s.ravel())
        travel = all_travel[:, None] - left.reshape(v.shape)
        rim_travel = all_rim[:, None] - rim_left.reshape(v.shape)
        g, r = self._deceleration, self._radius
        return Profile(
            times=t,
            speed=v.reshape(shape),
            spin=(s / r).reshape(shape),
            distance=(travel / g).reshape(shape),
            rotation=(rim_travel / (g * r)).reshape(shape),
        )


def _slow_down(table: SlideTable, speed: Array, rim_speed: Array, time: Array) -> tuple[Array, Array]:
    """Speed and rim speed, each (launches, times), of launches (n,) at reduced times (k,).

    The ratio of spin and speed is a function of the share of the duration that is left: one
    autonomous equation in its logarithm, stepped by the classic Runge-Kutta method; the size then
    follows from the time left.
    """
    total = table.rest_many(speed, rim_speed)[2]
    left = np.maximum(total[:, None] - time, 0.0)
    v_size, s_size = np.abs(speed), np.abs(rim_speed)
    both = (v_size > 0) & (s_size > 0)
    share = np.where(total[:, None] > 0, left / np.where(total > 0, total, 1.0)[:, None], 0.0)
    log_ratio = _ratio_at(
        table,
        np.log(np.where(both, s_size, 1.0) / np.where(both, v_size, 1.0)),
        np.log(np.maximum(share, math.exp(_PROFILE_END))),
    )
    # Directions of unit size, then the size that takes exactly the time left to stop.
    v_unit = np.exp(np.minimum(-log_ratio, 0.0))
    s_unit = np.exp(np.minimum(log_ratio, 0.0))
    v_unit = np.where(both[:, None], v_unit, (v_size > 0)[:, None] * 1.0)
    s_unit = np.where(both[:, None], s_unit, (s_size > 0)[:, None] * 1.0)
    unit_time = table.rest_many(v_unit.ravel(), s_unit.ravel())[2].reshape(left.shape)
    size = left / np.where(unit_time > 0, unit_time, 1.0)
    return (
        np.copysign(v_unit * size, speed[:, None]),
        np.copysign(s_unit * size, rim_speed[:, None]),
    )


def _ratio_at(table: SlideTable, start: Array, log_left: Array) -> Array:
    """ln(R omega / v) at ln(share of the time left), (n, k), of launches that start at (n,)."""
    steps = max(1, math.ceil(-float(log_left.min(initial=0.0)) / _PROFILE_STEP))
    values = np.empty((steps + 1, start.size))
    rates = np.empty_like(values)
    h = -_PROFILE_STEP
    y = start.copy()
    for i in range(steps + 1):
        values[i] = y
        k1 = rates[i] = table.ratio_rate(y)
        k2 = table.ratio_rate(y + h / 2 * k1)
        k3 = table.ratio_rate(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + table.ratio_rate(y + h * k3))
    place = -log_left / _PROFILE_STEP
    row = np.clip(place.astype(np.intp), 0, steps - 1)
    u = place - row
    column = np.arange(start.size)[:, None]
    y0, y1 = values[row, column], values[row + 1, column]
    d0, d1 = h * rates[row, column], h * rates[row + 1, column]
    return np.asarray(
        y0 + u * (d0 + u * (3 * (y1 - y0) - 2 * d0 - d1 + u * (2 * (y0 - y1) + d0 + d1)))
    )


def _not_finite(name: str, first: float, second: float) -> InvalidParameter:
    return InvalidParameter(f"{name} are {first!r} and {second!r}; both must be finite numbers.")
