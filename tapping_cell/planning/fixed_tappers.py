"""Tappers at fixed mounts, and the taps that each of them can make for an object at a given pose.

A fixed tapper has one line of travel. The contact and the direction of the tap follow from the
object's pose alone; only the speed is free. The slide scales with the square of the speed, so all
taps of one tapper at one pose have the same direction and the same rotation per distance. A tap is
therefore chosen by its tapper and its length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics import Polygon, Tap
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import Scatter
from tapping_cell.planning.strike import BoolArray, StrikePlan
from tapping_cell.planning.workspace import KeepOut, Workspace
from tapping_cell.se2 import Pose, unit_vectors

STEEPEST = math.radians(60.0)
"""Largest incidence of a tap. With a larger incidence, a small error of the striker's line could
make the striker graze or miss the object."""

STROKE_MARGIN = 0.003
"""Minimum stroke that must remain when the tip touches the object, m."""

BESIDES_FLIGHT_S = 0.40
"""Mean duration, s, of the parts of a tap other than the striker's flight to the object: the
messages to the board, the slide, the images of the object at rest and the decision."""

MEAN_TAP_S = 0.65
"""Mean time of a tap, s: the unit of W (see ``fixed_policy``) if the objective is time."""

WAY_POINTS = 40
"""Number of points of a stroke whose distance to the keep-outs is checked."""


@dataclass(frozen=True, slots=True)
class FixedTapper:
    """A tapper at a fixed mount.

    mount: centre of the tip at rest and direction of travel, in `table`, m and rad.
    stroke: largest travel of the tip, m. tap: mechanics with this tapper's striker.
    slowest, fastest: speed limits, m/s.
    """

    name: str
    mount: Pose
    stroke: float
    tap: Tap
    slowest: float
    fastest: float

    def __post_init__(self) -> None:
        """Reject an invalid stroke or invalid speeds (PlanningError)."""
        if not (self.stroke > 0.0 and 0.0 <= self.slowest < self.fastest):
            raise PlanningError(
                f"tapper '{self.name}': the stroke is {self.stroke!r} m and the speeds are "
                f"{self.slowest!r} to {self.fastest!r} m/s; the stroke must be above 0, and the "
                "lowest speed must be at least 0 and below the highest"
            )


@dataclass(frozen=True, slots=True)
class WorkingArea:
    """Disc in which the object's centre must stay: centre x, y and radius, m, in `table`."""

    x: float
    y: float
    radius: float

    def outline(self, edges: int = 72) -> Array:
        """Return the edges of the disc for drawing, (edges, 2 ends, 2), m in `table`."""
        angles = np.linspace(0.0, 2.0 * math.pi, edges + 1)
        corners = np.array([self.x, self.y]) + self.radius * unit_vectors(angles)
        return np.stack([corners[:-1], corners[1:]], axis=1)

    def clearance(self, points: ArrayLike) -> Array:
        """Return the distance of points (..., 2) to the area's edge, m, negative outside."""
        p = np.asarray(points, dtype=float)
        return np.asarray(self.radius - np.hypot(p[..., 0] - self.x, p[..., 1] - self.y))


def tap_seconds(travel: ArrayLike, reach: ArrayLike, length: ArrayLike) -> Array:
    """Return the durations of taps, s. travel, reach: as in ``Lines``. length: displacement, m."""
    flight = np.asarray(travel) * np.sqrt(np.asarray(reach) / np.asarray(length))
    return np.asarray(BESIDES_FLIGHT_S + flight)


class Lines(NamedTuple):
    """Possible taps of each tapper; shapes (..., tappers).

    usable: whether the tapper can make a tap at all. heading: direction of the object's travel in
    `table`, rad. slope: rotation per distance, rad/m. reach: displacement per squared speed,
    m/(m/s)^2. least, most: limits of the displacement, m. travel: travel of the tip until the
    contact, m.
    """

    usable: BoolArray
    heading: Array
    slope: Array
    reach: Array
    least: Array
    most: Array
    travel: Array

    def of(self, rows: NDArray[np.intp]) -> Lines:
        """Return the lines of the poses in ``rows``."""
        return Lines._make(part[rows] for part in self)


