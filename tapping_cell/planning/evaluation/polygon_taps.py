"""Taps on polygons, for many trials at once: where no contact gives a method's tap, another one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.mechanics import Polygon, Tap
from tapping_cell.planning.alternatives import candidate_taps, indirect
from tapping_cell.planning.interface import Array, Planner

BLOCK = 32
"""Trials whose candidates are ranked at once: what fits the cache."""

BEST = 24
"""Candidates of the least cost that are looked at before all the others are."""

ATTEMPTS = 8
"""Choices of one tap that may turn out to be out of reach by the exact slide."""


def contact_taps(
    pose: Array, goal: Array, first: Array, number: Array, planner: Planner, tap: Tap
) -> Array:
    """Displacements (n, 3) to command that a contact of the object gives, first choice or not; NaN
    where none was found.

    Ranked as ``alternative_taps`` does for a session on an open table, with candidates that slide
    like the equivalent disk; what is chosen is checked with the polygon's own slide. Poses, goals
    and first choices (n, 3); number: ``Gains.value``, (n, 6).
    """
    if not isinstance(tap.body, Polygon):
        return first
    chosen = first.copy()
    rough = replace(tap, sliding=tap.sliding.approximated())
    rows = np.flatnonzero(~tap.reachable(first, pose))
    for begin in range(0, rows.size, BLOCK):
        at = rows[begin : begin + BLOCK]
        ranking = _Ranking(pose[at], goal[at], first[at], number[at], planner, rough)
        open_rows: NDArray[np.intp] = np.arange(at.size)
        for _ in range(ATTEMPTS):
            best = ranking.best(open_rows)
            chosen[at[open_rows]] = best
            known = np.flatnonzero(np.isfinite(best[:, 0]))
            wrong = ~tap.reachable(best[known], pose[at[open_rows[known]]])
            open_rows = open_rows[known[wrong]]
            if open_rows.size == 0:
                break
        chosen[at[open_rows]] = np.nan
    return chosen


class _Ranking:
    """The candidates of some trials; a choice that was given out is not given again."""

    def __init__(
        self, pose: Array, goal: Array, first: Array, number: Array, planner: Planner, tap: Tap
    ) -> None:
        place = goal[:, None, :2]

        def straight(points: Array) -> Array:
            return np.hypot(points[..., 0] - place[..., 0], points[..., 1] - place[..., 1])

        self._made = candidate_taps(pose, goal, first, number, planner, straight, tap)
        self._pose, self._goal, self._number = pose, goal, number
        self._planner, self._tap = planner, tap
        self._made.cost[~_passed_on(tap, pose, self._made.commanded)] = np.inf

    def best(self, rows: NDArray[np.intp]) -> Array:
        """The best candidates left, (n, 3); NaN where there is none."""
        made = self._made
        chosen = np.full((rows.size, 3), np.nan)
        count = made.cost.shape[1]
        left: NDArray[np.intp] = np.arange(rows.size)
        for tried in (BEST, count):
            at = rows[left]
            order = np.argpartition(made.cost[at], min(tried, count - 1), axis=1)
            some = np.sort(order[:, :tried], axis=1)
            # The least cost of all that are not looked at.
            bound: Array = np.full(left.size, np.inf)
            if tried < count:
                bound = made.cost[at, order[:, tried]]
            total = self._total(at, some)
            best = np.argmin(total, axis=1)
            least = total[np.arange(left.size), best]
            sure = np.isfinite(least) & (least <= bound)
            column = some[np.arange(left.size), best]
            chosen[left[sure]] = made.commanded[at[sure], column[sure]]
            made.cost[at[sure], column[sure]] = np.inf
            left = left[~sure]
            if left.size == 0:
                break
        return chosen

    def _total(self, rows: NDArray[np.intp], some: NDArray[np.intp]) -> Array:
        """Cost with what follows of some candidates (n, k); infinite for those out of reach."""
        made, at = self._made, rows[:, None]
        total = made.cost[at, some]
        reached = self._tap.reachable(made.commanded[at, some], self._pose[at])
        total = np.where(reached, total, np.inf)
        row, column = np.nonzero(np.isfinite(total))
        after = made.after[rows[row], some[row, column]]
        total[row, column] += indirect(
            after, self._goal[rows[row]], self._number[rows[row]], self._planner, self._given
        )
        return total

    def _given(self, poses: Array, commanded: Array) -> NDArray[np.bool_]:
        """Which displacements some contact gives."""
        return np.asarray(self._tap.reachable(commanded, poses))


def _passed_on(tap: Tap, pose: Array, commanded: Array) -> NDArray[np.bool_]:
    """Whether the direction of displacements (n, m, 3) is within the contact friction of the normal
    of any edge: a polygon that slides like a disk goes where the impulse points."""
    body = tap.body
    assert isinstance(body, Polygon)
    inward = np.arctan2(-body.edge_normals[:, 1], -body.edge_normals[:, 0]) + pose[:, 2:]
    normals = np.stack([np.cos(inward), np.sin(inward)], axis=1)
    along = commanded[..., :2] @ normals
    length = np.hypot(commanded[..., 0], commanded[..., 1])
    least = math.cos(math.atan(tap.impact.friction)) * (1.0 - 1e-9) * length
    return np.asarray(along.max(axis=-1) >= least)
