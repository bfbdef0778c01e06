"""Fewest expected taps with fixed tappers: value iteration over (x, y, theta) of the object.

(Bertsekas, *Dynamic Programming and Optimal Control*, 2012, vol. 2, ch. 3: the stochastic shortest
path.)

A state is what remains to the goal, with the place of the goal fixed: where the object lies decides
which tapper meets it and how. The grid is graded: coordinate u of an axis is asinh(e / fine), so
that its steps are even near the goal and grow in proportion far from it, and the cell of a state is
found without a search. W is the least expected number of taps when one more must be made; inside
the stopping box a run costs nothing more. The scatter of a tap is a fixed set of equally likely
points. A tap is a tapper and a length: lengths in a geometric row, the one that ends nearest to the
goal and the one that ends the rotation.

Improvements compare all taps of all states; between them the policy is evaluated by sweeps with its
own sparse matrix. The coarse grid is solved first and starts the fine one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import csr_array
from scipy.special import ndtri

from tapping_cell.planning.fixed_tappers import FixedStrikeSpace, Lines
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.se2 import wrap_angle

COARSE, FINE = 0.5, 0.33
"""Steps of u on the two grids."""

FINE_DISTANCE = 2.0
"""Stopping boxes within which the steps of an axis are nearly even."""

LENGTHS = 10
"""Lengths of taps that a state tries in a geometric row."""

OUTER = 0.020
"""How far beyond the working area a state is still worth solving, m: objects that left it."""

LOST = 40.0
"""Taps that a state costs from which no tap leads back, or which nobody may reach."""

POINTS = 7
"""Equally likely points of a tap's scatter while solving."""

IMPROVEMENTS = (6, 3)
"""At most, on the coarse grid and on the fine one."""

SWEEPS = 30
SETTLED = 0.02
"""Mean change of W in taps below which an improvement is the last."""

PROMISING = 8
"""Taps of a state that are compared with their scatter."""

CHUNK = 40_000
"""Taps compared at once."""

LEAST_SCATTER = (0.02, 0.04, 0.003)
"""Plans allow for at least this much of distance, rotation (shares) and direction (rad)."""


class Grid(NamedTuple):
    """A graded grid about the goal. step: of u. fine: m and rad of the even part. size: of the
    index range on each side of the goal, for distances and for the rotation."""

    step: float
    fine: tuple[float, float]
    size: tuple[int, int]

    def coordinates(self, remaining: Array) -> Array:
        """Indices, not rounded, of states (..., 3): (3, ...)."""
        return np.stack(
            [
                np.arcsinh(remaining[..., 0] / self.fine[0]) / self.step + self.size[0],
                np.arcsinh(remaining[..., 1] / self.fine[0]) / self.step + self.size[0],
                np.arcsinh(remaining[..., 2] / self.fine[1]) / self.step + self.size[1],
            ]
        )

    def states(self) -> Array:
        """Errors (object less goal) at the grid's points, (n, n, m, 3)."""
        along = self.fine[0] * np.sinh(self.step * np.arange(-self.size[0], self.size[0] + 1))
        turn = self.fine[1] * np.sinh(self.step * np.arange(-self.size[1], self.size[1] + 1))
        return np.stack(np.meshgrid(along, along, turn, indexing="ij"), axis=-1)


def scatter_points(settings: PlannerSettings, count: int) -> Array:
    """Equally likely deviations of a tap, (count, 3): shares of distance and rotation, and rad."""
    scatter = settings.scatter
    # Roberts' additive recurrence: evenly spread in the cube, the same for every computer.
    root = 1.2207440846057596
    steps = np.outer(np.arange(1, count + 1), 1.0 / root ** np.arange(1, 4))
    drawn = ndtri((0.5 + steps) % 1.0)
    drawn = (drawn - drawn.mean(axis=0)) / drawn.std(axis=0)
    deviation = np.maximum([scatter.distance, scatter.rotation, scatter.direction], LEAST_SCATTER)
    return np.asarray(drawn * deviation)


@dataclass(frozen=True, slots=True)
class Solution:
    """A solved goal: W on a grid about it, (n, n, m), taps."""

    goal: tuple[float, float, float]
    grid: Grid
    value: Array

    def taps_to_go(self, error: ArrayLike) -> Array:
        """Expected taps for errors (..., 3), object less goal, when one more must be made."""
        e = np.asarray(error, dtype=float)
        where = self.grid.coordinates(e)
        return np.asarray(map_coordinates(self.value, where, order=1, mode="constant", cval=LOST))


def solve_coarse(space: FixedStrikeSpace, settings: PlannerSettings, goal: ArrayLike) -> Solution:
    """Solve for a goal on the coarse grid: good enough far from it, in a third of the time."""
    place = np.asarray(goal, dtype=float)
    return _solve_on(space, settings, place, COARSE, IMPROVEMENTS[0], None)