class FixedStrikeSpace:
    """Set of possible taps for one object, one table and tappers at fixed mounts."""

    def __init__(
        self,
        tappers: Sequence[FixedTapper],
        workspace: Workspace,
        area: WorkingArea,
        scatter: Scatter | None = None,
        *,
        smallest_distance: float = 0.0017,
        tool_radius: float = 0.009,
        objective: str = "taps",
    ) -> None:
        """``objective``: quantity that plans minimise, one of ``tap_times.OBJECTIVES``."""
        if not tappers:
            raise PlanningError("a cell with fixed tappers needs at least one tapper")
        self.tappers = tuple(
            replace(
                tapper,
                tap=replace(
                    tapper.tap,
                    sliding=tapper.tap.sliding.approximated(),
                    smallest_distance=0.0,
                ),
            )
            for tapper in tappers
        )
        self.workspace = workspace
        self.area = area
        self.scatter = Scatter() if scatter is None else scatter
        self.smallest_distance = smallest_distance
        self.tool_radius = tool_radius
        self.objective = objective
        self.object_radius = float(tappers[0].tap.body.bounding_radius)
        self._clear = self._clear_strokes()

    @property
    def is_round(self) -> bool:
        """True if taps do not depend on the object's orientation."""
        return not isinstance(self.tappers[0].tap.body, Polygon)

    def key(self) -> str:
        """Return a string that identifies the solutions: it contains all parameters except the
        names of the tappers."""
        parts = [
            f"{tapper.mount};{tapper.stroke};{tapper.slowest};{tapper.fastest};{tapper.tap}"
            for tapper in self.tappers
        ]
        rest = f"{self.workspace};{self.area};{self.smallest_distance};{self.objective}"
        return f"{parts};{rest}"

    def among(self, areas: Sequence[KeepOut]) -> FixedStrikeSpace:
        """Return a copy of this space with additional keep-outs."""
        made = copy(self)
        made.workspace = replace(self.workspace, keep_outs=(*self.workspace.keep_outs, *areas))
        made._clear = made._clear_strokes()
        return made

    def with_mounts(self, mounts: Sequence[Pose]) -> FixedStrikeSpace:
        """Return a copy with other (measured or learnt) mounts, in the order of the tappers."""
        made = copy(self)
        made.tappers = tuple(
            replace(tapper, mount=mount) for tapper, mount in zip(self.tappers, mounts, strict=True)
        )
        made._clear = made._clear_strokes()
        return made

    def _clear_strokes(self) -> BoolArray:
        """Return which tappers avoid all keep-outs along the whole stroke, because a striker that
        misses the object makes the whole stroke."""
        clear = []
        for tapper in self.tappers:
            way = np.linspace(0.0, tapper.stroke, WAY_POINTS)
            points = np.array(tapper.mount[:2]) + way[:, None] * unit_vectors(tapper.mount.theta)
            margin = self.workspace.keep_out_margin + self.tool_radius
            clear.append(bool(np.all(self.workspace.keep_out_distance(points) >= margin)))
        return np.array(clear)

    def lines(self, object_poses: ArrayLike) -> Lines:
        """Return the possible taps of each tapper for stationary objects at poses (..., 3)."""
        poses = np.asarray(object_poses, dtype=float)[..., None, :]
        groups = self._alike()
        made = [self._lines_of(group, poses) for group in groups]
        order = np.argsort(np.concatenate(groups))
        return Lines(
            *(np.concatenate(parts, axis=-1)[..., order] for parts in zip(*made, strict=True))
        )

    def _alike(self) -> list[list[int]]:
        """Group the indices of tappers with the same mechanics, which are computed together."""
        groups: list[list[int]] = []
        for index, tapper in enumerate(self.tappers):
            alike = (group for group in groups if self.tappers[group[0]].tap == tapper.tap)
            if (group := next(alike, None)) is None:
                groups.append([index])
            else:
                group.append(index)
        return groups

    def _lines_of(self, group: list[int], poses: Array) -> Lines:
        """Return the lines of a group of tappers with the same mechanics; poses (..., 1, 3)."""
        some = [self.tappers[index] for index in group]
        mounts = np.array([item.mount for item in some])
        slowest, fastest = np.array([[item.slowest, item.fastest] for item in some]).T
        stroke = np.array([item.stroke for item in some])
        hit = some[0].tap.strike(poses, mounts, 1.0)
        moved = hit.displacement
        reach = np.hypot(moved[..., 0], moved[..., 1])
        slope = moved[..., 2] / np.maximum(reach, 1e-12)
        most = reach * fastest**2
        least = np.maximum(reach * slowest**2, self.smallest_distance)
        usable = ~hit.missed & (np.abs(hit.incidence) <= STEEPEST) & (most > least)
        usable &= (hit.travel > 0.0) & (hit.travel <= stroke - STROKE_MARGIN)
        usable &= self._clear[group]
        heading = np.arctan2(moved[..., 1], moved[..., 0])
        return Lines(usable, heading, slope, reach, least, most, hit.travel)

    def plan(self, index: int, pose: ArrayLike, distance: float) -> StrikePlan:
        """Return the strike of tapper ``index`` that moves an object at ``pose`` (3,) by a distance
        in m."""
        held = np.asarray(pose, dtype=float)
        tapper = self.tappers[index]
        mount = tapper.mount
        hit = tapper.tap.strike(held, np.array(mount), 1.0)
        reach = float(np.hypot(hit.displacement[0], hit.displacement[1]))
        travel = float(hit.travel)
        point = np.asarray(hit.point) - held[:2]
        return StrikePlan(
            contact_angle=float(np.arctan2(point[1], point[0]) - held[2]),
            contact_pose=Pose(
                mount.x + travel * math.cos(mount.theta),
                mount.y + travel * math.sin(mount.theta),
                mount.theta,
            ),
            strike_pose=mount,
            striker_speed=math.sqrt(distance / reach),
            tapper=tapper.name,
        )
