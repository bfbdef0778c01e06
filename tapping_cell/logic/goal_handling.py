"""Goal handling: checks requests and creates tasks with the cell's map and planning method."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell
from tapping_cell.logic import tap_commands
from tapping_cell.logic.arm_times import arm_times
from tapping_cell.logic.arrangement import ArrangementTask, RequestedGoal
from tapping_cell.logic.clock import Now
from tapping_cell.logic.effects import Token
from tapping_cell.logic.frames import TABLE, Frames, TableOnly
from tapping_cell.logic.goal_validation import REFUSALS, Refused, read_goal, read_tolerance
from tapping_cell.logic.objects_on_table import ObjectsOnTable
from tapping_cell.logic.poses import to_message
from tapping_cell.logic.table_maps import TableMaps
from tapping_cell.logic.task import SingleTapTask, Task
from tapping_cell.messages import (
    ArrangeObjects,
    ErrorCode,
    Header,
    PoseStamped,
    SingleTap,
)
from tapping_cell.planning import (
    Gains,
    Planner,
    PositioningSession,
    PrescribedSession,
    Prescription,
    Refusal,
    check_goal,
    keep_gains,
    load_gains,
    make_planner,
)
from tapping_cell.planning.arrangement import Body, bodies_among, check_goals
from tapping_cell.planning.gains import NAMES
from tapping_cell.planning.precision_limit import precision_limit
from tapping_cell.planning.session import GoalSession
from tapping_cell.planning.shot_at_nothing import ShotAtNothing
from tapping_cell.se2 import Array, Pose

APPEARANCE_KEYS = ("name", "marker", "outline", "calibration")
"""Fields of an object file that do not affect how the object slides."""

SAFELY_SLOWEST = 1.001
"""Speed of a shot at nothing, as a multiple of the tapper's slowest speed: rounding must not make
it slower than the range."""
LONGEST_MEMORY_S = 5.0
"""Maximum time for which an arrangement waits for an object that is not seen, s. It is less than
the default of ``observe_deadline``, after which the arrangement would end."""


@dataclass(frozen=True, slots=True)
class Request:
    """A received goal. Tolerances in m and rad, time limit in s; 0 means the cell's default."""

    message: PoseStamped
    position_tolerance: float = 0.0
    angle_tolerance: float = 0.0
    max_taps: int = 0
    time_limit: float = 0.0
    token: Token | None = None
    probe: bool = False
    """Whether to begin with a few of the smallest taps, to estimate the object's friction."""
    ask: bool = False
    """Whether a person confirms every tap."""
    object_id: str = ""
    """Name of the object; empty for the cell's own object."""
    earlier_taps: int = 0
    """Taps of this goal that a planner commanded before it crashed."""


