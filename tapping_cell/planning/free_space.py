"""Map of the places where an object can be tapped, and path lengths from there to the goal.

A place is *tappable* if the object fits there and can be tapped in enough directions: no gap
between the directions exceeds ``WIDEST_GAP``. From such a place every remaining error can be
corrected, if necessary by a zigzag of taps. Taps may only end at tappable places, and the goal must
be tappable, so that a run does not get stuck. Path lengths around keep-outs are computed on a grid
with 16 neighbours per cell (accurate to 3 %) by Dijkstra's algorithm (Dijkstra 1959).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from tapping_cell.mechanics import Polygon
from tapping_cell.planning.interface import Array
from tapping_cell.planning.strike import BoolArray, StrikeSpace
from tapping_cell.planning.workspace import CircleArea, KeepOut, PolygonArea
from tapping_cell.se2 import unit_vectors

CELL = 0.010
"""Size of a grid cell in m."""

DIRECTIONS = 24
"""Number of tap directions tried at each place."""

WIDEST_GAP = math.radians(150.0) + 1e-9
"""Largest allowed angle between neighbouring directions of possible taps, below 180 degrees."""

TURNS = (-0.7, 0.0, 0.7)
"""Rotations per distance of the taps tried, as fractions of the cone's slope."""

TYPICAL_TAP = 0.010
"""Distance of the taps tried, m. The choice is arbitrary because the pose of a strike depends only
on the ratio of rotation to distance."""

STEPS = [(1, 0), (1, 1), (0, 1), (-1, 1), (2, 1), (1, 2), (-1, 2), (-2, 1)]
"""Offsets of a cell's neighbours; the opposite offsets are neighbours as well."""

SIGHT_POINTS = 16

MASKS_KEPT = 400
"""Maximum number of keep-outs whose masks are cached; a mask takes about 40 kB."""


