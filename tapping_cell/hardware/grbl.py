"""Codec of the Grbl 1.1 family: decodes received bytes to frames and encodes lines to send.

Source: Grbl 1.1 documentation, "Interface" and "Commands" (status reports, responses, settings).
grblHAL, grbl-Mega-5X, FluidNC and uCNC use the same formats. Values remain in the controller's
units: mm, degrees.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from tapping_cell.hardware.text_line import Bad, Decoded, decode_first_line

STATUS_QUERY = b"?"
FEED_HOLD = b"!"
SOFT_RESET = b"\x18"
FULL_FEED = b"\x90"
"""Resets the feed override to 100 %."""
STOP = FEED_HOLD + SOFT_RESET
"""Feed hold, then soft reset: real-time bytes that the controller executes ahead of its queue."""

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
    46: "homing is required",
}


@dataclass(frozen=True, slots=True)
class Ok:
    """The line was accepted; this does not confirm that it was executed."""


@dataclass(frozen=True, slots=True)
class Error:
    """The line was rejected, with Grbl's error number."""

    code: int


@dataclass(frozen=True, slots=True)
class Alarm:
    """The controller latched an alarm, with Grbl's alarm number."""

    code: int


@dataclass(frozen=True, slots=True)
class Banner:
    """The greeting after power-up or a reset."""

    name: str
    version: str


@dataclass(frozen=True, slots=True)
class Setting:
    """One line of the answer to ``$$``."""

    number: int
    value: float


@dataclass(frozen=True, slots=True)
class NamedSetting:
    """A setting with a name or a non-numeric value, such as ``$/stepping/idle_ms=255``."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class Message:
    """A bracketed line such as ``[VER:1.1h:]`` or ``[MSG:...]``."""

    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Status:
    """A status report; positions in the units of the axes (deg, deg, mm, deg)."""

    state: str
    substate: int | None
    machine: tuple[float, ...] | None
    """Machine position (MPos)."""
    work: tuple[float, ...] | None
    """Work position (WPos)."""
    offset: tuple[float, ...] | None
    """Work coordinate offset (WCO); only some reports contain it."""
    feed_override: int | None = None
    """Feed override in percent (first value of Ov); only some reports contain it."""


Frame = Ok | Error | Alarm | Banner | Setting | NamedSetting | Message | Status | Bad

_NUMBER = r"-?\d{1,7}(?:\.\d{1,6})?"
_BANNER = re.compile(r"^(Grbl|GrblHAL|grblHAL|FluidNC|uCNC|µCNC)\s+v?(\d+\.\d+\S*)")
_SETTING = re.compile(rf"^\$(\d{{1,3}})=({_NUMBER})$")
_NAMED_SETTING = re.compile(r"^\$(/?[A-Za-z0-9_/]{1,64})=(.{0,200})$")
_MESSAGE = re.compile(r"^\[([A-Z][A-Za-z0-9 ]{0,19}):(.*)\]$")
_OVERRIDES = re.compile(r"^(\d{1,3}),\d{1,3},\d{1,3}$")
_FEED = re.compile(r"(?:^| )F(\d{1,7})(?:\.0*)?(?= |$)")
_POSITION = re.compile(rf"^{_NUMBER}(?:,{_NUMBER}){{2,7}}$")


def decode(buffer: bytes) -> Decoded[Frame]:
    """Decode the first line of ``buffer``; empty lines are skipped. Never raises."""
    return decode_first_line(buffer, decode_line)


def decode_line(line: bytes) -> Frame:
    """Decode one line without its line ending. Never raises."""
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
    """Encode a straight absolute move of the axes ``letters`` to ``target`` at ``feed`` units/min.

    Every line contains the modal words, so that a garbled line cannot affect the next one. Raises
    ValueError if a value is not finite or the feed is not above 0.
    """
    return f"G21G90G94G1{_axes(letters, target)}F{_number(feed, positive=True)}\n".encode()


def marker_lines(number: int) -> bytes:
    """Encode lines that set the feed to ``number`` and query the modes; nothing moves.

    A mode report with this number proves that all earlier lines were processed.
    """
    return b"F%d\n$G\n" % number


def modal_feed(modes: str) -> int | None:
    """Return the feed in the parser state ``[GC:...]`` if it is a whole number, else None."""
    found = _FEED.search(modes)
    return int(found[1]) if found else None


def set_position_line(letters: str, position: Sequence[float]) -> bytes:
    """Encode a G92 that declares the current position; a reset cancels the declaration."""
    return f"G21G92{_axes(letters, position)}\n".encode()


def _axes(letters: str, values: Sequence[float]) -> str:
    return "".join(f"{a}{_number(v)}" for a, v in zip(letters, values, strict=True))


def _number(value: float, positive: bool = False) -> str:
    if not math.isfinite(value) or (positive and value <= 0):
        raise ValueError(f"{value} cannot be sent: it must be finite{' and above 0' * positive}")
    return f"{value:.3f}"