class GoalHandling:
    """Converts requests to tasks.

    Raises:
        tapping_cell.planning.PlanningError: the planning method is unknown, or the stored
            corrections of the model, learnt in earlier runs, cannot be read.
    """

    def __init__(
        self,
        cell: Cell,
        planner: str,
        objects: ObjectsOnTable,
        now: Now,
        *,
        objective: str = "",
        adapt: bool,
        probe: bool,
        keep_for: str,
        time_limit: float,
        maps: TableMaps | None = None,
        frames: Frames | None = None,
        solve_in_background: bool = True,
    ) -> None:
        """Create the goal handling of a cell.

        ``objects``: the cell's objects on the table; ``objective``: quantity to minimise, empty for
        the quantity in the cell file; ``adapt``: learn from taps; ``probe``: begin with a few of
        the smallest taps if the object's friction is not known; ``keep_for``: cell for which the
        learnt corrections of the model are stored between runs, empty to store none;
        ``time_limit``: default time limit of a goal, s; ``maps``: maps already made for this cell;
        ``frames``: other frames in which goals may be given, None for ``table`` only.
        """
        self.cell = cell
        self._frames = frames or TableOnly()
        self.objects = objects
        self._adapt = adapt
        self._probe = probe
        self._objective = objective or cell.file.goal.objective
        self._keep_for = keep_for
        self._time_limit = time_limit
        self._in_background = solve_in_background
        self._planner = planner or cell.file.goal.planner
        self._cells = {file.name: replace(cell, object=file) for file in objects.files}
        self._learnt_gains = {
            name: load_gains(name, keep_for) if keep_for else Gains.start() for name in self._cells
        }
        self._tapped = cell.object.name
        """Object for which ``others`` and the present map hold."""
        self._prepare(cell, maps)
        self.others = objects.areas(now, self._tapped)
        """Areas that the other objects cover; None for an object that is not on the table."""
        self._planned_among = self.others
        self._use_map()
        # The planning method is created now, because some methods run a solver before the first
        # goal.
        self._use_method(cell.tolerance)

    # Methods that the goal handling of a positioning cell overrides

    def _prepare(self, cell: Cell, maps: TableMaps | None) -> None:
        """Create the maps and planners that are kept for the lifetime of the cell. Objects that
        differ only in name and appearance share them."""
        self._planners: dict[str, Planner] = {}
        self._times = {name: arm_times(one) for name, one in self._cells.items()}
        self._maps: dict[str, TableMaps] = {}
        made = {} if maps is None else {_slides_like(cell): maps}
        for name, one in self._cells.items():
            key = _slides_like(one)
            if key not in made:
                made[key] = TableMaps(one)
            self._maps[name] = made[key]
            self._planner_for(one, one.tolerance)

    def _use_map(self) -> None:
        """Select the map of the table for the tapped object, with the other objects at their
        present poses."""
        areas = [area for area in self.others if area is not None]
        self.map = self._maps[self._tapped].among(areas)

    def _use_method(self, tolerance: tuple[float, float]) -> None:
        """Check that the planning method is available; raise PlanningError otherwise."""
        self._planner_for(self.cell, tolerance)

    def _update(self, task: Task) -> None:
        """Make a task use the present map."""
        if task.free_space is not self.map.free:
            assert isinstance(task.session, (PositioningSession, PrescribedSession))
            space = self.map.experiments if task.prescribed else self.map.space
            task.session.use_free_space(space, self.map.free)
            task.free_space = self.map.free

    def _goal_refusal(self, goal: Pose) -> Refusal | None:
        """Return why the cell cannot move the object to this goal, or None if the goal is
        possible."""
        return check_goal(goal, self.map.space, self.map.free)

    def _session(
        self, goal: Pose, tolerance: tuple[float, float], most_taps: int, probe: bool
    ) -> GoalSession:
        """Return the session that decides on the taps of a goal of the tapped object."""
        return PositioningSession(
            goal,
            self._planner_for(self._cells[self._tapped], tolerance),
            self.map.space,
            self.map.free,
            self._learnt_gains[self._tapped],
            times=self._times[self._tapped],
            objective=self._objective,
            adapt=self._adapt,
            probe=self._probe or probe,
            most_taps=most_taps,
        )

    def outline(self) -> Array:
        """Return the edges of the object's free space, (edges, 2 ends, 2), m."""
        return self.map.free.outline()

    # Methods of all cells

    def update_free_space(
        self, task: Task, since: float, search_since: float, now: Now
    ) -> tuple[int, str] | None:
        """Update the free space of a task to the present poses of the other objects.

        Return an error if one of the other objects was not observed since the steady time
        ``since``, or if the camera has not searched for objects without an object file since the
        steady time ``search_since``.
        """
        if not self.objects.searched(search_since):
            return (
                ErrorCode.NOT_READY,
                "camera_pose did not search the table for objects without an object file, because "
                "an object is moving; make sure that nothing moves on the table",
            )
        if isinstance(task, ArrangementTask):
            # An arrangement task itself observes all objects that have an object file. Such a task
            # needs to be given only the areas of the objects without an object file.
            task.avoid(self.objects.unknown)
            return None
        names = self.objects.unobserved(since, task.object_id)
        if names:
            return (
                ErrorCode.NOT_READY,
                f"object_states has no observation of the object {names}; give camera_pose the "
                "same other_object_files as tap_planner",
            )
        self._locate(task.object_id, now)
        self._planned_among = self.others
        self._update(task)
        return None

    def others_moved(self, task: Task, now: Now) -> bool:
        """Return whether another object has moved since the present tap was planned."""
        return self.objects.moved_since(self._planned_among, now, task.object_id)

    def _locate(self, tapped: str, now: Now) -> None:
        """Update the areas of the objects besides ``tapped``."""
        others = self.objects.areas(now, tapped)
        if (tapped, others) != (self._tapped, self.others):
            self._tapped, self.others = tapped, others
            self._use_map()

    def use(self, planner: str) -> None:
        """Use another planning method from the next goal on.

        Raises:
            tapping_cell.planning.PlanningError: the method is unknown; the previous method is kept.
        """
        before, self._planner = self._planner, planner or self.cell.file.goal.planner
        try:
            self._use_method(self.cell.tolerance)
        except ValueError:
            self._planner = before
            raise

    @property
    def gains(self) -> Gains:
        """Corrections of the model of the cell's own object, learnt from the taps of earlier
        goals."""
        return self._learnt_gains[self.cell.object.name]

    def learnt(self) -> dict[str, str]:
        """Return the learnt corrections of the model and their standard deviations as text, for
        diagnostics."""
        numbers = self.gains.as_numbers()
        return {
            f"learnt {name}": f"{numbers[name]:.4f} +- {numbers[f'{name}_deviation']:.4f}"
            for name in NAMES
        }

    def learn(self, task: Task) -> None:
        """Use the corrections of the model that were learnt from a goal's taps, also before the
        goal has ended, for the goals that are accepted from now on."""
        self._learnt_gains |= task.learnt()

    def keep_learnt(self, task: Task) -> None:
        """Store the corrections that were learnt in a goal for later runs, if the cell keeps them.

        Raises:
            OSError: a file cannot be written.
        """
        if self._keep_for and task.records:
            for name, gains in task.learnt().items():
                keep_gains(name, self._keep_for, gains)

    # Acceptance of requests. These methods do not change the tasks that they have returned before.
    # They raise PlanningError if a setting of a request is invalid for planning.

    def accept(self, request: Request, now: Now) -> Task | Refused:
        """Return a task for a request, or why the request is refused."""
        name = request.object_id or self.cell.object.name
        if name not in self._cells:
            known = ", ".join(f"'{one}'" for one in self._cells)
            return Refused(
                ErrorCode.GOAL_UNKNOWN_OBJECT,
                f"the cell has no object '{name}'; name one of {known}, or leave object_id empty"
                f" for '{self.cell.object.name}'",
            )
        goal = read_goal(request.message, 1e-9 * now.ros, self._frames)
        if isinstance(goal, Refused):
            return goal
        tolerance = _tolerance_of(
            self._cells[name], request.position_tolerance, request.angle_tolerance
        )
        if isinstance(tolerance, Refused):
            return tolerance
        limit = self.cell.file.goal.max_taps
        if request.max_taps > limit:
            return Refused(
                ErrorCode.GOAL_BAD_TAP_LIMIT,
                f"max_taps is {request.max_taps}, but the cell allows at most {limit}; reduce it",
            )
        bad_time_limit = _time_limit_refusal(request.time_limit)
        if bad_time_limit is not None:
            return bad_time_limit
        self._locate(name, now)
        unreachable = self._goal_refusal(goal)
        if unreachable is not None:
            return Refused(REFUSALS[unreachable.reason], unreachable.sentence)
        max_taps = request.max_taps or limit
        session = self._session(goal, tolerance, max_taps, request.probe)
        expires = now.steady + (request.time_limit or self._time_limit)
        message = request.message
        if message.header.frame_id != TABLE:
            message = PoseStamped(
                header=Header(stamp=message.header.stamp, frame_id=TABLE), pose=to_message(goal)
            )
        return Task(
            name,
            message,
            goal,
            tolerance,
            max_taps,
            session,
            request.token,
            expires,
            ask=request.ask,
            probe=request.probe,
        )

    def accept_tap(
        self, asked: SingleTap.Goal, token: Token, pose: Pose | None, now: Now
    ) -> SingleTapTask | Refused:
        """Return a task for a single tap, or why it is refused. ``pose``: observed pose, if any."""
        self._locate(self.cell.object.name, now)
        curve = self.cell.file.tapper.curve()
        if asked.at_nothing:
            speed, stroke = SAFELY_SLOWEST * curve.slowest, self.cell.file.tapper.stroke
            shot = ShotAtNothing(speed, stroke, self.map.experiments, self.map.free, self.gains)
            return self._single(shot, pose, token, now)
        if not curve.slowest <= asked.striker_speed <= curve.fastest:
            return Refused(
                ErrorCode.TAPPER_SPEED_OUT_OF_RANGE,
                f"the striker speed is {1000 * asked.striker_speed:.1f} mm/s, but the "
                f"tapper's range is {1000 * curve.slowest:.0f} to {1000 * curve.fastest:.0f} "
                "mm/s; give a speed within it",
            )
        names = self.cell.tapper_names
        if asked.tapper and asked.tapper not in names:
            return Refused(*tap_commands.unknown_tapper(asked.tapper, names))
        direction = None if math.isnan(asked.direction) else asked.direction
        tap = Prescription(asked.striker_speed, asked.incidence, direction, asked.slack)
        session = PrescribedSession(
            tap, self.map.experiments, self.map.free, self.gains, adapt=self._adapt
        )
        return self._single(session, pose, token, now)

    def _single(
        self, session: PrescribedSession, pose: Pose | None, token: Token, now: Now
    ) -> SingleTapTask:
        """Return the task of one tap; ``pose``: observed pose, if any."""
        # Until the tap is planned, the object's current pose is stored as the goal.
        goal = pose or Pose(0.0, 0.0, 0.0)
        message = PoseStamped(pose=to_message(goal))
        message.header.frame_id = "table"
        return SingleTapTask(
            object_id=self.cell.object.name,
            message=message,
            goal=goal,
            tolerance=self.cell.tolerance,
            max_taps=1,
            session=session,
            token=token,
            expires=now.steady + self._time_limit,
            references=self.cell.references,
        )

    def accept_arrangement(
        self, asked: ArrangeObjects.Goal, token: Token | None, now: Now
    ) -> ArrangementTask | Refused:
        """Return a task for an arrangement, or why it is refused. Whether the requested layout can
        be reached is checked later, after every object has been seen."""
        wanted = self._wanted(asked, now)
        if isinstance(wanted, Refused):
            return wanted
        limit = self.cell.file.goal.max_taps * len(wanted)
        if asked.max_taps > limit:
            return Refused(
                ErrorCode.GOAL_BAD_TAP_LIMIT,
                f"max_taps is {asked.max_taps}, but the cell allows at most {limit} for"
                f" {len(wanted)} objects; reduce it",
            )
        bad_time_limit = _time_limit_refusal(asked.time_limit)
        if bad_time_limit is not None:
            return bad_time_limit
        bodies = [
            Body(
                name,
                self._maps[name].empty,
                self._planner_for(
                    cell, wanted[name].tolerance if name in wanted else cell.tolerance
                ),
                wanted[name].goal if name in wanted else None,
                movable=name in wanted or name in asked.may_move,
            )
            for name, cell in self._cells.items()
        ]
        obstacles = self.objects.unknown
        impossible = check_goals(bodies_among(bodies, obstacles))
        if impossible is not None:
            return Refused(REFUSALS[impossible.reason], impossible.sentence)
        first, one = next(iter(wanted.items()))
        body = next(body for body in bodies if body.name == first)
        session = PositioningSession(
            one.goal, body.planner, body.free.space, body.free, self._learnt_gains[first]
        )
        return ArrangementTask(
            object_id=first,
            message=one.message,
            goal=one.goal,
            tolerance=one.tolerance,
            max_taps=asked.max_taps or limit,
            session=session,
            token=token,
            expires=now.steady + (asked.time_limit or self._time_limit * len(wanted)),
            wanted=wanted,
            bodies=bodies,
            known=dict(self._learnt_gains),
            adapt=self._adapt,
            in_order=asked.in_order,
            memory=min(self.objects.memory, LONGEST_MEMORY_S),
            obstacles=obstacles,
        )

    def _wanted(self, asked: ArrangeObjects.Goal, now: Now) -> dict[str, RequestedGoal] | Refused:
        """Return the goals of an arrangement by name of the object, or why they are refused."""
        if not asked.goals:
            return Refused(
                ErrorCode.COMMAND_INVALID, "the arrangement has no goals; give at least one"
            )
        known = ", ".join(f"'{name}'" for name in self._cells)
        wanted: dict[str, RequestedGoal] = {}
        for name in (*(one.object_id for one in asked.goals), *asked.may_move):
            if name not in self._cells:
                return Refused(
                    ErrorCode.GOAL_UNKNOWN_OBJECT,
                    f"the cell has no object '{name}'; name one of {known}",
                )
        for one in asked.goals:
            if one.object_id in wanted:
                return Refused(
                    ErrorCode.GOAL_UNKNOWN_OBJECT,
                    f"'{one.object_id}' has two goals; give each object one goal",
                )
            goal = read_goal(one.goal_pose, 1e-9 * now.ros, self._frames)
            tolerance = _tolerance_of(
                self._cells[one.object_id], one.position_tolerance, one.angle_tolerance
            )
            for found in (goal, tolerance):
                if isinstance(found, Refused):
                    return Refused(found.code, f"'{one.object_id}': {found.sentence}")
            assert isinstance(goal, Pose) and not isinstance(tolerance, Refused)
            message = PoseStamped(
                header=Header(stamp=one.goal_pose.header.stamp, frame_id=TABLE),
                pose=to_message(goal),
            )
            wanted[one.object_id] = RequestedGoal(message, goal, tolerance)
        return wanted

    def _planner_for(self, cell: Cell, tolerance: tuple[float, float]) -> Planner:
        """Return the planning method for a cell's object and a tolerance; methods are cached."""
        settings = assembly.make_planner_settings(cell, tolerance)
        key = f"{self._planner};{settings.key()}"
        if key not in self._planners:
            self._planners[key] = make_planner(
                self._planner, settings, background=self._in_background
            )
        return self._planners[key]


def _tolerance_of(cell: Cell, position: float, angle: float) -> tuple[float, float] | Refused:
    """Return the tolerance of a goal of a cell's object, or why it is refused."""
    tolerance = read_tolerance(position, angle, cell.tolerance)
    if isinstance(tolerance, Refused):
        return tolerance
    too_fine = precision_limit(assembly.make_planner_settings(cell, tolerance))
    return Refused(ErrorCode.GOAL_BAD_TOLERANCE, too_fine) if too_fine else tolerance


def _time_limit_refusal(seconds: float) -> Refused | None:
    """Return why the time limit of a request is refused; None if it is possible."""
    if math.isfinite(seconds) and seconds >= 0:
        return None
    return Refused(
        ErrorCode.COMMAND_INVALID,
        f"the time limit is {seconds:g} s; it must be above 0, or 0 for the cell's default",
    )


def _slides_like(cell: Cell) -> str:
    """Return a key that is equal for cells whose objects differ only in name and appearance."""
    return repr(
        [
            getattr(cell.object, entry.name)
            for entry in fields(cell.object)
            if entry.name not in APPEARANCE_KEYS
        ]
    )