class FreeSpace:
    """The map of tappable places for one object, table, arm and striker."""

    def __init__(self, space: StrikeSpace) -> None:
        table = space.workspace
        columns = max(2, math.ceil(table.length / CELL))
        rows = max(2, math.ceil(table.width / CELL))
        x = (np.arange(columns) + 0.5) * CELL - columns * CELL / 2
        y = (np.arange(rows) + 0.5) * CELL - rows * CELL / 2
        self._origin = np.array([x[0], y[0]])
        self._shape = (columns, rows)
        centres = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        self.centres: Array = centres
        self._tips = _tips_around(space)
        self._masks: dict[KeepOut, NDArray[np.uint32]] = {}
        self._set(space, _pack(_blocked(space, centres, self._tips)))

    def _set(self, space: StrikeSpace, blocked: NDArray[np.uint32]) -> None:
        """Set the map; ``blocked``: bit masks of the impossible tap directions, (turns, cells x,
        cells y)."""
        self._space = space
        self._blocked = blocked
        self._strikable = ~np.any(_has_long_run(blocked), axis=0)
        fits = space.workspace.object_clearance(self.centres) >= space.object_radius
        self.tappable: BoolArray = self._strikable & fits

    def among(self, areas: Sequence[KeepOut]) -> FreeSpace:
        """Return a copy of the map with additional keep-outs. This is fast because the arm's reach
        is not computed again."""
        made = copy(self)
        for name in ("_graph", "_nearest", "regions"):
            made.__dict__.pop(name, None)
        blocked = self._blocked.copy()
        for area in areas:
            if area not in self._masks:
                if len(self._masks) >= MASKS_KEPT:
                    del self._masks[next(iter(self._masks))]
                tool = _tool_in(area, self._space, self.centres, self._tips)
                self._masks[area] = _pack(tool)
            blocked |= self._masks[area]
        made._set(self._space.among(areas), blocked)
        return made

    @property
    def space(self) -> StrikeSpace:
        """Strike space that the map was made for."""
        return self._space

    @cached_property
    def _graph(self) -> scipy.sparse.coo_array:
        return _neighbour_graph(self.tappable)

    @cached_property
    def _nearest(self) -> NDArray[np.intp]:
        return _nearest_cells(self.tappable)

    @cached_property
    def regions(self) -> NDArray[np.int32]:
        """Number of the region of each cell (flat): connected tappable cells share a number from 1
        on; other cells have 0."""
        return np.asarray(
            scipy.ndimage.label(self.tappable, structure=np.ones((3, 3)))[0].reshape(-1)
        )

    def contains(self, points: ArrayLike) -> BoolArray:
        """Return whether the points (..., 2) are tappable."""
        p = np.asarray(points, dtype=float)
        low = np.floor((p - self._origin) / CELL).astype(int)
        found = np.zeros(p.shape[:-1], dtype=bool)
        for dx in (0, 1):
            for dy in (0, 1):
                i = np.clip(low[..., 0] + dx, 0, self._shape[0] - 1)
                j = np.clip(low[..., 1] + dy, 0, self._shape[1] - 1)
                found |= self._strikable[i, j]
        clearance = self._space.workspace.object_clearance(p)
        return np.asarray(found & (clearance >= self._space.object_radius - 1e-9))

    def outline(self) -> Array:
        """Return the edges between tappable and other cells for drawing, (edges, 2 ends, 2), m in
        `table`."""
        padded = np.pad(self.tappable, 1)
        corner = self._origin - CELL / 2
        edges = []
        for axis in (0, 1):
            i, j = np.nonzero(np.diff(padded, axis=axis))
            # The map is padded by one cell, so padded cell i + 1 is cell i of the map, and the
            # boundary between padded cells i and i + 1 is the lower boundary of cell i.
            first = np.stack([i, j], axis=-1).astype(float)
            first[:, 1 - axis] -= 1.0
            along = np.eye(2)[1 - axis]
            edges.append(np.stack([first, first + along], axis=1))
        return np.asarray(corner + CELL * np.concatenate(edges))

    def nearest_cells(self, points: ArrayLike) -> tuple[NDArray[np.intp], Array]:
        """Return the flat index of the tappable cell nearest to each point, and the distance of
        this cell from the point, m; the distance is inf if no cell is tappable.

        Accurate to the size of a cell: all points in one cell have the same nearest cell.
        """
        p = np.asarray(points, dtype=float)
        if not np.any(self.tappable):
            return np.zeros(p.shape[:-1], dtype=np.intp), np.full(p.shape[:-1], np.inf)
        cell = self._nearest[self._cell_of(p)]
        centre = self.centres.reshape(-1, 2)[cell]
        return cell, np.hypot(p[..., 0] - centre[..., 0], p[..., 1] - centre[..., 1])

    def in_sight(self, points: ArrayLike, goal: Array) -> BoolArray:
        """Return whether all places on the straight lines from points (..., 2) to the goal (2,) are
        tappable."""
        share = np.linspace(0.0, 1.0, SIGHT_POINTS)[:, None]
        line = np.asarray(points, dtype=float)[..., None, :] * (1.0 - share) + goal * share
        return np.asarray(np.all(self.tappable.reshape(-1)[self._cell_of(line)], axis=-1))

    def _cell_of(self, points: Array) -> NDArray[np.intp]:
        place = np.rint((points - self._origin) / CELL).astype(np.intp)
        i = np.clip(place[..., 0], 0, self._shape[0] - 1)
        j = np.clip(place[..., 1], 0, self._shape[1] - 1)
        return np.asarray(i * self._shape[1] + j)

    def to_goal(self, goal: ArrayLike) -> PathLengths:
        """Return the path lengths to the goal's position (x, y, ...)."""
        return PathLengths(self, np.asarray(goal, dtype=float)[:2])

    def cell_lengths(self, goal: Array) -> Array:
        """Return the path length from every cell (flat) to the goal's cell, m; inf if there is no
        path."""
        cell, offset = self.nearest_cells(goal)
        if not np.isfinite(offset):
            return np.full(self.tappable.size, np.inf)
        return np.asarray(
            scipy.sparse.csgraph.dijkstra(self._graph, directed=False, indices=int(cell))
        )


class PathLengths:
    """Path lengths to one goal: the straight distance if the straight line is free, else the length
    of the path around obstacles."""

    def __init__(self, free: FreeSpace, goal: Array) -> None:
        self._free = free
        self._goal = goal
        self._lengths = free.cell_lengths(goal)
        self._open = bool(np.all(free.tappable[_hull_mask(free.tappable)]))

    def reachable(self, point: ArrayLike) -> bool:
        """Return whether a path connects the tappable cell nearest to the point with the goal."""
        cell, offset = self._free.nearest_cells(np.asarray(point, dtype=float)[:2])
        return bool(np.isfinite(offset) and np.isfinite(self._lengths[cell]))

    def length(self, points: ArrayLike) -> Array:
        """Return the path length from the points (..., 2) to the goal, m; inf if there is no
        path."""
        p = np.asarray(points, dtype=float)
        straight: Array = np.hypot(p[..., 0] - self._goal[0], p[..., 1] - self._goal[1])
        if self._open:
            return straight
        seen = self._free.in_sight(p, self._goal)
        cell, offset = self._free.nearest_cells(p)
        around = np.maximum(self._lengths[cell] + offset, straight)
        return np.asarray(np.where(seen | (straight < CELL), straight, around))


