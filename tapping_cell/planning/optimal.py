"""The optimal method: the plan with the fewest expected taps, interpolated on its grid."""

from __future__ import annotations

import math
import threading

import numpy as np
import scipy
from numpy.typing import ArrayLike

from tapping_cell.planning.interface import Array, Taps
from tapping_cell.planning.lookup import Indices, bracket
from tapping_cell.planning.policy_cache import keep_policy, load_policy
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.two_tap import ExactPlanner
from tapping_cell.planning.value_iteration import (
    FINE_STEPS,
    MIN_DEVIATION,
    MIN_SCATTER,
    Solution,
    folded_weights,
    solutions,
)

ALIKE = 0.35
"""Neighbouring taps are interpolated if they differ by at most this share of the longest tap and of
its largest rotation."""


class OptimalPolicy:
    """A solved plan as a planning method: bilinear interpolation of the taps on its grid.

    If the four taps around a state are of different kinds (retreat and overshoot), the nearest tap
    is used, because the mean of different kinds would be wrong.
    """

    name = "optimal"

    def __init__(self, settings: PlannerSettings, solution: Solution) -> None:
        self.settings = settings
        self._solution = solution

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Choose the tap with the fewest expected taps in total."""
        i, u, j, v, sense = self._cell(distance, rotation)
        tap = _blend(self._solution.tap, i, u, j, v)
        turn = _blend(self._solution.turn, i, u, j, v)
        taps = np.stack([self._solution.tap[i + a, j + b] for a in (0, 1) for b in (0, 1)])
        turns = np.stack([self._solution.turn[i + a, j + b] for a in (0, 1) for b in (0, 1)])
        size = np.max(np.abs(taps), axis=0)
        unlike = (np.ptp(taps, axis=0) > ALIKE * size) | (
            np.ptp(turns, axis=0) > ALIKE * self.settings.cone_slope * size
        )
        near = (i + (u > 0.5), j + (v > 0.5))
        tap = np.where(unlike, self._solution.tap[near], tap)
        turn = np.where(unlike, self._solution.turn[near], turn)
        most = self.settings.cone_slope * np.abs(tap)
        return Taps(tap, sense * np.minimum(turn, most))

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the expected number of taps for these residuals, 0 inside the box. For residuals
        beyond the grid, one tap is added per multiple of the largest tap by which they exceed the
        grid."""
        # Rotations are divided by the learnt gain and may therefore exceed half a turn, where the
        # grid ends.
        most = self.settings.largest_distance
        far = np.asarray(distance, dtype=float) - self._solution.distances[-1]
        turned = np.abs(np.asarray(rotation, dtype=float)) - self._solution.rotations[-1]
        beyond = np.maximum(far, 0.0) / most
        beyond = beyond + np.maximum(turned, 0.0) / (self.settings.cone_slope * most)
        i, u, j, v, _ = self._cell(distance, rotation)
        box = self.settings.stopping
        inside = (np.asarray(distance) <= box.distance) & (np.abs(rotation) <= box.rotation)
        taps = _blend(self._solution.value, i, u, j, v) + beyond
        return np.asarray(np.where(inside, 0.0, taps))

    def taps_after(
        self, distance: float, rotation: float, aside: Array, sizes: Array, turns: Array
    ) -> Array:
        """Return the expected number of further taps after a tap; see ``interface.TapValues``."""
        return expected_taps(self._solution, self.settings, distance, rotation, aside, sizes, turns)

    def _cell(
        self, distance: ArrayLike, rotation: ArrayLike
    ) -> tuple[Indices, Array, Indices, Array, Array]:
        r, signed = np.broadcast_arrays(
            np.asarray(distance, dtype=float), np.asarray(rotation, dtype=float)
        )
        i, u = bracket(self._solution.distances, r)
        j, v = bracket(self._solution.rotations, np.abs(signed))
        return i, u, j, v, np.where(signed < 0.0, -1.0, 1.0)


