"""Codec of the tapper's line protocol, versions 2.0 and 2.1: bytes <-> frames.

``@<session>,<seq>,<WORD>[,args]*<CRC>\\n``. The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, start
0xFFFF, no reflection) over everything between ``@`` and ``*``, as four upper-case hex digits.
Requests carry a command word, replies a result word; no word is both, so an echoing line is not
taken for the device. An ``@`` begins a frame wherever it stands, a newline ends it.

A reply's arguments: state, shot, energy in uJ, interlock closed (0/1), stop latched (0/1), the last
shot fired in this boot (0: none), its measured speed in um/s (0: not measured), boot number, the
board's time in ms (wraps at 2**32), mode, enabling switch held (0/1); from 2.1 on: channel of the
shot, channels of the board, mask of the channels whose striker is seen at its mount. ``WELCOME``
adds the firmware's version, whose first part is the version of the protocol. A board with 2.0 has
one channel, 0, and takes no channel in ``CHARGE`` and ``FIRE``.
"""

from __future__ import annotations

import binascii
import re
from dataclasses import dataclass
from enum import Enum

STOP = b"!"
"""Latches the stop from the receive interrupt, wherever it stands."""
SILENCE_LIMIT = 0.5
"""Without a valid frame for this long a charged tapper discharges, s."""
LONGEST_WINDOW = 0.1
"""A FIRE whose deadline is further ahead of the board's time than this is refused, s."""
LONGEST_PULSE = 0.033
"""The release output is switched off by a timer at the latest this long after it was switched on,
s (16 bits of 0.5 us)."""
TIME_MODULUS = 2**32
"""The board's time in ms is counted modulo this."""
LONGEST_FRAME = 184
"""Bytes from ``@`` to the newline."""
MAXIMUM_SHOT = 2**64 - 1
MAXIMUM_JUMP = 2**32
"""A shot number further above the greatest one used is refused: one wrong number must not use up
all the others."""
MAXIMUM_ENERGY_UJ = 10_000_000


class Command(Enum):
    """What the host asks."""

    HELLO = "HELLO"
    HOME = "HOME"
    CHARGE = "CHARGE"
    FIRE = "FIRE"
    STATUS = "STATUS"
    DISCHARGE = "DISCHARGE"
    CLEAR = "CLEAR"
    MODE = "MODE"


class Result(Enum):
    """What the tapper answers; everything but the first three is a refusal. No refusal has an
    effect, but for LATE, which ends the shot and discharges."""

    WELCOME = "WELCOME"
    OK = "OK"
    FIRED = "FIRED"
    LATE = "LATE"
    SPENT = "SPENT"
    JUMP = "JUMP"
    NOT_CHARGED = "NOT_CHARGED"
    NOT_HOMED = "NOT_HOMED"
    NOT_ENABLED = "NOT_ENABLED"
    INTERLOCK = "INTERLOCK"
    STOPPED = "STOPPED"
    BUSY = "BUSY"
    RANGE = "RANGE"
    CHANNEL = "CHANNEL"
    SESSION = "SESSION"
    NEEDS_PERSON = "NEEDS_PERSON"
    UNKNOWN = "UNKNOWN"


class State(Enum):
    """The tapper's state machine."""

    UNHOMED = "UNHOMED"
    HOMING = "HOMING"
    SAFE = "SAFE"
    CHARGING = "CHARGING"
    CHARGED = "CHARGED"
    RELEASING = "RELEASING"
    DISCHARGING = "DISCHARGING"
    STOPPED = "STOPPED"


class Mode(Enum):
    """RUN allows every energy; SETUP only a small one, unless the enabling switch is held."""

    RUN = "RUN"
    SETUP = "SETUP"


@dataclass(frozen=True, slots=True)
class Reply:
    """One answer of the tapper; ``energy`` in J, ``speed`` in m/s or None."""

    session: int
    sequence: int
    result: Result
    state: State
    shot: int
    energy: float
    interlock_closed: bool
    stop_latched: bool
    last_fired: int
    speed: float | None
    boot: int
    time_ms: int
    """The board's time when it handled the request, ms, modulo ``TIME_MODULUS``."""
    mode: Mode
    enabled: bool
    """Whether the enabling switch is held."""
    version: str = ""
    channel: int = 0
    """Of ``shot``."""
    channels: int = 1
    """Tappers on this board."""
    at_mounts: int = 0
    """Mask of the channels whose striker a switch sees at its mount; 0 where none is fitted."""


@dataclass(frozen=True, slots=True)
class OtherFirmware:
    """The greeting of a firmware with another version of the protocol."""

    session: int
    sequence: int
    version: str


