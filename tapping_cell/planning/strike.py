"""The strike: where the arm must put the striker, and which taps the room around it allows.

Frames: everything in `table`. A strike pose is the pose of the centre of the striker's ball tip
with x along the direction of travel. The tool behind the tip is a straight bar (a capsule) on that
line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics import Tap
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.gains import Spread
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import Scatter
from tapping_cell.planning.workspace import KeepOut, Workspace
from tapping_cell.se2 import Pose, transform_points

BoolArray = NDArray[np.bool_]

ArmReach = Callable[[Array], BoolArray]
"""Which tip poses, (..., 3) in `table`, the arm can take: (...,) or, a column for each elbow side,
(..., sides). A strike uses one side for all of its waypoints."""

OUTLINE_POINTS = 72
PATH_POINTS = 12


def reach_everywhere(tip_poses: Array) -> BoolArray:
    """An arm without limits, for evaluation on an open table."""
    return np.ones(np.shape(tip_poses)[:-1], dtype=bool)


@dataclass(frozen=True, slots=True)
class StrikeSettings:
    """The striker's shape and the margins of a strike, lengths in m, speeds in m/s.

    standoff: from the tip at rest to the contact, along the line of travel.
    strike_height, travel_height: of the tip above the table when striking and when travelling.
    tool_radius, tool_start, tool_length: the bar behind the tip: its half width, where it begins
        and where it ends behind the centre of the tip.
    clearance: least gap between the tool at rest and the object.
    slowest, fastest: speeds that the striker can make.
    footprint: deviations of all that is not known of a slide that must stay on the table.
    """

    standoff: float = 0.015
    strike_height: float = 0.006
    travel_height: float = 0.040
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
            ("strike_height", 0.0, 0.2),
            ("travel_height", self.strike_height, 0.5),
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
                    f"StrikeSettings.{name} is {value!r}, allowed is {low:g} to {high:g}"
                )


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A pose of the tip's centre: strike pose in `table` and height above the table in m."""

    pose: Pose
    height: float


@dataclass(frozen=True, slots=True)
class StrikePlan:
    """Where the arm goes for one tap.

    contact_angle: of the contact on the outline, in the object's frame, rad.
    contact_pose: tip at the moment of contact; strike_pose: tip at rest, ``standoff`` before it.
    striker_speed: m/s. elbow: index of the arm's elbow side that reaches every waypoint.
    approach: waypoints to the strike pose, the last one at rest there; retreat: away from it.
    tapper: name of the tapper that strikes; empty where there is only one.
    """

    contact_angle: float
    contact_pose: Pose
    strike_pose: Pose
    striker_speed: float
    elbow: int
    approach: tuple[Waypoint, ...]
    retreat: tuple[Waypoint, ...]
    tapper: str = ""


