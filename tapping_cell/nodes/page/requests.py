"""Requests of a browser: one JSON object per message, parsed strictly into a dataclass."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

from tapping_cell.se2 import Pose

LARGEST_MESSAGE = 4096
"""Maximum number of bytes in a message. An arrangement needs about 90 bytes for each object."""
LARGEST_NUMBER = 1e6
"""Maximum absolute value of lengths in mm and angles in degrees."""


class BadRequest(ValueError):
    """The message is not a valid request, for the stated reason."""


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of a page, which requests access."""

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
class SendGoal:
    """Move the object to this pose, within a tolerance in m and rad, where 0 selects the cell's
    default."""

    pose: Pose
    tolerance: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Arrange:
    """Move several objects to their poses, within a tolerance in m and rad, where 0 selects the
    cell's default; ``in_order``: finish them in this order."""

    goals: tuple[tuple[str, Pose], ...]
    tolerance: tuple[float, float] = (0.0, 0.0)
    in_order: bool = False


@dataclass(frozen=True, slots=True)
class Preset:
    """Query the goals of a preset layout for these objects."""

    preset: str
    objects: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class QueueGoal:
    """Append a goal to the queue."""

    pose: Pose
    tolerance: tuple[float, float] = (0.0, 0.0)


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
    """Make or skip the tap with this id, which waits for confirmation."""

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
class Command:
    """One of COMMANDS, without arguments."""

    name: str


Frequent = Hello | Seen | Move | Turn | Place
"""Messages that a page sends automatically or during a drag. They do not count as commands, whose
rate is limited. During a drag, only the newest message is processed."""
Request = (
    Frequent
    | SendGoal
    | Arrange
    | Preset
    | QueueGoal
    | Unqueue
    | NameGoal
    | ForgetGoal
    | Confirm
    | SetAsk
    | SetPlanner
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
    "run_queue",
    "hold_queue",
)
KINDS = (
    "hello",
    "seen",
    "move",
    "turn",
    "place",
    "goal",
    "arrange",
    "preset",
    "queue_goal",
    "unqueue",
    "name_goal",
    "forget_goal",
    "confirm",
    "set_ask",
    "set_planner",
    *COMMANDS,
)
LONGEST_NAME = 40
MAX_OBJECTS = 20
"""Maximum number of objects in a request."""


def parse(text: str | bytes) -> Request:
    """Parse a message, whose values are in mm and degrees, as people type them.

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
    if kind == "hello":
        return Hello(content.get("token"))
    if kind == "seen":
        return Seen(_whole(content, "number"))
    if kind == "move":
        angle = math.radians(_number(content, "angle"))
        u, v = _number(content, "u"), _number(content, "v")
        return Move(_whole(content, "number"), u, v, angle, _object(content))
    if kind == "turn":
        x, y = 1e-3 * _number(content, "x"), 1e-3 * _number(content, "y")
        u, v = _number(content, "u"), _number(content, "v")
        return Turn(_whole(content, "number"), x, y, u, v, _object(content))
    if kind == "place":
        return Place(_whole(content, "number"), _pose(content), _object(content))
    if kind == "goal":
        return SendGoal(_pose(content), _tolerance(content))
    if kind == "arrange":
        in_order = _truth({"in_order": False, **content}, "in_order")
        return Arrange(_goals(content), _tolerance(content), in_order)
    if kind == "preset":
        names = tuple(_name({"object": each}, "object") for each in _list(content, "objects"))
        return Preset(_name(content, "preset"), names)
    if kind == "queue_goal":
        return QueueGoal(_pose(content), _tolerance(content))
    if kind == "unqueue":
        return Unqueue(_whole(content, "number"))
    if kind == "name_goal":
        return NameGoal(_name(content, "name"), _pose(content))
    if kind == "forget_goal":
        return ForgetGoal(_name(content, "name"))
    if kind == "confirm":
        return Confirm(_whole(content, "tap_id"), _truth(content, "confirm"))
    if kind == "set_ask":
        return SetAsk(_truth(content, "ask"))
    if kind == "set_planner":
        return SetPlanner(_name(content, "planner"))
    if kind in COMMANDS:
        return Command(str(kind))
    raise BadRequest(f"'do' is {_shown(kind)}, but must be one of {', '.join(KINDS)}")


def _pose(content: dict[str, object]) -> Pose:
    return Pose(
        1e-3 * _number(content, "x"),
        1e-3 * _number(content, "y"),
        math.radians(_number(content, "angle")),
    )


def _goals(content: dict[str, object]) -> tuple[tuple[str, Pose], ...]:
    """Parse the goals of an arrangement, each for a different object."""
    rows = [each for each in _list(content, "goals") if isinstance(each, dict)]
    goals = tuple((_name(row, "object"), _pose(row)) for row in rows)
    if not goals or len(dict(goals)) < len(_list(content, "goals")):
        raise BadRequest("'goals' must be a list of one goal or more, each for a different object")
    return goals


def _object(content: dict[str, object]) -> str:
    """Parse the name of an object. A missing value selects the cell's own object."""
    return _name(content, "object") if "object" in content else ""


def _list(content: dict[str, object], name: str) -> list[object]:
    value = content.get(name)
    if not isinstance(value, list) or len(value) > MAX_OBJECTS:
        raise BadRequest(f"{name} is not a list of at most {MAX_OBJECTS} entries")
    return value


def _tolerance(content: dict[str, object]) -> tuple[float, float]:
    """Parse a tolerance in mm and degrees. A missing value selects the cell's default."""
    given = {"position_tolerance": 0.0, "angle_tolerance": 0.0, **content}
    position, angle = (_number(given, name) for name in ("position_tolerance", "angle_tolerance"))
    return 1e-3 * position, math.radians(angle)


def _name(content: dict[str, object], name: str) -> str:
    value = content.get(name)
    shown = value.strip() if isinstance(value, str) else ""
    if not shown or len(shown) > LONGEST_NAME or not shown.isprintable():
        raise BadRequest(
            f"{name} is {_shown(value)}; 1 to {LONGEST_NAME} printable characters are expected"
        )
    return shown


def _truth(content: dict[str, object], name: str) -> bool:
    value = content.get(name)
    if not isinstance(value, bool):
        raise BadRequest(f"{name} is {_shown(value)}; true or false is expected")
    return value


def _number(content: dict[str, object], name: str) -> float:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadRequest(f"{name} is {_shown(value)}; type a number such as 12.5")
    if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:  # also rejects NaN
        raise BadRequest(
            f"{name} is {_shown(value)}; a number between -{LARGEST_NUMBER:g} and "
            f"{LARGEST_NUMBER:g} is expected"
        )
    return float(value)


def _whole(content: dict[str, object], name: str) -> int:
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
