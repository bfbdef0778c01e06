"""Baselines for comparison: objects in the given order, or the object nearest to its goal first.

Both avoid the other objects. They skip an object whose goal is occupied or unreachable, and they
never move an object out of the way.
"""

from __future__ import annotations

import math

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
        order = self._order(scene)
        for body in order:
            if (body.name, Purpose.TO_GOAL) in scene.excluded:
                continue
            others = areas_of(scene.bodies, scene.poses, [body.name])
            path = self._maps.path(body, others, scene.poses[body.name], body.target)
            if math.isfinite(path) and self._maps.fits(body, others, body.target):
                reason = (
                    "it is the first object whose goal is free and can be reached on a free path"
                )
                return Move(body.name, body.target, Purpose.TO_GOAL, reason)
        names = ", ".join(f"'{body.name}'" for body in order)
        return Refusal(
            RefusalReason.NO_ARRANGEMENT,
            f"none of {names} can go to its goal: other objects occupy or block each goal",
        )

    def _order(self, scene: Scene) -> list[Body]:
        """Return the unfinished objects in the order in which they are tried."""
        left_out = scene.finished | scene.later
        return [b for b in scene.bodies if b.goal is not None and b.name not in left_out]


class NearestFirst(FileOrder):
    """Baseline that moves the object nearest to its goal first."""

    name = "nearest first"

    def _order(self, scene: Scene) -> list[Body]:
        return sorted(
            super()._order(scene), key=lambda b: scene.poses[b.name].distance_to(b.target)
        )
