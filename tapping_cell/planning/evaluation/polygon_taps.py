"""Vectorised choice of taps on polygons. A tap is replaced by an alternative if no contact of the
polygon allows it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Polygon, Tap
from tapping_cell.planning.alternatives import candidate_taps, indirect
from tapping_cell.planning.interface import Array, Planner

BLOCK = 32
"""Number of trials whose candidates are ranked per batch, so that a batch fits in the cache."""

CHECKED = 16 * BLOCK
"""Number of trials whose best candidates are checked in one call with the exact slide."""

FIRST, MORE = 24, 4
"""Number of cheapest candidates that are evaluated first, and the factor by which this number is
increased until the best candidate is certain."""

ATTEMPTS = 8
"""Maximum number of candidates per tap that are checked with the exact slide."""


def contact_taps(
    pose: Array, goal: Array, first: Array, learnt: Array, planner: Planner, tap: Tap
) -> Array:
    """Return displacements (n, 3) that are possible with some contact: the first choices if they
    are possible, else alternatives; NaN if no alternative was found.

    Alternatives are ranked as by ``alternative_taps`` on an open table, on the assumption that the
    polygon slides like the equivalent disk. The chosen alternative is then checked with the
    polygon's own slide. Poses, goals and first choices are (n, 3); learnt: ``Gains.value``, (n, 6).
    """
    if not isinstance(tap.body, Polygon):
        return first
    chosen = first.copy()
    rough = replace(tap, sliding=tap.sliding.approximated())
    rows = np.flatnonzero(~tap.reachable(first, pose))
    for begin in range(0, rows.size, CHECKED):
        batch = rows[begin : begin + CHECKED]
        rankings = [
            _Ranking(pose[part], goal[part], first[part], learnt[part], planner, rough)
            for part in np.split(batch, range(BLOCK, batch.size, BLOCK))
        ]
        undecided: NDArray[np.intp] = np.arange(batch.size)
        for _ in range(ATTEMPTS):
            best = np.concatenate(
                [
                    ranking.best(undecided[undecided // BLOCK == index] - index * BLOCK)
                    for index, ranking in enumerate(rankings)
                ]
            )
            chosen[batch[undecided]] = best
            finite = np.flatnonzero(np.isfinite(best[:, 0]))
            wrong = ~tap.reachable(best[finite], pose[batch[undecided[finite]]])
            undecided = undecided[finite[wrong]]
            if undecided.size == 0:
                break
        chosen[batch[undecided]] = np.nan
    return chosen


class _Ranking:
    """Ranked candidates of several trials; each candidate is returned only once."""

    def __init__(
        self, pose: Array, goal: Array, first: Array, learnt: Array, planner: Planner, tap: Tap
    ) -> None:
        place = goal[:, None, :2]

        def straight(points: Array) -> Array:
            return np.hypot(points[..., 0] - place[..., 0], points[..., 1] - place[..., 1])

        self._candidates = candidate_taps(pose, goal, first, learnt, planner, straight, tap)
        self._pose, self._goal, self._learnt = pose, goal, learnt
        self._planner, self._tap = planner, tap
        self._candidates.cost[~_in_friction_cone(tap, pose, self._candidates.commanded)] = np.inf

    def best(self, rows: NDArray[np.intp]) -> Array:
        """Return each trial's best remaining candidate, (n, 3), or NaN if none remains."""
        candidates = self._candidates
        chosen = np.full((rows.size, 3), np.nan)
        count = candidates.cost.shape[1]
        left: NDArray[np.intp] = np.arange(rows.size)
        tried = min(FIRST, count)
        while left.size:
            at = rows[left]
            order = np.argpartition(candidates.cost[at], min(tried, count - 1), axis=1)
            some = np.sort(order[:, :tried], axis=1)
            # Lower bound of the costs of all candidates that are not evaluated yet.
            bound: Array = np.full(left.size, np.inf)
            if tried < count:
                bound = candidates.cost[at, order[:, tried]]
            total = self._total(at, some)
            best = np.argmin(total, axis=1)
            least = total[np.arange(left.size), best]
            sure = np.isfinite(least) & (least <= bound)
            column = some[np.arange(left.size), best]
            chosen[left[sure]] = candidates.commanded[at[sure], column[sure]]
            candidates.cost[at[sure], column[sure]] = np.inf
            none = np.isinf(least) & np.isinf(bound)
            left = left[~sure & ~none]
            if tried == count:
                break
            tried = min(MORE * tried, count)
        return chosen

    def _total(self, rows: NDArray[np.intp], some: NDArray[np.intp]) -> Array:
        """Return the total cost of the candidates ``some`` (n, k); infinite for impossible
        candidates."""
        candidates, at = self._candidates, rows[:, None]
        total = candidates.cost[at, some]
        reached = self._tap.reachable(candidates.commanded[at, some], self._pose[at])
        total = np.where(reached, total, np.inf)
        row, column = np.nonzero(np.isfinite(total))
        after = candidates.after[rows[row], some[row, column]]
        total[row, column] += indirect(
            after, self._goal[rows[row]], self._learnt[rows[row]], self._planner, self._reachable
        )
        return total

    def _reachable(self, poses: Array, commanded: Array) -> NDArray[np.bool_]:
        """Return which of the displacements ``commanded`` a tap can produce at the given poses."""
        return np.asarray(self._tap.reachable(commanded, poses))


def _in_friction_cone(tap: Tap, pose: Array, commanded: Array) -> NDArray[np.bool_]:
    """Return which displacements (n, m, 3) lie in the friction cone of some edge. All others are
    impossible for a polygon that slides like a disk: it moves in the direction of the impulse,
    which lies in the friction cone of the edge."""
    body = tap.body
    assert isinstance(body, Polygon)
    inward = np.arctan2(-body.edge_normals[:, 1], -body.edge_normals[:, 0]) + pose[:, 2:]
    normals = np.stack([np.cos(inward), np.sin(inward)], axis=1)
    along = commanded[..., :2] @ normals
    length = np.hypot(commanded[..., 0], commanded[..., 1])
    least = math.cos(math.atan(tap.impact.friction)) * (1.0 - 1e-9) * length
    return np.asarray(along.max(axis=-1) >= least)
