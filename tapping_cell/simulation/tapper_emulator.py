"""Emulator of the tapper board: a state machine in simulated time with its own parser and checksum.

It emulates the firmware ``firmware/tapper`` together with the spring, the interlock and the
buttons at the cell. Tests verify that it behaves like the real firmware.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell.simulation.coil_bank import CoilBank
from tapping_cell.simulation.device_emulator import OutputQueue, earliest
from tapping_cell.simulation.spring_drive import SpringDrive, SpringMechanism, Status

SILENCE = 0.5
CLEAR_WINDOW = 10.0
"""Time after a press of the clear button during which CLEAR is accepted, s."""
SHORTEST_PRESS = 0.5
"""Minimum duration of a press of the clear button, s."""
FORGET_PRESS = 5.0
"""Duration of a press of the clear button that resets the used shot numbers if the board is at
rest, s."""
LONGEST_WINDOW_MS = 100
LARGEST_JUMP = 2**32
OLD_VERSION = "2.0.0-sim"
"""Firmware version of a board without channels."""
SETTLING = {
    "HOMING": "SAFE",
    "SAFE": "SAFE",
    "CHARGING": "CHARGED",
    "CHARGED": "CHARGED",
    "DISCHARGING": "SAFE",
}
"""For each state in which parts may move: the state that follows when the motion has ended
successfully."""

FireCallback = Callable[[int, float, float], float | None]
"""Callback when a striker is released. Arguments: shot, energy in J, time in s. Returns the
measured speed in m/s, or None."""


@dataclass(frozen=True, slots=True)
class TapperMachine:
    """Mechanics and electronics around the board."""

    spring: SpringMechanism = field(default_factory=SpringMechanism)
    coils: int = 0
    """Number of channels of a board with coils at fixed mounts; 0 for a board with a spring."""
    version: str = "2.1.0-sim"
    """Firmware version."""
    carriage: float = 0.0
    """Initial position of the carriage, steps from its front switch."""
    release_time: float = 0.02
    """Length of the release pulse, s."""
    maximum_energy: float = 1.0
    """Maximum energy, J."""
    setup_energy: float = 0.005
    """Maximum energy in set-up mode without the enabling switch, J."""
    maximum_timeout: float = 10.0
    """Maximum charge timeout, s."""
    first_time_ms: int = 0
    """Board time at start-up, ms."""
    reply_latency: float = 0.002
    """Latency of the USB adapter and the processor, s."""
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
    """One emulated board with its striker or strikers."""

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
        """All releases: shot, energy in J, time in s."""
        self.drive: SpringDrive | CoilBank = (
            CoilBank(self.machine.coils)
            if self.machine.coils
            else SpringDrive(self.machine.spring, now, self.machine.carriage)
        )
        self.channel = 0
        """Channel of the last shot that was charged."""
        self._boot = boot - 1
        self._used = 0  # greatest shot number ever charged; the board stores it in EEPROM
        self._enabled = False
        self._button = False
        self._output = OutputQueue(self.machine.reply_latency, 10 / self.machine.baud)
        self._start(now)

    def _start(self, now: float) -> None:
        self._boot += 1
        self._started = now
        self._line: bytearray | None = None
        self._session = 0
        self._sequence: int | None = None
        self._last_body = b""
        self._last_reply = b""
        self._setup = True
        self._shot = self._used
        self._energy_uj = 0
        self.channel = 0
        self._fired = 0
        self._speed_um = 0
        self._received = now
        self._expires = 0.0
        self._released_until = 0.0
        self._press = ""
        self._pressed = 0.0
        self._acknowledged = -1e9
        self.drive.start()
        self.drive.halt(now)
        self._state = "UNHOMED"

    # Interface to the simulated world.

    @property
    def coils(self) -> CoilBank:
        """Coils of a board with channels; raises TypeError for a board with a spring."""
        if not isinstance(self.drive, CoilBank):
            raise TypeError("this board drives a spring")
        return self.drive

    @property
    def spring(self) -> SpringDrive:
        """Carriage of a board with a spring; raises TypeError for a board with coils."""
        if not isinstance(self.drive, SpringDrive):
            raise TypeError("this board has coils")
        return self.drive

    @property
    def state(self) -> str:
        """One of UNHOMED, HOMING, SAFE, CHARGING, CHARGED, RELEASING, DISCHARGING, STOPPED."""
        return self._state

    def press_clear_button(self, now: float) -> None:
        """Simulate a sufficiently long press of the clear button that ends at ``now``."""
        self.advance(now)
        if self._state == "STOPPED":
            self._acknowledged = now

    def set_clear_button(self, pressed: bool, now: float) -> None:
        """Press or release the clear button. A press takes effect when it ends; the effect depends
        on its duration."""
        self.advance(now)
        if pressed == self._button:
            return
        self._button = pressed
        if pressed:
            self._pressed = now
            purposes = {"STOPPED": "clear", "SAFE": "forget", "UNHOMED": "forget"}
            self._press = purposes.get(self._state, "")
        elif self._press == "clear" and now - self._pressed >= SHORTEST_PRESS - 1e-9:
            self._acknowledged = now
        elif self._press == "forget" and now - self._pressed >= FORGET_PRESS - 1e-9:
            self._boot += 1
            self._used = self._shot = self._fired = 0
            self._session = 0
            self._setup = True

    def set_interlock(self, closed: bool, now: float) -> None:
        """Open or close the guard."""
        self.advance(now)
        self.interlock_closed = closed
        if not closed:
            self._discharge(now)

    def set_enabling_switch(self, held: bool, now: float) -> None:
        """Hold or release the enabling switch of the set-up mode."""
        self.advance(now)
        self._enabled = held
        self._leave_setup_limit(now)

    def set_motor_power(self, on: bool, now: float) -> None:
        """Switch the supply of the spring's motor on or off; without the supply, steps do not move
        the carriage."""
        self.advance(now)
        assert isinstance(self.drive, SpringDrive), "coils have no motor"
        self.drive.set_power(on, now)

    def open_stop_loop(self, now: float) -> None:
        """Open the emergency stop loop, so that the motor loses its power, and close the loop
        again."""
        self.advance(now)
        self._stop(by_wire=True, now=now)

    # DeviceEmulator interface.

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes; a stop byte latches the stop at any position."""
        self.advance(now)
        for byte in data:
            if byte == 0x21:
                self._stop(by_wire=False, now=now)
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
        """Process timeouts and the ends of movements and releases, in order."""
        while True:
            due = self._next_internal()
            if due is None or due > now:
                # Some changes of the drive's status are not events, for example the end of a
                # coil-driven striker's motion. Therefore update the state from the drive's status
                # here.
                if self._state == "SAFE" or (self.machine.coils and self._state in SETTLING):
                    self._settle(SETTLING[self._state], self._state)
                return
            self.drive.advance(due)
            if self._state == "RELEASING" and due >= self._released_until:
                self.drive.back(due)
                self._state = "DISCHARGING"
            elif (limit := self._limit()) is not None and due >= limit:
                self._discharge(due)
            if self._state in SETTLING:
                self._settle(SETTLING[self._state], self._state)

    def take_output(self, now: float) -> bytes:
        """Return the bytes transmitted by ``now``."""
        self.advance(now)
        return self._output.take(now)

    def next_event(self) -> float | None:
        """Return the time of the next change of state or transmission."""
        return earliest(self._next_internal(), self._output.next_time())

    def power_cycle(self, now: float) -> None:
        """Restart the board: the motor is switched off and the boot number increases."""
        self.advance(now)
        self._output.clear()
        self._start(now)

    def _limit(self) -> float | None:
        """Return the time when the current action ends because of missing requests or its timeout;
        None if it does not end for such a reason."""
        if self._state == "HOMING":
            return self._received + SILENCE
        if self._state in ("CHARGING", "CHARGED"):
            return min(self._received + SILENCE, self._expires)
        return None

    def _next_internal(self) -> float | None:
        due = self._released_until if self._state == "RELEASING" else self._limit()
        return earliest(due, self.drive.next_event())

    def _settle(self, there: str, moving: str) -> None:
        self._state = {Status.THERE: there, Status.MOVING: moving}.get(self.drive.status, "UNHOMED")

    def _discharge(self, now: float) -> None:
        if self._state in ("CHARGING", "CHARGED"):
            self.drive.back(now)
            self._state = "DISCHARGING"
        elif self._state == "HOMING":
            self.drive.halt(now)
            self._state = "UNHOMED"

    def _stop(self, by_wire: bool, now: float) -> None:
        if by_wire or self._state == "HOMING":
            self.drive.halt(now)
        else:
            self.drive.back(now)
        self._state = "STOPPED"
        self._press = ""
        self._acknowledged = -1e9

    def _too_much_for_setup(self, energy_uj: int) -> bool:
        return self._setup and not self._enabled and energy_uj > self.machine.setup_energy * 1e6

    def _leave_setup_limit(self, now: float) -> None:
        if self._state in ("CHARGING", "CHARGED") and self._too_much_for_setup(self._energy_uj):
            self._discharge(now)

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
            self._setup = True
            self._discharge(now)
        elif session != self._session:
            self._output.put(self._reply(session, sequence, "SESSION", now), now)
            return
        elif sequence == self._sequence:
            if body == self._last_body:
                self._received = now
                self._output.put(self._last_reply, now)
            return
        elif not self._is_newer(sequence):
            return
        self._received = now
        self._sequence = sequence
        result = self._act(parts[2], parts[3:], now)
        self._last_body = body
        self._last_reply = self._reply(session, sequence, result, now)
        self._output.put(self._last_reply, now)

    def _is_newer(self, sequence: int) -> bool:
        return self._sequence is None or 0 < (sequence - self._sequence) % 65536 < 32768

    def _act(self, command: str, arguments: list[str], now: float) -> str:
        if command == "MODE":
            if arguments not in (["SETUP"], ["RUN"]):
                return "UNKNOWN"
            self._setup = arguments == ["SETUP"]
            self._leave_setup_limit(now)
            return "OK"
        if not all(_is_number(argument, 20) for argument in arguments):
            return "UNKNOWN"
        numbers = [int(argument) for argument in arguments]
        if any(number >= 2**64 for number in numbers):
            return "UNKNOWN"
        most = 0 if self.machine.version == OLD_VERSION else 1
        if command == "CHARGE" and 3 <= len(numbers) <= 3 + most:
            channel = numbers[3] if len(numbers) == 4 else 0
            return self._charge(numbers[0], numbers[1], numbers[2], channel, now)
        if command == "FIRE" and 2 <= len(numbers) <= 2 + most:
            return self._fire(numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else 0, now)
        if numbers:
            return "UNKNOWN"
        if command == "HELLO":
            return "WELCOME"
        if command == "STATUS":
            return "OK"
        if command == "HOME":
            return self._home(now)
        if command == "DISCHARGE":
            self._discharge(now)
            return "OK"
        if command == "CLEAR":
            return self._clear(now)
        return "UNKNOWN"

    def _home(self, now: float) -> str:
        if self._state == "STOPPED":
            return "STOPPED"
        if not self.interlock_closed:
            return "INTERLOCK"
        if self._state not in ("UNHOMED", "SAFE"):
            return "BUSY"
        self._press = ""
        self.drive.home(now)
        self._settle("SAFE", "HOMING")
        return "OK"

    def _charge(self, shot: int, energy_uj: int, timeout_ms: int, channel: int, now: float) -> str:
        if self._state == "STOPPED":
            return "STOPPED"
        if not self.interlock_closed:
            return "INTERLOCK"
        if shot <= self._shot:
            return "SPENT"
        if shot - self._shot > LARGEST_JUMP:
            return "JUMP"
        if self._state == "UNHOMED":
            return "NOT_HOMED"
        if self._state != "SAFE":
            return "BUSY"
        if not (
            0 < energy_uj <= self.machine.maximum_energy * 1e6
            and 0 < timeout_ms <= self.machine.maximum_timeout * 1e3
            and self.drive.can_store(energy_uj * 1e-6)
        ):
            return "RANGE"
        if channel >= max(self.machine.coils, 1):
            return "CHANNEL"
        if self._too_much_for_setup(energy_uj):
            return "NOT_ENABLED"
        self._shot, self._energy_uj, self.channel = shot, energy_uj, channel
        self._used = shot
        self._expires = now + timeout_ms * 1e-3
        self._press = ""
        self._state = "CHARGING"
        self.drive.charge(energy_uj * 1e-6, now)
        return "OK"

    def _time_ms(self, now: float) -> int:
        passed = int((now - self._started) * 1e3 + 1e-6)
        return (self.machine.first_time_ms + passed) % 2**32

    def _fire(self, shot: int, deadline: int, channel: int, now: float) -> str:
        if shot and shot == self._fired:
            return "FIRED"
        if self._state == "STOPPED":
            return "STOPPED"
        if not self.interlock_closed:
            return "INTERLOCK"
        if self._state != "CHARGED" or shot != self._shot:
            return "SPENT" if shot < self._shot else "NOT_CHARGED"
        if channel != self.channel:
            return "CHANNEL"
        if deadline >= 2**32:
            return "UNKNOWN"
        if not 0 < (deadline - self._time_ms(now)) % 2**32 <= LONGEST_WINDOW_MS:
            self._discharge(now)
            return "LATE"
        self._state = "RELEASING"
        self._released_until = now + self.machine.release_time
        self._fired = shot
        energy = self.drive.stored(now)
        self.fires.append((shot, energy, now))
        measured = self.on_fire(shot, energy, now) if self.on_fire else None
        self.drive.released(self.channel, now)
        self._speed_um = 0 if measured is None else max(round(measured * 1e6), 0)
        return "FIRED"

    def _clear(self, now: float) -> str:
        if self._state != "STOPPED":
            return "OK"
        if now - self._acknowledged > CLEAR_WINDOW:
            return "NEEDS_PERSON"
        self._acknowledged = -1e9
        self._settle("SAFE", "DISCHARGING")
        return "OK"

    def _reply(self, session: int, sequence: int, result: str, now: float) -> bytes:
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
            self._time_ms(now),
            "SETUP" if self._setup else "RUN",
            int(self._enabled),
        ]
        if self.machine.version != OLD_VERSION:
            fields += [self.channel, max(self.machine.coils, 1), self.drive.at_mounts(now)]
        if result == "WELCOME":
            fields.append(self.machine.version)
        body = ",".join(str(value) for value in fields).encode()
        return b"@" + body + b"*" + b"%04X" % _checksum(body) + b"\n"


def _is_number(text: str, digits: int) -> bool:
    return text.isascii() and text.isdigit() and len(text) <= digits