def widest_gap(space: StrikeSpace, centres: ArrayLike) -> Array:
    """Return the largest gap, rad, between neighbouring directions of possible taps for objects at
    ``centres`` (..., 2).

    The gap is computed for taps that rotate the object to the left, to the right and not at all;
    the largest of the three is returned. Only the arm's reach and the clearance of the tool are
    checked, not the slide of the object.
    """
    blocked = _blocked(space, np.asarray(centres, dtype=float), _tips_around(space))
    return np.asarray(np.max(_largest_run(blocked), axis=0))


def _blocked(space: StrikeSpace, centres: Array, tips: Sequence[Array]) -> BoolArray:
    """Return an array that is True for taps that are impossible because of the arm's reach or the
    tool's clearance, for objects at ``centres`` (..., 2); shape (turns, ..., directions)."""
    found = []
    for turn in tips:
        poses = np.empty((*centres.shape[:-1], DIRECTIONS, 3))
        poses[..., :2] = centres[..., None, :] + turn[:, :2]
        poses[..., 2] = turn[:, 2]
        found.append(~(np.any(space.elbows(poses), axis=-1) & space.tool_is_clear(poses)))
    return np.stack(found)


def _tool_in(area: KeepOut, space: StrikeSpace, centres: Array, tips: Sequence[Array]) -> BoolArray:
    """Return which taps would put the tip or the bar into this area or its margin: (turns, cells x,
    cells y, directions)."""
    shape = (*centres.shape[:-1], DIRECTIONS)
    round_area = area if isinstance(area, CircleArea) else _around(area)
    offset = (np.array([round_area.x, round_area.y]) - centres).reshape(-1, 2).astype(np.float32)
    found = np.stack([_circle_hits(offset, turn, round_area.radius, space) for turn in tips])
    if not isinstance(area, CircleArea):
        # Only tools that hit the circle around the polygon can hit the polygon.
        turn, cell, direction = np.nonzero(found)
        poses = np.stack(tips)[turn, direction]
        poses[:, :2] += centres.reshape(-1, 2)[cell]
        margin = space.workspace.keep_out_margin
        bar = np.min(area.distance(space.tool_points(poses)), axis=-1)
        hits = bar < space.settings.tool_radius + margin
        hits |= area.distance(poses[:, :2]) < space.tip_radius + margin
        found[turn, cell, direction] = hits
    return found.reshape(len(tips), *shape)


def _around(area: PolygonArea) -> CircleArea:
    """Return a circle that contains a polygon, slightly enlarged to allow for rounding errors."""
    corners = np.asarray(area.vertices)
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    reach = float(np.hypot(*(corners - middle).T).max())
    return CircleArea(float(middle[0]), float(middle[1]), reach + 1e-4)


def _circle_hits(
    offset: NDArray[np.float32], tips: Array, radius: float, space: StrikeSpace
) -> BoolArray:
    """Return which tools at ``tips`` (directions, 3) around an object hit a circle whose centre has
    the ``offset`` (n, 2) from the object: (n, directions)."""
    poses = tips.astype(np.float32)
    along = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    across = np.stack([-along[1], along[0]])
    ahead = offset @ along - np.sum(poses[:, :2].T * along, axis=0)
    aside = offset @ across - np.sum(poses[:, :2].T * across, axis=0)
    settings = space.settings
    margin = space.workspace.keep_out_margin + radius
    beside = aside * aside
    off_bar = ahead - np.clip(ahead, -settings.tool_length, -settings.tool_start)
    bar = off_bar * off_bar + beside < (settings.tool_radius + margin) ** 2
    return np.asarray(bar | (ahead * ahead + beside < (space.tip_radius + margin) ** 2))


def _pack(missing: BoolArray) -> NDArray[np.uint32]:
    """Pack the flags of the ``DIRECTIONS`` directions (last axis) into the bits of one integer."""
    octets = np.packbits(missing, axis=-1, bitorder="little").astype(np.uint32)
    shifts = np.uint32(8) * np.arange(octets.shape[-1], dtype=np.uint32)
    return np.asarray(np.bitwise_or.reduce(octets << shifts, axis=-1))


