"""Parts of the cell's logic as the tests use them: the handling of goals, messages of the camera,
and replies of the tapper's board."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tapping_cell.configuration.cell import Cell, load_cell
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.hardware.tapper_protocol import Mode, Reply, Result, State
from tapping_cell.logic.clock import Now
from tapping_cell.logic.goal_handling import GoalHandling
from tapping_cell.logic.objects_on_table import ObjectsOnTable
from tapping_cell.messages import ObjectState, ObjectStates


def goal_handling(
    cell: Cell | None = None,
    planner: str = "exact",
    others: Sequence[ObjectFile] = (),
    now: Now = Now(0.0, 0),  # noqa: B008 - a frozen value
    **options: Any,
) -> GoalHandling:
    """Return the handling of goals of a cell. ``options`` replaces the options that it is given."""
    given = {"adapt": True, "probe": False, "keep_for": "", "time_limit": 600.0, **options}
    cell = cell or load_cell()
    objects = ObjectsOnTable((cell.object, *others), 5.0, 0.002)
    return GoalHandling(cell, planner, objects, now, **given)


def at(steady: float) -> Now:
    """Return a time by its steady clock, s, with the ROS clock of the same age."""
    return Now(steady, 10**18 + round(1e9 * steady))


def alone(state: ObjectState) -> ObjectStates:
    """Return the message of a camera that sees the cell's only object in this state."""
    return ObjectStates(header=state.header, objects=[state])


def board_reply(state: State, shot: int = 0) -> Reply:
    """Return the reply of a working board in ``state``; ``shot`` is the number of its last shot."""
    return Reply(1, 1, Result.OK, state, shot, 0.0, True, False, 0, None, 1, 0, Mode.RUN, False)
