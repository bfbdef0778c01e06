"""The tapper's board as a state machine in told time, with a parser and checksum of its own.

The real firmware is ``firmware/tapper``; this stands in for it together with the spring, the
interlock and the buttons at the cell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from tapping_cell.simulation.device_emulator import OutputQueue

SILENCE = 0.5
CLEAR_WINDOW = 10.0
"""How long after the button at the cell was pressed a CLEAR is taken, s."""
VERSION = "1.0.0-sim"

FireCallback = Callable[[int, float, float], float | None]
"""Called at a release with shot, energy in J and time in s; returns the measured speed in m/s or
None."""


@dataclass(frozen=True, slots=True)
class TapperMachine:
    """The mechanics and electronics around the board."""

    draw_time: float = 0.10
    """Fixed part of a draw, s."""
    draw_time_per_root_joule: float = 0.5
    """A spring is drawn in proportion to the root of its energy, s per sqrt(J)."""
    release_time: float = 0.02
    """Length of the release pulse, s."""
    maximum_energy: float = 1.0
    """J."""
    maximum_timeout: float = 10.0
    """s."""
    reply_latency: float = 0.002
    """USB adapter and processor, s."""
    baud: int = 115200


def _crc_table() -> tuple[int, ...]:
    rows = []
    for high in range(256):
        value = high << 8
        for _ in range(8):
            value = ((value << 1) & 0xFFFF) ^ (0x1021 if value & 0x8000 else 0)
        rows.append(value)
    return tuple(rows)


_CRC_ROWS = _crc_table()


def _checksum(data: bytes) -> int:
    value = 0xFFFF
    for byte in data:
        value = ((value << 8) & 0xFF00) ^ _CRC_ROWS[(value >> 8) ^ byte]
    return value


class TapperEmulator:
    """See the module; one instance is one board with its striker."""

    def __init__(
        self,
        machine: TapperMachine | None = None,
        on_fire: FireCallback | None = None,
        boot: int = 1,
        now: float = 0.0,
    ) -> None:
        self.machine = machine or TapperMachine()
        self.on_fire = on_fire
        self.interlock_closed = True
        self.fires: list[tuple[int, float, float]] = []
        """Every release: shot, energy in J, time in s."""
        self._boot = boot - 1
        self._used = 0  # kept in EEPROM: the greatest shot ever drawn in an earlier boot
        self._highest_drawn = 0
        self._pressed = -1e9
        self._output = OutputQueue(self.machine.reply_latency, 10 / self.machine.baud)
        self._start(now)

    def _start(self, now: float) -> None:
        self._boot += 1
        self._used = max(self._used, self._highest_drawn)
        self._line: bytearray | None = None
        self._session = 0
        self._sequence: int | None = None
        self._last_body = b""
        self._last_reply = b""
        self._state = "SAFE"
        self._shot = 0
        self._energy_uj = 0
        self._fired = 0
        self._speed_um = 0
        self._heard = now
        self._drawn_at = 0.0
        self._expires = 0.0
        self._released_until = 0.0

    # What the world asks and does.

    @property
    def state(self) -> str:
        """SAFE, DRAWING, DRAWN, RELEASING or STOPPED."""
        return self._state

    def press_clear_button(self, now: float) -> None:
        """A person at the cell allows a latched stop to be cleared."""
        self.advance(now)
        self._pressed = now

    def set_interlock(self, closed: bool, now: float) -> None:
        """The guard opens or closes."""
        self.advance(now)
        self.interlock_closed = closed
        if not closed:
            self._disarm()

    # DeviceEmulator.

    def receive(self, data: bytes, now: float) -> None:
        """Bytes arrive: a stop byte latches wherever it stands."""
        self.advance(now)
        for byte in data:
            if byte == 0x21:
                self._state = "STOPPED"
                self._line = None
            elif byte == 0x40:
                self._line = bytearray()
            elif self._line is None:
                continue
            elif byte == 0x0A:
                line, self._line = bytes(self._line), None
                self._frame(line, now)
            elif len(self._line) >= 64:
                self._line = None
            elif byte != 0x0D:
                self._line.append(byte)

    def advance(self, now: float) -> None:
        """Time-outs and the ends of draws and releases, in their order."""
        while True:
            due = self._next_internal()
            if due is None or due > now:
                return
            if self._state == "RELEASING":
                self._state = "SAFE"
            elif due >= min(self._heard + SILENCE, self._expires):
                self._disarm()
            else:
                self._state = "DRAWN"

    def take_output(self, now: float) -> bytes:
        """Bytes out by ``now``."""
        self.advance(now)
        return self._output.take(now)

    def next_event(self) -> float | None:
        """Next change of state or byte going out."""
        times = [t for t in (self._next_internal(), self._output.next_time()) if t is not None]
        return min(times) if times else None

    def power_cycle(self, now: float) -> None:
        """The board restarts: a drawn spring is let down, the boot number counts up."""
        self.advance(now)
        self._output.clear()
        self._start(now)

    def _next_internal(self) -> float | None:
        if self._state == "RELEASING":
            return self._released_until
        if self._state in ("DRAWING", "DRAWN"):
            limit = min(self._heard + SILENCE, self._expires)
            return min(limit, self._drawn_at) if self._state == "DRAWING" else limit
        return None

    def _disarm(self) -> None:
        if self._state in ("DRAWING", "DRAWN"):
            self._state = "SAFE"

    def _frame(self, line: bytes, now: float) -> None:
        body, star, check = line.rpartition(b"*")
        if star != b"*" or check != b"%04X" % _checksum(body):
            return
        parts = body.decode("ascii", "replace").split(",")
        if len(parts) < 3 or not all(_is_number(part, 5) for part in parts[:2]):
            return
        session, sequence = int(parts[0]), int(parts[1])
        if not (0 < session < 65536 and sequence < 65536):
            return
        if parts[2] == "HELLO" and (session != self._session or self._is_newer(sequence)):
            self._session = session
            self._disarm()
        elif session != self._session:
            self._output.put(self._reply(session, sequence, "SESSION"), now)
            return
        elif sequence == self._sequence:
            if body == self._last_body:
                self._heard = now
                self._output.put(self._last_reply, now)
            return
        elif not self._is_newer(sequence):
            return
        self._heard = now
        self._sequence = sequence
        result = self._act(parts[2], parts[3:], now)
        self._last_body = body
        self._last_reply = self._reply(session, sequence, result)
        self._output.put(self._last_reply, now)

    def _is_newer(self, sequence: int) -> bool:
        return self._sequence is None or 0 < (sequence - self._sequence) % 65536 < 32768

    def _act(self, command: str, arguments: list[str], now: float) -> str:
        if not all(_is_number(argument, 20) for argument in arguments):
            return "UNKNOWN"
        numbers = [int(argument) for argument in arguments]
        if command == "ARM" and len(numbers) == 3:
            return self._arm(numbers[0], numbers[1], numbers[2], now)
        if command == "FIRE" and len(numbers) == 1:
            return self._fire(numbers[0], now)
        if numbers:
            return "UNKNOWN"
        if command == "HELLO":
            return "WELCOME"
        if command == "STATUS":
            return "OK"
        if command == "DISARM":
            self._disarm()
            return "OK"
        if command == "CLEAR":
            return self._clear(now)
        return "UNKNOWN"

    def _arm(self, shot: int, energy_uj: int, timeout_ms: int, now: float) -> str:
        if self._state == "STOPPED":
            return "STOPPED"
        if not self.interlock_closed:
            return "INTERLOCK"
        if shot <= max(self._fired, self._used):
            return "SPENT"
        if self._state != "SAFE":
            return "BUSY"
        if not (
            0 < energy_uj <= self.machine.maximum_energy * 1e6
            and 0 < timeout_ms <= self.machine.maximum_timeout * 1e3
            and shot < 2**64
        ):
            return "RANGE"
        self._state = "DRAWING"
        self._shot, self._energy_uj = shot, energy_uj
        self._highest_drawn = max(self._highest_drawn, shot)
        root = (energy_uj * 1e-6) ** 0.5
        self._drawn_at = now + self.machine.draw_time + root * self.machine.draw_time_per_root_joule
        self._expires = now + timeout_ms * 1e-3
        return "OK"

    def _fire(self, shot: int, now: float) -> str:
        if shot and shot == self._fired:
            return "FIRED"
        if shot <= self._used or shot < self._fired:
            return "SPENT"
        if self._state == "STOPPED":
            return "STOPPED"
        if not self.interlock_closed:
            return "INTERLOCK"
        if self._state != "DRAWN" or shot != self._shot:
            return "NOT_DRAWN"
        self._state = "RELEASING"
        self._released_until = now + self.machine.release_time
        self._fired = shot
        energy = self._energy_uj / 1e6
        self.fires.append((shot, energy, now))
        measured = self.on_fire(shot, energy, now) if self.on_fire else None
        self._speed_um = 0 if measured is None else max(round(measured * 1e6), 0)
        return "FIRED"

    def _clear(self, now: float) -> str:
        if self._state != "STOPPED":
            return "OK"
        if now - self._pressed > CLEAR_WINDOW:
            return "NEEDS_PERSON"
        self._pressed = -1e9
        self._state = "SAFE"
        return "OK"

    def _reply(self, session: int, sequence: int, result: str) -> bytes:
        fields: list[object] = [
            session,
            sequence,
            result,
            self._state,
            self._shot,
            self._energy_uj,
            int(self.interlock_closed),
            int(self._state == "STOPPED"),
            self._fired,
            self._speed_um,
            self._boot,
        ]
        if result == "WELCOME":
            fields.append(VERSION)
        body = ",".join(str(value) for value in fields).encode()
        return b"@" + body + b"*" + b"%04X" % _checksum(body) + b"\n"


def _is_number(text: str, digits: int) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= digits
