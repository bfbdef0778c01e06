"""Checks of a goal before the first tap, and texts about poses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from tapping_cell.planning.free_space import WIDEST_GAP, FreeSpace, widest_gap
from tapping_cell.planning.refusal import Refusal, RefusalReason
from tapping_cell.planning.strike import StrikeSpace


def place_text(pose: ArrayLike) -> str:
    """Format a pose for messages: "(10.0 mm, 0.0 mm, 5.0 degrees)"."""
    x, y, theta = np.asarray(pose, dtype=float)
    return f"({1e3 * x:.1f} mm, {1e3 * y:.1f} mm, {math.degrees(theta):.1f} degrees)"


def others_text(space: StrikeSpace) -> str:
    """Return a clause for refusals that names the other objects on the table, or an empty
    string."""
    others = space.workspace.others()
    return f"; the camera also sees {others}: remove the obstacles" if others else ""


def edge_warning(pose: ArrayLike, space: StrikeSpace) -> str:
    """Return a warning if the object at a pose (x, y, theta) is closer to an edge than the margin
    or hangs over the edge, else an empty string."""
    place = np.asarray(pose, dtype=float)
    gap = float(space.workspace.edge_distance(place[:2])) - space.object_radius
    margin = space.workspace.edge_margin
    if gap >= margin:
        return ""
    if gap >= 0.0:
        return (
            f"the object at {place_text(place)} is {1e3 * gap:.1f} mm from the table's edge "
            f"(margin {1e3 * margin:.1f} mm); only taps that lead away from the edge are made"
        )
    return (
        f"the object at {place_text(place)} may hang {-1e3 * gap:.1f} mm over the table's edge; "
        "only taps that bring it back are made"
    )


def check_goal(
    goal_pose: ArrayLike, space: StrikeSpace, free: FreeSpace | None = None
) -> Refusal | None:
    """Return why the goal (x, y, theta in `table`) cannot be reached, or None.

    If a map of the free space is given, the goal must also be tappable, so that a tap is always
    possible near the goal.
    """
    goal = np.asarray(goal_pose, dtype=float)
    if goal.shape != (3,) or not np.all(np.isfinite(goal)):
        return Refusal(
            RefusalReason.GOAL_NOT_FINITE,
            f"the goal {goal.tolist()} is not three finite numbers x, y, theta; send a valid pose",
        )
    table, radius = space.workspace, space.object_radius
    edge = float(table.edge_distance(goal[:2]))
    if edge < radius + table.edge_margin:
        return Refusal(
            RefusalReason.GOAL_OFF_TABLE,
            f"the goal {place_text(goal)} is {1e3 * abs(edge):.1f} mm "
            f"{'inside' if edge >= 0 else 'outside'} the table's edge; the "
            f"object needs {1e3 * (radius + table.edge_margin):.1f} mm: the goal must lie within "
            f"+-{1e3 * (table.length / 2 - radius - table.edge_margin):.1f} mm in x and "
            f"+-{1e3 * (table.width / 2 - radius - table.edge_margin):.1f} mm in y",
        )
    keep_out = float(table.keep_out_distance(goal[:2]))
    if keep_out < radius + table.keep_out_margin:
        return Refusal(
            RefusalReason.GOAL_IN_KEEP_OUT,
            f"the goal {place_text(goal)} is {1e3 * keep_out:.1f} mm from "
            f"{table.nearest_keep_out(goal[:2])}; the "
            f"object needs {1e3 * (radius + table.keep_out_margin):.1f} mm; move the goal away",
        )
    if free is not None and bool(free.contains(goal[:2])):
        return None
    gap = float(widest_gap(space, goal[:2]))
    if free is not None or gap > WIDEST_GAP:
        return Refusal(
            RefusalReason.GOAL_OUT_OF_REACH,
            f"at the goal {place_text(goal)} the directions of possible taps have a gap of "
            f"{math.degrees(gap):.0f} degrees; to correct every error, the gap must be at most "
            f"{math.degrees(WIDEST_GAP):.0f} degrees; "
            "choose a goal nearer to the middle of the arm's reach, or away from keep-outs"
            + others_text(space),
        )
    return None