def _has_long_run(blocked: NDArray[np.uint32]) -> BoolArray:
    """Return whether more adjacent directions are blocked than ``WIDEST_GAP`` allows."""
    # smallest number of adjacent blocked directions that makes too wide a gap
    needed = int(WIDEST_GAP / (2.0 * math.pi / DIRECTIONS))
    full = np.uint32((1 << DIRECTIONS) - 1)

    def turned(value: NDArray[np.uint32], by: int) -> NDArray[np.uint32]:
        return np.asarray(((value << np.uint32(by)) | (value >> np.uint32(DIRECTIONS - by))) & full)

    run, length = blocked, 1
    while length < needed:
        step = min(length, needed - length)
        run = run & turned(run, step)
        length += step
    return np.asarray(run != 0)


def _tips_around(space: StrikeSpace) -> list[Array]:
    """Return the tip poses at rest around an object at the origin, (directions, 3), one array per
    turn.

    For a round body, the mechanics model plans a typical tap in each direction, and the rest pose
    of this tap is returned. Polygons can be tapped in only a few
    directions at a given orientation; they are represented by taps through the centre of the
    bounding circle.
    """
    heading = np.arange(DIRECTIONS) * (2.0 * math.pi / DIRECTIONS)
    along = unit_vectors(heading)
    if isinstance(space.tap.body, Polygon):
        back = space.object_radius + space.tip_radius + space.settings.standoff
        return [np.concatenate([-back * along, heading[:, None]], axis=-1)]
    size = TYPICAL_TAP
    tips = []
    for share in TURNS:
        turn = np.full((DIRECTIONS, 1), share * space.tap.cone_slope * size)
        contact = space.tap.plan(np.concatenate([size * along, turn], axis=-1)).strike_pose
        tips.append(space.rest_pose(contact))
    return tips


def _largest_run(missing: BoolArray) -> Array:
    """Return the angle, rad, between the two directions on either side of the longest run of
    missing directions.

    ``missing``: flags (..., DIRECTIONS). Returns (...,).
    """
    longest = np.zeros(missing.shape[:-1], dtype=int)
    run = np.zeros(missing.shape[:-1], dtype=int)
    for index in range(2 * DIRECTIONS):
        run = np.where(missing[..., index % DIRECTIONS], run + 1, 0)
        longest = np.maximum(longest, run)
    return np.asarray((np.minimum(longest, DIRECTIONS - 1) + 1) * (2.0 * math.pi / DIRECTIONS))


def _neighbour_graph(tappable: BoolArray) -> scipy.sparse.coo_array:
    """Return the symmetric graph of tappable cells; the weight of an edge is the distance between
    the centres of its cells."""
    columns, rows = tappable.shape
    # SciPy before 1.12 accepts only 32-bit indices for a graph.
    index = np.arange(columns * rows, dtype=np.int32).reshape(columns, rows)
    starts, ends, weights = [], [], []
    for dx, dy in STEPS:
        i0, i1 = max(0, -dx), columns - max(0, dx)
        j0, j1 = max(0, -dy), rows - max(0, dy)
        first = (slice(i0, i1), slice(j0, j1))
        second = (slice(i0 + dx, i1 + dx), slice(j0 + dy, j1 + dy))
        both = tappable[first] & tappable[second]
        starts.append(index[first][both])
        ends.append(index[second][both])
        weights.append(np.full(int(both.sum()), CELL * math.hypot(dx, dy)))
    return scipy.sparse.coo_array(
        (np.concatenate(weights), (np.concatenate(starts), np.concatenate(ends))),
        shape=(tappable.size, tappable.size),
    ).tocsr()


def _nearest_cells(tappable: BoolArray) -> NDArray[np.intp]:
    """Return the flat index of the tappable cell nearest to each cell; 0 if no cell is tappable."""
    if not np.any(tappable):
        return np.zeros(tappable.size, dtype=np.intp)
    nearest = scipy.ndimage.distance_transform_edt(
        ~tappable, return_distances=False, return_indices=True
    )
    return np.asarray(np.ravel_multi_index(tuple(nearest), tappable.shape).reshape(-1))


def _hull_mask(tappable: BoolArray) -> BoolArray:
    """Return which cells lie between two tappable cells of the same column or of the same row."""

    def between(cells: BoolArray, axis: int) -> BoolArray:
        before = np.logical_or.accumulate(cells, axis=axis)
        after = np.flip(np.logical_or.accumulate(np.flip(cells, axis), axis=axis), axis)
        return np.asarray(before & after)

    return between(tappable, 0) | between(tappable, 1)
