"""Policy iteration for a goal in a cell with fixed tappers, over the object's states (x, y, theta).

Source: Bertsekas, *Dynamic Programming and Optimal Control*, 2012, vol. 2, ch. 3 (stochastic
shortest path).

A tap is defined by a tapper and a length. The lengths tried are a geometric progression, the length
after which the object is nearest to the goal, and the length that corrects the rotation. A policy
improvement compares the taps of every state by the mean of W (see ``fixed_policy``) over the
scatter. W is taken from the nearest point of a table that also has points halfway between the grid
points. The state after a tap is therefore an index, which is computed only once per grid. Between
improvements, the policy is evaluated by sweeps with a sparse transition matrix of linear
interpolation weights. The problem is first solved on a coarse grid. This solution initialises the
solution on the fine grid, for which only the taps that are promising on the coarse grid are
compared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tapping_cell.planning.fixed_policy import (
    LOST,
    MIN_SCATTER,
    Grading,
    Grid,
    Solution,
    scatter_points,
)
from tapping_cell.planning.fixed_tappers import (
    MEAN_TAP_S,
    FixedStrikeSpace,
    Lines,
    tap_seconds,
)
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import PlannerSettings

Singles = NDArray[np.float32]
Indices = NDArray[np.int32]

COARSE, FINE = 0.7, 0.22
"""Ratio of a grid step to the distance from the goal (see ``Grading``) on the first and the last
grid."""

WIDEST_STEPS = (0.03, 0.3)
"""Largest steps of the grid, m and rad. One tap can move and rotate the object by such a step. With
larger steps, plans for large rotations would begin with taps that hardly move the object."""

FINE_DISTANCE = 2.0
"""Distance from the goal, in sizes of the stopping box, within which the grid is almost uniform."""

LENGTHS = (8, 12)
"""Numbers of tap lengths, in geometric progression, that are tried in a state: the first on the
coarse grid, the second on the finer grids."""

OUTER = 0.020
"""Width, m, of the border around the working area for which the policy is computed. A tap may move
the object out of the area."""

POINTS = (4, 8)
"""Numbers of equally likely points that represent a tap's scatter while solving: the first on the
coarse grid, the second on the finer grids."""

IMPROVEMENTS = (3, 4)
"""Maximum numbers of policy improvements: the first on the coarse grid, the second on the finer
grids."""

SWEEPS = 20
SETTLED = 0.01
"""Mean change of W, in taps, below which the iteration ends."""

MAX_KEPT = 20
"""Number of taps per state that are compared on the fine grid."""

AROUND = (0.93, 1.07)
"""Multiples of the best length that are tried as well."""

CHUNK = 200_000
"""Number of end states of taps that are computed per batch, so that a batch fits in the processor's
cache."""

PER_HALF_STEP = 6
"""Resolution of the index table of an axis: number of entries per half of the grid's smallest
step."""


class Abandoned(Exception):
    """Solving was interrupted by a more urgent request."""


def solve_coarse(space: FixedStrikeSpace, settings: PlannerSettings, goal: ArrayLike) -> Solution:
    """Solve for a goal on the coarse grid. This is fast, and accurate enough far from the goal.

    If the first tap comes from this solution, runs need 0.05 taps (0.04 s) more than if it comes
    from a grid of ratio 0.5 (300 tasks at each of three goals). As the solution on the grid of
    ratio 0.5 takes 0.15 s longer, the coarse grid is used.
    """
    place = np.asarray(goal, dtype=float)
    problem = _Problem(space, settings, place, COARSE, LENGTHS[0], POINTS[0])
    return _solve_on(problem, IMPROVEMENTS[0], None)


def solve_finer(
    space: FixedStrikeSpace,
    settings: PlannerSettings,
    start: Solution,
    step: float = FINE,
    interrupted: Callable[[], bool] = lambda: False,
) -> Solution:
    """Refine a coarse solution on a finer grid.

    Raises:
        Abandoned: ``interrupted``, which is called some hundred times a second, returned True.
    """
    place = np.asarray(start.goal, dtype=float)
    problem = _Problem(space, settings, place, step, LENGTHS[1], POINTS[1], interrupted)
    problem.keep_best(problem.start(start))
    return _solve_on(problem, IMPROVEMENTS[1], start)


def _solve_on(problem: _Problem, improvements: int, start: Solution | None) -> Solution:
    value = problem.start(start)
    for _ in range(improvements):
        before = value
        value = problem.evaluate(value, *problem.improve(value))
        if float(np.mean(np.abs(value - before)[problem.rows])) < SETTLED:
            break
    return Solution(problem.goal, problem.grid, value.reshape(problem.grid.shape))


class _Axis:
    """Lookup table for the points of one axis: the grid points and the points halfway between them.
    It finds the nearest point ten times as fast as a computation with a logarithm.

    ``stride``: stride of the axis in the flat value table. Coordinates beyond the ends of the axis
    have the index ``beyond``.
    """

    def __init__(self, grading: Grading, size: int, stride: int, beyond: int, most: float) -> None:
        width = grading.fine * math.sinh(grading.step / 2.0) / PER_HALF_STEP
        self.scale = np.float32(1.0 / width)
        self.middle = math.ceil(most / width)
        value = width * np.arange(-self.middle, self.middle + 1)
        half = np.rint(2.0 * grading.steps(value)).astype(np.int64) + 2 * size
        outside = (half < 0) | (half > 4 * size)
        self.table = np.where(outside, beyond, half * stride).astype(np.int32)

    def index(self, value: Singles) -> Indices:
        """Return the indices of values in m or rad."""
        entry = (value * self.scale + np.float32(self.middle + 0.5)).astype(np.int32)
        return np.asarray(np.take(self.table, entry, mode="clip"))


class _Problem:
    """States, the possible taps of each state, and the states after these taps.

    rows: indices (n,) of the grid's states that have at least one possible tap. heading, slope,
    least, most: properties of their taps, (n, tappers); ``least`` is NaN for an impossible tap.
    """

    def __init__(
        self,
        space: FixedStrikeSpace,
        settings: PlannerSettings,
        goal: Array,
        step: float,
        lengths: int,
        points: int,
        interrupted: Callable[[], bool] = lambda: False,
    ) -> None:
        self.goal = (float(goal[0]), float(goal[1]), float(goal[2]))
        self._interrupted = interrupted
        box = settings.stopping
        self.box = box.distance, box.rotation
        fine = FINE_DISTANCE * box.distance, FINE_DISTANCE * box.rotation
        area = space.area
        far = math.hypot(goal[0] - area.x, goal[1] - area.y) + area.radius + OUTER
        along, turn = (Grading(step, *each) for each in zip(fine, WIDEST_STEPS, strict=True))
        sizes = (
            math.ceil(along.steps(np.array(far))),
            math.ceil(turn.steps(np.array(math.pi))),
        )
        self.grid = Grid(along, turn, sizes)
        self.states = self.grid.states().reshape(-1, 3)
        places = self.states + goal
        allowed = area.clearance(places[:, :2]) >= -OUTER
        allowed &= space.workspace.object_clearance(places[:, :2]) >= space.object_radius
        rows = np.flatnonzero(allowed)
        lines = _lines_at(space, places, rows, self.grid.shape)
        has_taps = np.any(lines.usable, axis=1)
        self.rows, lines = rows[has_taps], lines.of(np.flatnonzero(has_taps))
        self.error = self.states[self.rows].astype(np.float32)
        self.heading = lines.heading.astype(np.float32)
        self.slope = lines.slope.astype(np.float32)
        self.usable = lines.usable
        self._timed = space.objective == "time"
        self._travel, self._reach = lines.travel, lines.reach
        self.least = lines.least.astype(np.float32)
        most = np.minimum(lines.most, settings.largest_distance)
        self.most = np.maximum(most, lines.least).astype(np.float32)
        self.scatter = settings.scatter.at_least(MIN_SCATTER)
        self.points = scatter_points(points).astype(np.float32)
        self._make_axes(far + 2.0 * settings.largest_distance)
        self._exponents = np.linspace(0.0, 1.0, lengths, dtype=np.float32)
        self._per_tapper = lengths + 2
        count = lines.usable.shape[1] * self._per_tapper
        self.kept = np.broadcast_to(np.arange(count), (self.rows.size, count))
        """Indices of the compared taps: tapper * (lengths + 2) + length."""
        self._after: Indices | None = None

    def _make_axes(self, most: float) -> None:
        wide, turn = (4 * size + 1 for size in self.grid.size)
        self._beyond = wide * wide * turn
        grid = self.grid
        self._axes = (
            _Axis(grid.along, grid.size[0], wide * turn, self._beyond, most),
            _Axis(grid.along, grid.size[0], turn, self._beyond, most),
            _Axis(grid.turn, grid.size[1], 1, self._beyond, math.pi * 1.01),
        )

    def start(self, coarse: Solution | None) -> Array:
        """Return the initial W: from a coarser solution or, if there is none, estimated from
        distance and rotation."""
        value = np.full(self.states.shape[0], LOST)
        states = self.states[self.rows]
        if coarse is not None:
            guess = coarse.taps_to_go(states)
        else:
            error = np.hypot(states[:, 0], states[:, 1]) / self.box[0]
            guess = 2.0 + np.log1p(error) + np.log1p(np.abs(states[:, 2]) / self.box[1])
        value[self.rows] = np.minimum(guess, LOST)
        return value

    def _lengths(self, rows: slice) -> Singles:
        """Return the lengths of all taps of the given states, (n, tappers, lengths + 2), m."""
        least, most = self.least[rows, :, None], self.most[rows, :, None]
        heading, slope, error = self.heading[rows], self.slope[rows], self.error[rows]
        progression = least * (most / least) ** self._exponents
        nearest = -(error[:, 0, None] * np.cos(heading) + error[:, 1, None] * np.sin(heading))
        turned = -error[:, 2, None] / np.where(np.abs(slope) < 1e-3, np.float32(np.inf), slope)
        own = np.stack([nearest, turned], axis=-1)
        return np.concatenate([progression, np.clip(own, least, most)], axis=-1)

    def _taps(self, rows: slice) -> tuple[NDArray[np.intp], Singles]:
        """Return the tapper and the length of the compared taps of the given states, (n, kept)
        each."""
        lengths = self._lengths(rows)
        kept = self.kept[rows]
        flat = lengths.reshape(lengths.shape[0], -1)
        return kept // self._per_tapper, np.take_along_axis(flat, kept, axis=1)

    def _end_entries(
        self, rows: slice, tapper: NDArray[np.intp], length: Singles, points: Singles
    ) -> Indices:
        """Return the indices in ``_table``, (n, k, p), of the states after taps (n, k) of the given
        states."""
        heading = np.take_along_axis(self.heading[rows], tapper, axis=1)
        slope = np.take_along_axis(self.slope[rows], tapper, axis=1)
        x, y, turn = self._ends(self.error[rows][:, None], heading, slope, length, points)
        entry = self._axes[0].index(x)
        entry += self._axes[1].index(y)
        entry += self._axes[2].index(turn)
        np.minimum(entry, self._beyond, out=entry)
        inside = (x * x + y * y <= self.box[0] ** 2) & (np.abs(turn) <= self.box[1])
        entry[inside] = self._beyond + 1  # the entries of ``_table`` after the grid
        entry[~np.take_along_axis(self.usable[rows], tapper, axis=1)] = self._beyond + 2
        return entry

    def _cost(self, rows: slice, tapper: NDArray[np.intp], length: Singles) -> Singles | float:
        """Return the costs of taps of the given states, (n, k)."""
        if not self._timed:
            return 1.0
        travel = np.take_along_axis(self._travel[rows], tapper, axis=1)
        reach = np.take_along_axis(self._reach[rows], tapper, axis=1)
        return (tap_seconds(travel, reach, length) / MEAN_TAP_S).astype(np.float32)

    def _ends(
        self, error: Singles, heading: Singles, slope: Singles, length: Singles, points: Singles
    ) -> tuple[Singles, Singles, Singles]:
        """Return x, y and theta after taps (...) of states ``error`` (..., 3) at every scatter
        point, each (..., p)."""
        turn = length * slope
        along = self.scatter.along(length).astype(np.float32)
        turning = self.scatter.turning(turn).astype(np.float32)
        across = self.scatter.across(length).astype(np.float32) / length
        size = length[..., None] + along[..., None] * points[:, 0]
        turned = heading[..., None] + across[..., None] * points[:, 2]
        theta = turn[..., None] + turning[..., None] * points[:, 1]
        theta += error[..., 2, None]
        theta -= np.float32(2.0 * math.pi) * np.rint(theta * np.float32(0.5 / math.pi))
        return (
            error[..., 0, None] + size * np.cos(turned),
            error[..., 1, None] + size * np.sin(turned),
            theta,
        )

    def _table(self, value: Array) -> Singles:
        """Return a flat table of W at the grid points and at points halfway between them. Three
        entries are appended: W beyond the grid, W in the stopping box and W of an impossible tap.
        """
        table: Singles = value.reshape(self.grid.shape).astype(np.float32)
        for axis in range(3):
            table = _halved(table, axis)
        return np.append(table.reshape(-1), np.array([LOST, 0.0, np.inf], dtype=np.float32))

    def _chunks(self, taps: int) -> Iterator[slice]:
        size = max(1, CHUNK // taps)
        for first in range(0, self.rows.size, size):
            if self._interrupted():
                raise Abandoned
            yield slice(first, first + size)

    def keep_best(self, value: Array) -> None:
        """Restrict later comparisons to the taps with the lowest mean W over a few points."""
        table = self._table(value)
        count = self.kept.shape[1]
        if count <= MAX_KEPT:
            return
        kept = np.empty((self.rows.size, MAX_KEPT), dtype=np.intp)
        few = self.points[: len(self.points) // 2]
        for rows in self._chunks(count * few.shape[0]):
            taps = self._taps(rows)
            mean = table[self._end_entries(rows, *taps, few)].mean(axis=-1)
            mean += self._cost(rows, *taps)
            kept[rows] = np.argpartition(mean, MAX_KEPT, axis=1)[:, :MAX_KEPT]
        self.kept = kept

    def improve(self, value: Array) -> tuple[NDArray[np.intp], Singles]:
        """Return the best tap of every state for this W: its tapper (n,) and length (n,), m."""
        table = self._table(value)
        chosen = np.empty(self.rows.size, dtype=np.intp)
        length = np.empty(self.rows.size, dtype=np.float32)
        first = self._after is None
        count = self.kept.shape[1]
        if self._after is None:
            self._after = np.empty((self.rows.size, count, len(self.points)), dtype=np.int32)
        for rows in self._chunks(count * len(self.points)):
            tapper, lengths = self._taps(rows)
            if first:
                self._after[rows] = self._end_entries(rows, tapper, lengths, self.points)
            mean = table[self._after[rows]].mean(axis=-1)
            mean += self._cost(rows, tapper, lengths)
            best = np.argmin(mean, axis=1)[:, None]
            best_tapper = np.take_along_axis(tapper, best, axis=1)
            best_length = np.take_along_axis(lengths, best, axis=1)
            nearby = best_length * np.array((1.0, *AROUND), dtype=np.float32)
            low, high = (
                np.take_along_axis(end[rows], best_tapper, 1) for end in (self.least, self.most)
            )
            nearby = np.clip(nearby, low, high)
            same_tapper = np.broadcast_to(best_tapper, nearby.shape)
            mean = table[self._end_entries(rows, same_tapper, nearby, self.points)].mean(axis=-1)
            mean += self._cost(rows, same_tapper, nearby)
            best = np.argmin(mean, axis=1)[:, None]
            chosen[rows] = best_tapper[:, 0]
            length[rows] = np.take_along_axis(nearby, best, axis=1)[:, 0]
        return chosen, length

    def evaluate(self, value: Array, tapper: NDArray[np.intp], length: Singles) -> Array:
        """Return W of a fixed policy, iterated from the initial ``value``."""
        states = np.arange(self.rows.size)
        heading, slope = self.heading[states, tapper], self.slope[states, tapper]
        after = self._ends(self.error, heading, slope, length, self.points)
        corners, weights, beyond = self._corners(*after)
        share = 1.0 / len(self.points)
        count = len(self.points) * 8
        matrix = scipy.sparse.csr_array(
            (
                (np.float32(share) * weights).reshape(-1).astype(float),
                corners.reshape(-1),
                np.arange(0, states.size * count + 1, count, dtype=np.int32),
            ),
            shape=(states.size, value.size),
        )
        cost = self._cost(slice(None), tapper[:, None], length[:, None])
        constant = np.ravel(cost) + share * LOST * beyond.sum(axis=1)
        result = value.copy()
        for _ in range(SWEEPS):
            if self._interrupted():
                raise Abandoned
            result[self.rows] = np.minimum(constant + matrix @ result, LOST)
        return result

    def _corners(
        self, x: Singles, y: Singles, turn: Singles
    ) -> tuple[Indices, Singles, NDArray[np.bool_]]:
        """Return indices and weights, (n, p, 8) each, for linear interpolation at states (n, p),
        and which states lie beyond the grid, (n, p)."""
        grid, size = self.grid, self.grid.size
        inside = (x * x + y * y <= self.box[0] ** 2) & (np.abs(turn) <= self.box[1])
        beyond = np.zeros(inside.shape, dtype=bool)
        low, share = [], []
        for part, grading, half in (
            (x, grid.along, size[0]),
            (y, grid.along, size[0]),
            (turn, grid.turn, size[1]),
        ):
            where = grading.steps(part) + np.float32(half)
            beyond |= (where < 0) | (where > 2 * half)
            floor = np.clip(np.floor(where).astype(np.int32), 0, 2 * half - 1)
            low.append(floor)
            share.append(np.clip(where - floor, 0, 1).astype(np.float32))
        beyond &= ~inside
        counts = np.where(inside | beyond, np.float32(0), np.float32(1))
        _, wide, deep = self.grid.shape
        base = (low[0] * wide + low[1]) * deep + low[2]
        corners = np.empty((*x.shape, 8), dtype=np.int32)
        weights = np.empty((*x.shape, 8), dtype=np.float32)
        for corner in range(8):
            i, j, k = corner >> 2, (corner >> 1) & 1, corner & 1
            corners[..., corner] = base + ((i * wide + j) * deep + k)
            weights[..., corner] = (
                counts
                * (share[0] if i else 1 - share[0])
                * (share[1] if j else 1 - share[1])
                * (share[2] if k else 1 - share[2])
            )
        return corners, weights, beyond


def _halved(table: Singles, axis: int) -> Singles:
    """Insert, along an axis, the mean between each two neighbouring entries."""
    moved = np.moveaxis(table, axis, 0)
    made = np.empty((2 * moved.shape[0] - 1, *moved.shape[1:]), dtype=np.float32)
    made[::2] = moved
    made[1::2] = 0.5 * (moved[1:] + moved[:-1])
    return np.moveaxis(made, 0, axis)


def _lines_at(
    space: FixedStrikeSpace,
    places: Array,
    rows: NDArray[np.intp],
    shape: tuple[int, ...],
) -> Lines:
    """Return the ``Lines`` at these states; for a round object they are computed once per
    position."""
    if not space.is_round:
        return space.lines(places[rows])
    column = rows // shape[2]
    kept, back = np.unique(column, return_inverse=True)
    lines = space.lines(places[kept * shape[2]])
    return lines.of(back)
