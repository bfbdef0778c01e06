"""Codec of the Grbl 1.1 family: bytes from the controller to frames, axis values to lines.

Source: Grbl 1.1 documentation, "Interface" and "Commands" (status reports, responses, settings);
grblHAL, grbl-Mega-5X, FluidNC and uCNC keep the same forms. Values stay in the controller's units:
mm, degrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

STATUS_QUERY = b"?"
FEED_HOLD = b"!"
RESUME = b"~"
SOFT_RESET = b"\x18"
FULL_FEED = b"\x90"
"""Sets the feed override back to 100 %."""
STOP = FEED_HOLD + SOFT_RESET
"""Feed hold, then soft reset: real-time bytes that the controller takes ahead of its queue."""

LONGEST_LINE = 512
"""Bytes without an end of line after which the input is noise."""

STATES = ("Idle", "Run", "Hold", "Jog", "Alarm", "Door", "Check", "Home", "Sleep", "Tool")

ALARMS = {
    1: "a limit switch was hit; the position is lost",
    2: "the target is beyond the machine's travel (soft limit)",
    3: "reset while in motion; the position is lost",
    4: "the probe was not in its expected state",
    5: "the probe did not touch",
    6: "homing was reset",
    7: "the door opened while homing",
    8: "homing pulled off but the limit switch stayed closed",
    9: "homing found no limit switch",
    10: "homing on an axis with two motors found no second limit switch",
}
ERRORS = {
    1: "a line without a letter",
    2: "a number that cannot be read",
    3: "an unknown $ command",
    5: "homing is not enabled ($22)",
    8: "only possible while idle",
    9: "locked by an alarm or by a jog",
    14: "the line is too long",
    15: "the target is beyond the machine's travel",
    20: "an unsupported command",
    22: "no feed rate",
}


@dataclass(frozen=True, slots=True)
class Ok:
    """The line was taken; it says nothing about success."""


@dataclass(frozen=True, slots=True)
class Error:
    """The line was refused, with Grbl's number."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller latched an alarm, with Grbl's number."""

    code: int


@dataclass(frozen=True, slots=True)
class Banner:
    """The greeting after a power-up or a reset."""

    name: str
    version: str


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of ``$$``."""

    number: int
    value: float


@dataclass(frozen=True, slots=True)
class NamedSetting:
    """A setting with a name or a value that is no number, such as ``$/stepping/idle_ms=255``."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Message:
    """A bracketed line such as ``[VER:1.1h:]`` or ``[MSG:...]``."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Status:
    """A status report; positions in the axes' units (deg, deg, mm, deg)."""

    state: str
    substate: int | None
    machine: tuple[float, ...] | None
    """MPos."""
    work: tuple[float, ...] | None
    """WPos."""
    offset: tuple[float, ...] | None
    """WCO, which the controller sends only now and then."""
    feed_override: int | None = None
    """First figure of Ov in percent, sent only now and then."""


@dataclass(frozen=True, slots=True)
class Bad:
    """A line that is none of the above: noise, or a form that is not understood."""

    line: bytes
    why: str


Frame = Ok | Error | Alarm | Banner | Setting | NamedSetting | Message | Status | Bad


@dataclass(frozen=True, slots=True)
class Decoded:
    """``frame`` None: more bytes are needed; ``rest``: the bytes still to decode."""

    frame: Frame | None
    rest: bytes


