"""What an arrangement planner is asked and what it answers: the interface for other planners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from tapping_cell.planning.free_space import FreeSpace
from tapping_cell.planning.interface import Planner
from tapping_cell.planning.refusal import Refusal
from tapping_cell.planning.workspace import CircleArea
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """One object of an arrangement.

    name: its identity. free: its map of workable places on the table without the other objects;
    objects of one shape may share it. planner: the method that chooses its taps; its settings hold
    the tolerance of the goal. goal: pose in `table`; None for an object without one.
    movable: whether it may be tapped: an object with a goal, or one that may make way.
    """

    name: str
    free: FreeSpace
    planner: Planner
    goal: Pose | None = None
    movable: bool = True

    @property
    def radius(self) -> float:
        """Radius of the bounding circle, m."""
        return self.free.space.object_radius

    def area(self, pose: Pose) -> CircleArea:
        """The ground that it may cover at a pose, as a keep-out for the others: its bounding
        circle."""
        return CircleArea(pose.x, pose.y, self.radius, self.name)


class Purpose(Enum):
    """Why an object is moved."""

    TO_GOAL = "to its goal"
    MAKE_WAY = "out of the way"


@dataclass(frozen=True, slots=True)
class Move:
    """One object to be brought to a target, by as many taps as it takes. ``reason``: for people."""

    name: str
    target: Pose
    purpose: Purpose
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Scene:
    """Where everything is.

    bodies: every object. poses: of each, at rest. finished: names of those at their goals.
    excluded: moves that were tried from here and could not be tapped, as (name, purpose).
    """

    bodies: Sequence[Body]
    poses: Mapping[str, Pose]
    finished: frozenset[str] = frozenset()
    excluded: frozenset[tuple[str, Purpose]] = field(default_factory=frozenset)


class ArrangementPlanner(Protocol):
    """Chooses which object is moved next, and where to."""

    @property
    def name(self) -> str:
        """Name of the method."""
        ...

    def next_move(self, scene: Scene) -> Move | Refusal:
        """The next move; a refusal where none leads on. Some goal is not finished."""
        ...
