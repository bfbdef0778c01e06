"""The built-in arrangement planner: free goals first, then whoever stands in the way makes way.

A move to a goal is possible where the goal is free, a path of workable places leads to it among the
other objects as they lie, and every goal left after it can still be reached (``stuck_goals``). Of
the possible ones the cheapest is taken, in taps that the way around others costs, less what it
frees. Where none is possible (goals that are occupied, swaps, cycles, blocked paths), an object
that is in the way goes to a buffer place: reachable, clear of every open goal, and close to its own
way. Each such move opens a goal or a path, so the sequence ends; with no buffer place it is
refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
"""Taps that opening another object's goal is worth, against a detour."""

BUFFER_SLACK = 0.012
"""Clearance in m between a buffer place and an open goal besides the margin: a tap aimed at the
place may end some way off."""

BUFFERS_TRIED = 12

TOOL_ROOM = 0.10
"""Gap in m between a buffer place and an open goal below which taps at the goal have little room:
the tool stands there, and a polygon can be tapped along few lines only."""

CROWDED = 2.0
"""Taps that a buffer place right beside an open goal costs more."""

NARROW = 0.03
"""Gap in m below which a buffer place beside another object costs a tap more: little room."""


@dataclass(frozen=True, slots=True)
class _Option:
    cost: float
    move: Move


