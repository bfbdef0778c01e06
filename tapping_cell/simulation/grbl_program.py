"""Line parser of the emulated Grbl controller."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

INCH = 25.4
"""Length of an inch, mm."""

_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")


class Refused(Exception):
    """A line was rejected; ``code``: Grbl's error number."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass(slots=True)
class Modal:
    """Modal state of the parser; the defaults are the state after a reset."""

    motion: int = 0
    plane: int = 17
    inches: bool = False
    incremental: bool = False
    inverse_time: bool = False
    system: int = 54
    feed: float = 0.0
    tool: int = 0

    def __str__(self) -> str:
        return (
            f"G{self.motion} G{self.system} G{self.plane} G{20 if self.inches else 21}"
            f" G{91 if self.incremental else 90} G{93 if self.inverse_time else 94}"
            f" M5 M9 T{self.tool} F{self.feed:g} S0"
        )


@dataclass(slots=True)
class Line:
    """Content of one line: the modal state after it, and at most one non-modal action."""

    modal: Modal
    action: float | None
    """Number of a non-modal G code: 4, 53, 92 or 92.1."""
    axes: dict[int, float]
    """Axis number to value, in mm or degrees."""
    pause: float
    feed: float | None


def _words(text: str) -> list[tuple[str, float]]:
    words: list[tuple[str, float]] = []
    place = 0
    while place < len(text):
        found = _WORD.match(text, place)
        if found is None:
            raise Refused(2 if text[place].isalpha() else 1)
        words.append((found[1], float(found[2])))
        place = found.end()
    return words


def read_line(text: str, letters: str, before: Modal) -> Line:
    """Parse an upper-case line without spaces or comments; raises Refused."""
    modal = replace(before)
    line = Line(modal, None, {}, 0.0, None)
    motions = 0
    for letter, value in _words(text):
        if letter == "G":
            _take_g(value, line)
            motions += value in (0, 1)
        elif letter == "M":
            if value not in (0, 2, 3, 4, 5, 7, 8, 9, 30):
                raise Refused(20)
        elif letter in letters:
            axis = letters.index(letter)
            if axis in line.axes:
                raise Refused(25)
            line.axes[axis] = value * (INCH if modal.inches else 1.0)
        elif letter == "F":
            if value < 0:
                raise Refused(4)
            line.feed = value * (INCH if modal.inches and not modal.inverse_time else 1.0)
        elif letter == "P":
            line.pause = value
        elif letter == "T":
            modal.tool = int(value)
        elif letter not in "NS":
            raise Refused(20)
    if motions and line.action == 92:
        # A motion and G92 in one line would both use the axis words.
        raise Refused(24)
    if line.feed is not None:
        modal.feed = line.feed
    return line


def _take_g(value: float, line: Line) -> None:
    modal = line.modal
    if value in (0, 1):
        modal.motion = int(value)
    elif value in (17, 18, 19):
        modal.plane = int(value)
    elif value in (20, 21):
        modal.inches = value == 20
    elif value in (90, 91):
        modal.incremental = value == 91
    elif value in (93, 94):
        modal.inverse_time = value == 93
    elif value in (54, 55, 56, 57, 58, 59):
        modal.system = int(value)
    elif value in (4, 53, 92, 92.1):
        line.action = value
    elif value not in (40, 49, 80, 91.1):
        raise Refused(20)
