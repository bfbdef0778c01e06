"""Goal handling of a cell with fixed tappers."""

from __future__ import annotations

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.logic.arrangement import ArrangementTask
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Token
from tapping_cell.logic.goal_handling import GoalHandling, Request
from tapping_cell.logic.goal_validation import Refused
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.logic.task import SingleTapTask, Task
from tapping_cell.messages import ArrangeObjects, ErrorCode, SingleTap
from tapping_cell.planning import KeepOut, Refusal
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.fixed_session import METHOD, FixedTapperSession, check_fixed_goal
from tapping_cell.planning.fixed_solver import GoalSolver
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace
from tapping_cell.planning.mounts import MountBelief
from tapping_cell.planning.session import GoalSession
from tapping_cell.se2 import Array, Pose


class FixedGoalHandling(GoalHandling):
    """See the module's docstring. The estimated errors of the mounts are kept from one goal to the
    next."""

    def _prepare(self, cell: Cell, maps: TableMaps | None) -> None:
        self._whole = assembly.make_fixed_space(cell, objective=self._objective)
        self._spaces: dict[tuple[KeepOut, ...], FixedStrikeSpace] = {}
        self._solver = GoalSolver(background=self._in_background)
        self._mounts = MountBelief.start(len(self._whole.tappers))

    def _use_map(self) -> None:
        obstacles = tuple(area for area in self.others if area is not None)
        if obstacles not in self._spaces:
            self._spaces = {obstacles: self._whole.among(obstacles)}
        self._space = self._spaces[obstacles]

    def _use_method(self, tolerance: tuple[float, float]) -> None:
        if self._planner not in ("", METHOD, self.cell.file.goal.planner):
            raise PlanningError(
                f"the planning method '{self._planner}' needs an arm, but this cell has fixed"
                f" tappers; set the parameter planner to '{METHOD}'"
            )

    def _update(self, task: Task) -> None:
        assert isinstance(task.session, FixedTapperSession)
        if task.free_space is not self._space:
            task.session.use_free_space(self._space)
            task.free_space = self._space

    def _goal_refusal(self, goal: Pose) -> Refusal | None:
        return check_fixed_goal(goal, self._space)

    def _session(
        self, goal: Pose, tolerance: tuple[float, float], most_taps: int, probe: bool
    ) -> GoalSession:
        return FixedTapperSession(
            goal,
            assembly.make_planner_settings(self.cell, tolerance),
            self._space,
            self._solver,
            self.gains,
            self._mounts,
            adapt=self._adapt,
            most_taps=most_taps,
        )

    def outline(self) -> Array:
        """Return the edges of the working area, (edges, 2 ends, 2), m in ``table``."""
        return self._space.area.outline()

    def learn(self, task: Task) -> None:
        """Use what was learnt from a goal's taps: the corrections of the object's model and the
        estimated errors of the mounts."""
        super().learn(task)
        if isinstance(task.session, FixedTapperSession):
            self._mounts = task.session.mounts

    def accept(self, request: Request, now: Now) -> Task | Refused:
        """Return a task for a request, or why it is refused: the tappers' lines are computed for
        the cell's own object."""
        own = self.cell.object.name
        if request.object_id in self._cells and request.object_id != own:
            return Refused(
                ErrorCode.NO_ARRANGEMENT,
                f"this cell's fixed tappers move only '{own}', not '{request.object_id}'; use a"
                " cell with an arm",
            )
        return super().accept(request, now)

    def accept_arrangement(
        self, asked: ArrangeObjects.Goal, token: Token | None, now: Now
    ) -> ArrangementTask | Refused:
        """Refuse: fixed tappers move only the cell's own object."""
        return Refused(
            ErrorCode.NO_ARRANGEMENT,
            "this cell has fixed tappers, which cannot arrange several objects; use a cell with an"
            " arm",
        )

    def accept_tap(
        self, asked: SingleTap.Goal, token: Token, pose: Pose | None, now: Now
    ) -> SingleTapTask | Refused:
        """Refuse: prescribed taps are not yet supported for fixed tappers."""
        return Refused(
            ErrorCode.COMMAND_INVALID,
            "single taps can be prescribed only for a tapper on an arm; send goals instead, "
            "and calibrate the mounts from the records of their taps",
        )


def goal_handling_class(cell: Cell) -> type[GoalHandling]:
    """Return the class of goal handling for a cell."""
    return GoalHandling if cell.file.fixed_tappers is None else FixedGoalHandling