class SequencePlanner:
    """See the module's docstring."""

    name = "sequence"

    def __init__(self, maps: AmongOthers | None = None) -> None:
        self._maps = AmongOthers() if maps is None else maps

    def next_move(self, scene: Scene) -> Move | Refusal:
        """The next move, see ``ArrangementPlanner``."""
        options = [
            option
            for body in _open(scene)
            if (body.name, Purpose.TO_GOAL) not in scene.excluded
            and (option := self._to_goal(scene, body)) is not None
        ]
        if options:
            return min(options, key=lambda option: option.cost).move
        return self._make_way(scene) or self._refusal(scene)

    def _to_goal(self, scene: Scene, body: Body) -> _Option | None:
        goal, pose = body.goal, scene.poses[body.name]
        assert goal is not None
        others = areas_of(scene.bodies, scene.poses, [body.name])
        if not self._maps.fits(body, others, goal):
            return None
        path = self._maps.path(body, others, pose, goal)
        if not math.isfinite(path) or not self._leaves_a_way(scene, body):
            return None
        turn = pose.rotation_to(goal)
        around = taps(body, path, turn) - taps(body, pose.distance_to(goal), turn)
        freed = sum(
            gap(body.area(pose), other.area(other.goal)) < _margin(other)
            for other in _open(scene)
            if other is not body and other.goal is not None
        )
        # Ties: the nearest first, its path is the least likely to be shut by the others.
        cost = around - FREED * freed + path
        return _Option(cost, Move(body.name, goal, Purpose.TO_GOAL))

    def _leaves_a_way(self, scene: Scene, body: Body) -> bool:
        left = [other for other in _open(scene) if other is not body]
        placed = [other for other in scene.bodies if other.name in scene.finished]
        fixed = [b.area(scene.poses[b.name]) for b in scene.bodies if not b.movable]
        return not stuck_goals(left, [*placed, body], fixed, self._maps)

    def _make_way(self, scene: Scene) -> Move | None:
        """The cheapest move that takes an object out of the way of another one's goal or path."""
        found: list[_Option] = []
        for blocked in _open(scene):
            for name in self._in_the_way(scene, blocked):
                body = next(each for each in scene.bodies if each.name == name)
                if not body.movable or (name, Purpose.MAKE_WAY) in scene.excluded:
                    continue
                option = self._buffer(scene, body, blocked)
                if option is not None:
                    found.append(option)
        return min(found, key=lambda option: option.cost).move if found else None

    def _in_the_way(self, scene: Scene, blocked: Body) -> list[str]:
        """Objects of which any one's removal lets the other one through; else all near its way."""
        goal, pose = blocked.goal, scene.poses[blocked.name]
        assert goal is not None
        others = [body for body in scene.bodies if body is not blocked]
        alone = []
        for body in others:
            areas = areas_of(others, scene.poses, [body.name])
            if self._maps.fits(blocked, areas, goal) and math.isfinite(
                self._maps.path(blocked, areas, pose, goal)
            ):
                alone.append(body.name)
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
        """The cheapest buffer place for an object that is in the way of another one."""
        pose = scene.poses[body.name]
        others = areas_of(scene.bodies, scene.poses, [body.name])
        places = self._maps.places(body, others, pose)
        margin = _margin(body)
        for other in _open(scene):
            if other is body or other.goal is None:
                continue
            clear = other.radius + body.radius + margin + BUFFER_SLACK
            away = np.hypot(places[:, 0] - other.goal.x, places[:, 1] - other.goal.y)
            places = places[away >= clear]
        if places.shape[0] == 0:
            return None
        cost = _buffer_cost(body, pose, places, others)
        for other in _open(scene):
            if other is not body and other.goal is not None:
                away = np.hypot(places[:, 0] - other.goal.x, places[:, 1] - other.goal.y)
                room = (away - other.radius - body.radius) / TOOL_ROOM
                cost = cost + CROWDED * np.clip(1.0 - room, 0.0, 1.0)
        for index in np.argsort(cost, kind="stable")[:: max(1, len(cost) // 400)][:BUFFERS_TRIED]:
            place = Pose(float(places[index, 0]), float(places[index, 1]), pose.theta)
            if self._opens(scene, body, place, blocked):
                reason = f"it is in the way of '{blocked.name}'"
                return _Option(float(cost[index]), Move(body.name, place, Purpose.MAKE_WAY, reason))
        return None

    def _opens(self, scene: Scene, body: Body, place: Pose, blocked: Body) -> bool:
        """Whether the other object can go to its goal, or comes closer to it, with the buffer."""
        assert blocked.goal is not None
        poses = {**scene.poses, body.name: place}
        areas = areas_of(scene.bodies, poses, [blocked.name])
        if not any(gap(area, blocked.area(blocked.goal)) < _margin(blocked) for area in areas):
            path = self._maps.path(blocked, areas, poses[blocked.name], blocked.goal)
            return math.isfinite(path) and self._maps.fits(blocked, areas, blocked.goal)
        # Others occupy the goal as well: this one at least has left it.
        before = gap(body.area(scene.poses[body.name]), blocked.area(blocked.goal))
        return before < _margin(blocked)

    def _refusal(self, scene: Scene) -> Refusal:
        parts = []
        for body in _open(scene):
            names = ", ".join(f"'{name}'" for name in self._in_the_way(scene, body)[:3])
            assert body.goal is not None
            parts.append(
                f"'{body.name}' cannot go to {place_text(body.goal)}"
                + (f" (in the way: {names})" if names else "")
            )
        return Refusal(
            RefusalReason.NO_ARRANGEMENT,
            "no sequence of taps leads on: "
            + "; ".join(parts)
            + "; no free place on the table was found for what is in the way. Take an object away, "
            "allow others to be moved, or move these goals apart",
        )


def taps(body: Body, distance: float, turn: float) -> float:
    """About how many taps an object needs for a path of this length (m) and a turn (rad)."""
    return float(body.planner.taps_to_go(distance, float(wrap_angle(turn))))


def _open(scene: Scene) -> list[Body]:
    """Objects with a goal that are not there yet."""
    return [b for b in scene.bodies if b.goal is not None and b.name not in scene.finished]


def _margin(body: Body) -> float:
    return body.free.space.workspace.keep_out_margin


def _from_line(place: Pose, start: Pose, end: Pose) -> float:
    """Distance of a place from the straight line between two others, m."""
    dx, dy = end.x - start.x, end.y - start.y
    along = ((place.x - start.x) * dx + (place.y - start.y) * dy) / (dx * dx + dy * dy or 1.0)
    share = min(1.0, max(0.0, along))
    return math.hypot(place.x - start.x - share * dx, place.y - start.y - share * dy)


def _buffer_cost(body: Body, pose: Pose, places: Array, others: Sequence[CircleArea]) -> Array:
    """About how many taps each buffer place (n, 2) costs: there, onward, and for little room."""
    longest = body.planner.settings.largest_distance
    there = np.hypot(places[:, 0] - pose.x, places[:, 1] - pose.y)
    cost = np.ceil(there / longest) + 0.5 * there / longest
    if body.goal is not None:
        onward = np.hypot(places[:, 0] - body.goal.x, places[:, 1] - body.goal.y)
        direct = pose.distance_to(body.goal)
        cost = cost + np.maximum(onward - direct, 0.0) / longest
    for area in others:
        apart = np.hypot(places[:, 0] - area.x, places[:, 1] - area.y) - area.radius - body.radius
        cost = cost + np.clip(1.0 - apart / NARROW, 0.0, 1.0)
    return np.asarray(cost)