def solve_finer(
    space: FixedStrikeSpace, settings: PlannerSettings, start: Solution, step: float = FINE
) -> Solution:
    """Solve on a finer grid what was solved on a coarse one."""
    place = np.asarray(start.goal, dtype=float)
    return _solve_on(space, settings, place, step, IMPROVEMENTS[1], start)


def _solve_on(
    space: FixedStrikeSpace,
    settings: PlannerSettings,
    goal: Array,
    step: float,
    improvements: int,
    start: Solution | None,
) -> Solution:
    problem = _Problem(space, settings, goal, step)
    value = problem.start(start)
    for _ in range(improvements):
        best, chosen = problem.improve(value)
        change = float(np.mean(np.abs(np.minimum(best, LOST) - value)[problem.live]))
        value = problem.evaluate(best, chosen)
        if change < SETTLED:
            break
    shape = problem.shape
    place = (float(goal[0]), float(goal[1]), float(goal[2]))
    return Solution(place, problem.grid, value.reshape(shape))


class _Problem:
    """States, the taps that each can try, and where they lead."""

    def __init__(
        self,
        space: FixedStrikeSpace,
        settings: PlannerSettings,
        goal: Array,
        step: float,
    ) -> None:
        box = settings.stopping
        self.box = box.distance, box.rotation
        fine = FINE_DISTANCE * box.distance, FINE_DISTANCE * box.rotation
        area = space.area
        far = math.hypot(goal[0] - area.x, goal[1] - area.y) + area.radius + OUTER
        sizes = [
            math.ceil(math.asinh(most / width) / step)
            for most, width in zip((far, math.pi), fine, strict=True)
        ]
        self.grid = Grid(step, fine, (sizes[0], sizes[1]))
        states = self.grid.states()
        self.shape = states.shape[:-1]
        self.states = states.reshape(-1, 3)
        places = self.states + goal
        self.live = (area.room(places[:, :2]) >= -OUTER) & (
            np.abs(self.states[:, 2]) <= math.pi * math.exp(step)
        )
        self.lost = space.workspace.object_room(places[:, :2]) < space.object_radius
        self.lost |= area.room(places[:, :2]) < -OUTER
        self.live &= ~self.lost
        rows = np.flatnonzero(self.live)
        lines = _lines_at(space, places, rows, self.shape)
        row, tapper = np.nonzero(lines.usable)
        self.state_of = rows[row]
        self.heading = lines.heading[row, tapper]
        self.slope = lines.slope[row, tapper]
        self.lengths = self._lengths(
            lines.least[row, tapper],
            np.minimum(lines.most[row, tapper], settings.largest_distance),
        )
        self.points = scatter_points(settings, POINTS)
        used, index = np.unique(row, return_inverse=True)
        self.pair_of = np.full((used.size, len(space.tappers)), -1, dtype=np.intp)
        self.pair_of[index, tapper] = np.arange(row.size)

    def _lengths(self, least: Array, most: Array) -> Array:
        share = np.linspace(0.0, 1.0, LENGTHS)
        most = np.maximum(most, least)
        row = least[:, None] * (most / least)[:, None] ** share
        error = self.states[self.state_of]
        nearest = -(error[:, 0] * np.cos(self.heading) + error[:, 1] * np.sin(self.heading))
        turned = -error[:, 2] / np.where(np.abs(self.slope) < 1e-3, np.inf, self.slope)
        own = np.stack([nearest, turned], axis=-1)
        return np.concatenate([row, np.clip(own, least[:, None], most[:, None])], axis=-1)

    def start(self, coarse: Solution | None) -> Array:
        """A first guess of W: of a coarser grid, or the distance and rotation in taps."""
        if coarse is not None:
            value = coarse.taps_to_go(self.states)
        else:
            error = np.hypot(self.states[:, 0], self.states[:, 1])
            value = (
                2.0
                + np.log1p(error / self.box[0])
                + np.log1p(np.abs(self.states[:, 2]) / self.box[1])
            )
        return np.asarray(np.where(self.live, np.minimum(value, LOST), LOST))

    def after(self, pairs: NDArray[np.intp], lengths: Array, points: Array) -> Array:
        """States after taps: pairs (...), lengths (..., k), at scatter points: (..., k, p, 3)."""
        return states_after(
            self.states[self.state_of[pairs]][..., None, :],
            self.heading[pairs][..., None],
            self.slope[pairs][..., None],
            lengths,
            points,
        )

    def improve(self, value: Array) -> tuple[Array, tuple[NDArray[np.intp], Array]]:
        """W after the best tap of every state, and that tap: its pair and its length.

        Every tap is tried where it leads without scatter; the most promising ones with it.
        """
        table = value.reshape(self.shape)
        best_value = np.full(value.shape, LOST)
        states, _, count = (
            self.pair_of.shape[0],
            self.pair_of.shape[1],
            self.lengths.shape[1],
        )
        chosen = np.empty(states, dtype=np.intp)
        length = np.empty(states)
        size = max(1, CHUNK // (self.pair_of.shape[1] * count))
        for first in range(0, states, size):
            pairs = self.pair_of[first : first + size]
            lengths = np.where(pairs[..., None] >= 0, self.lengths[pairs], 0.0)
            straight = self.after(pairs, lengths, self.points[:1] * 0.0)
            rough = expected_taps(table, self.grid, self.box, straight)
            rough = np.where(pairs[..., None] >= 0, rough, math.inf).reshape(pairs.shape[0], -1)
            tried = np.argpartition(rough, PROMISING - 1, axis=1)[:, :PROMISING]
            some = np.take_along_axis(pairs, tried // count, axis=1)
            long = np.take_along_axis(lengths.reshape(pairs.shape[0], -1), tried, axis=1)
            each = expected_taps(
                table,
                self.grid,
                self.box,
                self.after(some, long[..., None], self.points),
            )[..., 0]
            each = np.where(some >= 0, each, math.inf)
            best = np.argmin(each, axis=1)[:, None]
            rows = slice(first, first + pairs.shape[0])
            chosen[rows] = np.take_along_axis(some, best, axis=1)[:, 0]
            length[rows] = np.take_along_axis(long, best, axis=1)[:, 0]
            best_value[self.state_of[chosen[rows]]] = (
                1.0 + np.take_along_axis(each, best, axis=1)[:, 0]
            )
        return np.minimum(best_value, LOST), (chosen, length)

    def evaluate(self, value: Array, chosen: tuple[NDArray[np.intp], Array]) -> Array:
        """W of always following a policy, from a first guess."""
        pairs, length = chosen
        after = self.after(pairs, length[:, None], self.points)[:, 0]
        corners, weights, beyond = _corners(self.grid, self.box, after, self.shape)
        share = 1.0 / self.points.shape[0]
        count = after.shape[1] * 8
        matrix = csr_array(
            (
                (share * weights).reshape(-1),
                corners.reshape(-1),
                np.arange(0, pairs.size * count + 1, count),
            ),
            shape=(pairs.size, value.size),
        )
        fixed = 1.0 + share * LOST * beyond.sum(axis=1)
        rows = self.state_of[pairs]
        made = value.copy()
        for _ in range(SWEEPS):
            made[rows] = np.minimum(fixed + matrix @ made, LOST)
        return made


def _lines_at(
    space: FixedStrikeSpace,
    places: Array,
    rows: NDArray[np.intp],
    shape: tuple[int, ...],
) -> Lines:
    """The lines at these states; of a round object once for every place."""
    if not space.is_round:
        return space.lines(places[rows])
    column = rows // shape[2]
    kept, back = np.unique(column, return_inverse=True)
    lines = space.lines(places[kept * shape[2]])
    return lines.of(back)


def states_after(error: Array, heading: Array, slope: Array, length: Array, points: Array) -> Array:
    """Errors after taps at every scatter point: (..., k, p, 3) for lengths (..., k)."""
    size = length[..., None] * (1.0 + points[:, 0])
    turned = heading[..., None] + points[:, 2]
    turn = length[..., None] * slope[..., None] * (1.0 + points[:, 1])
    return np.stack(
        [
            error[..., 0, None] + size * np.cos(turned),
            error[..., 1, None] + size * np.sin(turned),
            wrap_angle(error[..., 2, None] + turn),
        ],
        axis=-1,
    )


def expected_taps(table: Array, grid: Grid, box: tuple[float, float], after: Array) -> Array:
    """Mean W over scatter points (..., p, 3) of the states that a tap may lead to; 0 in the box."""
    where = grid.coordinates(after)
    value = map_coordinates(table, where, order=1, mode="constant", cval=LOST)
    inside = (np.hypot(after[..., 0], after[..., 1]) <= box[0]) & (np.abs(after[..., 2]) <= box[1])
    return np.asarray(np.where(inside, 0.0, value).mean(axis=-1))


def _corners(
    grid: Grid, box: tuple[float, float], after: Array, shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], Array, NDArray[np.bool_]]:
    """Indices and weights of linear interpolation at states (n, p, 3): (n, p, 8) each; and which
    states lie beyond the grid."""
    where = grid.coordinates(after)
    most = np.array(shape)[:, None, None] - 1
    beyond = np.any((where < 0) | (where > most), axis=0)
    inside = (np.hypot(after[..., 0], after[..., 1]) <= box[0]) & (np.abs(after[..., 2]) <= box[1])
    low = np.clip(np.floor(where).astype(np.intp), 0, most - 1)
    share = np.clip(where - low, 0.0, 1.0)
    counts = np.where(inside | beyond, 0.0, 1.0)
    corners, weights = [], []
    for corner in range(8):
        bits = [(corner >> axis) & 1 for axis in range(3)]
        index = np.zeros(after.shape[:-1], dtype=np.intp)
        weight = counts.copy()
        for axis, bit in enumerate(bits):
            index = index * shape[axis] + low[axis] + bit
            weight = weight * (share[axis] if bit else 1.0 - share[axis])
        corners.append(index)
        weights.append(weight)
    return np.stack(corners, axis=-1), np.stack(weights, axis=-1), beyond & ~inside
