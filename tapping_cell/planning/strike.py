"""Strikes of the arm: striker poses for taps, and checks of reach and of clearance to obstacles.

All poses are in `table`. A strike pose is the pose of the centre of the striker's ball tip, with x
along the direction of travel. The tool behind the tip is modelled as a straight bar (a capsule) on
that line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics import Tap
from tapping_cell.mechanics.tap import TapPlan
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.gains import Spread
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import Scatter
from tapping_cell.planning.workspace import KeepOut, Workspace
from tapping_cell.se2 import Pose, transform_points, unit_vectors

BoolArray = NDArray[np.bool_]

ArmReach = Callable[[Array], BoolArray]
"""Function that returns which tip poses (..., 3) in `table` the arm can reach. The result has the
shape (...,) or, if it is given for each elbow side, (..., sides)."""

OUTLINE_POINTS = 72
PATH_POINTS = 12


def reach_everywhere(tip_poses: Array) -> BoolArray:
    """Return True for every pose: an arm without limits, for evaluation on an open table."""
    return np.ones(np.shape(tip_poses)[:-1], dtype=bool)


@dataclass(frozen=True, slots=True)
class StrikeSettings:
    """The striker's shape and the margins of a strike, lengths in m, speeds in m/s.

    standoff: distance from the tip at rest to the contact, along the line of travel.
    tool_radius, tool_start, tool_length: half width of the bar behind the tip, and the distances
        from the centre of the tip to the start and the end of the bar.
    clearance: minimum gap between the tool at rest and the object.
    slowest, fastest: speed limits of the striker.
    footprint: size of the uncertainty bound, in standard deviations, for which a slide must stay
        on the table.
    """

    standoff: float = 0.015
    tool_radius: float = 0.009
    tool_start: float = 0.010
    tool_length: float = 0.120
    clearance: float = 0.001
    slowest: float = 0.0
    fastest: float = 5.0
    footprint: float = 3.0

    def __post_init__(self) -> None:
        """Refuse values out of range (PlanningError names the value and the range)."""
        for name, low, high in (
            ("standoff", 0.001, 0.2),
            ("tool_radius", 0.0005, 0.1),
            ("tool_start", 0.0, 0.2),
            ("tool_length", self.tool_start, 1.0),
            ("clearance", 0.0, 0.05),
            ("slowest", 0.0, 20.0),
            ("fastest", self.slowest, 50.0),
            ("footprint", 0.0, 6.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise PlanningError(
                    f"StrikeSettings.{name} is {value!r}; it must be {low:g} to {high:g}"
                )


@dataclass(frozen=True, slots=True)
class StrikePlan:
    """Contact, strike pose and striker speed of one tap.

    contact_angle: polar angle of the contact on the outline, in the object's frame, rad.
    contact_pose: tip at the moment of contact; strike_pose: tip at rest, ``standoff`` before it.
    striker_speed: m/s. tapper: name of the tapper that strikes; empty if the cell has only one.
    """

    contact_angle: float
    contact_pose: Pose
    strike_pose: Pose
    striker_speed: float
    tapper: str = ""

    @property
    def flight(self) -> float:
        """Time from the release of the striker until it hits the object, s."""
        return self.strike_pose.distance_to(self.contact_pose) / self.striker_speed


class StrikeSpace:
    """Set of possible strikes for one object, one table, one arm and one striker."""

    def __init__(
        self,
        tap: Tap,
        workspace: Workspace,
        arm_reach: ArmReach = reach_everywhere,
        settings: StrikeSettings | None = None,
        scatter: Scatter | None = None,
    ) -> None:
        self.tap = replace(tap, sliding=tap.sliding.tabulated(), smallest_distance=0.0)
        """The mechanics, with tabulated slides for a polygon. Their smallest distance is set to 0,
        because this limit applies to the true distance, whereas commands are scaled by the learnt
        gains; the planning method applies the limit."""
        self.workspace = workspace
        self.settings = StrikeSettings() if settings is None else settings
        self.scatter = Scatter() if scatter is None else scatter
        self._arm_reach = arm_reach
        angles = np.linspace(-math.pi, math.pi, OUTLINE_POINTS, endpoint=False)
        self.outline: Array = np.asarray(tap.body.boundary(angles), dtype=float)
        """Points of the object's outline in its own frame, (points, 2), m."""
        self.object_radius = tap.body.bounding_radius
        self.tip_radius = float(tap.impact.striker.tip_radius)

    def among(self, areas: Sequence[KeepOut]) -> StrikeSpace:
        """Return a copy of this space with additional keep-outs."""
        made = copy(self)
        made.workspace = replace(self.workspace, keep_outs=(*self.workspace.keep_outs, *areas))
        return made

    def elbows(self, tip_poses: ArrayLike) -> BoolArray:
        """Return which elbow sides reach the tip poses (..., 3): shape (..., sides)."""
        poses = np.asarray(tip_poses, dtype=float)
        sides = np.asarray(self._arm_reach(poses), dtype=bool)
        return sides[..., None] if sides.ndim == poses.ndim - 1 else sides

    def footprint(
        self, object_pose: ArrayLike, displacement: ArrayLike, spread: Spread | None = None
    ) -> Array:
        """Return the possible positions of the object's centre during and after a slide, m in
        `table`.

        For displacements (..., 3), the result has the shape (..., rays, points, 2): points on rays
        from the start to the end of the longest slide. ``spread`` bounds the rays' direction and
        length; with None, the bounds are ``settings.footprint`` standard deviations of the scatter
        alone.
        """
        start = np.asarray(object_pose, dtype=float)
        moved = np.asarray(displacement, dtype=float)
        length = np.hypot(moved[..., 0], moved[..., 1])
        if spread is None:
            reach, size = self.settings.footprint, np.maximum(length, 1e-6)
            aside = reach * self.scatter.across(size) / size
            spread = Spread(
                1.0 + reach * self.scatter.along(size) / size, np.stack([-aside, aside], axis=-1)
            )
        length = length * spread.longest
        heading = np.arctan2(moved[..., 1], moved[..., 0])
        right, left = spread.aside[..., :1], spread.aside[..., 1:]
        turned = np.concatenate([right, right / 2, np.zeros_like(left), left / 2, left], axis=-1)
        rays = unit_vectors(heading[..., None] + turned)[..., None, :]
        along = length[..., None, None, None] * np.linspace(0.0, 1.0, PATH_POINTS)[:, None]
        return np.asarray(start[..., None, None, :2] + along * rays)

    def slide_is_safe(
        self, object_pose: ArrayLike, displacement: ArrayLike, spread: Spread | None = None
    ) -> BoolArray:
        """Return whether the whole footprint of each slide (..., 3) keeps the margins: (...,).

        An object that is already closer to an edge or a keep-out than the margin may move away from
        it, but not closer to it.
        """
        clearance = self.workspace.object_clearance(
            self.footprint(object_pose, displacement, spread)
        )
        needed = np.minimum(self.object_radius, clearance[..., 0, 0]) - 1e-9
        return np.asarray(np.all(clearance >= needed[..., None, None], axis=(-2, -1)))

    def tool_points(self, tip_poses: ArrayLike, count: int = 8) -> Array:
        """Return points on the axis of the bar behind the tips: (..., count, 2), m."""
        poses = np.asarray(tip_poses, dtype=float)
        behind = np.linspace(self.settings.tool_start, self.settings.tool_length, count)
        points = np.stack([-behind, np.zeros_like(behind)], axis=-1)
        return transform_points(poses[..., None, :], points)

    def tool_is_clear(self, tip_poses: ArrayLike) -> BoolArray:
        """Return whether, at tip poses (..., 3), the tip and the bar avoid the keep-outs and extend
        beyond the edges of the table by no more than the allowed overhang."""
        poses = np.asarray(tip_poses, dtype=float)
        bar = self.workspace.striker_clearance(self.tool_points(poses)) >= self.settings.tool_radius
        tip = self.workspace.striker_clearance(poses[..., :2]) >= self.tip_radius
        return np.asarray(np.all(bar, axis=-1) & tip)

    def tool_clears_object(self, object_pose: ArrayLike, tip_poses: ArrayLike) -> BoolArray:
        """Return whether the tool, at rest at tip poses (..., 3), keeps the clearance from the
        object."""
        tips = np.asarray(tip_poses, dtype=float)
        pose = np.asarray(object_pose, dtype=float)
        outline = transform_points(pose[..., None, :], self.outline)
        offset = outline - tips[..., None, :2]
        cos, sin = np.cos(tips[..., 2, None]), np.sin(tips[..., 2, None])
        ahead = cos * offset[..., 0] + sin * offset[..., 1]
        aside = -sin * offset[..., 0] + cos * offset[..., 1]
        on_bar = np.clip(ahead, -self.settings.tool_length, -self.settings.tool_start)
        gap_bar = np.hypot(ahead - on_bar, aside) - self.settings.tool_radius
        gap_tip = np.hypot(ahead, aside) - self.tip_radius
        gap = np.minimum(gap_bar, gap_tip).min(axis=-1)
        return np.asarray(gap >= self.settings.clearance)

    def rest_pose(self, contact_pose: ArrayLike) -> Array:
        """Return the tip poses ``standoff`` before the contact, (..., 3)."""
        rest = np.array(contact_pose, dtype=float)
        rest[..., :2] -= self.settings.standoff * unit_vectors(rest[..., 2])
        return rest

    def strike_poses(self, object_pose: Array, displacements: Array) -> tuple[BoolArray, Array]:
        """Return which displacements (n, 3) are possible with some contact, (n,), and the poses (n,
        3) of the tip at rest for these displacements; NaN for the impossible ones. Reach and
        clearance are not checked here."""
        possible = np.asarray(self.tap.reachable(displacements, object_pose))
        poses = np.full(displacements.shape, math.nan)
        if np.any(possible):
            plan = self.tap.plan(displacements[possible], object_pose)
            poses[possible] = self.rest_pose(plan.strike_pose)
        return possible, poses

    def first_strike(
        self, object_pose: Pose, displacements: Array
    ) -> tuple[int, StrikePlan] | None:
        """Return the index and the strike of the first possible displacement (n, 3), or None.

        The slide itself is not checked here (see ``slide_is_safe``).
        """
        found, plan = self.tap.plan_reachable(displacements, object_pose)
        known = np.flatnonzero(found)
        if known.size == 0:
            return None
        usable = self._usable(object_pose, plan)
        if not np.any(usable):
            return None
        index = int(np.argmax(usable))
        return int(known[index]), self.plan_at(
            float(np.asarray(plan.contact_angle)[index]),
            np.asarray(plan.strike_pose)[index],
            float(np.asarray(plan.striker_speed)[index]),
        )

    def strikeable(self, object_poses: Array, displacements: Array) -> BoolArray:
        """Return which displacements (n, 3) are possible, each for its own object pose (n, 3)."""
        return self.contacts(object_poses, displacements)[1]

    def contacts(self, object_poses: Array, displacements: Array) -> tuple[BoolArray, BoolArray]:
        """Return which displacements (n, 3) are possible with some contact, (n,), and which of
        these are also possible for the arm, the tool and the striker, (n,). ``object_poses``: (n,
        3)."""
        found, plan = self.tap.plan_reachable(displacements, object_poses)
        possible = found.copy()
        if np.any(found):
            possible[found] = self._usable(object_poses[found], plan)
        return found, possible

    def _usable(self, object_pose: ArrayLike, plan: TapPlan) -> BoolArray:
        """Return which planned taps are possible for the striker, the arm and the tool."""
        speed = np.asarray(plan.striker_speed, dtype=float)
        usable = (speed >= self.settings.slowest) & (speed <= self.settings.fastest)
        return usable & self.tool_fits(object_pose, plan.strike_pose)

    def tool_fits(self, object_pose: ArrayLike, contact_poses: ArrayLike) -> BoolArray:
        """Return whether the arm reaches the rest poses of these contacts and the tool has
        clearance there.

        ``contact_poses``: poses (..., 3) of the tip at the contact.
        """
        rest = self.rest_pose(contact_poses)
        return np.asarray(
            np.any(self.elbows(rest), axis=-1)
            & self.tool_is_clear(rest)
            & self.tool_clears_object(object_pose, rest)
        )

    def plan_at(self, contact_angle: float, contact_pose: Array, speed: float) -> StrikePlan:
        """Return the strike for a tip pose (3,) at the contact. Check ``tool_fits`` first."""
        return StrikePlan(
            contact_angle=contact_angle,
            contact_pose=Pose(*np.asarray(contact_pose, dtype=float).tolist()),
            strike_pose=Pose(*self.rest_pose(contact_pose).tolist()),
            striker_speed=speed,
        )
