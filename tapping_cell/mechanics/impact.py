"""Planar impact of a striker on a body: Routh's method with Poisson's restitution.

In the contact frame, n is the normal into the body and t is n rotated by +90 degrees. The body's
contact point relative to its centre of mass is c = (c_n, c_t), the striker moves along a = (a_n,
a_t) at speed v_s, and the impulse on the body is (P_n, P_t). The velocity of the body relative to
the striker is, along the normal (compression) and along the tangent (sliding),

    C = -a_n v_s + B2 P_n - B3 P_t
    S = -a_t v_s - B3 P_n + B1 P_t

    B1 = 1/m + c_n^2 / I + striker,  B2 = 1/m + c_t^2 / I + striker,  B3 = c_n c_t / I + striker

where ``striker`` is, in B1, B2 and B3 respectively, a_t^2 / m_s, a_n^2 / m_s and -a_n a_t / m_s if
the striker moves in linear bearings, and 1 / m_s, 1 / m_s and 0 if it is free. Routh's method (Wang
and Mason, J. Applied Mechanics 59, 1992) follows the impulse along the friction limit until sliding
stops (S = 0). It then continues along S = 0 if friction can prevent sliding, and otherwise along
the opposite limit. Compression ends at C = 0. With Poisson's restitution e, the total normal
impulse is 1 + e times the normal impulse of the compression.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics.bodies import Body
from tapping_cell.mechanics.errors import (
    InvalidParameterError,
    finite,
    fraction,
    not_negative,
    positive,
)
from tapping_cell.mechanics.planar import Array, unit

Rows = NDArray[np.intp] | slice

_ALL = slice(None)
Constraint = Literal["linear_bearings", "free"]

# Maximum planned angle between the striker's axis and the contact normal. At such a grazing
# incidence the striker usually slides during the whole impact, and the impulse is on the edge of
# the friction cone. Planned impulses can therefore have every direction inside the cone.
LARGEST_INCIDENCE = math.radians(89.0)
_ROOT_STEPS = 60
_ROOT_TOLERANCE = 1e-15
_SLOPE_TOLERANCE = 1e-14


@dataclass(frozen=True, slots=True)
class Striker:
    """The moving part of the tapper: ``mass`` in kg, and a ball of ``tip_radius`` in m at its tip.

    ``constraint`` is ``"linear_bearings"`` (it can move only along its axis, as in the paper) or
    ``"free"``. Raises :class:`InvalidParameterError` for a mass that is not positive, a radius
    below 0 or another constraint.
    """

    mass: float
    tip_radius: float
    constraint: Constraint = "linear_bearings"

    def __post_init__(self) -> None:
        object.__setattr__(self, "mass", positive("striker mass", self.mass, "kg"))
        object.__setattr__(self, "tip_radius", not_negative("tip radius", self.tip_radius, "m"))
        if self.constraint not in get_args(Constraint):
            raise InvalidParameterError(
                f"striker constraint is {self.constraint!r}; it must be one of "
                f"{', '.join(get_args(Constraint))}."
            )


class ImpactResult(NamedTuple):
    """Result of an impact in the contact frame (n, t); every field has the shape of the input.

    ``normal_impulse`` and ``tangential_impulse`` on the body are in N s; ``velocity`` (..., 2) of
    the body's centre of mass is in m/s and its ``spin`` in rad/s. ``striker_velocity`` (..., 2) is
    in m/s. ``sliding`` is the sign of S at the end, 0 if the contact sticks.
    """

    normal_impulse: Array
    tangential_impulse: Array
    velocity: Array
    spin: Array
    striker_velocity: Array
    sliding: Array


@dataclass(frozen=True, slots=True)
class Impact:
    """Impact of ``striker`` on ``body`` at rest.

    ``restitution`` is Poisson's coefficient, 0 to 1, and ``friction`` is the friction coefficient
    of the contact. The model can be calibrated for a real device in two ways (section 3.1.1 of the
    paper fits two constants): ``scale`` contains factors for the model's B1, B2 and B3, and
    ``constants`` contains values in 1/kg that replace them, or None to keep the model's value.
    Without calibration, energy never increases and mirrored impacts have mirrored results; with
    calibration, neither is guaranteed. Raises :class:`InvalidParameterError` for values out of
    range.
    """

    body: Body
    striker: Striker
    restitution: float
    friction: float
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    constants: tuple[float | None, float | None, float | None] = (None, None, None)

    def __post_init__(self) -> None:
        object.__setattr__(self, "restitution", fraction("restitution", self.restitution))
        object.__setattr__(self, "friction", positive("contact friction", self.friction))
        scale = tuple(float(s) for s in finite("impact scale", self.scale).ravel())
        if len(scale) != 3 or scale[0] <= 0 or scale[1] <= 0:
            raise InvalidParameterError(
                f"impact scale is {scale}; it must hold three numbers, the first two above 0."
            )
        object.__setattr__(self, "scale", scale)
        if len(self.constants) != 3:
            raise InvalidParameterError(
                f"impact constants are {self.constants}; they must be three numbers or None."
            )
        b1, b2, b3 = self.constants
        constants = (
            None if b1 is None else positive("impact constant B1", b1, "1/kg"),
            None if b2 is None else positive("impact constant B2", b2, "1/kg"),
            None if b3 is None else float(finite("impact constant B3", b3, "1/kg")),
        )
        object.__setattr__(self, "constants", constants)

    def largest_impulse_angle(self, contact: ArrayLike) -> Array:
        """Compute the maximum angle (rad) of the impulse to either side of the normal at
        ``contact``.

        If the contact slides throughout the impact at ``LARGEST_INCIDENCE``, the angle is the
        arctangent of the contact friction; otherwise the angle is smaller. ``contact`` (..., 2) is
        (c_n, c_t) in m.
        """
        c = np.asarray(contact, dtype=float)
        angle = np.full(c.shape[:-1], LARGEST_INCIDENCE)
        impulses = (self._routh(side, c) for side in (angle, -angle))
        return np.asarray(np.arctan(np.minimum(*(np.abs(p_t / p_n) for p_n, p_t, _ in impulses))))

    def inverse_inertias(
        self, incidence: ArrayLike, contact: ArrayLike
    ) -> tuple[Array, Array, Array]:
        """Compute the calibrated B1, B2 and B3 in 1/kg. Arguments as for :meth:`strike`.

        Raises :class:`InvalidParameterError` if the calibrated values are physically impossible, B1
        B2 <= B3^2.
        """
        angle, c = np.asarray(incidence, dtype=float), np.asarray(contact, dtype=float)
        a_n, a_t = np.cos(angle), np.sin(angle)
        mass, inertia, striker = self.body.mass, self.body.inertia, self.striker.mass
        c_n, c_t = c[..., 0], c[..., 1]
        if self.striker.constraint == "free":
            add1, add2, add3 = 1 / striker, 1 / striker, 0.0 * a_n
        else:
            add1, add2, add3 = a_t**2 / striker, a_n**2 / striker, -a_n * a_t / striker
        b1 = self.scale[0] * (1 / mass + c_n**2 / inertia + add1)
        b2 = self.scale[1] * (1 / mass + c_t**2 / inertia + add2)
        b3 = self.scale[2] * (c_n * c_t / inertia + add3)
        b1, b2, b3 = (
            model if fitted is None else np.full(np.shape(model), fitted)
            for model, fitted in zip((b1, b2, b3), self.constants, strict=True)
        )
        singular = np.asarray(b1 * b2 <= b3 * b3)
        if singular.any():
            raise InvalidParameterError(
                f"impact scale {self.scale} and constants {self.constants} give B1 B2 <= B3^2 at "
                "this contact, which is physically impossible. Fit them again."
            )
        return b1, b2, b3

    def strike(self, speed: ArrayLike, incidence: ArrayLike, contact: ArrayLike) -> ImpactResult:
        """Compute the impact of a striker at ``speed`` (m/s, 0 or more).

        ``incidence`` is the angle from the normal n to the striker's axis in rad, at most a right
        angle. ``contact`` (..., 2) is (c_n, c_t) in m: (-R, 0) for a disk of radius R. Arguments
        broadcast. Raises :class:`InvalidParameterError` for values out of range.
        """
        v = finite("striker speed", speed, "m/s")
        angle = finite("incidence", incidence, "rad")
        c = finite("contact point", contact, "m")
        if v.size and v.min() < 0:
            raise InvalidParameterError(f"striker speed is {v.min():g} m/s; it must be 0 or more.")
        if angle.size and np.abs(angle).max() > math.pi / 2:
            raise InvalidParameterError(
                f"incidence is {np.abs(angle).max():g} rad; it must be at most pi/2."
            )
        p_n, p_t, sliding = self._routh(angle, c)
        p_n, p_t, sliding = p_n * v, p_t * v, sliding * (v > 0)
        p_n, p_t, c_n, c_t, angle, v = np.broadcast_arrays(p_n, p_t, c[..., 0], c[..., 1], angle, v)
        impulse = np.stack([p_n, p_t], axis=-1)
        axis = unit(angle)
        lost = impulse
        if self.striker.constraint == "linear_bearings":
            lost = (impulse * axis).sum(axis=-1, keepdims=True) * axis
        return ImpactResult(
            normal_impulse=p_n,
            tangential_impulse=p_t,
            velocity=impulse / self.body.mass,
            spin=(c_n * p_t - c_t * p_n) / self.body.inertia,
            striker_velocity=axis * v[..., None] - lost / self.striker.mass,
            sliding=np.broadcast_to(sliding, p_n.shape),
        )

    def incidence_for(self, impulse_slope: ArrayLike, contact: ArrayLike) -> Array:
        """Compute the incidence (rad) at which the impulse has P_t / P_n = ``impulse_slope``.

        The slope must be within the friction cone. ``contact`` (..., 2) is (c_n, c_t) in m. The
        result is NaN if no incidence within ``LARGEST_INCIDENCE`` gives the slope.
        """
        bracket = self._bracket(impulse_slope, contact)
        root = np.full(bracket.found.shape, np.nan)
        rows = np.flatnonzero(bracket.found)
        root[rows] = _bracketed_root(
            lambda angle, some: bracket.error(angle, rows[some]),
            *(part[rows] for part in (bracket.low, bracket.high, bracket.e_low, bracket.e_high)),
        )
        return root.reshape(bracket.shape)

    def has_incidence(self, impulse_slope: ArrayLike, contact: ArrayLike) -> NDArray[np.bool_]:
        """Return whether :meth:`incidence_for` would find an incidence, without computing it."""
        bracket = self._bracket(impulse_slope, contact)
        return bracket.found.reshape(bracket.shape)

    def _bracket(self, impulse_slope: ArrayLike, contact: ArrayLike) -> _Bracket:
        """Find a range of incidences that contains the incidence at which the impulse has this
        slope."""
        slope = np.asarray(impulse_slope, dtype=float)
        c = np.asarray(contact, dtype=float)
        shape = np.broadcast_shapes(slope.shape, c.shape[:-1])
        slope = np.broadcast_to(slope, shape).ravel()
        c = np.broadcast_to(c, (*shape, 2)).reshape(-1, 2)
        # At every incidence at which the contact slides throughout the impact, the slope equals the
        # friction limit, so the limit itself does not determine the incidence. The target is
        # therefore slightly inside the limit.
        limit = self.friction * (1 - 1e-11)
        target = np.clip(slope, -limit, limit)
        beyond = np.abs(slope) > self.friction * (1 + 1e-9)

        def error(angle: Array, rows: Rows) -> Array:
            p_n, p_t, _ = self._routh(angle, c[rows])
            return np.asarray(p_t / p_n - target[rows])

        straight = np.zeros(slope.shape)
        e_straight = error(straight, _ALL)
        # For a sticking contact, the slope is linear in the tangent of the incidence. The other end
        # of the bracket has 1.5 times the tangent of this linear estimate of the root.
        # ``LARGEST_INCIDENCE`` replaces this end if the end is beyond it or if the root is not
        # between the two ends.
        b1, b2, _ = self.inverse_inertias(straight, c)
        other = np.arctan(-1.5 * (1 + self.restitution) * b1 / b2 * e_straight)
        e_other = error(other, _ALL)
        open_ended = (e_other * e_straight > 0) | (np.abs(other) > LARGEST_INCIDENCE)
        if open_ended.any():
            other = np.where(open_ended, np.copysign(LARGEST_INCIDENCE, -e_straight), other)
            e_other = np.where(open_ended, error(other, _ALL), e_other)
        # If the contact normal passes far from a polygon's centre of mass, the slope of the impulse
        # may decrease with the incidence. The root then has the sign opposite to that of the linear
        # estimate, so this sign is tried too.
        wrong_side = e_other * e_straight > 0
        if wrong_side.any():
            other = np.where(wrong_side, np.copysign(LARGEST_INCIDENCE, e_straight), other)
            e_other = np.where(wrong_side, error(other, _ALL), e_other)
        found = ~((e_other * e_straight > 0) | beyond)
        return _Bracket(shape, found, straight, other, e_straight, e_other, error)

    def _routh(self, incidence: Array, contact: Array) -> tuple[Array, Array, Array]:
        """Compute the impulses for a striker of unit speed, and the sign of the sliding velocity at
        the end."""
        a_n, a_t = np.cos(incidence), np.sin(incidence)
        b1, b2, b3 = self.inverse_inertias(incidence, contact)
        mu = self.friction
        # First phase: friction opposes the sliding, until the sliding ends at the normal impulse
        # p_stop.
        direction = -np.sign(a_t)
        first = -direction * mu
        closing = direction * b3 + mu * b1
        stops = (closing > 0) | (direction == 0)
        p_stop = np.where(stops, np.abs(a_t) / np.where(stops & (closing > 0), closing, 1), np.inf)
        # Second phase: sticking, or reverse sliding if friction cannot prevent it.
        hold = b3 / b1
        second = np.clip(hold, -mu, mu)
        rate_first = b2 - b3 * first
        rate_second = b2 - b3 * second
        ends_first = (rate_first > 0) & (a_n <= rate_first * p_stop)
        start_second = np.where(ends_first, 0.0, np.where(np.isinf(p_stop), 0.0, p_stop))
        p_compression = np.where(
            ends_first,
            a_n / np.where(ends_first, rate_first, 1.0),
            start_second + (a_n - rate_first * start_second) / rate_second,
        )
        p_n = (1 + self.restitution) * p_compression
        along_first = np.minimum(p_n, p_stop)
        p_t = first * along_first + second * (p_n - along_first)
        still_first = p_n < p_stop
        reverse = np.where(np.abs(hold) <= mu, 0.0, -np.sign(hold))
        return p_n, p_t, np.where(still_first, direction, reverse)


class _Bracket(NamedTuple):
    """Brackets as flat arrays.

    ``low`` and ``high`` are incidences on opposite sides of the root, ``e_low`` and ``e_high`` the
    errors of the slope at these incidences, and ``found`` states whether there is a root between
    them. ``error`` computes the error of the slope from incidences and their row indices.
    """

    shape: tuple[int, ...]
    found: NDArray[np.bool_]
    low: Array
    high: Array
    e_low: Array
    e_high: Array
    error: Callable[[Array, Rows], Array]


def _bracketed_root(
    function: Callable[[Array, Rows], Array], low: Array, high: Array, f_low: Array, f_high: Array
) -> Array:
    """Find the roots (n,) of a function between ``low`` and ``high``, by Chandrupatla's method
    (1997).

    ``function`` takes values and the rows to which they belong. Rows that have converged are no
    longer passed to it.
    """
    found = low.copy()
    rows: NDArray[np.intp] = np.arange(low.size)
    a, b, c = high.copy(), low.copy(), high.copy()
    fa, fb, fc = f_high.copy(), f_low.copy(), f_high.copy()
    t = np.full(a.shape, 0.5)
    for _ in range(_ROOT_STEPS):
        x = a + t * (b - a)
        fx = function(x, rows)
        same = np.sign(fx) == np.sign(fa)
        c, fc = np.where(same, a, b), np.where(same, fa, fb)
        b, fb = np.where(same, b, a), np.where(same, fb, fa)
        a, fa = x, fx
        best_f = np.minimum(np.abs(fa), np.abs(fb))
        width = np.abs(b - a)
        found[rows] = np.where(np.abs(fa) < np.abs(fb), a, b)
        left = (best_f > _SLOPE_TOLERANCE) & (width > _ROOT_TOLERANCE)
        rows = rows[left]
        if rows.size == 0:
            break
        a, b, c, fa, fb, fc, width = (part[left] for part in (a, b, c, fa, fb, fc, width))
        tolerance = _ROOT_TOLERANCE / width
        with np.errstate(divide="ignore", invalid="ignore"):
            xi = (a - b) / (c - b)
            phi = (fa - fb) / (fc - fb)
            inverse = (fa / (fb - fa)) * (fc / (fb - fc)) + (
                (c - a) / (b - a) * fa / (fc - fa) * fb / (fc - fb)
            )
            good = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi) & np.isfinite(inverse)
        t = np.where(good, inverse, 0.5)
        t = np.clip(t, np.minimum(tolerance, 0.5), np.maximum(1 - tolerance, 0.5))
    return found
