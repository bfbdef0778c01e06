"""Requests of a browser: one JSON object per message, parsed strictly into a dataclass."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tapping_cell.logic import jogging
from tapping_cell.nodes.recorder.run_names import LONGEST_NAME as LONGEST_RUN
from tapping_cell.se2 import Pose

LARGEST_MESSAGE = 4096
"""Maximum number of bytes in a message. An arrangement needs about 90 bytes for each object."""
LARGEST_NUMBER = 1e6
"""Maximum absolute value of lengths in mm and angles in degrees."""


class BadRequest(ValueError):
    """The message is not a valid request, for the stated reason."""


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of a page; it requests access."""

    token: object


@dataclass(frozen=True, slots=True)
class Seen:
    """The page has drawn this image and is ready for the next."""

    number: int


@dataclass(frozen=True, slots=True)
class Move:
    """Query the pose of the ghost whose centre appears at (u, v) in the image.

    ``u`` and ``v`` are fractions of the image's width and height from its top left corner; the
    angle is in rad. ``object`` is the name of the ghost's object; if empty, it is the cell's own
    object.
    """

    number: int
    u: float
    v: float
    angle: float
    object: str = ""


@dataclass(frozen=True, slots=True)
class Turn:
    """Query the pose of the ghost at x, y (m) whose handle appears at (u, v) in the image."""

    number: int
    x: float
    y: float
    u: float
    v: float
    object: str = ""


@dataclass(frozen=True, slots=True)
class Place:
    """Query how the ghost (the outline of the object at its goal) at this pose on the table is
    drawn in the image."""

    number: int
    pose: Pose
    object: str = ""


@dataclass(frozen=True, slots=True)
class RequestedGoal:
    """Goal in ``table``, with its tolerance in m and rad. A tolerance of 0 selects the cell's
    default. ``object``: name of the object; if empty, it is the cell's own object."""

    pose: Pose
    tolerance: tuple[float, float] = (0.0, 0.0)
    object: str = ""


class SendGoal(RequestedGoal):
    """Move the object to this goal."""


class QueueGoal(RequestedGoal):
    """Append this goal to the queue."""


@dataclass(frozen=True, slots=True)
class Arrange:
    """Move several objects to their poses, within a tolerance in m and rad. A tolerance of 0
    selects the cell's default. ``in_order``: whether to finish the objects in this order."""

    goals: tuple[tuple[str, Pose], ...]
    tolerance: tuple[float, float] = (0.0, 0.0)
    in_order: bool = False


@dataclass(frozen=True, slots=True)
class Drafts:
    """Goals that the operator has placed but not sent, by object. Every page shows them."""

    goals: tuple[tuple[str, Pose], ...]


@dataclass(frozen=True, slots=True)
class Preset:
    """Query the goals of a preset layout for these objects."""

    preset: str
    objects: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Unqueue:
    """Remove the goal with this number from the queue."""

    number: int


@dataclass(frozen=True, slots=True)
class NameGoal:
    """Store a pose under a name."""

    name: str
    pose: Pose


@dataclass(frozen=True, slots=True)
class ForgetGoal:
    """Remove a name."""

    name: str


@dataclass(frozen=True, slots=True)
class Confirm:
    """Make or skip the tap that has this id and waits for confirmation."""

    tap_id: int
    confirm: bool


@dataclass(frozen=True, slots=True)
class SetAsk:
    """Set whether every tap from now on requires confirmation."""

    ask: bool


@dataclass(frozen=True, slots=True)
class SetPlanner:
    """Use this planning method from the next goal on."""

    planner: str


@dataclass(frozen=True, slots=True)
class KeepRun:
    """Set whether a run is never deleted."""

    run: str
    keep: bool


@dataclass(frozen=True, slots=True)
class Jog:
    """Move the arm by a step (m or rad) along an axis of ``jogging.AXES``."""

    axis: str
    step: float


@dataclass(frozen=True, slots=True)
class Command:
    """One of COMMANDS, without arguments."""

    name: str


Frequent = Hello | Seen | Move | Turn | Place
"""Messages that a page sends automatically or during a drag. The limit on the rate of commands does
not apply to these messages. During a drag, only the newest message is processed."""
Request = (
    Frequent
    | SendGoal
    | Arrange
    | Drafts
    | Preset
    | QueueGoal
    | Unqueue
    | NameGoal
    | ForgetGoal
    | Confirm
    | SetAsk
    | SetPlanner
    | KeepRun
    | Jog
    | Command
)

COMMANDS = (
    "stop",
    "clear",
    "cancel",
    "home",
    "press_button",
    "enable",
    "disable",
    "park",
    "fire_at_nothing",
    "run_queue",
    "hold_queue",
)
LONGEST_NAME = 40
MAX_OBJECTS = 20
"""Maximum number of objects in a request."""

Content = dict[str, Any]
"""A parsed message. Its values are checked by the functions below."""


