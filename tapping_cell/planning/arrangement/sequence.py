"""The built-in arrangement planner: it first moves objects to free goals, then moves objects out of
the way.

A move to a goal is possible if the goal is free, a path through tappable places leads to it between
the other objects, and every other unfinished goal can still be reached afterwards
(``stuck_goals``). The cheapest possible move is chosen. Its cost is the number of extra taps for
the detour around other objects, plus a small cost of the path's length, minus a bonus for each goal
that the move frees. If no such move is possible (occupied goals, swaps, cycles, blocked paths), an
object in the way is moved to a buffer place: a reachable place that is clear of every unfinished
goal and close to the object's own path. Each such move opens a goal or a path, so the sequence
ends. If there is no buffer place, the planner refuses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tapping_cell.planning.arrangement.among import AmongOthers, areas_of, gap
from tapping_cell.planning.arrangement.interface import Body, Move, Purpose, Scene
from tapping_cell.planning.arrangement.layout import stuck_goals
from tapping_cell.planning.goal import place_text
from tapping_cell.planning.interface import Array
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.workspace import CircleArea
from tapping_cell.se2 import Pose, wrap_angle

FREED = 0.4
"""Bonus, in taps, of a move that frees another object's goal."""

BUFFER_SLACK = 0.012
"""Clearance, in addition to the margin, between a buffer place and an unfinished goal, m. It is
needed because taps may end beside the buffer place."""

BUFFERS_TRIED = 12

TOOL_CLEARANCE = 0.10
"""Space, m, that the tool needs between a buffer place and an unfinished goal."""

CROWDING_COST = 2.0
"""Extra cost, in taps, of a buffer place directly beside an unfinished goal."""

CLOSEST = 3
"""Number of objects that are considered to be in the way if the map shows a free path but no tap is
possible."""

AGAIN = 1.0
"""Extra cost, in taps, of moving an object out of the way. It is charged once for each earlier move
of the object out of the way, because those moves did not help enough. Close to an earlier buffer
place the extra cost is doubled."""

NARROW = 0.03
"""Gap, m, below which a buffer place costs up to one tap more."""


@dataclass(frozen=True, slots=True)
class _Option:
    cost: float
    move: Move


