"""Where goals are accepted: the cell's mechanics, its map of the table and its planning methods."""

from __future__ import annotations

import math
from dataclasses import dataclass

from geometry_msgs.msg import PoseStamped
from rclpy.action.server import ServerGoalHandle
from rclpy.time import Time
from tapping_cell_msgs.msg import ErrorCode

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.nodes.conversions import to_message
from tapping_cell.nodes.planner.goal_validation import REFUSALS, Refused, read_goal, read_tolerance
from tapping_cell.nodes.planner.markers import region_marker
from tapping_cell.nodes.planner.other_objects import Neighbours
from tapping_cell.nodes.planner.tap_task import SingleTapTask, Task
from tapping_cell.planning import (
    FreeSpace,
    Gains,
    Planner,
    PlanningError,
    PositioningSession,
    PrescribedSession,
    Prescription,
    cautious,
    check_goal,
    keep_gains,
    load_gains,
    make_planner,
)
from tapping_cell.planning.gains import NAMES
from tapping_cell.se2 import Pose


@dataclass(frozen=True, slots=True)
class Request:
    """A goal as it arrives. Tolerances in m and rad, 0 for the cell's own; max_taps 0 likewise."""

    message: PoseStamped
    position_tolerance: float = 0.0
    angle_tolerance: float = 0.0
    max_taps: int = 0
    time_limit: float = 0.0
    """s; 0 for the planner's own."""
    handle: ServerGoalHandle | None = None


