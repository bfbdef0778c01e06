"""Baselines for comparison: objects in the given order, or the object nearest to its goal first.

Both avoid the other objects. They skip an object whose goal is occupied or unreachable, and they
never move an object out of the way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from tapping_cell.planning.arrangement.among import AmongOthers, areas_of
from tapping_cell.planning.arrangement.interface import Body, Move, Purpose, Scene
from tapping_cell.planning.refusal import Refusal, RefusalReason


class FileOrder:
    """Baseline that moves the objects in the order of the list."""

    name = "file order"

    def __init__(self, maps: AmongOthers | None = None) -> None:
        self._maps = AmongOthers() if maps is None else maps

    def next_move(self, scene: Scene) -> Move | Refusal:
        """Return the move of the first object whose goal is free and reachable."""
        return _first_possible(scene, _unfinished(scene), self._maps)


class NearestFirst:
    """Baseline that moves the object nearest to its goal first."""

    name = "nearest first"

    def __init__(self, maps: AmongOthers | None = None) -> None:
        self._maps = AmongOthers() if maps is None else maps

    def next_move(self, scene: Scene) -> Move | Refusal:
        """Return the move of the nearest object whose goal is free and reachable."""

        def away(body: Body) -> float:
            assert body.goal is not None
            return scene.poses[body.name].distance_to(body.goal)

        return _first_possible(scene, sorted(_unfinished(scene), key=away), self._maps)


def _unfinished(scene: Scene) -> list[Body]:
    left_out = scene.finished | scene.later
    return [b for b in scene.bodies if b.goal is not None and b.name not in left_out]


def _first_possible(scene: Scene, order: Iterable[Body], maps: AmongOthers) -> Move | Refusal:
    names = []
    for body in order:
        names.append(f"'{body.name}'")
        if (body.name, Purpose.TO_GOAL) in scene.excluded:
            continue
        others = areas_of(scene.bodies, scene.poses, [body.name])
        assert body.goal is not None
        path = maps.path(body, others, scene.poses[body.name], body.goal)
        if math.isfinite(path) and maps.fits(body, others, body.goal):
            reason = "it is the first object whose goal is free and can be reached on a free path"
            return Move(body.name, body.goal, Purpose.TO_GOAL, reason)
    return Refusal(
        RefusalReason.NO_ARRANGEMENT,
        f"none of {', '.join(names)} can go to its goal: other objects occupy or block each goal",
    )
