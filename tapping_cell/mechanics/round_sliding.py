"""Sliding of a body with isotropic friction, looked up in the table and converted to SI units."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.mechanics.errors import InvalidParameterError
from tapping_cell.mechanics.planar import Array
from tapping_cell.mechanics.slide_results import Launch, Profile, Rest
from tapping_cell.mechanics.slide_table import SlideTable

_PROFILE_STEP = 0.04
# ln of the smallest remaining fraction of the duration for which the ratio of the velocities is
# computed. The remaining displacement, relative to the whole displacement, is then about the square
# of this fraction (4e-18) and thus less than the rounding errors.
_PROFILE_END = -20.0


class RoundSlide:
    """Slides from a table. ``deceleration`` is mu g in m/s^2; ``radius`` is that of the support in
    m."""

    def __init__(self, table: SlideTable, deceleration: float, radius: float) -> None:
        """Store the table and the quantities that convert its values to SI units."""
        self.table = table
        self._deceleration = deceleration
        self._radius = radius

    def rest(self, speed: ArrayLike, spin: ArrayLike, direction: ArrayLike = 0.0) -> Rest:
        """Compute where and when slides with these launch velocities end. ``direction`` is ignored,
        because the friction is isotropic."""
        del direction
        if isinstance(speed, (float, int)) and isinstance(spin, (float, int)):
            v, w = float(speed), float(spin)
            if not math.isfinite(v * v + w * w):
                raise _not_finite("speed and spin", v, w)
            travel, rim_travel, time = self.table.rest(v, w * self._radius)
            g = self._deceleration
            return Rest(travel / g, rim_travel / (g * self._radius), time / g)
        v_all, w_all = np.broadcast_arrays(
            np.asarray(speed, dtype=float), np.asarray(spin, dtype=float)
        )
        rim = w_all.ravel() * self._radius
        travels, rim_travels, times = self.table.rest_many(v_all.ravel(), rim)
        travels *= 1 / self._deceleration
        rim_travels *= 1 / (self._deceleration * self._radius)
        times *= 1 / self._deceleration
        shape = v_all.shape
        return Rest(travels.reshape(shape), rim_travels.reshape(shape), times.reshape(shape))

    def launch(
        self, distance: ArrayLike, rotation: ArrayLike, direction: ArrayLike = 0.0
    ) -> Launch:
        """Compute the launches with these displacements; the direction does not matter."""
        del direction
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
        speeds, rims = self.table.launch_many(
            x_all.ravel() * g, theta_all.ravel() * (g * self._radius)
        )
        rims *= 1 / self._radius
        return Launch(speeds.reshape(x_all.shape), rims.reshape(x_all.shape))

    def displace(self, twist: Array) -> Array:
        """Compute the displacements (..., 3) caused by launches (..., 3): along the launch, with a
        rotation."""
        speed = np.hypot(twist[..., 0], twist[..., 1])
        distance, rotation, _ = self.rest(speed, twist[..., 2])
        scale = distance / np.where(speed > 0, speed, 1.0)
        return np.stack([scale * twist[..., 0], scale * twist[..., 1], rotation], axis=-1)

    def twist_for(self, displacement: Array) -> Array:
        """Compute the launches (..., 3) that cause displacements (..., 3)."""
        distance = np.hypot(displacement[..., 0], displacement[..., 1])
        speed, spin = self.launch(distance, displacement[..., 2])
        scale = speed / np.where(distance > 0, distance, 1.0)
        return np.stack([scale * displacement[..., 0], scale * displacement[..., 1], spin], axis=-1)

    def profile(self, speed: Array, spin: Array, direction: Array, times: Array) -> Profile:
        """Compute the motion of launches (n,) at times (k,); results (n, k)."""
        del direction
        g, r = self._deceleration, self._radius
        rim = spin * r
        v, s = _slow_down(self.table, speed, rim, times * g)
        total, total_rim, _ = self.table.rest_many(speed, rim)
        left, left_rim, _ = self.table.rest_many(v.ravel(), s.ravel())
        return Profile(
            times=times,
            speed=v,
            spin=s / r,
            distance=(total[:, None] - left.reshape(v.shape)) / g,
            rotation=(total_rim[:, None] - left_rim.reshape(v.shape)) / (g * r),
        )


def _slow_down(
    table: SlideTable, speed: Array, rim_speed: Array, time: Array
) -> tuple[Array, Array]:
    """Compute speed and rim speed, each (n, k), of launches (n,) at reduced times (k,).

    Reduced times are multiplied by mu g. The logarithm of the ratio of spin to speed, as a function
    of the logarithm of the remaining fraction of the duration, obeys an autonomous differential
    equation. The classic Runge-Kutta method integrates it. The magnitude of the velocity then
    follows from the remaining time.
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
    # Speed and rim speed with this ratio; the larger of the two is 1. They are then scaled so that
    # the slide takes the remaining time.
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
    """Compute ln(R omega / v), (n, k), of launches with the initial values ``start`` (n,), at
    ln(remaining fraction of the duration) ``log_left`` (n, k)."""
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


def _not_finite(name: str, first: float, second: float) -> InvalidParameterError:
    return InvalidParameterError(
        f"{name} are {first!r} and {second!r}; both must be finite numbers with finite squares."
    )
