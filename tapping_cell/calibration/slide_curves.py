"""Fast computation of slides over time for fits: states of many launches at many times.

The equations and tables are those of ``mechanics.sliding``, arranged for fits: a fit needs a few
samples of each of many slides, for changing parameters. Slides are self-similar: the ratio of spin
to speed, as a function of the remaining time, follows one of two curves: one above the terminal
value of the ratio, one below this value. A table of these two curves is therefore sufficient for
all launches. There is a table for each torque factor of a grid. Between the torque factors of the
grid, values are interpolated. The interpolation also gives the derivatives of the values with
respect to the torque factor.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Body
from tapping_cell.mechanics.slide_table import SlideTable
from tapping_cell.se2 import Array

TORQUE_FACTORS = (0.1, 15.0)
"""Range of torque factors that a fit considers."""
FINE, COARSE = 0.02, 0.12
"""Spacing of the fine and the coarse tables in ln(torque factor). Their interpolation errors are
3e-5 and 1e-3 of the rotation. A table takes a tenth of a second to compute, so a search starts with
the coarse tables."""
# largest magnitude of ln(R omega / v); beyond it, either the rotation or the translation is
# negligible
_FARTHEST = 14.0
_NEAREST = -20.0  # ln of the smallest distance from the terminal ratio
_KNOTS = 1000
_SPACING = 0.02
_MIN_LEFT = 1e-9


class State(NamedTuple):
    """Arrays of distance (m) and rotation (rad) covered, speed (m/s) and spin (rad/s)."""

    distance: Array
    rotation: Array
    speed: Array
    spin: Array


class Slopes(NamedTuple):
    """Derivatives of distance and rotation with respect to ln(torque factor)."""

    distance: Array
    rotation: Array


class _Curve:
    """Slides of one support at one Lambda (torque factor times gamma). Lengths are multiplied by mu
    g, and spins are given as rim speeds."""

    def __init__(self, support: str, torque_ratio: float) -> None:
        self.table = SlideTable(support, torque_ratio)
        terminal = -math.log(max(min(self.table.terminal_ratio, 1e9), 1e-9))
        self._terminal = min(max(terminal, -_FARTHEST), _FARTHEST)
        self._above = self._side(1.0)
        self._below = self._side(-1.0)

    def _side(self, sign: float) -> tuple[Array, Array]:
        """Tabulate ln(R omega / v) minus its terminal value, against ln(remaining time). ``sign``
        is 1 for ratios above the terminal value and -1 for ratios below it.
        """
        width = _FARTHEST - sign * self._terminal
        if width < 1e-6:
            return np.zeros(0), np.zeros(0)
        # Knots are dense near the terminal ratio and evenly spaced elsewhere. The terminal ratio is
        # approached but never reached.
        close = np.exp(np.linspace(_NEAREST, math.log(width), _KNOTS))
        away = np.union1d(close, np.arange(width, 0.0, -_SPACING))
        ratio = self._terminal + sign * away
        rate = sign * self.table.ratio_rate(ratio)
        # `rate` is d ratio / d ln(remaining time), so d ln(remaining time) = d ratio / rate. The
        # integrand is smooth in ln(away), so this is the integration variable. `left` is
        # ln(remaining time), up to a constant.
        slope = away / np.maximum(rate, 1e-12)
        steps = np.diff(np.log(away)) * (slope[1:] + slope[:-1]) / 2
        left = np.concatenate([[0.0], np.cumsum(steps)])
        return sign * away, left

    def _ratio_after(self, start: Array, log_share: Array, rows: NDArray[np.intp]) -> Array:
        away = np.clip(start, -_FARTHEST, _FARTHEST) - self._terminal
        result = np.zeros(rows.shape)
        for sign, (ratios, left) in ((1.0, self._above), (-1.0, self._below)):
            chosen = sign * away[rows] > 0
            if not ratios.size or not chosen.any():
                continue
            begin = np.interp(np.log(sign * away[rows][chosen]), np.log(sign * ratios), left)
            result[chosen] = np.interp(begin + log_share[chosen], left, ratios)
        return np.asarray(result + self._terminal)

    def at(self, speed: Array, rim: Array, time: Array, rows: NDArray[np.intp]) -> State:
        """Compute states at times (N,) for launches (n,) with speed and rim speed of 0 or more.

        Times are multiplied by mu g. ``rows`` (N,) is the index of each time's launch.
        """
        total = self.table.rest_many(speed, rim)
        left = np.maximum(total[2][rows] - time, 0.0)
        share = np.maximum(left / np.maximum(total[2][rows], 1e-300), _MIN_LEFT)
        ratio = self._ratio_after(
            np.log(np.maximum(rim, 1e-12)) - np.log(np.maximum(speed, 1e-12)), np.log(share), rows
        )
        unit_v, unit_s = np.exp(np.minimum(-ratio, 0.0)), np.exp(np.minimum(ratio, 0.0))
        travel, turn, duration = self.table.rest_many(unit_v, unit_s)
        size = left / duration
        return State(
            total[0][rows] - travel * size**2,
            total[1][rows] - turn * size**2,
            unit_v * size,
            unit_s * size,
        )


@lru_cache(maxsize=512)
def _curve(support: str, gamma: float, log_torque_factor: float) -> _Curve:
    return _Curve(support, gamma * math.exp(log_torque_factor))


class SlideCurves:
    """Slides of a body; a polygon slides like its equivalent disk."""

    def __init__(self, body: Body, gravity: float, grid: float = FINE) -> None:
        self._body = body
        self._radius, self._gamma = body.support_radius, body.gamma
        self._gravity = gravity
        self._grid = grid

    def on(self, grid: float) -> SlideCurves:
        """Return a copy with tables of another spacing."""
        return SlideCurves(self._body, self._gravity, grid)

    def _around(self, log_torque_factor: float) -> tuple[_Curve, _Curve, float]:
        """Return the tables with the next smaller and larger torque factor, and the position
        between them, 0 to 1."""
        low, high = (math.log(limit) for limit in (0.05, 20.0))
        place = min(max(log_torque_factor, low), high) / self._grid
        step = math.floor(place)
        below, above = (
            _curve(self._body.support, self._gamma, number * self._grid)
            for number in (step, step + 1)
        )
        return below, above, place - step

    def at(
        self,
        launch: tuple[Array, Array],
        time: Array,
        rows: NDArray[np.intp],
        friction: Array,
        log_torque_factor: float,
    ) -> tuple[State, Slopes]:
        """Compute states (N,) of launches (speed and spin, (n,), m/s and rad/s) at times (N,) in s.

        ``rows`` (N,) is the index of each time's launch, and ``friction`` (n,) is that of each
        launch. An infinite time gives the end of the slide.
        """
        speed, spin = launch
        rim = np.abs(spin) * self._radius
        sign_v, sign_s = np.sign(speed)[rows], np.sign(spin)[rows]
        pull = (friction * self._gravity)[rows]
        below, above, part = self._around(log_torque_factor)
        low, high = (curve.at(np.abs(speed), rim, pull * time, rows) for curve in (below, above))
        mixed = State(*(a + part * (b - a) for a, b in zip(low, high, strict=True)))
        turned = sign_s / (pull * self._radius)
        return (
            State(
                sign_v * mixed.distance / pull,
                turned * mixed.rotation,
                sign_v * mixed.speed,
                sign_s * mixed.spin / self._radius,
            ),
            Slopes(
                sign_v * (high.distance - low.distance) / (pull * self._grid),
                turned * (high.rotation - low.rotation) / self._grid,
            ),
        )

    def launch(
        self, distance: Array, rotation: Array, friction: float, log_torque_factor: float
    ) -> tuple[Array, Array]:
        """Compute speeds and spins (n,) that cause these displacements."""
        pull = friction * self._gravity
        below, above, part = self._around(log_torque_factor)
        (v0, s0), (v1, s1) = (
            curve.table.launch_many(distance * pull, rotation * pull * self._radius)
            for curve in (below, above)
        )
        return v0 + part * (v1 - v0), (s0 + part * (s1 - s0)) / self._radius