def parse(text: str | bytes) -> Request:
    """Parse a message. The values in the message are in mm and degrees, as people type them.

    Raises:
        BadRequest: the message is invalid, for the stated reason.
    """
    if isinstance(text, bytes):
        raise BadRequest("the message is binary; a JSON object in text is expected")
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadRequest(f"the message is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise BadRequest("the message is not a JSON object")
    kind = content.get("do")
    if kind in COMMANDS:
        return Command(str(kind))
    if isinstance(kind, str) and kind in PARSERS:
        return PARSERS[kind](content)
    raise BadRequest(f"'do' is {_shown(kind)}, but must be one of {', '.join(KINDS)}")


def _pose(content: Content) -> Pose:
    return Pose(
        1e-3 * _number(content, "x"),
        1e-3 * _number(content, "y"),
        math.radians(_number(content, "angle")),
    )


def _goals(content: Content, least: int = 1) -> tuple[tuple[str, Pose], ...]:
    """Parse the goals of an arrangement, each for a different object."""
    rows = [each for each in _list(content, "goals") if isinstance(each, dict)]
    goals = tuple((_name(row, "object"), _pose(row)) for row in rows)
    if len(goals) < least or len(dict(goals)) < len(_list(content, "goals")):
        raise BadRequest("'goals' must be a list of one goal or more, each for a different object")
    return goals


def _object(content: Content) -> str:
    """Parse the name of an object. A missing value selects the cell's own object."""
    return _name(content, "object") if "object" in content else ""


def _objects(content: Content) -> tuple[str, ...]:
    return tuple(_name({"object": each}, "object") for each in _list(content, "objects"))


def _list(content: Content, name: str) -> list[object]:
    value = content.get(name)
    if not isinstance(value, list) or len(value) > MAX_OBJECTS:
        raise BadRequest(f"{name} is not a list of at most {MAX_OBJECTS} entries")
    return value


def _jog(content: Content) -> Jog:
    axis, step = content.get("axis"), _number(content, "step")
    if not isinstance(axis, str) or axis not in jogging.AXES:
        raise BadRequest(f"axis is {_shown(axis)}, but must be one of {', '.join(jogging.AXES)}")
    return Jog(axis, 1e-3 * step if jogging.is_length(axis) else math.radians(step))


def _tolerance(content: Content) -> tuple[float, float]:
    """Parse a tolerance in mm and degrees. A missing value selects the cell's default."""
    given = {"position_tolerance": 0.0, "angle_tolerance": 0.0, **content}
    position, angle = (_number(given, name) for name in ("position_tolerance", "angle_tolerance"))
    return 1e-3 * position, math.radians(angle)


def _name(content: Content, name: str, longest: int = LONGEST_NAME) -> str:
    value = content.get(name)
    shown = value.strip() if isinstance(value, str) else ""
    if not shown or len(shown) > longest or not shown.isprintable():
        raise BadRequest(
            f"{name} is {_shown(value)}; 1 to {longest} printable characters are expected"
        )
    return shown


def _truth(content: Content, name: str) -> bool:
    value = content.get(name)
    if not isinstance(value, bool):
        raise BadRequest(f"{name} is {_shown(value)}; true or false is expected")
    return value


def _number(content: Content, name: str) -> float:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadRequest(f"{name} is {_shown(value)}; type a number such as 12.5")
    if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:  # also rejects NaN
        raise BadRequest(
            f"{name} is {_shown(value)}; a number between -{LARGEST_NUMBER:g} and "
            f"{LARGEST_NUMBER:g} is expected"
        )
    return float(value)


def _whole(content: Content, name: str) -> int:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise BadRequest(f"{name} is {_shown(value)}, not a whole number of at least 0")
    return value


def _shown(value: object) -> str:
    """Return a value as JSON, shortened for an error message."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    shown = json.dumps(value)
    return shown if len(shown) <= 40 else shown[:37] + "..."


# The arguments are in the order in which they are checked.
PARSERS: dict[str, Callable[[Content], Request]] = {
    "hello": lambda c: Hello(c.get("token")),
    "seen": lambda c: Seen(_whole(c, "number")),
    "move": lambda c: Move(
        angle=math.radians(_number(c, "angle")),
        u=_number(c, "u"),
        v=_number(c, "v"),
        number=_whole(c, "number"),
        object=_object(c),
    ),
    "turn": lambda c: Turn(
        x=1e-3 * _number(c, "x"),
        y=1e-3 * _number(c, "y"),
        u=_number(c, "u"),
        v=_number(c, "v"),
        number=_whole(c, "number"),
        object=_object(c),
    ),
    "place": lambda c: Place(_whole(c, "number"), _pose(c), _object(c)),
    "goal": lambda c: SendGoal(_pose(c), _tolerance(c), _object(c)),
    "drafts": lambda c: Drafts(_goals(c, 0)),
    "arrange": lambda c: Arrange(
        in_order=_truth({"in_order": False, **c}, "in_order"),
        goals=_goals(c),
        tolerance=_tolerance(c),
    ),
    "preset": lambda c: Preset(objects=_objects(c), preset=_name(c, "preset")),
    "queue_goal": lambda c: QueueGoal(_pose(c), _tolerance(c), _object(c)),
    "unqueue": lambda c: Unqueue(_whole(c, "number")),
    "name_goal": lambda c: NameGoal(_name(c, "name"), _pose(c)),
    "forget_goal": lambda c: ForgetGoal(_name(c, "name")),
    "confirm": lambda c: Confirm(_whole(c, "tap_id"), _truth(c, "confirm")),
    "set_ask": lambda c: SetAsk(_truth(c, "ask")),
    "set_planner": lambda c: SetPlanner(_name(c, "planner")),
    "keep_run": lambda c: KeepRun(_name(c, "run", LONGEST_RUN), _truth(c, "keep")),
    "jog": _jog,
}
KINDS = (*PARSERS, *COMMANDS)