class StrikeSpace:
    """Which taps can be struck: one object's mechanics, one table, one arm, one striker."""

    def __init__(
        self,
        tap: Tap,
        workspace: Workspace,
        arm_reach: ArmReach = reach_everywhere,
        settings: StrikeSettings | None = None,
        scatter: Scatter | None = None,
    ) -> None:
        self.tap = replace(tap, sliding=tap.sliding.tabulated(), smallest_distance=0.0)
        """The mechanics, with a polygon's slides from a table, and without its smallest tap: that
        is for the planning method to keep, since it counts in true distance and commands are
        scaled by the gains learnt."""
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
        """The same space with these keep-outs besides the workspace's own."""
        made = copy(self)
        made.workspace = replace(self.workspace, keep_outs=(*self.workspace.keep_outs, *areas))
        return made

    def elbows(self, tip_poses: ArrayLike) -> BoolArray:
        """Which elbow sides reach the tip poses (..., 3): shape (..., sides)."""
        poses = np.asarray(tip_poses, dtype=float)
        sides = np.asarray(self._arm_reach(poses), dtype=bool)
        return sides[..., None] if sides.ndim == poses.ndim - 1 else sides

    def footprint(
        self, object_pose: ArrayLike, displacement: ArrayLike, spread: Spread | None = None
    ) -> Array:
        """Centres that the object may pass or rest at: shape (..., rays, points, 2), m.

        Rays over all directions from the start to the longest slide; displacements (..., 3).
        ``spread`` bounds both; None takes ``settings.footprint`` deviations of the scatter alone.
        """
        start = np.asarray(object_pose, dtype=float)
        moved = np.asarray(displacement, dtype=float)
        if spread is None:
            reach = self.settings.footprint
            aside = reach * self.scatter.direction
            spread = Spread(
                np.full(moved.shape[:-1], 1.0 + reach * self.scatter.distance),
                np.broadcast_to([-aside, aside], (*moved.shape[:-1], 2)),
            )
        length = np.hypot(moved[..., 0], moved[..., 1]) * spread.longest
        heading = np.arctan2(moved[..., 1], moved[..., 0])
        right, left = spread.aside[..., :1], spread.aside[..., 1:]
        turned = np.concatenate([right, right / 2, np.zeros_like(left), left / 2, left], axis=-1)
        rays = heading[..., None] + turned
        share = np.linspace(0.0, 1.0, PATH_POINTS)
        along = length[..., None, None] * share
        return np.stack(
            [
                start[..., 0, None, None] + along * np.cos(rays)[..., None],
                start[..., 1, None, None] + along * np.sin(rays)[..., None],
            ],
            axis=-1,
        )

    def slide_is_safe(
        self, object_pose: ArrayLike, displacement: ArrayLike, spread: Spread | None = None
    ) -> BoolArray:
        """Whether the whole slide with its footprint keeps its margins: (...,) for (..., 3).

        An object that already stands closer to an edge or a keep-out than the margin may leave,
        but not come closer.
        """
        room = self.workspace.object_room(self.footprint(object_pose, displacement, spread))
        needed = np.minimum(self.object_radius, room[..., 0, 0]) - 1e-9
        return np.asarray(np.all(room >= needed[..., None, None], axis=(-2, -1)))

    def tool_points(self, tip_poses: ArrayLike, count: int = 8) -> Array:
        """Points on the axis of the bar behind the tips: (..., count, 2), m."""
        poses = np.asarray(tip_poses, dtype=float)
        behind = np.linspace(self.settings.tool_start, self.settings.tool_length, count)
        points = np.stack([-behind, np.zeros_like(behind)], axis=-1)
        return transform_points(poses[..., None, :], points)

    def tool_has_room(self, tip_poses: ArrayLike) -> BoolArray:
        """Whether tip and bar at (..., 3) stay out of the keep-outs and near the table."""
        poses = np.asarray(tip_poses, dtype=float)
        bar = self.workspace.striker_room(self.tool_points(poses)) >= self.settings.tool_radius
        tip = self.workspace.striker_room(poses[..., :2]) >= self.tip_radius
        return np.asarray(np.all(bar, axis=-1) & tip)

    def tool_clears_object(self, object_pose: ArrayLike, tip_poses: ArrayLike) -> BoolArray:
        """Whether the resting tool at (..., 3) touches no point of the object's outline."""
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
        """Tip poses ``standoff`` before the contact, (..., 3)."""
        contact = np.asarray(contact_pose, dtype=float)
        back = self.settings.standoff
        return np.stack(
            [
                contact[..., 0] - back * np.cos(contact[..., 2]),
                contact[..., 1] - back * np.sin(contact[..., 2]),
                contact[..., 2],
            ],
            axis=-1,
        )

    def strike_poses(self, object_pose: Array, displacements: Array) -> tuple[BoolArray, Array]:
        """Which displacements (n, 3) a contact of the object gives, (n,), and the strike poses of
        the tip at rest, (n, 3); NaN for the others. Whether there is room is not looked at here."""
        possible = np.asarray(self.tap.reachable(displacements, object_pose))
        poses = np.full(displacements.shape, math.nan)
        if np.any(possible):
            plan = self.tap.plan(displacements[possible], object_pose)
            poses[possible] = self.rest_pose(plan.strike_pose)
        return possible, poses

    def first_strike(
        self, object_pose: Pose, displacements: Array
    ) -> tuple[int, StrikePlan] | None:
        """The first of the displacements (n, 3) that can be struck, with its strike, or None.

        The slide itself is not looked at here (``slide_is_safe``).
        """
        known = np.flatnonzero(self.tap.reachable(displacements, object_pose))
        if known.size == 0:
            return None
        plan = self.tap.plan(displacements[known], object_pose)
        contact = np.asarray(plan.strike_pose, dtype=float)
        speed = np.asarray(plan.striker_speed, dtype=float)
        usable = (speed >= self.settings.slowest) & (speed <= self.settings.fastest)
        usable &= self.tool_fits(object_pose, contact)
        if not np.any(usable):
            return None
        index = int(np.argmax(usable))
        return int(known[index]), self.plan_at(
            float(np.asarray(plan.contact_angle)[index]), contact[index], float(speed[index])
        )

    def strikeable(self, object_poses: Array, displacements: Array) -> BoolArray:
        """Which displacements (n, 3) of the object can be struck, each from its own pose (n, 3)."""
        found = np.asarray(self.tap.reachable(displacements, object_poses))
        if not np.any(found):
            return found
        held = object_poses[found]
        plan = self.tap.plan(displacements[found], held)
        speed = np.asarray(plan.striker_speed, dtype=float)
        usable = (speed >= self.settings.slowest) & (speed <= self.settings.fastest)
        found[found] = usable & self.tool_fits(held, plan.strike_pose)
        return found

    def tool_fits(self, object_pose: ArrayLike, contact_poses: ArrayLike) -> BoolArray:
        """Whether arm and tool have room to strike with the tip at (..., 3) at the contact."""
        rest = self.rest_pose(contact_poses)
        return np.asarray(
            np.any(self.elbows(rest), axis=-1)
            & self.tool_has_room(rest)
            & self.tool_clears_object(object_pose, rest)
        )

    def plan_at(self, contact_angle: float, contact_pose: Array, speed: float) -> StrikePlan:
        """The strike with the tip at (3,) at the contact; ``tool_fits`` says whether it can be."""
        rest = self.rest_pose(contact_pose)
        pose = Pose(*rest.tolist())
        above = Waypoint(pose, self.settings.travel_height)
        return StrikePlan(
            contact_angle=contact_angle,
            contact_pose=Pose(*np.asarray(contact_pose, dtype=float).tolist()),
            strike_pose=pose,
            striker_speed=speed,
            elbow=int(np.argmax(self.elbows(rest))),
            approach=(above, Waypoint(pose, self.settings.strike_height)),
            retreat=(above,),
        )
