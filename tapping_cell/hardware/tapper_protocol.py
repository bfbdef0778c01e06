"""Codec of the tapper's line protocol, versions 2.0 and 2.1.

A frame is ``@<session>,<seq>,<WORD>[,args]*<CRC>\\n``. The CRC is CRC-16/CCITT-FALSE (polynomial
0x1021, start 0xFFFF, no reflection) over everything between ``@`` and ``*``, as four upper-case hex
digits. The WORD of a request is a command, and the WORD of a reply is a result. No word is both a
command and a result, so a request that the line echoes is not mistaken for a reply. An ``@`` always
begins a frame, and a newline ends it.

Arguments of a reply: state, shot, energy in uJ, interlock closed (0/1), stop latched (0/1), the
last shot fired since boot (0: none), its measured speed in um/s (0: not measured), boot number, the
board's time in ms (wraps at 2**32), mode, enabling switch held (0/1). Version 2.1 adds the channel
of the shot, the number of channels of the board, and the mask of channels whose striker is detected
at its mount. ``WELCOME`` adds the firmware version; its major version is the version of the
protocol. A board with version 2.0 has only channel 0 and accepts no channel argument in ``CHARGE``
and ``FIRE``.
"""

from __future__ import annotations

import binascii
import re
from dataclasses import dataclass
from enum import Enum

STOP = b"!"
"""Byte that latches the stop in the receive interrupt, at any position in the stream."""
SILENCE_LIMIT = 0.5
"""A charged tapper discharges after this time without a valid frame, s."""
LONGEST_WINDOW = 0.1
"""Maximum time by which the deadline of FIRE may lie ahead of the board's time, s; the board
refuses a later deadline."""
LONGEST_PULSE = 0.033
"""A hardware timer switches the release output off at most this long after it was switched on, s.
The timer has 16 bits and counts in steps of 0.5 us."""
TIME_MODULUS = 2**32
"""Modulus of the board's time in ms."""
LONGEST_FRAME = 184
"""Maximum length of a frame from ``@`` to the newline, in bytes."""
MAXIMUM_SHOT = 2**64 - 1
MAXIMUM_JUMP = 2**32
"""Maximum difference between a new shot number and the greatest number used. Without this limit,
one wrong number could use up all numbers."""
MAXIMUM_ENERGY_UJ = 10_000_000


class Command(Enum):
    """Commands of the host, in frames of at most 64 bytes. A repeated request with the same
    sequence number gets the same reply and has no further effect. A request with an older number is
    not answered."""

    HELLO = "HELLO"
    """Opens a session, discharges the striker and selects set-up mode."""
    HOME = "HOME"
    """Moves the carriage off the front switch if necessary, then onto it. The state is HOMING, then
    SAFE, or UNHOMED if the switch did not open or close."""
    CHARGE = "CHARGE"
    """``<shot>,<energy uJ>,<timeout ms>[,<channel>]``: charges. Requires a closed interlock, no
    latched stop, a homed carriage, and a shot number that exceeds the greatest number used by at
    most ``MAXIMUM_JUMP``."""
    FIRE = "FIRE"
    """``<shot>,<deadline ms>[,<channel>]``: fires once if the deadline has not passed on the
    board's clock. After the deadline, or if the deadline is further ahead than ``LONGEST_WINDOW``,
    the reply is LATE, the board discharges and the shot number is used up. The reply to a repeated
    FIRE is FIRED, without a second shot."""
    STATUS = "STATUS"
    """No effect, but restarts the timeout of a charged tapper."""
    DISCHARGE = "DISCHARGE"
    """Discharges without firing; aborts homing."""
    CLEAR = "CLEAR"
    """Ends a latched stop if the clear button was pressed in the last 10 s; otherwise the reply is
    NEEDS_PERSON."""
    MODE = "MODE"
    """``SETUP`` or ``RUN``. In set-up mode, energies above 5 mJ are refused unless the enabling
    switch is held; releasing the switch discharges the striker."""


class Result(Enum):
    """Result words of the tapper's replies; all but the first three are refusals. A refused request
    has no effect, with one exception: LATE ends the shot and discharges the tapper."""

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
    """States of the tapper's state machine."""

    UNHOMED = "UNHOMED"
    HOMING = "HOMING"
    SAFE = "SAFE"
    CHARGING = "CHARGING"
    CHARGED = "CHARGED"
    RELEASING = "RELEASING"
    DISCHARGING = "DISCHARGING"
    STOPPED = "STOPPED"


class Mode(Enum):
    """Operating mode. RUN allows every energy; SETUP allows only a small energy unless the enabling
    switch is held."""

    RUN = "RUN"
    SETUP = "SETUP"


SETUP_ENERGY = 0.005
"""Maximum energy in set-up mode without the enabling switch, J; ``TAPPER_SETUP_ENERGY_UJ`` of the
firmware."""


@dataclass(frozen=True, slots=True)
class Reply:
    """One reply of the tapper; ``energy`` in J, ``speed`` in m/s or None."""

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
    """Board time when the request was processed, ms, modulo ``TIME_MODULUS``."""
    mode: Mode
    enabled: bool
    """True if the enabling switch is held."""
    version: str = ""
    channel: int = 0
    """Channel of ``shot``."""
    channels: int = 1
    """Number of tappers on this board."""
    at_mounts: int = 0
    """Mask of the channels whose switch detects the striker at its mount; 0 without switches."""

    @property
    def lacks_switch(self) -> bool:
        """Whether the board refuses to keep the energy of ``shot``, because in set-up mode the
        enabling switch is not held."""
        return self.mode is Mode.SETUP and not self.enabled and self.energy > SETUP_ENERGY


@dataclass(frozen=True, slots=True)
class OtherFirmware:
    """Greeting of a firmware with another protocol version."""

    session: int
    sequence: int
    version: str


@dataclass(frozen=True, slots=True)
class Bad:
    """Bytes that are not a valid frame, and the reason."""

    data: bytes
    why: str

    @property
    def damaged(self) -> bool:
        """Whether the bytes begin or end like a frame, so that a tapper probably sent them."""
        return self.data.startswith(b"@") or b"*" in self.data


@dataclass(frozen=True, slots=True)
class Decoded:
    """A decoded frame (None if more bytes are needed), and the bytes not decoded yet."""

    frame: Reply | OtherFirmware | Bad | None
    rest: bytes


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE; its check value over ``123456789`` is 0x29B1."""
    return binascii.crc_hqx(data, 0xFFFF)


def encode(session: int, sequence: int, command: Command, *arguments: int | Mode) -> bytes:
    """Encode one request. Raises ValueError for numbers that do not fit into the frame."""
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
    """Decode the first frame of ``buffer``. Never raises."""
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
    """Return the board time ``window`` s after ``time_ms``, rounded down, as a FIRE deadline."""
    return (time_ms + int(window * 1e3)) % TIME_MODULUS


def _reply(line: bytes) -> Reply | OtherFirmware | Bad:
    body, star, check = line[1:].rstrip(b"\r\n").rpartition(b"*")
    if not star or not re.fullmatch(rb"[0-9A-F]{4}", check):
        return Bad(line, "no checksum")
    if int(check, 16) != crc16(body):
        return Bad(line, f"the checksum is {check.decode()}, but must be {crc16(body):04X}")
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
