"""Codec of Marlin 2: numbered lines with a checksum out, its answers in.

Source: Marlin's documentation and the answers of real firmware; the checksum is the XOR of all
bytes before the ``*``. Values stay in the controller's units: mm, degrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

LONGEST_LINE = 512
"""Bytes without an end of line after which the input is noise."""

QUICK_STOP = b"\nM410\n"
"""Stops at once where the firmware has the emergency parser; the newline ends a line half sent."""
KILL = b"\nM112\n"
"""Halts the firmware until its board is reset; unnumbered, for a numbered one waits in the
queue."""


@dataclass(frozen=True, slots=True)
class Ok:
    """The line was taken (``M400``, ``G28``: and done); it says nothing about success."""


@dataclass(frozen=True, slots=True)
class Busy:
    """Still working on the line; sent about every 2 s."""


@dataclass(frozen=True, slots=True)
class LineError:
    """A line was refused for its number or checksum."""

    why: str
    last_line: int | None
    """None where the firmware does not tell."""


@dataclass(frozen=True, slots=True)
class Resend:
    """The line number that is wanted next."""

    number: int


@dataclass(frozen=True, slots=True)
class Start:
    """The board has started."""


@dataclass(frozen=True, slots=True)
class Halted:
    """The firmware killed itself; only a reset brings it back."""

    why: str


@dataclass(frozen=True, slots=True)
class Unknown:
    """A code that this firmware does not have."""

    code: str


@dataclass(frozen=True, slots=True)
class Position:
    """``M114``: what was commanded, and the step counts where they are."""

    commanded: Mapping[str, float]
    counts: Mapping[str, int]
    with_ok: bool = False
    """True where the firmware writes its ``ok`` on the same line."""


@dataclass(frozen=True, slots=True)
class AxisFigures:
    """``M92``: steps per unit; ``M203``: units/s; ``M201``: units/s^2; by axis letter."""

    code: str
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class SoftEndstops:
    """``M211``: whether targets are clipped, and to what."""

    on: bool
    low: Mapping[str, float]
    high: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class FirmwareName:
    """First line of ``M115``."""

    name: str


@dataclass(frozen=True, slots=True)
class Capability:
    """A ``Cap:`` line of ``M115``."""

    name: str
    present: bool


@dataclass(frozen=True, slots=True)
class Note:
    """A remark that needs no answer."""

    text: str


@dataclass(frozen=True, slots=True)
class Bad:
    """A line that is none of the above."""

    line: bytes
    why: str


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


@dataclass(frozen=True, slots=True)
class Decoded:
    """``frame`` None: more bytes are needed; ``rest``: the bytes still to decode."""

    frame: Frame | None
    rest: bytes


_OK = re.compile(r"^ok(?: N\d{1,10})?(?: P\d{1,3})?(?: B\d{1,3})?$")
# Marlin 2 has four wordings with the last line; its relatives have others.
_LINE_ERROR = re.compile(r"^Error: ?(.*(?:checksum|line number|expected line).*)$", re.IGNORECASE)
_LAST_LINE = re.compile(r"Last Line: ?(\d{1,10})$")
_RESEND = re.compile(r"^(?:Resend|rs): ?N?(\d{1,10})$")
_POSITION = re.compile(r"^(?:[A-Z]:-?\d{1,7}\.\d{1,4} ?)+(?:Count:? ?(.*))?$")
_AXIS = re.compile(r"([A-Z]):(-?\d{1,7}\.\d{1,4})(?= |$)")
_COUNT = re.compile(r"([A-Z]): ?(-?\d{1,10})(?= |$)")
_FIGURES = re.compile(r"^(?:echo:)? *M(92|201|203)((?: [A-Z]\d{1,7}(?:\.\d{1,4})?)+)$")
_PLACE = r"((?: *[A-Z]:?-?\d{1,7}(?:\.\d{1,4})?)+)"
_SOFT_ENDSTOPS = re.compile(
    rf"^(?:echo:)?Soft endstops: (ON|OFF|On|Off) +Min: *{_PLACE} +Max: *{_PLACE}$"
)
_FIRMWARE = re.compile(r"^FIRMWARE_NAME:(.{1,60}?)(?: SOURCE_CODE_URL:.*| PROTOCOL_VERSION:.*)?$")
_CAPABILITY = re.compile(r"^Cap:([A-Z0-9_]{1,40}):([01])$")


def decode(buffer: bytes) -> Decoded:
    """Take the first line off ``buffer``; empty lines are skipped. Never raises."""
    while True:
        end = buffer.find(b"\n")
        if end < 0:
            if len(buffer) > LONGEST_LINE:
                return Decoded(Bad(buffer[:32], f"{len(buffer)} bytes without an end of line"), b"")
            return Decoded(None, buffer)
        line, buffer = buffer[:end].strip(b"\r "), buffer[end + 1 :]
        if line:
            return Decoded(decode_line(line), buffer)


def decode_line(line: bytes) -> Frame:
    """One line without its end. Never raises."""
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
        return SoftEndstops(found[1].upper() == "ON", _by_axis(found[2]), _by_axis(found[3]))
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
    """``N<number> <code>*<checksum>`` and a newline."""
    body = f"N{number} {code}".encode("ascii")
    check = 0
    for byte in body:
        check ^= byte
    return b"%s*%d\n" % (body, check)


def move_code(letters: str, target: Sequence[float], feed: float) -> str:
    """A straight move of the axes ``letters`` to ``target`` at ``feed`` units/min.

    Raises ValueError for values that are not finite or a feed that is not above 0.
    """
    if not (math.isfinite(feed) and feed > 0):
        raise ValueError(f"feed {feed} must be finite and above 0")
    return f"G1{axis_words(letters, target)} F{feed:.3f}"


def axis_words(letters: str, values: Sequence[float]) -> str:
    """Axis words with a space before each; ValueError for values that are not finite."""
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"axis values {tuple(values)} must be finite")
    return "".join(f" {a}{v:.3f}" for a, v in zip(letters, values, strict=True))
