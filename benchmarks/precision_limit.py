"""Minimum expected number of taps, with any planning method, for moving an object by 10 mm and 10
degrees to within 0.1 mm and 0.1 degrees.

For a round object on an open table, distance and rotation to the goal are the complete state, and a
tap is given by direction, distance and rotation. The benchmark computes the optimal policy over all
taps, whereas the planning method ``optimal`` taps only along the line to the goal. Near the
smallest tap, where the expected taps change rapidly, the grid is finer than that of ``optimal``.
The camera noise is 0.01 mm and 0.01 degrees. The expected number of taps is accurate to 0.05: the
results of two grids differ by this value.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import ndtr

from benchmarks.precision import SMALLEST_TAPS_MM, settings_of
from tapping_cell.planning import PlannerSettings
from tapping_cell.planning.expected_taps import ASIDE_NODES, normal_nodes
from tapping_cell.planning.interface import Array
from tapping_cell.planning.lookup import bracket
from tapping_cell.planning.nominal import nominal_taps
from tapping_cell.planning.value_iteration import (
    MIN_DEVIATION,
    RATIO,
    folded_weights,
    interpolation_weights,
    state_grid,
)

TOLERANCE = 0.1
TASK = 0.010, math.radians(10.0)
FARTHEST, LARGEST_ROTATION = 0.060, math.radians(25.0)
LARGEST_TAP = 0.040
ALL_DIRECTIONS = np.linspace(0.0, math.pi, 9)
LINE = np.array([0.0, math.pi])
NEAR = 3.2
"""Limit for taps that are not along the line to the goal, in multiples of the length of the
smallest tap. Such a tap is considered only if neither its length nor the distance to the goal
exceeds the limit."""
ITERATIONS, EVALUATIONS, SETTLED = 12, 25, 2e-3


def measure() -> dict[str, Any]:
    """Return the minimum expected taps for two lengths of the smallest tap, two stopping boxes, and
    taps along the line or in all directions."""
    rows = []
    for least in SMALLEST_TAPS_MM:
        for box in (None, 1.0):
            settings = settings_of(least, TOLERANCE, box)
            rows.append(
                {
                    "smallest_tap_mm": least,
                    "box_mm": 1e3 * settings.stopping.distance,
                    "line": least_taps(settings, LINE),
                    "all": least_taps(settings, ALL_DIRECTIONS),
                }
            )
    return {"rows": rows}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [
        "10 mm and 10 degrees to 0.1 mm and 0.1 degrees: least expected taps of any method",
        "smallest  stopping box  taps on the line  taps of all directions",
    ]
    for row in report["rows"]:
        text.append(
            f"{row['smallest_tap_mm']:5.1f} mm {row['box_mm']:10.3f} mm {row['line']:17.2f} "
            f"{row['all']:23.2f}"
        )
    return text


def least_taps(settings: PlannerSettings, directions: Array) -> float:
    """Return the minimum expected number of taps for the task if taps are made only in
    ``directions``, in rad relative to the direction of the goal."""
    problem = _Problem(settings, directions)
    guess = nominal_taps(problem.r[:, None], problem.theta[None, :], settings) + 1.0
    value = problem.solved(np.asarray(guess, dtype=np.float32))
    i, u = bracket(problem.r, TASK[0])
    j, v = bracket(problem.theta, TASK[1])
    rows = (1.0 - u) * value[i] + u * value[i + 1]
    return float((1.0 - v) * rows[j] + v * rows[j + 1])


class _Problem:
    """Grids of states and taps, and transition weights between the states."""

    def __init__(self, settings: PlannerSettings, directions: Array) -> None:
        box, least = settings.stopping, settings.smallest_distance
        self.slope, self.settings = settings.cone_slope, settings
        grid, self.box_r = state_grid(box.distance, least, FARTHEST)
        self.theta, self.box_t = state_grid(box.rotation, self.slope * least, LARGEST_ROTATION)
        fine = least * np.arange(0.89, 1.5, 0.018)
        apart = 0.009 * least
        rest = grid[(grid < fine[0] - apart) | (grid > fine[-1] + apart)]
        self.r = np.sort(np.concatenate([rest, fine]))
        count = math.ceil(math.log(LARGEST_TAP / least) / math.log(RATIO))
        coarse = least * RATIO ** np.arange(count + 1)
        small = least * 1.02 ** np.arange(20)
        middle = least * 1.05 ** np.arange(8, 18)
        sizes = np.unique(np.concatenate([small, middle, coarse[coarse > 2.4 * least]]))
        turns = self.slope * least * RATIO ** np.arange(-14.0, count + 1)
        shared = np.broadcast_to(np.append(0.0, turns), (self.theta.size, turns.size + 1))
        self.turns = np.concatenate([shared, self.theta[:, None]], axis=1)
        spread = np.sqrt(
            (settings.scatter.rotation * self.turns) ** 2
            + 2.0 * settings.camera.angle**2
            + (MIN_DEVIATION * box.rotation) ** 2
        )
        self.p_t = folded_weights(self.theta, self.theta[:, None] - self.turns, spread)
        self.taps, self.p_r = [], []
        for r in self.r.tolist():
            beside = directions if r <= NEAR * least else LINE
            size, direction = (x.ravel() for x in np.meshgrid(sizes, beside, indexing="ij"))
            on_line = (direction == 0.0) | (direction == math.pi)
            useful = (size <= 4.0 * max(r, least) + 0.012) & (on_line | (size <= NEAR * least))
            size = np.append(size[useful], min(max(r, least), LARGEST_TAP))
            direction = np.append(direction[useful], 0.0)
            self.taps.append(size)
            self.p_r.append(self._after(r, size, direction))

    def _after(self, r: float, size: Array, direction: Array) -> tuple[Array, Array]:
        """Return two arrays with a row for each of the n taps from distance ``r``: the expected
        interpolation weights of the grid's distances after the tap, and the part of these weights
        that is due to distances inside the stopping box."""
        scatter, measurement = self.settings.scatter, 2.0 * self.settings.camera.position**2
        floor = MIN_DEVIATION * self.settings.stopping.distance
        along = np.sqrt((scatter.distance * size) ** 2 + measurement + floor**2)[:, None]
        aside = np.sqrt((scatter.direction * size) ** 2 + measurement)
        ahead, beside = (r * np.cos(direction) - size)[:, None], -r * np.sin(direction)

        def distribution(z: Array) -> Array:
            total = np.zeros((size.size, z.size))
            for node in normal_nodes(ASIDE_NODES).tolist():
                left = z**2 - ((beside + node * aside) ** 2)[:, None]
                chord = np.sqrt(np.maximum(left, 0.0))
                inside = ndtr((chord - ahead) / along) - ndtr((-chord - ahead) / along)
                total += np.where(left > 0.0, inside, 0.0)
            return total / ASIDE_NODES

        points, shares = np.polynomial.legendre.leggauss(3)
        width = np.diff(self.r)
        abscissae = (self.r[:-1, None] + width[:, None] * (points + 1.0) / 2.0).ravel()
        cells = distribution(abscissae).reshape(size.size, width.size, 3) @ (shares / 2.0) * width
        cumulative = np.concatenate([np.zeros((size.size, 1)), np.cumsum(cells, axis=1)], axis=1)
        edge = self.r[self.box_r : self.box_r + 1]
        return interpolation_weights(self.r, cumulative, self.box_r, distribution(edge)[:, 0])

    def solved(self, value: Array) -> Array:
        """Return the value function of the optimal policy, computed by policy iteration."""
        rows, columns = self.r.size, self.theta.size
        both = np.concatenate([self.p_t[0], -self.p_t[1]], axis=-1)
        flat = both.reshape(-1, both.shape[-1]).T.copy()
        column = np.arange(columns)
        for _ in range(ITERATIONS):
            improved = np.empty((rows, columns), dtype=np.float32)
            tap, turn = (np.empty((rows, columns), dtype=np.intp) for _ in range(2))
            inside = value[: self.box_r + 1, : self.box_t + 1]
            for row, (whole, part) in enumerate(self.p_r):
                cost = np.concatenate([whole @ value, part @ inside], axis=1) @ flat
                cost = cost.reshape(len(whole), columns, -1)
                limit = self.slope * self.taps[row] * (1.0 + 1e-9)
                cost[self.turns[None] > limit[:, None, None]] = np.inf
                chosen = cost.argmin(axis=2)
                best = np.take_along_axis(cost, chosen[..., None], axis=2)[..., 0]
                tap[row] = best.argmin(axis=0)
                turn[row] = chosen[tap[row], column]
                improved[row] = 1.0 + best[tap[row], column]
            change = np.abs(improved - value)[improved < 10.0].max()
            value = self._evaluated(improved, tap, turn)
            if change < SETTLED:
                break
        return value

    def _evaluated(self, value: Array, tap: Array, turn: Array) -> Array:
        to_r, in_r = (
            np.stack([part[index][tap[row]] for row, part in enumerate(self.p_r)])
            for index in (0, 1)
        )
        to_t, in_t = (weights[np.arange(self.theta.size), turn] for weights in self.p_t)
        for _ in range(EVALUATIONS):
            inside = value[: self.box_r + 1, : self.box_t + 1]
            outer = np.einsum("ijk,ijk->ij", to_r @ value, to_t)
            value = 1.0 + outer - np.einsum("ijk,ijk->ij", in_r @ inside, in_t)
        return value
