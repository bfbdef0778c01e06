"""Table of all slides for one support and one torque factor, forward and inverse.

It holds the functions X, Theta and D of ``slide_solution`` as cubic Hermite polynomials between
knots that are uniformly spaced in p (also defined in ``slide_solution``). A single slide is
computed with Python floats; many slides are computed in blocks that fit in the cache. The inverse
looks up an estimate of p in a separate table and refines it by Newton steps on the forward table,
so that ``launch`` inverts ``rest`` up to rounding errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics.errors import InvalidParameterError
from tapping_cell.mechanics.planar import Array
from tapping_cell.mechanics.slide_solution import (
    PIECES,
    Friction,
    SlideSolution,
    grade_inverse,
)
from tapping_cell.mechanics.support_friction import disk_friction, ring_friction

_CHUNK = 4096
_NEWTON_STEPS = 2
_TINY = 1e-300

_FRICTION: dict[str, Friction] = {"disk": disk_friction, "ring": ring_friction}


class SlideTable:
    """Sliding of one support (``"disk"`` or ``"ring"``) at one Lambda, forward and inverse.

    All arguments and results are reduced: ``speed`` v, ``rim_speed`` R omega, ``travel`` mu g times
    the distance, ``rim_travel`` mu g R times the rotation, ``time`` mu g times the duration. Use
    :func:`slide_table`, which caches the tables.
    """

    def __init__(self, support: str, torque_ratio: float) -> None:
        self.torque_ratio = torque_ratio
        solution = SlideSolution(_FRICTION[support], torque_ratio)
        self.terminal_ratio = solution.terminal_ratio
        x, theta, duration = (
            _hermite(v, s) for v, s in zip(solution.values, solution.slopes, strict=True)
        )
        self._forward = np.ascontiguousarray(np.concatenate([x, theta, duration], axis=1).T)
        # The inverse finds p from the ratio of _minor to _major. This ratio increases with p.
        # _major is the travel that belongs to the larger of speed and rim speed: x in the
        # translating regime, theta in the spinning regime. _minor is the other travel.
        translating = np.arange(2 * PIECES)[:, None] < PIECES
        self._minor = np.ascontiguousarray(np.where(translating, theta, x).T)
        self._major = np.ascontiguousarray(np.where(translating, x, theta).T)
        self._divide = float(solution.values[1][0, -1] / solution.values[0][0, -1])
        self._guess = np.ascontiguousarray(self._inverse_guess().T)
        rates = solution.ratio_rates
        self._rates = _hermite(rates, np.gradient(rates, 1 / PIECES, axis=1, edge_order=2)).T.copy()
        self._forward_rows, self._minor_rows, self._major_rows, self._guess_rows = (
            [tuple(row) for row in columns.T.tolist()]
            for columns in (self._forward, self._minor, self._major, self._guess)
        )

    # ---- single slides, with Python floats

    def rest(self, speed: float, rim_speed: float) -> tuple[float, float, float]:
        """Compute travel, rim travel and time of one slide. Travel and rim travel have the signs of
        speed and rim speed."""
        v, s = abs(speed), abs(rim_speed)
        major, minor = (v, s) if v >= s else (s, v)
        if major == 0.0:
            return 0.0, 0.0, 0.0
        root = math.sqrt(minor)
        t = PIECES * root / (root + math.sqrt(major - minor))
        row = int(t) if t < PIECES else PIECES - 1
        t -= row
        x0, x1, x2, x3, r0, r1, r2, r3, d0, d1, d2, d3 = self._forward_rows[
            row if v >= s else row + PIECES
        ]
        return (
            speed * major * (x0 + t * (x1 + t * (x2 + t * x3))),
            rim_speed * major * (r0 + t * (r1 + t * (r2 + t * r3))),
            major * (d0 + t * (d1 + t * (d2 + t * d3))),
        )

    def launch(self, travel: float, rim_travel: float) -> tuple[float, float]:
        """Compute launch speed and rim speed of the slide that covers this travel and rim travel.
        The speed has the sign of the travel, and the rim speed that of the rim travel."""
        x, r = abs(travel), abs(rim_travel)
        if x == 0.0 and r == 0.0:
            return 0.0, 0.0
        translating = r <= self._divide * x
        if translating:
            ratio, longer, z = r / x, x, r / (self._divide * x)
        else:
            ratio, longer, z = x / r, r, self._divide * x / r
        root = math.sqrt(z)
        t = PIECES * root / (root + math.sqrt(max(1.0 - z, 0.0)))
        row = int(t) if t < PIECES else PIECES - 1
        t -= row
        offset = 0 if translating else PIECES
        c0, c1, c2, c3 = self._guess_rows[row + offset]
        p = c0 + t * (c1 + t * (c2 + t * c3))
        for step in range(_NEWTON_STEPS + 1):
            p = min(max(p, 0.0), 1.0)
            t = p * PIECES
            row = int(t) if t < PIECES else PIECES - 1
            t -= row
            b0, b1, b2, b3 = self._major_rows[row + offset]
            large = b0 + t * (b1 + t * (b2 + t * b3))
            q = 1.0 - p
            square = p * p + q * q
            tau = p * p / square
            if step == _NEWTON_STEPS:
                break
            a0, a1, a2, a3 = self._minor_rows[row + offset]
            small = a0 + t * (a1 + t * (a2 + t * a3))
            slope_small = PIECES * (a1 + t * (2 * a2 + t * 3 * a3))
            slope_large = PIECES * (b1 + t * (2 * b2 + t * 3 * b3))
            slope = 2 * p * q / (square * square) * small + tau * slope_small - ratio * slope_large
            if slope != 0.0:
                p -= (tau * small - ratio * large) / slope
        major = math.sqrt(longer / large)
        minor = tau * major
        v, s = (major, minor) if translating else (minor, major)
        return math.copysign(v, travel), math.copysign(s, rim_travel)

    # ---- many slides, in blocks that fit in the cache

    def rest_many(self, speed: Array, rim_speed: Array) -> tuple[Array, Array, Array]:
        """Vectorised :meth:`rest` for two flat arrays of equal length.
        Raises :class:`InvalidParameterError` if a value is not finite.
        """
        travel, rim_travel, time = _in_blocks(self._rest_block, speed, rim_speed)
        return travel, rim_travel, time

    def _rest_block(self, speed: Array, rim_speed: Array) -> tuple[Array, Array, Array]:
        v, s = np.abs(speed), np.abs(rim_speed)
        major, minor = np.maximum(v, s), np.minimum(v, s)
        if not math.isfinite(float(np.dot(major, major))):
            raise InvalidParameterError(
                f"the largest speed or rim speed is {float(major.max()):g} m/s; all values and "
                "their squares must be finite"
            )
        index, t = _piece(_graded(major, minor), s > v)
        x, r, d = self._forward[0:4], self._forward[4:8], self._forward[8:12]
        return (
            speed * major * _cubic(x, index, t),
            rim_speed * major * _cubic(r, index, t),
            major * _cubic(d, index, t),
        )

    def launch_many(self, travel: Array, rim_travel: Array) -> tuple[Array, Array]:
        """Vectorised :meth:`launch` for two flat arrays of equal length.
        Raises :class:`InvalidParameterError` if a value is not finite.
        """
        speed, rim_speed = _in_blocks(self._launch_block, travel, rim_travel)
        return speed, rim_speed

    def _launch_block(self, travel: Array, rim_travel: Array) -> tuple[Array, Array]:
        x, r = np.abs(travel), np.abs(rim_travel)
        # With x scaled by ``_divide``, both travels are equal at the boundary between the regimes.
        # In both regimes, the travel that belongs to the smaller of speed and rim speed is
        # therefore the smaller of r and the scaled x.
        scaled = self._divide * x
        spinning = r > scaled
        longer = np.where(spinning, r, x)
        if not math.isfinite(float((x + r).sum())):
            raise InvalidParameterError(
                f"the largest travel or rim travel (mu g times the distance) is "
                f"{float(np.maximum(x, r).max()):g} m^2/s^2; all values must be finite"
            )
        ratio = np.where(spinning, x, r) / (longer + _TINY)
        index, t = _piece(_graded(np.maximum(scaled, r), np.minimum(scaled, r)), spinning)
        p = _cubic(self._guess, index, t)
        for step in range(_NEWTON_STEPS + 1):
            p = np.clip(p, 0.0, 1.0)
            index, t = _piece(PIECES * p, spinning)
            q = 1.0 - p
            square = p * p + q * q
            tau = p * p / square
            if step == _NEWTON_STEPS:
                break
            large, large_slope = _cubic_and_slope(self._major, index, t)
            small, small_slope = _cubic_and_slope(self._minor, index, t)
            slope = 2 * p * q / (square * square) * small + tau * small_slope - ratio * large_slope
            p = p - (tau * small - ratio * large) / (slope + _TINY)
        major = np.sqrt(longer / _cubic(self._major, index, t))
        minor = tau * major
        return (
            np.copysign(np.where(spinning, minor, major), travel),
            np.copysign(np.where(spinning, major, minor), rim_travel),
        )

    def travel_ratio(self, spin_ratio: float) -> float:
        """Compute the ratio of rim travel to travel of a launch with R omega / v =
        ``spin_ratio``."""
        travel, rim_travel, _ = self.rest(1.0, spin_ratio)
        return rim_travel / travel

    def ratio_rate(self, log_ratio: Array) -> Array:
        """Compute d ln(R omega / v) / d ln(time left) at values of ln(R omega / v), a flat
        array."""
        root = np.exp(-0.5 * np.abs(log_ratio))
        index, t = _piece(PIECES * root / (root + np.sqrt(1.0 - root * root)), log_ratio > 0)
        return _cubic(self._rates, index, t)

    def _inverse_guess(self) -> Array:
        """Compute the table of p as a function of the ratio of the travels. This ratio is graded
        like tau. Return the coefficients of its cubic pieces: first those for the translating
        regime, then those for the spinning regime."""
        p = _floats(np.linspace(0.0, 1.0, PIECES + 1))
        halves = []
        for half in range(2):
            rows = slice(half * PIECES, (half + 1) * PIECES)
            small = np.append(self._minor[0, rows], self._minor[:, rows.stop - 1].sum())
            large = np.append(self._major[0, rows], self._major[:, rows.stop - 1].sum())
            divide = self._divide if half == 0 else 1 / self._divide
            fraction = np.minimum(grade_inverse(p) * small / (large * divide), 1.0)
            if not np.all(np.diff(fraction) > 0):
                raise InvalidParameterError(
                    f"torque factor times m R^2 / I is {self.torque_ratio:g}; this is so far from "
                    "1 that different initial velocities lead to the same displacement"
                )
            root: Array = np.sqrt(fraction)
            graded = root / (root + np.sqrt(1.0 - fraction))
            graded[-1] = 1.0
            # Refine p at the knots by Newton's method on the cubic polynomials that rest()
            # evaluates.
            first = _floats(np.interp(p, graded, p))
            values = self._solve_knots(first, grade_inverse(p), half, divide)
            slopes = _floats(np.gradient(values, p, edge_order=2))
            halves.append(_hermite(values[None, :], slopes[None, :]))
        return np.concatenate(halves)

    def _solve_knots(self, p: Array, fraction: Array, half: int, divide: float) -> Array:
        spinning = np.full(p.size, half == 1)
        ratio = fraction * divide
        for _ in range(4):
            index, t = _piece(PIECES * p, spinning)
            large, slope = _cubic_and_slope(self._major, index, t)
            small, slope_small = _cubic_and_slope(self._minor, index, t)
            square = p * p + (1 - p) ** 2
            tau_slope = 2 * p * (1 - p) / square**2
            derivative = tau_slope * small + grade_inverse(p) * slope_small - ratio * slope
            error = grade_inverse(p) * small - ratio * large
            flat = np.abs(derivative) < 1e-12
            p = np.clip(p - np.where(flat, 0.0, error / np.where(flat, 1.0, derivative)), 0.0, 1.0)
        p[0], p[-1] = 0.0, 1.0
        return p


def _in_blocks(
    function: Callable[[Array, Array], Sequence[Array]], first: Array, second: Array
) -> list[Array]:
    """Apply a function to two flat arrays in blocks that fit in the cache, and join the results."""
    parts = [slice(start, start + _CHUNK) for start in range(0, max(first.size, 1), _CHUNK)]
    results = zip(*(function(first[part], second[part]) for part in parts), strict=True)
    return [np.concatenate(blocks) for blocks in results]


def _graded(major: Array, minor: Array) -> Array:
    """Compute PIECES * p for tau = minor / major; 0 if both are 0."""
    root = np.sqrt(minor)
    graded: Array = PIECES * root / (root + np.sqrt(major - minor) + _TINY)
    return graded


def _piece(t: Array, spinning: NDArray[np.bool_]) -> tuple[NDArray[np.intp], Array]:
    """Split t = PIECES * p into the row of its piece and the position in the piece, from 0 to 1.
    The pieces of the spinning regime are in the second half of the table."""
    piece = np.minimum(t.astype(np.intp), PIECES - 1)
    return piece + PIECES * spinning, t - piece


def _cubic(rows: Array, index: NDArray[np.intp], t: Array) -> Array:
    """Compute the value of one cubic piece for each element."""
    a, b, c, d = (row[index] for row in rows)
    value: Array = a + t * (b + t * (c + t * d))
    return value


def _cubic_and_slope(rows: Array, index: NDArray[np.intp], t: Array) -> tuple[Array, Array]:
    """Compute, for each element, the value of one cubic piece and its derivative with respect to
    p."""
    a, b, c, d = (row[index] for row in rows)
    return a + t * (b + t * (c + t * d)), PIECES * (b + t * (2 * c + t * (3 * d)))


def _hermite(values: Array, slopes: Array) -> Array:
    """Return the coefficients of cubic Hermite polynomials, one row per interval between knots.

    ``values`` and ``slopes`` (derivatives with respect to p) have the shape (n, PIECES + 1): curve,
    knot.
    """
    y0, y1 = values[:, :-1], values[:, 1:]
    s0, s1 = slopes[:, :-1] / PIECES, slopes[:, 1:] / PIECES
    rows = np.stack([y0, s0, 3 * (y1 - y0) - 2 * s0 - s1, 2 * (y0 - y1) + s0 + s1], axis=-1)
    return rows.reshape(-1, 4)


def _floats(values: NDArray[np.floating]) -> Array:
    """Convert to float64, because numpy's type annotations of interp and gradient are not specific
    enough."""
    return np.asarray(values, dtype=np.float64)


@lru_cache(maxsize=32)
def slide_table(support: str, torque_ratio: float) -> SlideTable:
    """Return the table of a support and Lambda = torque factor * m R^2 / I; the table is built once
    per process."""
    return SlideTable(support, torque_ratio)