@dataclass(frozen=True, slots=True)
class Bad:
    """Bytes that are no frame, and why."""

    data: bytes
    why: str


@dataclass(frozen=True, slots=True)
class Decoded:
    """``frame`` None: more bytes are needed; ``rest``: the bytes still to decode."""

    frame: Reply | OtherFirmware | Bad | None
    rest: bytes


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE; its check value over ``123456789`` is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode(session: int, sequence: int, command: Command, *arguments: int | Mode) -> bytes:
    """One request frame. Raises ValueError for numbers that the frame cannot carry."""
    if not (1 <= session <= 0xFFFF and 0 <= sequence <= 0xFFFF):
        raise ValueError(f"session {session} must be 1 to 65535 and sequence {sequence} 0 to 65535")
    if any(isinstance(argument, int) and argument < 0 for argument in arguments):
        raise ValueError(f"arguments {arguments} must not be negative")
    words = [argument.value if isinstance(argument, Mode) else argument for argument in arguments]
    body = ",".join(str(part) for part in (session, sequence, command.value, *words)).encode()
    return b"@%s*%04X\n" % (body, crc16(body))


_UNSIGNED = r"(\d{1,10})"
_SHOT = r"(\d{1,20})"
_VERSION = r"\d{1,3}\.[A-Za-z0-9.+-]{1,20}"
_REPLY = re.compile(
    rf"^(\d{{1,5}}),(\d{{1,5}}),([A-Z_]{{1,12}}),([A-Z]{{1,11}}),{_SHOT},{_UNSIGNED},([01]),([01]),"
    rf"{_SHOT},{_UNSIGNED},{_UNSIGNED},{_UNSIGNED},([A-Z]{{1,5}}),([01])"
    rf"(?:,(\d{{1,2}}),(\d{{1,2}}),{_UNSIGNED})?(?:,({_VERSION}))?$"
)
_GREETING = re.compile(rf"^(\d{{1,5}}),(\d{{1,5}}),WELCOME,.*,({_VERSION})$")


def decode(buffer: bytes) -> Decoded:
    """Take the first frame off ``buffer``. Never raises."""
    start = buffer.find(b"@")
    if start < 0:
        return Decoded(Bad(buffer, "no frame begins here") if buffer else None, b"")
    if start > 0:
        return Decoded(Bad(buffer[:start], "bytes before a frame"), buffer[start:])
    again = buffer.find(b"@", 1)
    end = buffer.find(b"\n")
    if again >= 0 and (end < 0 or again < end):
        return Decoded(Bad(buffer[:again], "a frame without its end"), buffer[again:])
    if end < 0:
        if len(buffer) > LONGEST_FRAME:
            return Decoded(Bad(buffer, f"a frame longer than {LONGEST_FRAME} bytes"), b"")
        return Decoded(None, buffer)
    return Decoded(_reply(buffer[: end + 1]), buffer[end + 1 :])


def deadline_after(time_ms: int, window: float) -> int:
    """The board's time ``window`` s after ``time_ms``, rounded down, for a FIRE."""
    return (time_ms + int(window * 1e3)) % TIME_MODULUS


def _reply(line: bytes) -> Reply | OtherFirmware | Bad:
    body, star, check = line[1:].rstrip(b"\r\n").rpartition(b"*")
    if not star or not re.fullmatch(rb"[0-9A-F]{4}", check):
        return Bad(line, "no checksum")
    if int(check, 16) != crc16(body):
        return Bad(line, f"checksum {check.decode()} but {crc16(body):04X} was computed")
    text = body.decode("ascii", "replace")
    found = _REPLY.match(text)
    if not found:
        greeting = _GREETING.match(text)
        if greeting:
            return OtherFirmware(int(greeting[1]), int(greeting[2]), greeting[3])
        return Bad(line, "not a reply")
    try:
        result, state, mode = Result(found[3]), State(found[4]), Mode(found[13])
    except ValueError as error:
        return Bad(line, str(error))
    speed = int(found[10])
    return Reply(
        session=int(found[1]),
        sequence=int(found[2]),
        result=result,
        state=state,
        shot=int(found[5]),
        energy=int(found[6]) / 1e6,
        interlock_closed=found[7] == "1",
        stop_latched=found[8] == "1",
        last_fired=int(found[9]),
        speed=speed / 1e6 if speed else None,
        boot=int(found[11]),
        time_ms=int(found[12]),
        mode=mode,
        enabled=found[14] == "1",
        version=found[18] or "",
        channel=int(found[15] or 0),
        channels=int(found[16] or 1),
        at_mounts=int(found[17] or 0),
    )
