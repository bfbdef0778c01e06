"""Interface of arrangement planners: the scene as input and the next move as output."""

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

    name: unique name. free: map of tappable places on the table without other objects; objects of
    the same shape may share it. planner: method that chooses the taps; its settings contain the
    tolerance of the goal. goal: pose in `table`; None for an object without a goal.
    movable: whether the object may be tapped, to reach its goal or to make way.
    """

    name: str
    free: FreeSpace
    planner: Planner
    goal: Pose | None = None
    movable: bool = True

    @property
    def target(self) -> Pose:
        """Goal of an object that has one."""
        assert self.goal is not None, f"'{self.name}' has no goal"
        return self.goal

    def is_at_goal(self, pose: Pose) -> bool:
        """Return whether this pose is within the tolerance of the goal of an object that has
        one."""
        settings = self.planner.settings
        return (
            pose.distance_to(self.target) <= settings.tolerance_position
            and abs(pose.rotation_to(self.target)) <= settings.tolerance_angle
        )

    @property
    def radius(self) -> float:
        """Radius of the bounding circle, m."""
        return self.free.space.object_radius

    def area(self, pose: Pose) -> CircleArea:
        """Return the bounding circle at a pose. This circle is a keep-out for the other objects."""
        return CircleArea(pose.x, pose.y, self.radius, self.name)


class Purpose(Enum):
    """Purpose of a move."""

    TO_GOAL = "to its goal"
    MAKE_WAY = "out of the way"


@dataclass(frozen=True, slots=True)
class Move:
    """Move of one object to a target by one or more taps.

    reason: why this move is made now, as text for messages. blocked: name of the object for which
    the moved object makes way, or empty.
    """

    name: str
    target: Pose
    purpose: Purpose
    reason: str = ""
    blocked: str = ""


@dataclass(frozen=True, slots=True)
class Scene:
    """State of all objects on the table.

    bodies: all objects. poses: stationary pose of each object. finished: names of the objects at
    their goals. excluded: moves, as (name, purpose), that must not be chosen now, because no tap
    was possible in this state or because many taps did not complete the move. buffers: targets of
    the earlier moves out of the way, by name of the object. later: names of the objects that must
    wait for other objects before they go to their own goals: either the requested order demands
    this, or they made way for those objects.
    """

    bodies: Sequence[Body]
    poses: Mapping[str, Pose]
    finished: frozenset[str] = frozenset()
    excluded: frozenset[tuple[str, Purpose]] = frozenset()
    buffers: Mapping[str, Sequence[Pose]] = field(default_factory=dict)
    later: frozenset[str] = frozenset()


class ArrangementPlanner(Protocol):
    """Chooses the next object to move and its target."""

    @property
    def name(self) -> str:
        """Name of the method."""
        ...

    def next_move(self, scene: Scene) -> Move | Refusal:
        """Return the next move, or a refusal if no move helps. Called only while a goal is
        unfinished."""
        ...
