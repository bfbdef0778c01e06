"""What a browser may say: one JSON object a message, read strictly into a dataclass."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

from tapping_cell.se2 import Pose

LARGEST_MESSAGE = 4096
"""Bytes of a message; the longest that the page sends has about 200."""
LARGEST_NUMBER = 1e6
"""Of millimetres and degrees: what is beyond is no typing error of a person."""


class BadRequest(ValueError):
    """A message that cannot be served; the sentence says why."""


@dataclass(frozen=True, slots=True)
class Hello:
    """The first message: may I come in?"""

    token: object


@dataclass(frozen=True, slots=True)
class Seen:
    """The page has drawn this picture and may get the next."""

    number: int


@dataclass(frozen=True, slots=True)
class Move:
    """Where does the ghost lie when its centre is seen at (u, v) of the picture?

    ``u`` and ``v`` in widths and heights of the picture from its top left corner; angle in rad.
    """

    number: int
    u: float
    v: float
    angle: float


@dataclass(frozen=True, slots=True)
class Turn:
    """How does the ghost lie when its handle is seen at (u, v) of the picture? x and y in m."""

    number: int
    x: float
    y: float
    u: float
    v: float


@dataclass(frozen=True, slots=True)
class Place:
    """Where is the ghost seen when it lies at this pose of the table?"""

    number: int
    pose: Pose


@dataclass(frozen=True, slots=True)
class SendGoal:
    """Bring the object to this pose."""

    pose: Pose


@dataclass(frozen=True, slots=True)
class Command:
    """One of COMMANDS, which needs no more words."""

    name: str


Request = Hello | Seen | Move | Turn | Place | SendGoal | Command

COMMANDS = ("stop", "clear", "cancel", "home", "press_button", "enable", "disable")
KINDS = ("hello", "seen", "move", "turn", "place", "goal", *COMMANDS)


def parse(text: str | bytes) -> Request:
    """A request out of a message. On the wire mm and degrees, as people type them.

    Raises:
        BadRequest: with a sentence, for whatever is not one.
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
        return Move(_whole(content, "number"), _number(content, "u"), _number(content, "v"), angle)
    if kind == "turn":
        x, y = 1e-3 * _number(content, "x"), 1e-3 * _number(content, "y")
        return Turn(_whole(content, "number"), x, y, _number(content, "u"), _number(content, "v"))
    if kind == "place":
        return Place(_whole(content, "number"), _pose(content))
    if kind == "goal":
        return SendGoal(_pose(content))
    if kind in COMMANDS:
        return Command(str(kind))
    raise BadRequest(f"'do' is {_shown(kind)}; known are {', '.join(KINDS)}")


def _pose(content: dict[str, object]) -> Pose:
    return Pose(
        1e-3 * _number(content, "x"),
        1e-3 * _number(content, "y"),
        math.radians(_number(content, "angle")),
    )


def _number(content: dict[str, object], name: str) -> float:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadRequest(f"{name} is {_shown(value)}, not a number; type one such as 12.5")
    if not -LARGEST_NUMBER <= value <= LARGEST_NUMBER:  # also what is not a number at all
        raise BadRequest(
            f"{name} is {_shown(value)}; a number between -{LARGEST_NUMBER:g} and "
            f"{LARGEST_NUMBER:g} is expected"
        )
    return float(value)


def _whole(content: dict[str, object], name: str) -> int:
    value = content.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise BadRequest(f"{name} is {_shown(value)}, not a whole number from 0")
    return value


def _shown(value: object) -> str:
    """A value as JSON writes it, short enough for a sentence."""
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    shown = json.dumps(value)
    return shown if len(shown) <= 40 else shown[:37] + "..."
