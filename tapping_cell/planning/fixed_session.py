"""Closed loop of one positioning task with tappers at fixed mounts. Uses no clock and no ROS."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.fixed_iteration import OUTER
from tapping_cell.planning.fixed_policy import (
    LOST,
    MIN_SCATTER,
    expected_taps,
    scatter_points,
    states_after,
)
from tapping_cell.planning.fixed_solver import GoalSolver, SolvedGoal
from tapping_cell.planning.fixed_tappers import (
    MEAN_TAP_S,
    FixedStrikeSpace,
    Lines,
    tap_seconds,
)
from tapping_cell.planning.gains import Gains
from tapping_cell.planning.goal import place_text
from tapping_cell.planning.interface import Array
from tapping_cell.planning.mounts import MountBelief, corrected_space
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.session import (
    MAX_TAPS,
    MISSED,
    Expected,
    GoalSession,
    Strike,
    noise_of,
)
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.strike import BoolArray
from tapping_cell.se2 import difference, unit_vectors

METHOD = "fixed tappers"
"""Name of the planning method, for records."""

LENGTHS = 32
"""Number of tap lengths, in geometric progression, that a decision compares per tapper."""

AROUND = np.array([0.94, 0.97, 1.0, 1.03])
"""Multiples of two lengths that a decision compares as well: the length after which the object is
nearest to the goal and the length that corrects the rotation."""

POINTS = 24
"""Number of equally likely points that represent the scatter in a decision."""

DEVIATIONS = 3.0
"""Number of standard deviations by which a slide may deviate and still stay on the table and off
the keep-outs."""

RETRIEVABLE = 1.5
"""Number of standard deviations by which a slide may deviate and still end where a tap can bring
the object back."""

WAY = np.linspace(0.25, 1.0, 4)
"""Fractions of a slide at which the object's distance to the keep-outs is checked."""


