"""The layout file: goal poses of the objects of a cell, for ``goal --layout``."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.cell import LARGEST_FILE_ANGLE_TOLERANCE
from tapping_cell.configuration.schema import quantity, section, text
from tapping_cell.planning.settings import LARGEST_POSITION_TOLERANCE


@dataclass(frozen=True, slots=True)
class LayoutGoal:
    """Goal pose of one object."""

    object: str = text("name of the object: the key 'name' of its file")
    pose: tuple[float, float, float] = quantity(
        "goal pose of the object's centre of mass in the frame table: x, y in m, theta in rad",
        "m, m, rad",
        -7.0,
        7.0,
    )
    position_tolerance: float = quantity(
        "position tolerance of the goal; 0 means the tolerance of the cell file",
        "m",
        0.0,
        LARGEST_POSITION_TOLERANCE,
        default=0.0,
    )
    angle_tolerance: float = quantity(
        "angle tolerance of the goal; 0 means the tolerance of the cell file",
        "rad",
        0.0,
        LARGEST_FILE_ANGLE_TOLERANCE,
        default=0.0,
    )


@dataclass(frozen=True, slots=True)
class LayoutFile:
    """Contents of a layout file: one arrangement of objects."""

    goals: tuple[LayoutGoal, ...] = section("goals, each for a different object")
    in_order: bool = text(
        "whether the objects are brought to their goals in the order of the key goals; "
        "if false, the planner chooses the order",
        default=False,
    )
    may_move: tuple[str, ...] = text(
        "names of objects without a goal that may be tapped out of the way", default=()
    )
    max_taps: int = quantity(
        "maximum number of taps for all objects together; 0 means goal.max_taps times the number "
        "of goals",
        "",
        0,
        10000,
        default=0,
    )
    time_limit: float = quantity(
        "time limit for all objects together; 0 means the planner's time limit for one goal "
        "times the number of goals",
        "s",
        0.0,
        86400.0,
        default=0.0,
    )

    def __post_init__(self) -> None:
        """Raise ValueError if there is no goal, or two for one object."""
        names = [goal.object for goal in self.goals]
        if not names:
            raise ValueError("'goals' is empty; give at least one")
        for name in names:
            if names.count(name) > 1:
                places = [f"'goals[{k}]'" for k, other in enumerate(names) if other == name]
                raise ValueError(
                    f"{' and '.join(places)} are both for the object '{name}'; correct one of the "
                    "names, or delete one goal"
                )