class SequencePlanner:
    """The built-in planner; see the module's docstring."""

    name = "sequence"

    def __init__(self, maps: AmongOthers | None = None) -> None:
        self._maps = AmongOthers() if maps is None else maps

    def next_move(self, scene: Scene) -> Move | Refusal:
        """Return the next move; see ``ArrangementPlanner``."""
        options = [
            option
            for body in _due(scene)
            if (body.name, Purpose.TO_GOAL) not in scene.excluded
            and (option := self._to_goal(scene, body)) is not None
        ]
        if options:
            options.sort(key=lambda option: option.cost)
            return next(
                (each.move for each in options if self._keeps_open(scene, each.move, options)),
                options[0].move,
            )
        return self._make_way(scene) or self._refusal(scene)

    def _to_goal(self, scene: Scene, body: Body) -> _Option | None:
        goal, pose = body.target, scene.poses[body.name]
        others = areas_of(scene.bodies, scene.poses, [body.name])
        if not self._maps.fits(body, others, goal):
            return None
        path = self._maps.path(body, others, pose, goal)
        if not math.isfinite(path) or not self._leaves_a_way(scene, body):
            return None
        turn = pose.rotation_to(goal)
        around = taps(body, path, turn) - taps(body, pose.distance_to(goal), turn)
        freed = [
            other.name
            for other in _open(scene)
            if other is not body and gap(body.area(pose), other.area(other.target)) < _margin(other)
        ]
        # The length of the path, m, is added as a small cost (taps): other objects are less likely
        # to block a short path.
        cost = around - FREED * len(freed) + path
        reason = "its goal and a path to it are free"
        if freed:
            reason += f", and it leaves the goal of {' and '.join(map(repr, freed))}"
        return _Option(cost, Move(body.name, goal, Purpose.TO_GOAL, reason))

    def _keeps_open(self, scene: Scene, move: Move, options: Sequence[_Option]) -> bool:
        """Return whether the other moves in ``options`` stay possible after a move."""
        poses = {**scene.poses, move.name: move.target}
        for body in scene.bodies:
            if body.name == move.name or not any(each.move.name == body.name for each in options):
                continue
            if not self._is_open(replace(scene, poses=poses), body):
                return False
        return True

    def _is_open(self, scene: Scene, body: Body) -> bool:
        """Return whether an object's goal is free and a path leads to it."""
        others = areas_of(scene.bodies, scene.poses, [body.name])
        return self._fits_and_path(body, others, scene.poses[body.name])

    def _fits_and_path(self, body: Body, others: Sequence[CircleArea], pose: Pose) -> bool:
        """Return whether, among the areas ``others``, the goal is free and a path leads to it."""
        return self._maps.fits(body, others, body.target) and math.isfinite(
            self._maps.path(body, others, pose, body.target)
        )

    def _leaves_a_way(self, scene: Scene, body: Body) -> bool:
        left = [other for other in _open(scene) if other is not body]
        placed = [other for other in scene.bodies if other.name in scene.finished]
        fixed = [b.area(scene.poses[b.name]) for b in scene.bodies if not b.movable]
        return not stuck_goals(left, [*placed, body], fixed, self._maps)

    def _make_way(self, scene: Scene) -> Move | None:
        """Return the cheapest move that clears the goal or the path of another object, or None."""
        found: list[_Option] = []
        for blocked in _due(scene):
            for name in self._in_the_way(scene, blocked):
                body = next(each for each in scene.bodies if each.name == name)
                if not body.movable or (name, Purpose.MAKE_WAY) in scene.excluded:
                    continue
                option = self._buffer(scene, body, blocked)
                if option is not None:
                    found.append(option)
        return min(found, key=lambda option: option.cost).move if found else None

    def _in_the_way(self, scene: Scene, blocked: Body) -> list[str]:
        """Return the names of the objects that block ``blocked``.

        An object blocks the path if removing it alone would open the path. If there is no such
        object, the objects on the goal count as blocking. If the goal is free too, all objects
        count as blocking, ordered by distance from the straight line to the goal."""
        goal, pose = blocked.target, scene.poses[blocked.name]
        others = [body for body in scene.bodies if body is not blocked]
        if (blocked.name, Purpose.TO_GOAL) in scene.excluded and self._is_open(scene, blocked):
            # The map shows a free path, but no tap along it is possible. Probably the objects
            # nearest to the straight line to the goal are in the way.
            near = sorted(
                others,
                key=lambda body: _from_line(scene.poses[body.name], pose, goal) - body.radius,
            )
            return [body.name for body in near[:CLOSEST]]
        alone = [
            body.name
            for body in others
            if self._fits_and_path(blocked, areas_of(others, scene.poses, [body.name]), pose)
        ]
        if alone:
            return alone
        on_goal = [
            body.name
            for body in others
            if gap(body.area(scene.poses[body.name]), blocked.area(goal)) < _margin(blocked)
        ]
        if on_goal:
            return on_goal
        near = sorted(
            others,
            key=lambda body: _from_line(scene.poses[body.name], pose, goal),
        )
        return [body.name for body in near]

    def _buffer(self, scene: Scene, body: Body, blocked: Body) -> _Option | None:
        """Return the move of ``body`` to the cheapest buffer place at which it no longer blocks
        ``blocked``, or blocks it less. Return None if there is no such place."""
        pose = scene.poses[body.name]
        others = areas_of(scene.bodies, scene.poses, [body.name])
        places = self._maps.places(body, others, pose)
        margin = _margin(body)
        unfinished = [other for other in _open(scene) if other is not body]
        for other in unfinished:
            clear = other.radius + body.radius + margin + BUFFER_SLACK
            places = places[_away(places, other.target) >= clear]
        if places.shape[0] == 0:
            return None
        cost = _buffer_cost(body, pose, places, others)
        for earlier in scene.buffers.get(body.name, ()):
            cost = cost + AGAIN * (1.0 + (_away(places, earlier) < TOOL_CLEARANCE))
        # Places near the blocked object cost more as well, because its taps need clearance.
        crowded = [(other, other.target) for other in unfinished]
        for other, here in [*crowded, (blocked, scene.poses[blocked.name])]:
            room = (_away(places, here) - other.radius - body.radius) / TOOL_CLEARANCE
            cost = cost + CROWDING_COST * np.clip(1.0 - room, 0.0, 1.0)
        for index in np.argsort(cost, kind="stable")[:: max(1, len(cost) // 400)][:BUFFERS_TRIED]:
            place = Pose(float(places[index, 0]), float(places[index, 1]), pose.theta)
            if self._opens(scene, body, place, blocked):
                reason = f"it is in the way of '{blocked.name}'"
                move = Move(body.name, place, Purpose.MAKE_WAY, reason, blocked.name)
                return _Option(float(cost[index]), move)
        return None

    def _opens(self, scene: Scene, body: Body, place: Pose, blocked: Body) -> bool:
        """Return whether moving ``body`` to ``place`` opens the blocked object's goal or helps to
        open it."""
        poses = {**scene.poses, body.name: place}
        areas = areas_of(scene.bodies, poses, [blocked.name])
        goal = blocked.area(blocked.target)
        if not any(gap(area, goal) < _margin(blocked) for area in areas):
            return self._fits_and_path(blocked, areas, poses[blocked.name])
        # Other objects still occupy the goal, so this move alone does not free it. The move helps
        # if ``body`` occupies part of the goal.
        return gap(body.area(scene.poses[body.name]), goal) < _margin(blocked)

    def _refusal(self, scene: Scene) -> Refusal:
        parts = []
        for body in _open(scene):
            names = ", ".join(f"'{name}'" for name in self._in_the_way(scene, body)[:3])
            parts.append(
                f"'{body.name}' cannot go to {place_text(body.target)}"
                + (f" (in the way: {names})" if names else "")
            )
        return Refusal(
            RefusalReason.NO_ARRANGEMENT,
            "no further move was found: "
            + "; ".join(parts)
            + "; no free place was found for the objects in the way. Take an object away, "
            "allow others to be moved, or move these goals apart",
        )


def taps(body: Body, distance: float, turn: float) -> float:
    """Estimate how many taps an object needs for a path length (m) and a rotation (rad)."""
    return float(body.planner.taps_to_go(distance, float(wrap_angle(turn))))


def _open(scene: Scene) -> list[Body]:
    """Return the objects that are not yet at their goals."""
    return [b for b in scene.bodies if b.goal is not None and b.name not in scene.finished]


def _due(scene: Scene) -> list[Body]:
    """Return the unfinished objects that need not wait for other objects (``Scene.later``)."""
    return [body for body in _open(scene) if body.name not in scene.later]


def _margin(body: Body) -> float:
    return body.free.space.workspace.keep_out_margin


def _from_line(place: Pose, start: Pose, end: Pose) -> float:
    """Return the distance of a place from the line segment between two poses, m."""
    dx, dy = end.x - start.x, end.y - start.y
    along = ((place.x - start.x) * dx + (place.y - start.y) * dy) / (dx * dx + dy * dy or 1.0)
    share = min(1.0, max(0.0, along))
    return math.hypot(place.x - start.x - share * dx, place.y - start.y - share * dy)


def _away(places: Array, middle: Pose | CircleArea) -> Array:
    """Return the distances of places (n, 2) from the x and y of a pose or an area, m."""
    return np.hypot(places[:, 0] - middle.x, places[:, 1] - middle.y)


def _buffer_cost(body: Body, pose: Pose, places: Array, others: Sequence[CircleArea]) -> Array:
    """Estimate the cost of each buffer place (n, 2), in taps: the path to the buffer place, the
    longer path from there to the goal, and a penalty for little clearance."""
    longest = body.planner.settings.largest_distance
    there = _away(places, pose)
    cost = np.ceil(there / longest) + 0.5 * there / longest
    if body.goal is not None:
        detour = _away(places, body.goal) - pose.distance_to(body.goal)
        cost = cost + np.maximum(detour, 0.0) / longest
    for area in others:
        apart = _away(places, area) - area.radius - body.radius
        cost = cost + np.clip(1.0 - apart / NARROW, 0.0, 1.0)
    return np.asarray(cost)
