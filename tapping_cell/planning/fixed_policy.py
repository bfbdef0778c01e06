"""Expected number of taps to a goal with fixed tappers, on a grid over the object's (x, y, theta).

A state is the object's error relative to one goal. Each goal is solved separately, because the
object's position on the table determines which tappers can hit it and how.

The grid is graded: its steps are uniform near the goal and then grow in proportion to the distance
from the goal, up to a largest step. The step is limited because the expected number of taps is
interpolated between grid points: if a single tap cannot move the object by one step, the result is
far too high. The cell of a state is found without a search.

W is the least expected number of taps if at least one more tap must be made. The cost inside the
stopping box is 0. If the objective is time, W is the least expected time, in units of
``MEAN_TAP_S``. The scatter of a tap is represented by a fixed set of equally likely points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import Scatter
from tapping_cell.se2 import wrap_angle

LOST = 40.0
"""Cost, in taps, of a forbidden state and of a state from which no tap leads towards the goal."""

MIN_SCATTER = Scatter(0.02, 0.04, 0.003)
"""Minimum scatter that plans assume."""


class Grading(NamedTuple):
    """Steps of one axis of the grid. step: ratio of the steps to the distance from the goal. fine:
    distance up to which the steps are about uniform. widest: largest step. In m or rad."""

    step: float
    fine: float
    widest: float

    @property
    def _limits(self) -> tuple[float, float]:
        """Distance from the goal beyond which the steps are constant, and asinh(distance / fine) of
        this distance."""
        distance = math.sqrt(max((self.widest / self.step) ** 2 - self.fine**2, 0.0))
        return distance, math.asinh(distance / self.fine)

    def steps(self, value: NDArray[Any]) -> NDArray[Any]:
        """Return the fractional number of steps from the goal, with the sign of ``value``."""
        distance, limit = self._limits
        size = np.abs(value)
        graded = np.arcsinh(np.minimum(size, distance) / self.fine) / self.step
        constant = np.maximum(size - distance, 0.0) / self.widest
        return np.asarray(np.copysign(graded + constant, value))

    def value(self, steps: NDArray[Any]) -> NDArray[Any]:
        """Return the distance after a number of steps; inverse of :meth:`steps`."""
        distance, limit = self._limits
        size = self.step * np.abs(steps)
        graded = self.fine * np.sinh(np.minimum(size, limit))
        constant = np.maximum(size - limit, 0.0) * (self.widest / self.step)
        return np.asarray(np.copysign(graded + constant, steps))


class Grid(NamedTuple):
    """A graded grid about the goal. along, turn: steps of the distances and of the rotation. size:
    number of points on each side of the goal, for the distances and for the rotation."""

    along: Grading
    turn: Grading
    size: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of points along each axis."""
        along, turn = 2 * self.size[0] + 1, 2 * self.size[1] + 1
        return along, along, turn

    def coordinates(self, remaining: Array) -> Array:
        """Return the fractional grid indices, (3, ...), of states (..., 3)."""
        return np.stack(
            [
                self.along.steps(remaining[..., 0]) + self.size[0],
                self.along.steps(remaining[..., 1]) + self.size[0],
                self.turn.steps(remaining[..., 2]) + self.size[1],
            ]
        )

    def states(self) -> Array:
        """Return the errors (object minus goal) at the grid points, (n, n, m, 3)."""
        along = self.along.value(np.arange(-self.size[0], self.size[0] + 1))
        turn = self.turn.value(np.arange(-self.size[1], self.size[1] + 1))
        return np.stack(np.meshgrid(along, along, turn, indexing="ij"), axis=-1)


@dataclass(frozen=True, slots=True)
class Solution:
    """Solution for one goal: W on a grid about the goal, (n, n, m)."""

    goal: tuple[float, float, float]
    grid: Grid
    value: Array

    def taps_to_go(self, error: ArrayLike) -> Array:
        """Return the expected number of taps for errors (..., 3), object minus goal, if at least
        one more tap must be made."""
        e = np.asarray(error, dtype=float)
        where = self.grid.coordinates(e)
        return np.asarray(
            scipy.ndimage.map_coordinates(self.value, where, order=1, mode="constant", cval=LOST)
        )


def scatter_points(count: int) -> Array:
    """Return equally likely deviations of a tap, (count, 3): distance, rotation and direction, in
    standard deviations."""
    # Roberts' additive recurrence: evenly distributed in the cube and deterministic.
    root = 1.2207440846057596
    steps = np.outer(np.arange(1, count + 1), 1.0 / root ** np.arange(1, 4))
    drawn = scipy.special.ndtri((0.5 + steps) % 1.0)
    return np.asarray((drawn - drawn.mean(axis=0)) / drawn.std(axis=0))


def states_after(
    error: Array, heading: Array, slope: Array, length: Array, scatter: Scatter, points: Array
) -> Array:
    """Compute the errors (object minus goal) after taps, at every scatter point. Lengths (..., k)
    give errors (..., k, p, 3)."""
    length, turn = length[..., None], (length * slope)[..., None]
    size = length + scatter.along(length) * points[:, 0]
    turned = heading[..., None] + scatter.across(length) / length * points[:, 2]
    turn = turn + scatter.turning(turn) * points[:, 1]
    return np.stack(
        [
            error[..., 0, None] + size * np.cos(turned),
            error[..., 1, None] + size * np.sin(turned),
            wrap_angle(error[..., 2, None] + turn),
        ],
        axis=-1,
    )


def expected_taps(table: Array, grid: Grid, box: tuple[float, float], after: Array) -> Array:
    """Return the mean of W over ``after`` (..., p, 3), the states after a tap at its p scatter
    points. For states inside the box, 0 is used in place of W."""
    where = grid.coordinates(after)
    value = scipy.ndimage.map_coordinates(table, where, order=1, mode="constant", cval=LOST)
    inside = (np.hypot(after[..., 0], after[..., 1]) <= box[0]) & (np.abs(after[..., 2]) <= box[1])
    return np.asarray(np.where(inside, 0.0, value).mean(axis=-1))
