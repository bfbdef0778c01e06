"""Check of goals for one object of the cell, by the same rules as in the planner."""

from __future__ import annotations

from functools import cached_property

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.goal_validation import REFUSALS
from tapping_cell.nodes.page.cell_view import with_code
from tapping_cell.planning import FreeSpace, check_goal
from tapping_cell.planning.fixed_session import check_fixed_goal
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace
from tapping_cell.se2 import Pose


class GoalCheck:
    """Finds out whether the planner would refuse a goal of one object. ``cell`` is a configuration
    in which this object is the cell's own object."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self.ready = False
        """Whether ``prepare`` has been called. Without preparation, the first check of a polygon
        takes seconds."""

    @cached_property
    def free(self) -> FreeSpace:
        """Map of the places where the object can be tapped."""
        return FreeSpace(assembly.make_strike_space(self._cell))

    @cached_property
    def _fixed(self) -> FixedStrikeSpace:
        return assembly.make_fixed_space(self._cell)

    def prepare(self) -> None:
        """Compute the data that the first check needs."""
        _ = self._fixed if self._cell.file.arm is None else self.free
        self.ready = True

    def refusal_if_ready(self, pose: Pose) -> str:
        """Return the result of ``refusal``, or an empty text while the check is not prepared."""
        return self.refusal(pose) if self.ready else ""

    def refusal(self, pose: Pose) -> str:
        """Return the planner's message for a goal that it would refuse, or an empty text."""
        if self._cell.file.arm is None:
            found = check_fixed_goal(pose, self._fixed)
        else:
            found = check_goal(pose, self.free.space, self.free)
        return with_code(found.sentence, REFUSALS[found.reason]) if found is not None else ""
