"""Codec of the tapper's line protocol, version 1: bytes <-> frames.

``@<session>,<seq>,<WORD>[,args]*<CRC>\\n``. The CRC is CRC-16/CCITT-FALSE (polynomial 0x1021, start
0xFFFF, no reflection) over everything between ``@`` and ``*``, as four upper-case hex digits.
Requests carry a command word, replies a result word; no word is both, so an echoing line is not
taken for the device. An ``@`` begins a frame wherever it stands, a newline ends it.

A reply's arguments: state, shot, energy in uJ, interlock closed (0/1), stop latched (0/1), the last
shot fired in this boot (0: none), its measured speed in um/s (0: not measured), boot number;
``WELCOME`` adds the firmware's version.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import Enum

STOP = b"!"
"""Latches the stop from the receive interrupt, wherever it stands."""
SILENCE_LIMIT = 0.5
"""Without a valid frame for this long a drawn tapper disarms, s."""
LONGEST_FRAME = 160
"""Bytes from ``@`` to the newline."""
MAXIMUM_SHOT = 2**64 - 1
MAXIMUM_ENERGY_UJ = 10_000_000


class Command(Enum):
    """What the host asks."""

    HELLO = "HELLO"
    ARM = "ARM"
    FIRE = "FIRE"
    STATUS = "STATUS"
    DISARM = "DISARM"
    CLEAR = "CLEAR"


class Result(Enum):
    """What the tapper answers; everything but the first three is a refusal without effect."""

    WELCOME = "WELCOME"
    OK = "OK"
    FIRED = "FIRED"
    SPENT = "SPENT"
    NOT_DRAWN = "NOT_DRAWN"
    INTERLOCK = "INTERLOCK"
    STOPPED = "STOPPED"
    BUSY = "BUSY"
    RANGE = "RANGE"
    SESSION = "SESSION"
    NEEDS_PERSON = "NEEDS_PERSON"
    UNKNOWN = "UNKNOWN"


class State(Enum):
    """The tapper's state machine."""

    SAFE = "SAFE"
    DRAWING = "DRAWING"
    DRAWN = "DRAWN"
    RELEASING = "RELEASING"
    STOPPED = "STOPPED"


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
    version: str = ""


@dataclass(frozen=True, slots=True)
class Bad:
    """Bytes that are no frame, and why."""

    data: bytes
    why: str


@dataclass(frozen=True, slots=True)
class Decoded:
    """``frame`` None: more bytes are needed; ``rest``: the bytes still to decode."""

    frame: Reply | Bad | None
    rest: bytes


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE; its check value over ``123456789`` is 0x29B1."""
    value = 0xFFFF
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1) ^ 0x1021 if value & 0x8000 else value << 1
        value &= 0xFFFF
    return value


def encode(session: int, sequence: int, command: Command, *arguments: int) -> bytes:
    """One request frame. Raises ValueError for numbers that the frame cannot carry."""
    if not (1 <= session <= 0xFFFF and 0 <= sequence <= 0xFFFF):
        raise ValueError(f"session {session} must be 1 to 65535 and sequence {sequence} 0 to 65535")
    if any(argument < 0 for argument in arguments):
        raise ValueError(f"arguments {arguments} must not be negative")
    body = ",".join(str(part) for part in (session, sequence, command.value, *arguments)).encode()
    return b"@%s*%04X\n" % (body, crc16(body))


_UNSIGNED = r"(\d{1,10})"
_SHOT = r"(\d{1,20})"
_REPLY = re.compile(
    rf"^(\d{{1,5}}),(\d{{1,5}}),([A-Z_]{{1,12}}),([A-Z]{{1,9}}),{_SHOT},{_UNSIGNED},([01]),([01]),"
    rf"{_SHOT},{_UNSIGNED},{_UNSIGNED}(?:,([A-Za-z0-9.+-]{{1,24}}))?$"
)


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


def _reply(line: bytes) -> Reply | Bad:
    body, star, check = line[1:].rstrip(b"\r\n").rpartition(b"*")
    if not star or not re.fullmatch(rb"[0-9A-F]{4}", check):
        return Bad(line, "no checksum")
    if int(check, 16) != crc16(body):
        return Bad(line, f"checksum {check.decode()} but {crc16(body):04X} was computed")
    found = _REPLY.match(body.decode("ascii", "replace"))
    if not found:
        return Bad(line, "not a reply")
    try:
        result, state = Result(found[3]), State(found[4])
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
        version=found[12] or "",
    )
