"""Check, before the first tap, whether a layout can be reached.

The order of placement is found backwards from the finished layout. An object that can be tapped at
its goal and moved away from it may have been placed last; it is removed and the search continues.
Removing an object never blocks another object, so the greedy choice finds an order if one exists
(disassembly planning: Wilson and Latombe, Artificial Intelligence 71, 1994). This module does not
check whether the objects can make way for each other before they are placed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tapping_cell.planning.arrangement.among import AmongOthers, gap
from tapping_cell.planning.arrangement.interface import Body, Scene
from tapping_cell.planning.goal import check_goal, place_text
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.workspace import CircleArea
from tapping_cell.se2 import Pose

NOWHERE: Mapping[str, Pose] = {}


def check_layout(scene: Scene, maps: AmongOthers) -> Refusal | None:
    """Return a refusal that names the goals of a scene that cannot be reached, or None."""
    goals = {body.name: body.goal for body in scene.bodies if body.goal is not None}
    for body in scene.bodies:
        place = scene.poses[body.name]
        if not np.all(np.isfinite(place)):
            return Refusal(
                RefusalReason.OBJECT_POSE_NOT_FINITE,
                f"the pose of '{body.name}' is {list(place)}, but must be three finite numbers; "
                "observe the object again",
            )
    standing = {body.name: scene.poses[body.name] for body in scene.bodies if not body.movable}
    return check_goals(scene.bodies, standing) or _order_refusal(scene, goals, maps)


def check_goals(bodies: Sequence[Body], standing: Mapping[str, Pose] = NOWHERE) -> Refusal | None:
    """Return a refusal if a goal is impossible regardless of where the movable objects are now,
    else None.

    Each goal is checked alone, then against the other goals and against the poses ``standing`` of
    unmovable objects.
    """
    for body in bodies:
        if body.goal is None:
            continue
        alone = check_goal(np.array(body.goal), body.free.space, body.free)
        if alone is not None:
            return Refusal(alone.reason, f"'{body.name}': {alone.sentence}")
    return _overlap_refusal(bodies, standing)


def _overlap_refusal(bodies: Sequence[Body], standing: Mapping[str, Pose]) -> Refusal | None:
    """Return a refusal if two goals, or a goal and an unmovable object, are too close together."""
    placed = [
        (body, body.goal if body.goal is not None else standing[body.name])
        for body in bodies
        if body.goal is not None or body.name in standing
    ]
    for number, (first, here) in enumerate(placed):
        for second, there in placed[:number]:
            if first.goal is None and second.goal is None:
                continue
            margin = max(b.free.space.workspace.keep_out_margin for b in (first, second))
            between = gap(first.area(here), second.area(there))
            if between < margin:
                both = first.goal is not None and second.goal is not None
                remedy = "these goals apart" if both else "the goal away from the other object"
                return Refusal(
                    RefusalReason.GOALS_OVERLAP,
                    f"'{second.name}' at {place_text(there)} and '{first.name}' at "
                    f"{place_text(here)} would be too close together: the gap between their "
                    f"bounding circles would be {1e3 * between:.1f} mm, but at least "
                    f"{1e3 * margin:.1f} mm are needed; move {remedy}",
                )
    return None


def _order_refusal(scene: Scene, goals: dict[str, Pose], maps: AmongOthers) -> Refusal | None:
    fixed = [b.area(scene.poses[b.name]) for b in scene.bodies if b.goal is None and not b.movable]
    stuck = stuck_goals([b for b in scene.bodies if b.goal is not None], [], fixed, maps)
    if not stuck:
        return None
    names = ", ".join(f"'{name}' at {place_text(goals[name])}" for name in stuck)
    return Refusal(
        RefusalReason.NO_ARRANGEMENT,
        "the layout cannot be reached: if the other objects are at their goals, the striker lacks "
        f"space to tap {names}, whatever the order; move these goals further apart or towards "
        "the middle of the arm's reach",
    )


def stuck_goals(
    unplaced: list[Body],
    placed: list[Body],
    fixed: list[CircleArea],
    maps: AmongOthers,
) -> list[str]:
    """Return the names of the unplaced objects that cannot be placed in any order; empty if none.

    ``placed``: objects that stay at their goals; ``fixed``: other occupied areas.
    """
    left = list(unplaced)
    standing = [body.area(body.target) for body in placed]
    while left:
        for body in left:
            others = [b.area(b.target) for b in left if b is not body]
            if maps.in_largest_region(body, [*standing, *fixed, *others], body.target):
                left.remove(body)
                break
        else:
            return [body.name for body in left]
    return []