_NUMBER = r"-?\d{1,7}(?:\.\d{1,6})?"
_BANNER = re.compile(r"^(Grbl|GrblHAL|grblHAL|FluidNC|uCNC|µCNC)\s+v?(\d+\.\d+\S*)")
_SETTING = re.compile(rf"^\$(\d{{1,3}})=({_NUMBER})$")
_NAMED_SETTING = re.compile(r"^\$(/?[A-Za-z0-9_/]{1,64})=(.{0,200})$")
_MESSAGE = re.compile(r"^\[([A-Z][A-Za-z0-9 ]{0,19}):(.*)\]$")
_OVERRIDES = re.compile(r"^(\d{1,3}),\d{1,3},\d{1,3}$")
_FEED = re.compile(r"(?:^| )F(\d{1,7})(?:\.0*)?(?= |$)")
_POSITION = re.compile(rf"^{_NUMBER}(?:,{_NUMBER}){{2,7}}$")


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
    try:
        text = line.decode("ascii" if line[:1] != b"\xc2" else "utf-8")
    except UnicodeDecodeError:
        return Bad(line, "bytes outside ASCII")
    if text == "ok":
        return Ok()
    if text.startswith("error:"):
        return Error(int(text[6:])) if _short_number(text[6:]) else Bad(line, "no error number")
    if text.startswith("ALARM:"):
        return Alarm(int(text[6:])) if _short_number(text[6:]) else Bad(line, "no alarm number")
    if text.startswith("<"):
        return _status(line, text)
    found = _SETTING.match(text)
    if found:
        return Setting(int(found[1]), float(found[2]))
    found = _NAMED_SETTING.match(text)
    if found:
        return NamedSetting(found[1], found[2])
    found = _MESSAGE.match(text)
    if found:
        return Message(found[1], found[2])
    found = _BANNER.match(text)
    if found:
        return Banner(found[1], found[2])
    return Bad(line, "not a line of this controller")


def _short_number(text: str) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= 3


def _status(line: bytes, text: str) -> Frame:
    if not text.endswith(">") or "<" in text[1:]:
        return Bad(line, "a status report without its brackets")
    state, *fields = text[1:-1].split("|")
    name, _, sub = state.partition(":")
    if name not in STATES or (sub and not _short_number(sub)):
        return Bad(line, f"unknown state {state!r}")
    positions: dict[str, tuple[float, ...]] = {}
    override: int | None = None
    for field in fields:
        key, _, value = field.partition(":")
        if key == "Ov" and (percents := _OVERRIDES.match(value)):
            override = int(percents[1])
        if key in ("MPos", "WPos", "WCO"):
            if not _POSITION.match(value) or key in positions:
                return Bad(line, f"unreadable {key}")
            positions[key] = tuple(float(number) for number in value.split(","))
    if "MPos" not in positions and "WPos" not in positions:
        return Bad(line, "a status report without a position")
    if len({len(position) for position in positions.values()}) > 1:
        return Bad(line, "positions of different numbers of axes")
    return Status(
        name,
        int(sub) if sub else None,
        positions.get("MPos"),
        positions.get("WPos"),
        positions.get("WCO"),
        override,
    )


def move_line(letters: str, target: Sequence[float], feed: float) -> bytes:
    """A straight absolute move of the axes ``letters`` to ``target`` at ``feed`` units/min.

    The modal words stand in every line, so that one garbled line cannot change the next.
    Raises ValueError for values that are not finite or a feed that is not above 0.
    """
    return f"G21G90G94G1{_axes(letters, target)}F{_number(feed, positive=True)}\n".encode()


def marker_lines(number: int) -> bytes:
    """Set the feed to ``number`` and ask for the modes, which then name it; nothing moves.

    The modes that carry this number prove that every line before has been dealt with.
    """
    return b"F%d\n$G\n" % number


def modal_feed(modes: str) -> int | None:
    """The feed that a ``[GC:...]`` message names, where it is a whole number."""
    found = _FEED.search(modes)
    return int(found[1]) if found else None


def set_position_line(letters: str, position: Sequence[float]) -> bytes:
    """Declare the present position to be ``position`` (G92: forgotten by the next reset)."""
    return f"G21G92{_axes(letters, position)}\n".encode()


def _axes(letters: str, values: Sequence[float]) -> str:
    return "".join(f"{a}{_number(v)}" for a, v in zip(letters, values, strict=True))


def _number(value: float, positive: bool = False) -> str:
    if not math.isfinite(value) or (positive and value <= 0):
        raise ValueError(f"{value} cannot be sent: it must be finite{' and above 0' * positive}")
    return f"{value:.3f}"
