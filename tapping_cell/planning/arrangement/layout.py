"""Whether a layout can be reached at all, judged before the first tap.

The order of placing is found backwards: from the finished layout, an object that can be worked on
at its goal and leave it may have come last; it is taken away and the next one is looked for. Taking
an object away never blocks another one, so the greedy choice finds an order wherever there is one
(disassembly planning: Wilson and Latombe, Artificial Intelligence 71, 1994). How the objects get
out of each other's way on the table before that is not judged here.
"""

from __future__ import annotations

import numpy as np

from tapping_cell.planning.arrangement.among import AmongOthers, gap
from tapping_cell.planning.arrangement.interface import Body, Scene
from tapping_cell.planning.goal import check_goal, place_text
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.workspace import CircleArea
from tapping_cell.se2 import Pose


def check_layout(scene: Scene, maps: AmongOthers) -> Refusal | None:
    """Why the goals of a scene cannot all be reached, with the objects; None where they can."""
    goals = {body.name: body.goal for body in scene.bodies if body.goal is not None}
    for body in scene.bodies:
        place = scene.poses[body.name]
        if not np.all(np.isfinite(place)):
            return Refusal(
                RefusalReason.OBJECT_POSE_NOT_FINITE,
                f"the pose of '{body.name}' is {list(place)}; look again",
            )
        if body.goal is None:
            continue
        alone = check_goal(np.array(body.goal), body.free.space, body.free)
        if alone is not None:
            return Refusal(alone.reason, f"'{body.name}': {alone.sentence}")
    return _overlap(scene) or _order_exists(scene, goals, maps)


def _overlap(scene: Scene) -> Refusal | None:
    """Two goals, or a goal and an object that may not be moved, that are too close together."""
    placed = [
        (body, body.goal) if body.goal is not None else (body, scene.poses[body.name])
        for body in scene.bodies
        if body.goal is not None or not body.movable
    ]
    for number, (first, here) in enumerate(placed):
        for second, there in placed[:number]:
            if first.goal is None and second.goal is None:
                continue
            margin = max(b.free.space.workspace.keep_out_margin for b in (first, second))
            between = gap(first.area(here), second.area(there))
            if between < margin:
                kind = "their goals" if first.goal and second.goal else "the goal and the object"
                return Refusal(
                    RefusalReason.GOALS_OVERLAP,
                    f"'{second.name}' at {place_text(there)} and '{first.name}' at "
                    f"{place_text(here)}: the gap between {kind} is {1e3 * between:.1f} mm "
                    f"(bounding circles), at least {1e3 * margin:.1f} mm are needed; move one away",
                )
    return None


def _order_exists(scene: Scene, goals: dict[str, Pose], maps: AmongOthers) -> Refusal | None:
    fixed = [b.area(scene.poses[b.name]) for b in scene.bodies if b.goal is None and not b.movable]
    stuck = stuck_goals([b for b in scene.bodies if b.goal is not None], [], fixed, maps)
    if not stuck:
        return None
    names = ", ".join(f"'{name}' at {place_text(goals[name])}" for name in stuck)
    return Refusal(
        RefusalReason.NO_ARRANGEMENT,
        f"the layout cannot be reached: with the others at their goals the striker has no room to "
        f"bring {names} into place, in whatever order; move these goals further apart or towards "
        "the middle of the arm's reach",
    )


def stuck_goals(
    unplaced: list[Body],
    placed: list[Body],
    fixed: list[CircleArea],
    maps: AmongOthers,
) -> list[str]:
    """Names of the unplaced objects for which no order of placing exists; empty where one does.

    ``placed`` stand at their goals already and stay there; ``fixed`` is further ground taken.
    """
    left = list(unplaced)
    standing = [body.area(body.goal) for body in placed if body.goal is not None]
    while left:
        for body in left:
            others = [b.area(b.goal) for b in left if b is not body and b.goal is not None]
            assert body.goal is not None
            if maps.in_largest_region(body, [*standing, *fixed, *others], body.goal):
                left.remove(body)
                break
        else:
            return [body.name for body in left]
    return []
