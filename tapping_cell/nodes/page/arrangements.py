"""Arrangements of several objects on the operator's page: presets, sending and progress."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property

from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.subscription import Subscription
from tapping_cell_msgs.action import ArrangeObjects
from tapping_cell_msgs.msg import (
    ArrangementState,
    ObjectProgress,
    ObjectState,
    ObjectStates,
    UnknownObjects,
)

from tapping_cell.configuration import assembly
from tapping_cell.configuration.cell import Cell, cells_of
from tapping_cell.configuration.preset_layout import preset_layout
from tapping_cell.logic.goal_validation import REFUSALS
from tapping_cell.nodes.cell_node import LATCHED
from tapping_cell.nodes.conversions import from_message, object_goal
from tapping_cell.nodes.page.calls import answer_to, send_goal
from tapping_cell.nodes.page.cell_view import error_pair, triple, with_code
from tapping_cell.nodes.page.requests import Arrange, BadRequest, Preset
from tapping_cell.nodes.page.server import Answer
from tapping_cell.planning import FreeSpace, PlanningError, check_goal
from tapping_cell.planning.fixed_session import check_fixed_goal
from tapping_cell.planning.fixed_tappers import FixedStrikeSpace
from tapping_cell.report.words import PROGRESS, counted, word
from tapping_cell.se2 import Pose

Drawing = Callable[[str, Pose], "dict[str, object] | None"]


class Arrangements:
    """The objects of the cell, and arrangements that pages send. Called in the executor's thread.

    ``cells``: see ``cells_of``; ``checks``: goal checks by name of the object; ``note``: adds an
    entry to the page's list of events.
    """

    def __init__(self, node: Node, note: Callable[[str], None]) -> None:
        self._node = node
        self._note = note
        self.cells: dict[str, Cell] = {}
        self.checks: dict[str, GoalCheck] = {}
        self._action = ActionClient(node, ArrangeObjects, "arrange_objects")
        self._states: dict[str, ObjectState] = {}
        self._unknown = 0
        self._progress = ArrangementState()
        self._copied: dict[str, Pose] | None = None
        """Goals of the arrangement under way, which are among the drafts since it began."""
        self.drafts: dict[str, Pose] | None = None
        """Goals that the operator has placed, by object; None until a page has placed one."""

    def use_cell(self, cell: Cell) -> None:
        """Use the objects of this cell. Raises ConfigurationError for an invalid object file."""
        self.cells = cells_of(cell)
        self.checks = {name: GoalCheck(each) for name, each in self.cells.items()}
        self.checks[cell.object.name].prepare()

    @property
    def names(self) -> list[str]:
        """Names of the objects if the cell can arrange them, else an empty list."""
        several = len(self.cells) > 1
        able = several and next(iter(self.cells.values())).file.arm is not None
        return list(self.cells) if able else []

    @property
    def active(self) -> bool:
        """Whether an arrangement is under way."""
        return bool(self._progress.active)

    def subscribe(self) -> list[Subscription]:
        """Subscribe to the topics of several objects."""
        if not all(check.ready for check in self.checks.values()):
            threading.Thread(target=self._prepare, name="goal checks", daemon=True).start()
        subscribe = self._node.create_subscription
        return [
            subscribe(ObjectStates, "object_states", self._on_states, LATCHED),
            subscribe(UnknownObjects, "unknown_objects", self._on_unknown, LATCHED),
            subscribe(ArrangementState, "arrangement_state", self._on_progress, LATCHED),
        ]

    def forget(self) -> None:
        """Discard the received states when no page is open."""
        self._states, self._progress, self._unknown = {}, ArrangementState(), 0

    def state(self, drawing: Drawing) -> dict[str, object]:
        """Return the objects and the progress of the last arrangement for the page, in mm and
        degrees. ``drawing``: outline of an object at a pose in the image."""
        progress = self._progress
        return {
            "objects": [self._object_row(name, drawing) for name in self.names],
            "unknown": self._unknown,
            "active": self.active,
            "taps": progress.taps,
            "progress": {one.object_id: progress_row(one) for one in progress.objects},
            "sentence": with_code(progress.error_msg, progress.error_code),
        }

    def preset(self, request: Preset, answer: Answer) -> None:
        """Answer with the goals of a preset layout."""
        seen = {name: self._states.get(name) for name in request.objects}
        missing = [name for name, state in seen.items() if state is None or not state.visible]
        unknown = [name for name in request.objects if name not in self.cells]
        try:
            if unknown:
                raise BadRequest(f"the cell has no object '{unknown[0]}'")
            if missing:
                raise BadRequest(f"'{missing[0]}' is not seen; uncover it")
            goals = preset_layout(
                self.cells,
                request.preset,
                {n: from_message(s.pose.pose) for n, s in seen.items() if s is not None},
                next(iter(self.checks.values())).free,  # of any object, for the middle of the table
            )
        except (BadRequest, PlanningError) as error:
            answer(answer_to("arrange", False, str(error)))
            return
        rows = [[name, *triple(pose)] for name, pose in goals.items()]
        answer({"type": "preset", "goals": rows})

    def send(self, request: Arrange, who: str, answer: Answer) -> None:
        """Send an arrangement to the planner. Send the arrangement's result to the page when the
        arrangement has ended."""
        goal = ArrangeObjects.Goal(
            goals=[object_goal(name, pose, request.tolerance) for name, pose in request.goals],
            in_order=request.in_order,
        )
        if send_goal(self._action, goal, "arrange", "arrangement", answer):
            objects = counted(len(goal.goals), "object")
            self._note(f"arrangement of {objects} sent from the page ({who})")

    def _prepare(self) -> None:
        """Prepare the goal checks that are not ready. Until the check of an object is ready, the
        page sends any goal of this object to the planner; the planner checks every goal."""
        for check in list(self.checks.values()):
            if not check.ready:
                check.prepare()

    def _on_states(self, message: ObjectStates) -> None:
        self._states = {state.object_id: state for state in message.objects}

    def _on_unknown(self, message: UnknownObjects) -> None:
        self._unknown = len(message.outlines)

    def _on_progress(self, message: ArrangementState) -> None:
        goals = {o.object_id: from_message(o.goal_pose) for o in message.objects if o.has_goal}
        if message.active and not self.active and goals != self._copied:
            # Pages show the goals of an arrangement, whoever sent it. A page that is opened again
            # during the arrangement keeps the goals placed since it began.
            self.drafts = {**(self.drafts or {}), **goals}
        self._copied = goals if message.active else None
        self._progress = message

    def _object_row(self, name: str, drawing: Drawing) -> dict[str, object]:
        state = self._states.get(name)
        if state is None or not state.visible:
            return {"name": name, "pose": None}
        pose = from_message(state.pose.pose)
        row = {"name": name, "pose": triple(pose), "at_rest": state.at_rest}
        return {**row, **(drawing(name, pose) or {})}


def progress_row(one: ObjectProgress) -> dict[str, object]:
    """Return the progress of one object, in mm and degrees."""
    distance, rotation = error_pair(one.residual_distance, one.residual_rotation)
    return {
        "state": word(PROGRESS, one.state),
        "distance": distance,
        "rotation": rotation,
        "taps": one.taps,
    }


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