class GoalDesk:
    """Turns requests into tasks.

    Raises:
        tapping_cell.planning.PlanningError: the planning method is not known, or what was learnt
            in earlier runs cannot be read.
    """

    def __init__(
        self,
        cell: Cell,
        planner: str,
        neighbours: Neighbours,
        *,
        adapt: bool,
        probe: bool,
        keep_for: str,
    ) -> None:
        """``neighbours``: the further objects, to be kept clear of; ``adapt``: learn from taps;
        ``probe``: begin with a few of the smallest taps for an object that is not known;
        ``keep_for``: the cell for which what was learnt is remembered between runs; empty for none.
        """
        self.cell = cell
        self._neighbours = neighbours
        self._adapt = adapt
        self._probe = probe
        self._keep_for = keep_for
        self._gains = load_gains(cell.object.name, keep_for) if keep_for else Gains.start()
        self._planner = planner or cell.file.goal.planner
        self._alone = assembly.make_strike_space(cell)
        self._experiments_alone = assembly.make_strike_space(cell, cautious(self._alone))
        self.others = neighbours.areas()
        """Where the further objects lie; None for one that is not on the table."""
        self._planned_among = self.others
        self._place()
        self._planners: dict[str, Planner] = {}
        # Made now, so that a method that must be solved first begins before the first goal.
        self._planner_for(cell.tolerance)

    def room_for(self, task: Task, since: Time) -> tuple[int, str] | None:
        """Have a task work in the room that the further objects leave; or why that is not known:
        the camera has not looked for one of them since a moment."""
        names = self._neighbours.unlooked(since)
        if names:
            return (
                ErrorCode.NOT_READY,
                f"nothing is heard of the object {names} on other_objects; give camera_pose the "
                "same other_object_files as tap_planner",
            )
        self._keep_clear()
        self._planned_among = self.others
        if task.room is not self._free:
            single = isinstance(task, SingleTapTask)
            task.session.use_room(self._experiments if single else self._space, self._free)
            task.room = self._free
        return None

    def others_moved(self) -> bool:
        """True where a further object lies elsewhere than when a task was last given its room."""
        return self._neighbours.moved_since(self._planned_among)

    def _keep_clear(self) -> None:
        """Take in where the further objects lie now."""
        before, self.others = self.others, self._neighbours.areas()
        if before != self.others:
            self._place()

    def _place(self) -> None:
        """Make the map of the table with the further objects on it (about 0.1 s)."""
        others = [area for area in self.others if area is not None]
        self._space = self._alone.among(others)
        self._experiments = self._experiments_alone.among(others)
        self._free = FreeSpace(self._space)
        self.region = region_marker(self._free.outline())

    def use(self, planner: str) -> None:
        """Take another planning method, from the next goal on.

        Raises:
            tapping_cell.planning.PlanningError: the method is not known; the old one stays.
        """
        before, self._planner = self._planner, planner or self.cell.file.goal.planner
        try:
            self._planner_for(self.cell.tolerance)
        except ValueError:
            self._planner = before
            raise

    def learnt(self) -> dict[str, str]:
        """What earlier goals taught about the object, with deviations, for diagnostics."""
        numbers = self._gains.as_numbers()
        return {
            f"learnt {name}": f"{numbers[name]:.4f} +- {numbers[f'{name}_deviation']:.4f}"
            for name in NAMES
        }

    def learn(self, task: Task) -> None:
        """Remember what a goal's taps taught about the object, for the goals that follow."""
        self._gains = task.session.gains
        if self._keep_for and task.records:
            keep_gains(self.cell.object.name, self._keep_for, self._gains)

    def accept(self, request: Request, now: float) -> Task | Refused:
        """A task for a request, or why there is none. ``now`` is ROS time in s."""
        goal = read_goal(request.message, now)
        if isinstance(goal, Refused):
            return goal
        tolerance = read_tolerance(
            request.position_tolerance, request.angle_tolerance, self.cell.tolerance
        )
        if isinstance(tolerance, Refused):
            return tolerance
        if not (math.isfinite(request.time_limit) and request.time_limit >= 0):
            return Refused(
                ErrorCode.COMMAND_INVALID,
                f"time_limit is {request.time_limit:g} s; it must be 0 (the planner's own) or more",
            )
        limit = self.cell.file.goal.max_taps
        if request.max_taps > limit:
            return Refused(
                ErrorCode.GOAL_BAD_TAP_LIMIT,
                f"max_taps is {request.max_taps}, the cell allows {limit}; ask for at most that "
                "many",
            )
        self._keep_clear()
        unreachable = check_goal(goal, self._space, self._free)
        if unreachable is not None:
            return Refused(REFUSALS[unreachable.reason], unreachable.sentence)
        max_taps = request.max_taps or limit
        session = PositioningSession(
            goal,
            self._planner_for(tolerance),
            self._space,
            self._free,
            self._gains,
            adapt=self._adapt,
            probe=self._probe,
            most_taps=max_taps,
        )
        return Task(request.message, goal, tolerance, max_taps, session, request.handle)

    def accept_tap(self, handle: ServerGoalHandle, pose: Pose | None) -> SingleTapTask | Refused:
        """A task for a single tap, or why there is none. ``pose``: where the object is, if seen."""
        asked = handle.request
        curve = self.cell.file.tapper.curve()
        if not curve.slowest <= asked.striker_speed <= curve.fastest:
            return Refused(
                ErrorCode.TAPPER_SPEED_OUT_OF_RANGE,
                f"the striker speed is {1000 * asked.striker_speed:.1f} mm/s, the tapper makes "
                f"{1000 * curve.slowest:.0f} to {1000 * curve.fastest:.0f} mm/s; ask for one of "
                "these",
            )
        direction = None if math.isnan(asked.direction) else asked.direction
        try:
            tap = Prescription(asked.striker_speed, asked.incidence, direction, asked.slack)
        except PlanningError as error:
            return Refused(ErrorCode.COMMAND_INVALID, str(error))
        session = PrescribedSession(
            tap, self._experiments, self._free, self._gains, adapt=self._adapt
        )
        # Until the tap is decided on, its goal is where the object lies.
        goal = pose or Pose(0.0, 0.0, 0.0)
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        return SingleTapTask(
            message=message,
            goal=goal,
            tolerance=self.cell.tolerance,
            max_taps=1,
            session=session,
            handle=handle,
            references=self.cell.references,
        )

    def _planner_for(self, tolerance: tuple[float, float]) -> Planner:
        """The planning method for a tolerance, made once and kept."""
        settings = assembly.make_planner_settings(self.cell, tolerance)
        key = f"{self._planner};{settings.key()}"
        if key not in self._planners:
            self._planners[key] = make_planner(self._planner, settings, background=True)
        return self._planners[key]
