"""Solve the equations of sliding for one support and one torque factor, as functions of one
variable.

Sliding is scale-invariant, because friction depends only on the ratio of spin to speed. Let N be
the larger of v and R omega, and tau the smaller divided by N. Then, in the regimes of
``support_friction``,

    distance = (v N / mu g) X(tau),  R rotation = (R omega N / mu g) Theta(tau),
    duration = (N / mu g) D(tau),

where X, Theta and D obey the linear equations psi y' = a y - 1 with these coefficients in the
translating regime (left) and in the spinning regime (right):

    psi     = tau (F - Lambda T / tau)            tau (Lambda T - F / tau)
    a_X     = 2 F                                 Lambda T + F / tau
    a_Theta = F + Lambda T / tau                  2 Lambda T
    a_D     = F                                   Lambda T

Lambda is the torque factor times m R^2 / I. The motion converges to the only attracting zero of psi
(the terminal ratio). Only the physical solution is bounded there. In the interval around that zero,
the equations are therefore solved by collocation without an initial value. From this interval, the
Radau IIA method of order five continues the solution to pure sliding and to pure spinning. The
method is stable in these directions.

Near tau = 0, y contains powers of tau with exponents slightly above one. Near tau = 1, a ring's
friction contains a logarithm. The knots of the table are therefore denser near both ends: they are
uniformly spaced in p, with tau = p^2 / (p^2 + (1 - p)^2). Near an end, p varies like the square
root of the distance of tau from that end. Computing p from tau takes two square roots.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics.planar import Array
from tapping_cell.mechanics.support_friction import SupportFriction

Friction = Callable[[Array, Array, NDArray[np.bool_]], SupportFriction]

PIECES = 1024

_ROOT6 = math.sqrt(6.0)
# Radau IIA of order five: Hairer and Wanner, Solving Ordinary Differential Equations II, IV.5.
_RADAU_C = np.array([(4 - _ROOT6) / 10, (4 + _ROOT6) / 10, 1.0])
_RADAU_A = np.array(
    [
        [(88 - 7 * _ROOT6) / 360, (296 - 169 * _ROOT6) / 1800, (-2 + 3 * _ROOT6) / 225],
        [(296 + 169 * _ROOT6) / 1800, (88 + 7 * _ROOT6) / 360, (-2 - 3 * _ROOT6) / 225],
        [(16 - _ROOT6) / 36, (16 + _ROOT6) / 36, 1 / 9],
    ]
)
_START_DEGREE = 4


class SlideSolution:
    """X, Theta and D at the knots of p, in both regimes.

    ``values`` and ``slopes`` (derivatives with respect to p) have shape (3, 2, PIECES + 1):
    function, regime (translating or spinning), knot; p increases in both regimes. ``ratio_rates``,
    shape (2, PIECES + 1), is d ln(R omega / v) / d ln(time left). ``terminal_ratio`` is the limit
    of v / (R omega) at the end of the slide.
    """

    def __init__(self, friction: Friction, torque_ratio: float) -> None:
        self._friction = friction
        self._torque_ratio = torque_ratio
        # The path runs from pure sliding (p = 0) through translating motions to p = 1, then through
        # spinning motions back to p = 0, which is pure spinning.
        knots = np.linspace(0.0, 1.0, PIECES + 1)
        path_p = np.concatenate([knots, knots[-2::-1]])
        count = path_p.size - 1
        flow, _ = self._terms(path_p, np.arange(count + 1) > PIECES)
        flow[PIECES + 1 :] *= -1
        stops = np.flatnonzero(flow < 0)
        first = min(max(int(stops[0]) - 1, 0), count - 1) if stops.size else count - 1
        values = np.empty((3, count + 1))
        slopes = np.empty((3, count + 1))
        self._start(path_p, first, values, slopes)
        self._march(path_p, first, values, slopes)
        slopes[:, [0, PIECES, count]] = 0.0
        self.values, self.slopes, self.ratio_rates = (
            np.stack([path[..., : PIECES + 1], path[..., : PIECES - 1 : -1]], axis=-2)
            for path in (values, slopes, -flow * values[2])
        )
        self.terminal_ratio = self._terminal(path_p, flow, first)

    def _terms(self, p: Array, spinning: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Compute psi / tau and the three factors a (a_X, a_Theta, a_D) at values of p."""
        square = p * p + (1 - p) ** 2
        tau = p * p / square
        complement = (1 - p) ** 2 / square * (1 + tau)
        leading, trailing = self._friction(tau, complement, spinning)
        leading = np.where(spinning, self._torque_ratio, 1.0) * leading
        trailing = np.where(spinning, 1.0, self._torque_ratio) * trailing
        mixed = leading + trailing
        factors = np.stack(
            [
                np.where(spinning, mixed, 2 * leading),
                np.where(spinning, 2 * leading, mixed),
                leading,
            ]
        )
        return leading - trailing, factors

    def _equation(self, p: Array, spinning: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Compute P, Q and a of the equation P dy/dp = Q (a y - 1). It is regular at both ends of
        p."""
        flow, factors = self._terms(p, spinning)
        square = p * p + (1 - p) ** 2
        return p * flow * square, 2 * (1 - p), factors

    def _start(self, path_p: Array, first: int, values: Array, slopes: Array) -> None:
        """Solve the equations in the interval that contains the terminal ratio, by collocation. No
        initial value is needed, because the solution must be bounded."""
        low, high = path_p[first], path_p[first + 1]
        width = high - low
        points, _ = np.polynomial.legendre.leggauss(_START_DEGREE + 1)
        s = (points + 1) / 2
        spinning = np.full(s.size, first >= PIECES)
        flow, weight, factors = self._equation(low + width * s, spinning)
        powers = np.arange(_START_DEGREE + 1)
        basis = s[:, None] ** powers
        derivative = powers * s[:, None] ** np.maximum(powers - 1, 0) / width
        matrix = flow[:, None] * derivative - (weight * factors)[:, :, None] * basis
        right = np.broadcast_to(-weight[:, None], (3, s.size, 1))
        polynomial = np.linalg.solve(matrix, right)[:, :, 0]
        values[:, first] = polynomial[:, 0]
        values[:, first + 1] = polynomial.sum(axis=1)
        slopes[:, first] = polynomial[:, 1] / width
        slopes[:, first + 1] = polynomial @ powers / width

    def _march(self, path_p: Array, first: int, values: Array, slopes: Array) -> None:
        """Compute the Radau steps of all intervals at once. The step of an interval is an affine
        map from the solution at the start of the interval to the solution at its end. The maps of
        all intervals are then applied one after the other."""
        count = path_p.size - 1
        interval = np.arange(count)
        outward = interval > first
        start = np.where(outward, path_p[:-1], path_p[1:])
        width = np.where(outward, path_p[1:], path_p[:-1]) - start
        stages = start[:, None] + width[:, None] * _RADAU_C
        spinning = np.broadcast_to((interval >= PIECES)[:, None], stages.shape)
        flow, weight, factors = self._equation(np.clip(stages, 0.0, 1.0), spinning)
        pull = weight * factors
        matrix = flow[:, :, None] * np.eye(3) - pull[:, :, :, None] * (
            width[:, None, None] * _RADAU_A
        )
        matrix[:, first] = np.eye(3)  # the starting interval is already solved
        right = np.stack([pull, np.broadcast_to(-weight, pull.shape)], axis=-1)
        rates = np.linalg.solve(matrix, right)
        ends = width[:, None] * np.einsum("j,kijm->kim", _RADAU_A[2], rates)
        gain = (1 + ends[:, :, 0]).tolist()
        shift = ends[:, :, 1].tolist()
        for kind in range(3):
            chain = values[kind].tolist()
            gains, shifts = gain[kind], shift[kind]
            for i in range(first + 1, count):
                chain[i + 1] = gains[i] * chain[i] + shifts[i]
            for i in range(first - 1, -1, -1):
                chain[i] = gains[i] * chain[i + 1] + shifts[i]
            values[kind] = chain
            last = rates[kind, :, 2]
            after, before = interval[first + 1 :], interval[:first]
            slopes[kind, after + 1] = last[after, 0] * values[kind, after] + last[after, 1]
            slopes[kind, before] = last[before, 0] * values[kind, before + 1] + last[before, 1]

    def _terminal(self, path_p: Array, flow: Array, first: int) -> float:
        """Compute the limit of v / (R omega) at the end: inf if the spin vanishes first, 0 if the
        speed vanishes first."""
        if first == 0 and flow[0] <= 0:
            return math.inf
        if first == path_p.size - 2 and flow[-1] >= 0:
            return 0.0
        low, high = float(path_p[first]), float(path_p[first + 1])
        spinning = np.array([first >= PIECES])
        rising = float(self._terms(np.array([low]), spinning)[0][0]) > 0
        for _ in range(60):
            middle = (low + high) / 2
            positive = float(self._terms(np.array([middle]), spinning)[0][0]) > 0
            low, high = (middle, high) if positive == rising else (low, middle)
        tau = float(grade_inverse(np.array(low)))
        return tau if first >= PIECES else 1 / tau


def grade_inverse(p: Array) -> Array:
    """Compute tau from p (see the module's docstring); both are in [0, 1]."""
    square: Array = p * p
    return square / (square + (1 - p) ** 2)
