"""Codec of Marlin 2: encodes numbered lines with a checksum and decodes the answers.

Source: Marlin's documentation and the answers of real firmware. The checksum is the XOR of all
bytes before the ``*``. Values remain in the controller's units: mm, degrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tapping_cell.hardware.text_line import Bad, Decoded, decode_first_line

QUICK_STOP = b"\nM410\n"
"""Immediate stop for firmware with the emergency parser; the first newline ends a partial line."""
KILL = b"\nM112\n"
"""Halts the firmware until its board is reset; not numbered, because numbered lines are queued."""


@dataclass(frozen=True, slots=True)
class Ok:
    """The line was accepted. As the answer to ``M400`` or ``G28``, it also means that the motion
    has ended. It never confirms that the motion was successful."""


@dataclass(frozen=True, slots=True)
class Busy:
    """Sent about every 2 s while a line is being processed."""


@dataclass(frozen=True, slots=True)
class LineError:
    """A line was rejected because of its number or checksum."""

    why: str
    last_line: int | None
    """Number of the last accepted line; None if the firmware does not report it."""


@dataclass(frozen=True, slots=True)
class Resend:
    """The firmware requests the line with this number next."""

    number: int


@dataclass(frozen=True, slots=True)
class Start:
    """The board has started."""


@dataclass(frozen=True, slots=True)
class Halted:
    """The firmware halted itself and works again only after a reset."""

    why: str


@dataclass(frozen=True, slots=True)
class Unknown:
    """The firmware does not support a code."""

    code: str


@dataclass(frozen=True, slots=True)
class Position:
    """Answer to ``M114``: commanded position, and the actual step counts if reported."""

    commanded: Mapping[str, float]
    counts: Mapping[str, int]
    with_ok: bool = False
    """True if the firmware sent its ``ok`` on the same line."""


@dataclass(frozen=True, slots=True)
class AxisFigures:
    """Values by axis letter: ``M92`` steps per unit, ``M203`` units/s, ``M201`` units/s^2."""

    code: str
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class SoftEndstops:
    """Answer to ``M211``: whether targets are clipped, and the limits. Since version 2.0.9, these
    are two lines: a part that a line does not contain is None or empty."""

    on: bool | None
    low: Mapping[str, float]
    high: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class FirmwareName:
    """First line of the answer to ``M115``."""

    name: str


@dataclass(frozen=True, slots=True)
class Capability:
    """A ``Cap:`` line of the answer to ``M115``."""

    name: str
    present: bool


@dataclass(frozen=True, slots=True)
class Note:
    """An informational line that needs no answer."""

    text: str


Frame = (
    Ok
    | Busy
    | LineError
    | Resend
    | Start
    | Halted
    | Unknown
    | Position
    | AxisFigures
    | SoftEndstops
    | FirmwareName
    | Capability
    | Note
    | Bad
)

_OK = re.compile(r"^ok(?: N\d{1,10})?(?: P\d{1,3})?(?: B\d{1,3})?$")
# Errors of the line number or of the checksum. Marlin 2 ends these messages with the number of the
# last line. The messages of related firmwares differ.
_LINE_ERROR = re.compile(r"^Error: ?(.*(?:checksum|line number|expected line).*)$", re.IGNORECASE)
_LAST_LINE = re.compile(r"Last Line: ?(\d{1,10})$")
_RESEND = re.compile(r"^(?:Resend|rs): ?N?(\d{1,10})$")
_POSITION = re.compile(r"^(?:[A-Z]:-?\d{1,7}\.\d{1,4} ?)+(?:Count:? ?(.*))?$")
_AXIS = re.compile(r"([A-Z]):(-?\d{1,7}\.\d{1,4})(?= |$)")
_COUNT = re.compile(r"([A-Z]): ?(-?\d{1,10})(?= |$)")
_FIGURES = re.compile(r"^(?:echo:)? *M(92|201|203)((?: [A-Z]\d{1,7}(?:\.\d{1,4})?)+)$")
_PLACE = r"((?: *[A-Z]:?-?\d{1,7}(?:\.\d{1,4})?)+)"
_SOFT_ENDSTOPS = re.compile(
    rf"^(?:echo:)?(?:Soft endstops: (ON|OFF|On|Off))? +Min: *{_PLACE} +Max: *{_PLACE}$"
)
_SOFT_ENDSTOPS_ON = re.compile(r"^(?:echo:)? *M211 S([01])(?: ; ?(?:ON|OFF|On|Off))?$")
_FIRMWARE = re.compile(r"^FIRMWARE_NAME:(.{1,60}?)(?: SOURCE_CODE_URL:.*| PROTOCOL_VERSION:.*)?$")
_CAPABILITY = re.compile(r"^Cap:([A-Z0-9_]{1,40}):([01])$")


FEED_GROUPS = ("XYZ", "UVW", "ABC")
"""Axes to whose displacement the feed of a move refers: those of the first group in which an axis
moves, as in LinuxCNC. Firmware that is built with ``ARTICULATED_ROBOT_ARM`` takes all axes."""


SMALL = 2.0
"""Displacement from which its rounding to steps hardly changes the speed, units."""
SMALL_MIN = 0.25 / 60
"""Maximum duration of the line for a smaller displacement, min."""
DECIMALS = 3
"""Number of decimals of a position in a line."""


def decode(buffer: bytes) -> Decoded[Frame]:
    """Decode the first line of ``buffer``; empty lines are skipped. Never raises."""
    return decode_first_line(buffer, decode_line)


def decode_line(line: bytes) -> Frame:
    """Decode one line without its line ending. Never raises."""
    if not line.isascii():
        return Bad(line, "bytes outside ASCII")
    text = line.decode("ascii")
    if _OK.match(text):
        return Ok()
    if text.startswith(("echo:busy:", "busy:")):
        return Busy()
    if text == "start":
        return Start()
    if found := _LINE_ERROR.match(text):
        last = _LAST_LINE.search(found[1])
        return LineError(found[1].split(", Last")[0], int(last[1]) if last else None)
    if found := _RESEND.match(text):
        return Resend(int(found[1]))
    if text.startswith("Error:"):
        return Halted(text[6:])
    if found := re.match(r'^echo:Unknown command: "(.{0,96})"$', text):
        return Unknown(found[1])
    place = text.removeprefix("ok ")
    if found := _POSITION.match(place):
        commanded = place.partition("Count")[0].strip()
        counts = {axis: int(count) for axis, count in _COUNT.findall(found[1] or "")}
        values = {axis: float(value) for axis, value in _AXIS.findall(commanded)}
        return Position(values, counts, place is not text)
    if found := _FIGURES.match(text):
        return AxisFigures(f"M{found[1]}", _by_axis(found[2]))
    if found := _SOFT_ENDSTOPS.match(text):
        on = None if found[1] is None else found[1].upper() == "ON"
        return SoftEndstops(on, _by_axis(found[2]), _by_axis(found[3]))
    if found := _SOFT_ENDSTOPS_ON.match(text):
        return SoftEndstops(found[1] == "1", {}, {})
    if found := _FIRMWARE.match(text):
        return FirmwareName(found[1])
    if found := _CAPABILITY.match(text):
        return Capability(found[1], found[2] == "1")
    if text.startswith(("echo:", "//", "Cap:", "Marlin")):
        return Note(text)
    return Bad(line, "not a line of this firmware")


def _by_axis(text: str) -> dict[str, float]:
    return {axis: float(value) for axis, value in re.findall(r"([A-Z]):?(-?\d+(?:\.\d+)?)", text)}


def numbered(number: int, code: str) -> bytes:
    """Encode ``N<number> <code>*<checksum>`` and a newline."""
    body = f"N{number} {code}".encode("ascii")
    check = 0
    for byte in body:
        check ^= byte
    return b"%s*%d\n" % (body, check)


def move_code(letters: str, target: Sequence[float], feed: float) -> str:
    """Format a straight move of the axes ``letters`` to ``target`` at ``feed`` units/min. The feed
    refers to a part of the axes only: see :data:`FEED_GROUPS`.

    Raises ValueError if a value is not finite or the feed is not above 0.
    """
    if not (math.isfinite(feed) and feed > 0):
        raise ValueError(f"feed {feed} must be finite and above 0")
    return f"G1{axis_text(letters, target)} F{feed:.3f}"


def feed_parts(
    letters: str, start: Sequence[float], target: Sequence[float], feed: float
) -> list[tuple[str, Sequence[float], float]]:
    """Divide a straight move into lines for :func:`move_code`, as axes, target and feed of each.

    ``feed``: speed along the line through all axes, units/min. Usually there is one line, without
    the axes that do not move. There are two if the displacement to which the feed would refer is
    less than ``SMALL``: the firmware rounds it to steps, which would change the speed of the other
    axes.
    """
    ways = {
        letter: round(end, DECIMALS) - round(begin, DECIMALS)
        for letter, begin, end in zip(letters, start, target, strict=True)
    }
    values = dict(zip(letters, target, strict=True))
    whole = math.hypot(*ways.values())
    groups = [[one for one in letters if one in group] for group in FEED_GROUPS]
    groups.append([one for one in letters if one not in "".join(FEED_GROUPS)])
    moving = [group for group in groups if any(ways[one] for one in group)]
    if not moving:
        return [(letters, target, feed)]
    first, others = moving[0], [one for group in moving[1:] for one in group]
    length = math.hypot(*(ways[one] for one in first))
    if length >= SMALL or not others:
        used = "".join([*first, *others])
        return [(used, [values[one] for one in used], feed * length / whole)]
    minutes = whole / feed
    begin = dict(zip(letters, start, strict=True))
    rest = math.hypot(*(ways[one] for one in others))
    return [
        *feed_parts(
            "".join(others),
            [begin[one] for one in others],
            [values[one] for one in others],
            rest / minutes,
        ),
        ("".join(first), [values[one] for one in first], length / min(minutes, SMALL_MIN)),
    ]


def axis_text(letters: str, values: Sequence[float]) -> str:
    """Format axis words, each preceded by a space; ValueError for values that are not finite."""
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"axis values {tuple(values)} must be finite")
    return "".join(f" {a}{v:.{DECIMALS}f}" for a, v in zip(letters, values, strict=True))
