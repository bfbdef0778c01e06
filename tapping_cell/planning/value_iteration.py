"""Plan with the fewest expected taps, solved as a stochastic shortest path over the residual.

Source: Bertsekas, *Dynamic Programming and Optimal Control*, 2012, vol. 2, ch. 3.

The state is the distance r >= 0 and the rotation theta >= 0 to the goal (a rotation in the opposite
sense gives the mirror image). A tap (d, turn) changes the state to ::

    r'     = hypot(r - d (1 + a), |d| c)     a, c: scatter of distance and direction
    theta' = |theta - turn (1 + b)|          b: scatter of the rotation

where the noise of the camera is added to the scatter. The run ends inside the stopping box. The
value W(r, theta) is the least expected number of taps if at least one more tap must be made. The
value of a state is 0 inside the box and W outside. W is smooth because it is an average over the
scatter of a tap. It is therefore stored on a product grid and interpolated linearly. For a given
tap, r' and theta' are independent. The expectations for all taps from a state are therefore two
matrix products,

    E = P_r W P_t^T - (the part of this product from values inside the box).

A row of P_r or P_t contains the expected weights of linear interpolation, as exact integrals over
the distribution. The solver uses policy iteration: each improvement compares all taps of the action
grid, and repeated sweeps between improvements evaluate the policy. The problem is first solved on a
coarse grid, whose values initialise the fine grid (Chow and Tsitsiklis, IEEE Trans. Automatic
Control 36, 1991). The coarse plan is ready in a fraction of a second, and the fine grid then needs
only few improvements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from tapping_cell.planning.interface import Array
from tapping_cell.planning.lookup import bracket
from tapping_cell.planning.nominal import nominal_taps
from tapping_cell.planning.settings import PlannerSettings, Scatter

RATIO = 1.1
"""Ratio of neighbouring grid values far from the box, for states and for taps."""

COARSE_RATIO = 1.3
"""Ratio of neighbouring values of the coarse grid far from the box."""

FINE_STEPS = 5
"""Number of grid steps from the goal to the edge of the box."""

FARTHEST = 1.0
"""Distance in m beyond which the plan does not change."""

SMALLEST_TURN = 0.26
"""Smallest rotation of the taps that are compared, as a share of the largest rotation of the
smallest tap."""

LATERAL_NODES = 8
"""Number of quadrature nodes over one half of the (symmetric) error of direction."""

MIN_SCATTER = Scatter(0.02, 0.04, 0.0)
"""Minimum scatter that plans assume. Without scatter, plans would aim exactly at the edge of the
cone, which lies between two grid points."""

IMPROVEMENTS = 12
EVALUATIONS = 25
SETTLED, NEAR = 1e-3, 10.0
"""Policy iteration ends early when an improvement changes every value below ``NEAR`` by less than
``SETTLED`` (both in taps)."""

MIN_DEVIATION = 0.01
"""Minimum standard deviation, as a share of the box; it keeps the integrals finite if there is no
scatter."""


Values = NDArray[np.float32]
"""Single precision, because the matrix products take most of the time and an error of 1e-6 taps is
negligible."""


class Solution(NamedTuple):
    """A solved plan on the product grid of distances (m) and rotations (rad).

    value: expected taps if at least one more tap must be made; tap, turn: distance and rotation of
    that tap.
    """

    distances: Array
    rotations: Array
    value: Array
    tap: Array
    turn: Array


def solve(settings: PlannerSettings) -> Solution:
    """Solve the shortest path for these settings; this takes a few seconds."""
    *_, finest = solutions(settings)
    return finest


def solutions(settings: PlannerSettings) -> Iterator[Solution]:
    """Generate plans for these settings: first on the coarse grid, then on the fine grid."""
    known: Solution | None = None
    for ratio in (COARSE_RATIO, RATIO):
        problem = _Problem(settings, ratio)
        if known is None:
            guess = nominal_taps(problem.r[:, None], problem.theta[None, :], settings) + 1.0
        else:
            guess = _resampled(known, problem.r, problem.theta)
        known = problem.solved(np.asarray(guess, dtype=np.float32))
        yield known


def _resampled(known: Solution, r: Array, theta: Array) -> Array:
    """Interpolate the values of a plan bilinearly on another grid."""
    i, u = bracket(known.distances, r)
    j, v = bracket(known.rotations, theta)
    rows = (1.0 - u[:, None]) * known.value[i] + u[:, None] * known.value[i + 1]
    return np.asarray((1.0 - v) * rows[:, j] + v * rows[:, j + 1])


class _Improvement(NamedTuple):
    value: Values
    tap: NDArray[np.intp]  # index into the taps of the state's distance
    turn: NDArray[np.intp]  # index into the turns of the state's rotation


class _Problem:
    """Grids and transition weights."""

    def __init__(self, settings: PlannerSettings, ratio: float) -> None:
        box = settings.stopping
        least, most, k = settings.smallest_distance, settings.largest_distance, settings.cone_slope
        scatter, camera = settings.scatter.at_least(MIN_SCATTER), settings.camera
        self.slope = k
        self.r, self.box_r = state_grid(box.distance, least, max(FARTHEST, 4.0 * most), ratio)
        self.theta, self.box_t = state_grid(box.rotation, k * least, math.pi, ratio)

        sizes = least * ratio ** np.arange(math.ceil(math.log(most / least) / math.log(ratio)) + 1)
        sizes[-1] = most
        signed = np.concatenate([sizes, -sizes])
        own = np.clip(self.r, least, most)[:, None]
        self.taps = np.concatenate([np.broadcast_to(signed, (self.r.size, signed.size)), own], 1)
        small = k * least * ratio ** np.arange(round(math.log(SMALLEST_TURN, ratio)), 0.0)
        turns = np.concatenate([[0.0], small, k * sizes])
        self.turns = np.concatenate(
            [np.broadcast_to(turns, (self.theta.size, turns.size)), self.theta[:, None]], axis=1
        )

        floor_r, floor_t = MIN_DEVIATION * box.distance, MIN_DEVIATION * box.rotation
        camera_r, camera_t = 2.0 * camera.position**2, 2.0 * camera.angle**2
        along = np.sqrt(scatter.along(self.taps) ** 2 + camera_r + floor_r**2)
        aside = np.sqrt(scatter.across(self.taps) ** 2 + camera_r)
        self.p_r = _radial_weights(self.r, self.r[:, None] - self.taps, along, aside)
        spread = np.sqrt(scatter.turning(self.turns) ** 2 + camera_t + floor_t**2)
        self.p_t = folded_weights(self.theta, self.theta[:, None] - self.turns, spread)

    def solved(self, value: Values) -> Solution:
        """Run policy iteration from initial values."""
        best = self.improve(value)
        for _ in range(IMPROVEMENTS):
            value = self.evaluate(value, best)
            improved = self.improve(value)
            change = np.abs(improved.value - value)[value < NEAR]
            best, value = improved, improved.value
            if change.max(initial=0.0) < SETTLED:
                break
        return Solution(
            self.r,
            self.theta,
            value.astype(float),
            self.taps[np.arange(self.r.size)[:, None], best.tap],
            self.turns[np.arange(self.theta.size)[None, :], best.turn],
        )

    def improve(self, value: Values) -> _Improvement:
        """Return the best tap of every state, given a value function."""
        rows, columns = self.r.size, self.theta.size
        after_turn, after_turn_in = self.p_t
        flat = after_turn.reshape(-1, columns).T.copy()
        inside = value[: self.box_r + 1, : self.box_t + 1]
        flat_in = after_turn_in.reshape(-1, self.box_t + 1).T.copy()
        shape = (self.taps.shape[1], columns, self.turns.shape[1])
        best = _Improvement(
            np.empty((rows, columns), dtype=np.float32),
            np.empty((rows, columns), dtype=np.intp),
            np.empty((rows, columns), dtype=np.intp),
        )
        for row in range(rows):
            cost = (self.p_r[0][row] @ value) @ flat
            cost -= (self.p_r[1][row] @ inside) @ flat_in
            cost = cost.reshape(shape)
            limit = self.slope * np.abs(self.taps[row]) * (1.0 + 1e-9)
            cost[self.turns[None, :, :] > limit[:, None, None]] = np.inf
            flattened = cost.transpose(1, 0, 2).reshape(columns, -1)
            choice = np.argmin(flattened, axis=1)
            best.value[row] = 1.0 + flattened[np.arange(columns), choice]
            best.tap[row], best.turn[row] = np.divmod(choice, shape[2])
        return best

    def evaluate(self, value: Values, policy: _Improvement) -> Values:
        """Return the value function of a fixed policy, iterated from the initial ``value``."""
        rows, columns = np.indices(policy.tap.shape)
        to_r, in_r = (weights[rows, policy.tap] for weights in self.p_r)
        to_t, in_t = (weights[columns, policy.turn] for weights in self.p_t)
        for _ in range(EVALUATIONS):
            inside = value[: self.box_r + 1, : self.box_t + 1]
            outer = np.einsum("ijk,ijk->ij", to_r @ value, to_t)
            value = 1.0 + outer - np.einsum("ijk,ijk->ij", in_r @ inside, in_t)
        return value


def state_grid(
    box: float, smallest: float, farthest: float, ratio: float = RATIO
) -> tuple[Array, int]:
    """Return a grid from 0 through the edge of the box to ``farthest`` and the index of this edge.

    The steps are uniform up to twice the box and twice the smallest tap, and grow farther out.
    """
    step = box / FINE_STEPS
    uniform = np.arange(0.0, 2.0 * max(box, smallest) + step, step)
    if uniform.size > 10 * FINE_STEPS:
        # The box is far smaller than the smallest tap, and the steps would be too many.
        uniform = np.arange(0.0, 2.0 * box + step, step)
    return np.array(_extended(uniform.tolist(), farthest, ratio)), FINE_STEPS


def _extended(values: list[float], farthest: float, ratio: float) -> list[float]:
    """Return a uniform grid with growing steps up to ``farthest`` appended.

    A step is at most ``ratio`` squared times the step before it, until it is the share ``ratio`` -
    1 of its grid value.
    """
    step = values[1] - values[0]
    while values[-1] < farthest:
        step = max(step, min(step * ratio**2, values[-1] * (ratio - 1.0)))
        values.append(values[-1] + step)
    values[-1] = farthest
    if values[-1] - values[-2] < 0.5 * step:  # the cut left a short last step
        del values[-2]
    return values


def interpolation_weights(
    grid: Array, cumulative: Array, box: int, at_box: Array
) -> tuple[Array, Array]:
    """Compute the expected weights of linear interpolation from the integral of the distribution
    function.

    ``cumulative``: I(z) = integral of F from 0 to z at the grid points (last axis); ``at_box``: F
    at the edge of the box. The weight of node k is the expectation of its hat function; integration
    by parts turns it into the difference of the slopes of I on both sides of the node. The second
    result is the part of the weights due to values inside the box.
    """
    slope = np.diff(cumulative, axis=-1) / np.diff(grid)
    ends = np.ones((*slope.shape[:-1], 1))
    upper = np.concatenate([slope, ends], axis=-1)
    lower = np.concatenate([np.zeros_like(ends), slope], axis=-1)
    whole = upper - lower
    inside = whole[..., : box + 1].copy()
    inside[..., box] = at_box - slope[..., box - 1]
    return whole.astype(np.float32), inside.astype(np.float32)


def folded_weights(grid: Array, mean: Array, deviation: Array) -> tuple[Array, Array]:
    """Compute the weights for |N(mean, deviation)|: I(z) = H(z) + H(-z) - 2 H(0), where H is the
    integral of the normal distribution function."""
    box = FINE_STEPS

    def integral(z: Array) -> Array:
        u = (z - mean[..., None]) / deviation[..., None]
        density = np.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
        return np.asarray(deviation[..., None] * (u * scipy.special.ndtr(u) + density))

    cumulative = integral(grid) + integral(-grid) - 2.0 * integral(np.zeros(1))
    edge = grid[box]
    at_box = scipy.special.ndtr((edge - mean) / deviation) - scipy.special.ndtr(
        (-edge - mean) / deviation
    )
    return interpolation_weights(grid, cumulative, box, at_box)


def _radial_weights(grid: Array, mean: Array, along: Array, aside: Array) -> tuple[Array, Array]:
    """Return interpolation weights for the expectation over a distance hypot(u, v), with normal
    distributions u ~ N(mean, along) and v ~ N(0, aside).

    Nodes of equal probability represent the lateral part v. The distribution function of the
    distance is integrated over each cell of the grid by Gaussian quadrature with three points.
    """
    box = FINE_STEPS
    lateral = _normal_quantiles(LATERAL_NODES)

    def distribution(z: Array) -> Array:
        total = np.zeros((*mean.shape, z.size))
        for node in lateral:
            offset = (node * aside)[..., None]
            chord = np.sqrt(np.maximum(z * z - offset * offset, 0.0))
            upper = scipy.special.ndtr((chord - mean[..., None]) / along[..., None])
            total += upper - scipy.special.ndtr((-chord - mean[..., None]) / along[..., None])
        return total / lateral.size

    points, shares = np.polynomial.legendre.leggauss(3)
    width = np.diff(grid)
    abscissae = (grid[:-1, None] + width[:, None] * (points + 1.0) / 2.0).reshape(-1)
    values = distribution(abscissae).reshape(*mean.shape, width.size, 3)
    cells = values @ (shares / 2.0) * width
    cumulative = np.concatenate([np.zeros((*mean.shape, 1)), np.cumsum(cells, axis=-1)], axis=-1)
    return interpolation_weights(grid, cumulative, box, distribution(grid[box : box + 1])[..., 0])


def _normal_quantiles(count: int) -> Array:
    """Return the conditional means of |N(0, 1)| over ``count`` intervals of equal probability."""
    edges = scipy.special.ndtri(0.5 + 0.5 * np.arange(count) / count)
    density = np.append(np.exp(-0.5 * edges**2), 0.0) / math.sqrt(2.0 * math.pi)
    return np.asarray(2.0 * count * -np.diff(density))