class FixedTapperSession(GoalSession):
    """Closed loop of one task: goal, solved policy, learnt gains and learnt tapper lines.

    Args:
        goal_pose: x, y (m), theta (rad) of the object in `table`.
        settings: tolerance, scatter and camera.
        space: the tappers, the object and the obstacles.
        solver: solves goals and keeps the solutions; None creates a new solver.
        gains, mounts: what was learnt about the object and the tapper lines in earlier runs.
        adapt: whether ``observe`` learns.
        most_taps: maximum number of taps of the run.
    """

    def __init__(
        self,
        goal_pose: ArrayLike,
        settings: PlannerSettings,
        space: FixedStrikeSpace,
        solver: GoalSolver | None = None,
        gains: Gains | None = None,
        mounts: MountBelief | None = None,
        *,
        adapt: bool = True,
        most_taps: int = MAX_TAPS,
    ) -> None:
        super().__init__(goal_pose, gains, adapt, most_taps)
        self._settings = settings
        self.mounts = MountBelief.start(len(space.tappers)) if mounts is None else mounts
        self._missed: frozenset[int] = frozenset()
        self._skipped: frozenset[int] = frozenset()
        self._solver = GoalSolver() if solver is None else solver
        self._scatter = settings.scatter.at_least(MIN_SCATTER)
        self._points = scatter_points(POINTS)
        self.use_free_space(space)

    @property
    def settings(self) -> PlannerSettings:
        """Tolerance, scatter and camera."""
        return self._settings

    @property
    def method(self) -> str:
        """Name of the planning method, for records."""
        return METHOD

    def use_free_space(self, space: FixedStrikeSpace) -> None:
        """Replace the space, because the obstacles on the table may have changed."""
        self._nominal = space
        self._space = corrected_space(space, self.mounts)
        self._solved: SolvedGoal | None = None
        self._goal_refusal = check_fixed_goal(self.goal, space)
        if self._goal_refusal is None:
            self._solved = self._solver.goal(space, self.settings, self.goal)

    @property
    def ready(self) -> bool:
        """True if a decision can be made: the goal is refused, or a solution for it exists, at
        least on the coarse grid."""
        return self._solved is None or self._solved.solution is not None

    def observe(
        self,
        strike: Strike,
        pose_before: ArrayLike,
        pose_after: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> None:
        """Learn from a tap that was fired; see ``PositioningSession.observe``."""
        self.taps += 1
        before = np.asarray(pose_before, dtype=float)
        moved = difference(before, pose_after)
        asked = math.hypot(strike.wanted.x, strike.wanted.y)
        index = self._index(strike)
        missed = math.hypot(moved[0], moved[1]) < MISSED * asked
        self._missed = self._missed | {index} if missed else frozenset()
        self._skipped = frozenset()
        if not self._adapt or not np.all(np.isfinite(moved)):
            return
        noise = self.settings.camera if covariance is None else noise_of(covariance)
        self.mounts = self.mounts.observe(
            index,
            self._nominal.tappers[index],
            before,
            moved,
            float(self.gains.value[1]),
            self.settings.scatter,
            noise,
        )
        self._space = corrected_space(self._nominal, self.mounts)
        lines = self._space.lines(before)
        length = lines.reach[index] * strike.plan.striker_speed**2
        if length > 0.0:
            commanded = _displacement(lines.heading[index], lines.slope[index], length)
            self.gains = self.gains.observe(
                commanded, moved, before[2], self.settings.scatter, noise
            )

    def edge_warning(self, pose: ArrayLike) -> str:
        """Return a warning if the object is outside the working area, else an empty string."""
        clearance = float(self._space.area.clearance(np.asarray(pose, dtype=float)[:2]))
        if clearance >= 0.0:
            return ""
        return (
            f"the object at {place_text(pose)} lies {-1e3 * clearance:.1f} mm outside the "
            "working area; only taps that bring it back are made"
        )

    def _index(self, strike: Strike) -> int:
        names = [tapper.name for tapper in self._nominal.tappers]
        return names.index(strike.plan.tapper)

    def _place_refusal(self, pose: Array) -> Refusal | None:
        clearance = float(self._space.area.clearance(pose[:2]))
        if clearance < -OUTER:
            return Refusal(
                RefusalReason.OBJECT_OFF_TABLE,
                f"the object's centre at {place_text(pose)} is {-1e3 * clearance:.1f} mm "
                f"outside the working area (limit {1e3 * OUTER:.0f} mm); put the object back by "
                "hand",
            )
        return None

    @property
    def _too_many_taps(self) -> str:
        return (
            f"{self.taps} taps did not bring the object to the goal (limit "
            f"{self._most_taps}); check the strikers, the camera and the object's file"
        )

    def _next_tap(self, pose: Array, left: Array) -> Strike | Refusal:
        return self._strike(pose, left, self._missed | self._skipped)

    def skip(self, strike: Strike) -> None:
        """Reject a tap that the operator did not want (see ``GoalSession.skip``)."""
        self._skipped |= {self._index(strike)}

    def _strike(self, pose: Array, left: Array, missed: frozenset[int]) -> Strike | Refusal:
        lines = self._space.lines(pose)
        usable = [index for index in np.flatnonzero(lines.usable).tolist() if index not in missed]
        chosen = self._best(pose, left, lines, usable) if usable else None
        if chosen is None and missed:
            return self._strike(pose, left, frozenset())
        if chosen is None:
            return Refusal(
                RefusalReason.NO_STRIKE,
                f"no safe tap of the object at {place_text(pose)} is possible: "
                f"{int(lines.usable.sum())} of {lines.usable.size} tappers can hit it, but they "
                "would move it out of the working area, into a keep-out or to a place from which "
                "no tap can bring it back; move the object by hand towards the middle",
            )
        index, commanded, length, expected = chosen
        plan = self._space.plan(index, pose, length)
        return self._make_strike(pose, left, commanded, plan, expected=expected)

    def _best(
        self, pose: Array, left: Array, lines: Lines, usable: list[int]
    ) -> tuple[int, Array, float, Expected] | None:
        """Return the acceptable tap with the least expected cost, in taps or time: index of the
        tapper, commanded displacement (3,), its length and the expected effort; None if there is
        none."""
        assert self._solved is not None
        solution = self._solved.solution
        assert solution is not None, "the goal is not solved yet; check ready first"
        heading, slope = lines.heading[usable], lines.slope[usable]
        gain = self.gains.value
        least = lines.least[usable]
        most = np.minimum(lines.most[usable], self.settings.largest_distance / gain[0])
        length = _lengths(left, heading, slope, least, np.maximum(most, least), gain)
        commanded = _displacement(heading[:, None], slope[:, None], length)
        expected = self.gains.predict(commanded, pose[2])
        allowed = self._ends_well(pose, commanded, expected)
        if not np.any(allowed):
            return None
        size = np.maximum(np.hypot(expected[..., 0], expected[..., 1]), 1e-9)
        # ``states_after`` expects the error as object minus goal, but ``left`` is goal minus
        # object. The scatter is the one with which the goal was solved.
        states = states_after(
            np.broadcast_to(-left, (*size.shape, 3)),
            np.arctan2(expected[..., 1], expected[..., 0]),
            expected[..., 2] / size,
            size,
            self._scatter,
            self._points,
        )
        box = self.settings.stopping
        follow = expected_taps(
            solution.value,
            solution.grid,
            (box.distance, box.rotation),
            states,
        )
        seconds = tap_seconds(lines.travel[usable, None], lines.reach[usable, None], length)
        timed = self._space.objective == "time"
        cost = np.where(allowed, follow + (seconds / MEAN_TAP_S if timed else 0.0), math.inf)
        best = np.unravel_index(int(np.argmin(cost)), cost.shape)
        if cost[best] >= LOST - 1.0:
            return None
        after = float(follow[best])
        effort = Expected(1.0 + after, float(seconds[best]) + after * MEAN_TAP_S)
        return usable[int(best[0])], commanded[best], float(length[best]), effort

    def _ends_well(self, pose: Array, commanded: Array, expected: Array) -> BoolArray:
        """Return which displacements (tappers, n, 3) are acceptable. Within the bounds of the
        uncertainty, the object must stay on the table, off the keep-outs and where a tap can bring
        it back. An object outside the working area must come nearer to the area."""
        far = self._way(pose, commanded, expected, DEVIATIONS)
        here = float(self._space.area.clearance(pose[:2]))
        needed = min(
            self._space.object_radius,
            float(self._space.workspace.object_clearance(pose[:2])),
        )
        safe = np.all(self._space.workspace.object_clearance(far) >= needed - 1e-9, axis=(-2, -1))
        clearance = self._space.area.clearance(self._way(pose, commanded, expected, RETRIEVABLE))
        if here >= 0.0:
            safe &= np.all(clearance >= -OUTER, axis=(-2, -1))
        else:
            safe &= np.all(clearance[..., -1] > here, axis=-1)
        return np.asarray(safe)

    def _way(self, pose: Array, commanded: Array, expected: Array, deviations: float) -> Array:
        """Return points on slides whose length and direction deviate by ``deviations`` standard
        deviations. Displacements (tappers, n, 3) give points (tappers, n, 3 directions, points, 2),
        m in `table`."""
        spread = self.gains.spread(commanded, self.settings.scatter, deviations)
        size = np.hypot(expected[..., 0], expected[..., 1])
        heading = np.arctan2(expected[..., 1], expected[..., 0])
        longest = size * (spread.longest if self._adapt else 1.0)
        aside = np.concatenate([spread.aside, np.zeros_like(spread.aside[..., :1])], axis=-1)
        rays = unit_vectors(heading[..., None] + aside)[..., None, :]
        way = longest[..., None, None, None] * WAY[:, None]
        return np.asarray(pose[:2] + way * rays)


def check_fixed_goal(goal_pose: ArrayLike, space: FixedStrikeSpace) -> Refusal | None:
    """Return why the goal (x, y, theta in `table`) cannot be reached, or None."""
    goal = np.asarray(goal_pose, dtype=float)
    if goal.shape != (3,) or not np.all(np.isfinite(goal)):
        return Refusal(
            RefusalReason.GOAL_NOT_FINITE,
            f"the goal {goal.tolist()} is not three finite numbers x, y, theta; send a valid pose",
        )
    clearance = float(space.area.clearance(goal[:2]))
    if clearance < 0.0:
        return Refusal(
            RefusalReason.GOAL_OUTSIDE_WORKING_AREA,
            f"the goal {place_text(goal)} lies {-1e3 * clearance:.1f} mm outside the working area "
            f"of {1e3 * space.area.radius:.0f} mm radius about ({1e3 * space.area.x:.1f} mm, "
            f"{1e3 * space.area.y:.1f} mm); send a goal inside it",
        )
    table = space.workspace
    if float(table.object_clearance(goal[:2])) < space.object_radius:
        near = table.nearest_keep_out(goal[:2]) or "the table's edge"
        return Refusal(
            RefusalReason.GOAL_IN_KEEP_OUT,
            f"the object at the goal {place_text(goal)} would come too close to {near}; move the "
            "goal away",
        )
    return None


def _displacement(heading: ArrayLike, slope: ArrayLike, length: ArrayLike) -> Array:
    """Compute displacements (..., 3) from headings (rad), rotations per distance (rad/m) and
    lengths (m)."""
    size = np.asarray(length, dtype=float)
    along = np.broadcast_to(np.asarray(heading, dtype=float), size.shape)
    turn = np.broadcast_to(np.asarray(slope, dtype=float), size.shape)
    return np.stack([size * np.cos(along), size * np.sin(along), size * turn], axis=-1)


def _lengths(
    left: Array, heading: Array, slope: Array, least: Array, most: Array, gain: Array
) -> Array:
    """Return the lengths to compare, (tappers, n): a geometric progression and lengths that end
    near the goal."""
    row = least[:, None] * (most / least)[:, None] ** np.linspace(0.0, 1.0, LENGTHS)
    nearest = (left[0] * np.cos(heading) + left[1] * np.sin(heading)) / gain[0]
    true_slope = slope * gain[1]
    turned = left[2] / np.where(np.abs(true_slope) < 1e-3, np.inf, true_slope) / gain[0]
    own = np.concatenate([nearest[:, None] * AROUND, turned[:, None] * AROUND], axis=-1)
    return np.concatenate([row, np.clip(own, least[:, None], most[:, None])], axis=-1)