class OptimalPlanner:
    """The optimal method: its plan is loaded from the cache, or solved now or in the background.

    While a plan is solved in the background, the taps come from exact two-tap plans, then from the
    plan on the coarse grid as soon as it is ready, and finally from the plan on the fine grid.
    ``name`` states which of these is in use.
    """

    def __init__(self, settings: PlannerSettings, *, background: bool = False) -> None:
        self.settings = settings
        self._fallback = ExactPlanner(settings)
        self._ready = threading.Event()
        self._policy: OptimalPolicy | None = None
        self._finest = False
        self._failure: BaseException | None = None
        kept = load_policy(settings)
        if kept is not None:
            self._policy = OptimalPolicy(settings, kept)
            self._finest = True
            self._ready.set()
        elif background:
            threading.Thread(target=self._solve, name="optimal-plan", daemon=True).start()
        else:
            self._solve()
            if self._failure is not None:
                raise self._failure

    @property
    def ready(self) -> bool:
        """True if the plan on the fine grid is in use."""
        return self._finest

    @property
    def failure(self) -> BaseException | None:
        """Exception of the solver, or None. After a failure the fallback stays in use."""
        return self._failure

    @property
    def name(self) -> str:
        """ "optimal", or a description of the method in use while the plan is being solved."""
        if self._finest:
            return "optimal"
        if self._policy is not None:
            return "optimal on a coarse grid (the fine one is being solved)"
        return f"{self._fallback.name} (optimal is being solved)"

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the plan is solved, at most ``timeout`` s; returns ``ready``."""
        self._ready.wait(timeout)
        return self.ready

    def choose(self, distance: ArrayLike, rotation: ArrayLike) -> Taps:
        """Return the optimal tap, or the tap of the fallback method while the plan is being
        solved."""
        return (self._policy or self._fallback).choose(distance, rotation)

    def taps_to_go(self, distance: ArrayLike, rotation: ArrayLike) -> Array:
        """Return the expected number of taps, or the estimate of the fallback method while the plan
        is being solved."""
        return (self._policy or self._fallback).taps_to_go(distance, rotation)

    def taps_after(
        self, distance: float, rotation: float, aside: Array, sizes: Array, turns: Array
    ) -> Array | None:
        """Return the expected number of further taps (see ``interface.TapValues``); None while the
        fallback is in use."""
        policy = self._policy
        if policy is None:
            return None
        return policy.taps_after(distance, rotation, aside, sizes, turns)

    def _solve(self) -> None:
        try:
            for solution in solutions(self.settings):
                self._policy = OptimalPolicy(self.settings, solution)
            keep_policy(self.settings, solution)
            self._finest = True
        except Exception as error:  # stored in ``failure``, because a thread has no caller
            self._failure = error
        finally:
            self._ready.set()


def _blend(table: Array, i: Indices, u: Array, j: Indices, v: Array) -> Array:
    low = (1.0 - v) * table[i, j] + v * table[i, j + 1]
    high = (1.0 - v) * table[i + 1, j] + v * table[i + 1, j + 1]
    return np.asarray((1.0 - u) * low + u * high)


ALONG_NODES, ASIDE_NODES = 48, 12
"""Numbers of nodes that represent the errors of distance and direction."""


def expected_taps(
    solution: Solution,
    settings: PlannerSettings,
    distance: float,
    rotation: float,
    aside: Array,
    sizes: Array,
    turns: Array,
) -> Array:
    """Return the expected number of taps that follow a tap, (directions, sizes, turns); infinite
    outside the cone.

    The solution contains only taps along the line to the goal. After a tap of length s at an angle
    phi to that line, the residual of a goal at the distance r is, in the frame of the tap, ::

        (r cos phi - s (1 + a), -r sin phi + s c)

    with the relative error a of the distance and the error c of the direction. Each of the two
    errors is represented by values of equal probability, its nodes. Each pair of nodes gives a
    length, whose weight is divided between the neighbouring points of the solution's grid. The
    rotation is independent of this length, as in ``value_iteration``.

    Args:
        solution: plan that is followed after the tap.
        settings: settings of that plan.
        distance, rotation: residual before the tap, m and rad.
        aside: directions of the tap relative to the direction of the goal, rad.
        sizes: lengths of the tap, m, above 0.
        turns: rotations of the tap, rad.
    """
    box, camera = settings.stopping, settings.camera
    scatter = settings.scatter.at_least(MIN_SCATTER)
    camera_noise = 2.0 * camera.position**2
    floor = MIN_DEVIATION * box.distance
    along = np.sqrt(scatter.along(sizes) ** 2 + camera_noise + floor**2)
    across = np.sqrt(scatter.across(sizes) ** 2 + camera_noise)
    ahead = distance * np.cos(aside)[:, None] - sizes
    beside = np.broadcast_to(-distance * np.sin(aside)[:, None], ahead.shape)
    lengths = np.hypot(
        (ahead[..., None] + along[:, None] * normal_nodes(ALONG_NODES))[..., :, None],
        (beside[..., None] + across[:, None] * normal_nodes(ASIDE_NODES))[..., None, :],
    ).reshape(ahead.size, -1)
    whole, inside = _radial_weights(solution.distances, lengths, box.distance)

    sense = -1.0 if rotation < 0.0 else 1.0
    deviation = np.sqrt(
        scatter.turning(turns) ** 2 + 2.0 * camera.angle**2 + (MIN_DEVIATION * box.rotation) ** 2
    )
    after, after_in = folded_weights(solution.rotations, abs(rotation) - sense * turns, deviation)
    value, near = solution.value, slice(0, FINE_STEPS + 1)
    taps = whole @ value @ after.T - inside @ value[near, near] @ after_in.T
    taps = taps.reshape(aside.size, sizes.size, turns.size)
    most = settings.cone_slope * sizes * (1.0 + 1e-9)
    return np.where(np.abs(turns) > most[:, None], np.inf, taps)


def normal_nodes(count: int) -> Array:
    """Return the conditional means of N(0, 1) over ``count`` intervals of equal probability,
    (count,)."""
    edges = scipy.special.ndtri(np.arange(1, count) / count)
    density = np.exp(-0.5 * edges**2) / math.sqrt(2.0 * math.pi)
    return np.asarray(-count * np.diff(density, prepend=0.0, append=0.0))


def _radial_weights(grid: Array, lengths: Array, box: float) -> tuple[Array, Array]:
    """Return the weights, (n, grid), for linear interpolation on a grid at lengths (n, nodes),
    averaged over the nodes. Also return the part of these weights that is due to lengths inside the
    box, (n, grid points up to the edge of the box)."""
    rows, nodes = lengths.shape
    index, share = bracket(grid, lengths)
    at = np.arange(rows)[:, None] * grid.size + index

    def spread(counted: Array) -> Array:
        low = np.bincount(at.ravel(), (counted * (1.0 - share)).ravel(), rows * grid.size)
        high = np.bincount(at.ravel() + 1, (counted * share).ravel(), rows * grid.size)
        return (low + high).reshape(rows, grid.size) / nodes

    inside = spread(np.asarray(lengths <= box, dtype=float))
    return spread(np.ones_like(share)), inside[:, : FINE_STEPS + 1]
