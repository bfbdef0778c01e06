"""The layout file: where the objects of a cell are to go, for the verb ``arrange``."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.schema import quantity, section, text


@dataclass(frozen=True, slots=True)
class LayoutGoal:
    """Where one object is to go."""

    object: str = text("name of the object: the key 'name' of its file")
    pose: tuple[float, float, float] = quantity(
        "x and y in m and theta in rad, in table, of the object's centre of mass", "", -7.0, 7.0
    )
    position_tolerance: float = quantity("0 for the cell's own", "m", 0.0, 1.0, default=0.0)
    angle_tolerance: float = quantity("0 for the cell's own", "rad", 0.0, 3.2, default=0.0)


@dataclass(frozen=True, slots=True)
class LayoutFile:
    """One arrangement."""

    goals: tuple[LayoutGoal, ...] = section("goals, each of another object")
    in_order: bool = text("finish the objects in the order of the list", default=False)
    may_move: tuple[str, ...] = text(
        "names of objects without a goal that may be tapped out of the way", default=()
    )
    max_taps: int = quantity(
        "taps of all objects together; 0 for the cell's own for each goal", "", 0, 10000, default=0
    )
    time_limit: float = quantity(
        "of all together; 0 for the planner's own for each goal", "s", 0.0, 86400.0, default=0.0
    )
