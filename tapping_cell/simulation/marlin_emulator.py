"""Emulator of a Marlin 2 controller with an arm: a state machine in simulated time.

It answers wrong, repeated and skipped lines as real boards do: a duplicate of the last line is not
answered, and an error is answered with the lines ``Error``, ``Resend`` and ``ok``. It has its own
line parser, independent of the driver's codec.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from tapping_cell.simulation.arm_emulator import ArmEmulator, AxisLimits
from tapping_cell.simulation.device_emulator import earliest
from tapping_cell.simulation.joint_motion import Array
from tapping_cell.simulation.motor_axes import AXES, ArmMachine

QUEUE_LENGTH = 4
"""Number of lines read ahead (Marlin's BUFSIZE)."""
PLANNER_BLOCKS = 16
LINE_LENGTH = 96
RECEIVE_BUFFER = 256
LINE_TIME = 0.001
"""Processing time of a line, s."""
BUSY_PERIOD = 2.0
KILL_TIME = 0.03
"""Time from ``M112`` to standstill, s."""


@dataclass(frozen=True, slots=True)
class MarlinMachine(ArmMachine):
    """The arm that the emulated controller drives, and its firmware build."""

    steps: tuple[float, float, float, float] = (200.0, 200.0, 400.0, 100.0)
    """Steps per unit (M92)."""
    max_rate: tuple[float, ...] = (115.0, 143.0, 250.0, 345.0)
    """Maximum speed, units/s (M203)."""
    acceleration: tuple[float, ...] = (458.0, 573.0, 2000.0, 1720.0)
    """Acceleration, units/s2 (M201)."""
    homing_rate: float = 60.0
    """Homing speed, units/s."""
    emergency_parser: bool = True
    workspace_offsets: bool = True
    """True, Marlin's default: ``G92`` shifts the reported position but does not change the step
    counts. False: a build with NO_WORKSPACE_OFFSETS, in which ``G92`` changes both."""
    soft_endstops: bool = False
    soft_low: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    soft_high: tuple[float, float, float, float] = (200.0, 200.0, 200.0, 200.0)
    """Upper limits that ``M211`` reports; the emulated firmware does not clip targets to them."""
    two_lines: bool = False
    """Whether the answer to ``M211`` has the format that Marlin uses since version 2.0.9."""
    idle_time: float = 120.0
    """Idle time after which the motors lose their power, s (DEFAULT_STEPPER_TIMEOUT_SEC)."""


class MarlinEmulator(ArmEmulator):
    """One emulated board with its arm."""

    def __init__(
        self, machine: MarlinMachine | None = None, seed: int = 0, now: float = 0.0
    ) -> None:
        self.machine = machine or MarlinMachine()
        super().__init__(self.machine, seed)
        self._steps = np.array(self.machine.steps)
        self._busy_at: float | None = None
        self._running: Callable[[float], bool] | None = None
        self._line = bytearray()
        self._blocks: deque[tuple[Array, float, float]] = deque()
        self._restart(now)

    # Interface to the simulated world.

    def enter_sleep(self, now: float) -> None:
        """Cut the motors' power and end any move, as ``M84`` from another sender does."""
        self.advance(now)
        self._axes.freeze(now)
        self._blocks.clear()
        self._due = self._after = None
        self._commanded = self._axes.counted(now)
        self._axes.disable(now)

    @property
    def halted(self) -> bool:
        """Whether the firmware has halted itself."""
        return self._killed

    # DeviceEmulator interface.

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes; with the emergency parser, stops take effect at the end of their line."""
        self.advance(now)
        if self._killed:
            return
        for byte in data:
            if byte in b"\r\n":
                line, self._line = bytes(self._line), bytearray()
                if line:
                    self._read_line(line, now)
            elif len(self._line) < LINE_LENGTH:
                self._line.append(byte)
            if self._killed:
                return
        self._work(now)

    def advance(self, now: float) -> None:
        """Process everything that is due by ``now``, in order."""
        while True:
            due = self._next_internal()
            if due is None or due > now:
                self._idle_out(now)
                return
            if self._due is not None and self._due <= due:
                after, self._due, self._after = self._after, None, None
                if after is not None:
                    after(due)
                self._work(due)
            else:
                self._send_line("echo:busy: processing", due)
                self._busy_at = due + BUSY_PERIOD

    def next_event(self) -> float | None:
        """Return the time of the next event: the end of a motion or transmission, or a busy
        message."""
        return earliest(self._next_internal(), self._output.next_time())

    def power_cycle(self, now: float) -> None:
        """Restart the board. The arm stays in place, but the board takes this position as zero."""
        self.advance(now)
        self._axes.stop_abruptly(now)
        self._output.clear()
        self._restart(now)

    def _next_internal(self) -> float | None:
        return earliest(self._due, self._busy_at)

    def _restart(self, now: float) -> None:
        self._killed = False
        self._idle_limit = self.machine.idle_time
        self._feed_percent = 100.0
        self._power(now)
        self._line = bytearray()
        self._queue: deque[str] = deque()
        self._waiting: deque[bytes] = deque()
        self._blocks.clear()
        self._due = self._after = self._busy_at = self._running = None
        self._last_number = 0
        self._relative = False
        self._inches = False
        self._feed = 1500.0
        # A restart takes the present motor position as zero. Logical position = native position +
        # shift.
        self._axes.reference = self._axes.motors(now)
        self._commanded = np.zeros(AXES)
        self._shift: Array = np.zeros(AXES)
        for line in ("start", "Marlin 2.1.2.4", "echo: Last Updated: 2024-01-01"):
            self._send_line(line, now)

    def _idle_out(self, now: float) -> None:
        """Cut the motors' power after the idle time; with a limit of 0, the power stays on."""
        if self._due is not None or self._blocks:
            self._rests_since = now
        elif self._idle_limit and self._rests_since is not None:
            ends = self._rests_since + self._idle_limit
            if now >= ends:
                self._axes.disable(ends)

    def _send_line(self, text: str, now: float) -> None:
        self._output.put(text.encode() + b"\n", now)

    # Received lines.

    def _read_line(self, line: bytes, now: float) -> None:
        """Check a line's number and checksum, as Marlin's serial reader does, then queue the
        line."""
        text = line.decode("ascii", "replace").split(";")[0].strip()
        stop = re.match(r"^(M112|M410)\b", text)
        if stop and (stop[1] == "M112" or self.machine.emergency_parser):
            if stop[1] == "M112":
                self._kill("M112 Shutdown", now)
            else:
                self._quick_stop(now)
            return
        if text.startswith("N"):
            found = re.match(r"^N(\d{1,10})", text)
            number = int(found[1]) if found else -1
            is_m110 = "M110" in text
            star = text.rfind("*")
            if star < 0:
                self._line_error("No Checksum with line number", now)
                return
            if not is_m110 and number == self._last_number:
                # Real boards drop a repeated line without an answer.
                if self._checksum_of(text[:star]) == _number_of(text[star + 1 :]):
                    return
            elif not is_m110 and number != self._last_number + 1:
                self._line_error("Line Number is not Last Line Number+1", now)
                return
            if self._checksum_of(text[:star]) != _number_of(text[star + 1 :]):
                self._line_error("checksum mismatch", now)
                return
            self._last_number = number
            text = re.sub(r"^N\d+ ?", "", text[:star]).strip()
        elif "*" in text:
            self._line_error("No Line Number with checksum", now)
            return
        if text and len(self._queue) < 8 * QUEUE_LENGTH:
            self._queue.append(text)

    @staticmethod
    def _checksum_of(text: str) -> int:
        return reduce(lambda value, byte: value ^ byte, text.encode("ascii", "replace"), 0)

    def _line_error(self, why: str, now: float) -> None:
        self._send_line(f"Error:{why}, Last Line: {self._last_number}", now)
        self._send_line(f"Resend: {self._last_number + 1}", now)
        self._send_line("ok", now)

    def _kill(self, why: str, now: float) -> None:
        self._send_line(f"Error:Printer halted. kill() called! {why}", now)
        self._killed = True
        self._queue.clear()
        self._blocks.clear()
        self._busy_at = self._running = None
        self._due, self._after = now + KILL_TIME, self._stand_dead

    def _stand_dead(self, now: float) -> None:
        self._axes.stop_abruptly(now)
        self._axes.disable(now)

    def _quick_stop(self, now: float) -> None:
        self._axes.stop_abruptly(now)
        self._queue.clear()
        self._blocks.clear()
        self._due = self._after = self._busy_at = self._running = None
        self._commanded = self._axes.counted(now)

    # Execution of queued lines.

    def _work(self, now: float) -> None:
        """Execute queued lines until one of them takes time to complete."""
        while not self._killed:
            if self._running is not None:
                if not self._running(now):
                    return
                self._running = self._busy_at = None
                self._send_line("ok", now + LINE_TIME)
            if not self._queue:
                return
            self._run(self._queue.popleft(), now)

    def _run(self, text: str, now: float) -> None:
        code, words = _parse(text)
        if code in ("G0", "G1"):
            self._move(words, now)
            return
        still: dict[str, Callable[[], None]] = {
            "M400": lambda: None,
            "M410": lambda: None,
            "M112": lambda: self._kill("M112 Shutdown", now),
            "G92": lambda: self._set_position(words),
        }
        if code in still:
            act = still[code]

            def rest(at: float) -> bool:
                if self._due is not None or self._blocks:
                    return False
                act()
                return not self._killed

            self._begin(rest, now)
        elif code == "G28":
            self._home(now)
        elif code == "G4":
            self._dwell(words.get("P", 0.0) / 1e3 + words.get("S", 0.0), now)
        else:
            if not self._setting(code, words, now):
                self._send_line(f'echo:Unknown command: "{text}"', now)
            self._send_line("ok", now + LINE_TIME)

    def _begin(self, done: Callable[[float], bool], now: float) -> None:
        """Delay the ``ok`` of a line until ``done`` returns True, and send ``busy`` meanwhile."""
        self._running = done
        self._busy_at = now + BUSY_PERIOD

    def _setting(self, code: str, words: dict[str, float], now: float) -> bool:
        """Execute a code that takes no time; return False for an unknown code."""
        letters = self.machine.letters
        if code in ("G90", "G91"):
            self._relative = code == "G91"
        elif code in ("G20", "G21"):
            self._inches = code == "G20"
        elif code == "M110":
            self._last_number = int(words.get("N", self._last_number))
        elif code == "M114":
            logical = self._commanded + self._shift
            counted = self._axes.counted(now)
            if not self.machine.workspace_offsets:
                counted = counted + self._shift
            counts = np.round(counted * self._steps).tolist()
            place = " ".join(f"{a}:{v:.2f}" for a, v in zip(letters, logical, strict=True))
            count = " ".join(f"{a}:{int(n)}" for a, n in zip(letters, counts, strict=True))
            self._send_line(f"{place} Count {count}", now)
        elif code == "M115":
            self._send_line(
                "FIRMWARE_NAME:Marlin 2.1.2.4 (Jan  1 2024 00:00:00) SOURCE_CODE_URL:"
                "github.com/MarlinFirmware/Marlin PROTOCOL_VERSION:1.0 MACHINE_TYPE:Arm",
                now,
            )
            self._send_line("Cap:SERIAL_XON_XOFF:0", now)
            self._send_line(f"Cap:EMERGENCY_PARSER:{int(self.machine.emergency_parser)}", now)
        elif code in ("M92", "M201", "M203") and not words:
            machine = self.machine
            values = {"M92": machine.steps, "M201": machine.acceleration, "M203": machine.max_rate}
            figures = zip(letters, values[code], strict=True)
            self._send_line(f"echo:  {code}" + "".join(f" {a}{v:.2f}" for a, v in figures), now)
        elif code == "M211" and not words:
            low, high = (
                " ".join(f"{a}{v:.2f}" for a, v in zip(letters, ends, strict=False))
                for ends in (self.machine.soft_low, self.machine.soft_high)
            )
            on = "ON" if self.machine.soft_endstops else "OFF"
            if self.machine.two_lines:
                self._send_line("echo:; Soft endstops:", now)
                self._send_line(f"echo:  M211 S{int(self.machine.soft_endstops)} ; {on}", now)
                self._send_line(f"echo:  Min:  {low}   Max:  {high}", now)
            else:
                self._send_line(f"Soft endstops: {on}  Min: {low}  Max: {high}", now)
        elif code == "M17":
            self._power(now)
        elif code in ("M18", "M84"):
            if "S" in words:
                self._idle_limit = words["S"]
            else:
                self._axes.disable(now)
        elif code == "M220":
            self._feed_percent = words.get("S", self._feed_percent)
        elif code not in ("M105", "M999"):
            return False
        return True

    def _set_position(self, words: dict[str, float]) -> None:
        for axis, letter in enumerate(self.machine.letters):
            if letter in words:
                self._shift[axis] = words[letter] - self._commanded[axis]

    # Motion.

    def _move(self, words: dict[str, float], now: float) -> None:
        scale = 25.4 if self._inches else 1.0
        if words.get("F", 0.0) > 0:
            self._feed = words["F"] * scale
        target = self._commanded.copy()
        for axis, letter in enumerate(self.machine.letters):
            if letter in words:
                value = words[letter] * scale
                target[axis] = target[axis] + value if self._relative else value - self._shift[axis]
        # The firmware computes in whole steps.
        delta = np.abs(np.round(target * self._steps) - np.round(self._commanded * self._steps))
        delta /= self._steps
        length = float(np.linalg.norm(delta))
        if length == 0:
            self._commanded = target
            self._send_line("ok", now + LINE_TIME)
            return
        used = delta > 1e-9 * length
        parts = delta[used] / length
        wanted = self._feed / 60 * length / self._feed_length(delta)
        speed = min(wanted, float(np.min(np.array(self.machine.max_rate)[used] / parts)))
        pull = float(np.min(np.array(self.machine.acceleration)[used] / parts))
        self._commanded = target

        def queue(at: float) -> bool:
            if len(self._blocks) >= PLANNER_BLOCKS:
                return False
            self._blocks.append((target, speed, pull))
            if self._due is None:
                self._start_block(at)
            return True

        self._begin(queue, now)

    def _feed_length(self, delta: Array) -> float:
        """Return the displacement to which the feed refers: that of the linear axes X, Y, Z, or if
        none of them moves, that of the other axes."""
        linear = [axis for axis, letter in enumerate(self.machine.letters) if letter in "XYZ"]
        way = float(np.linalg.norm(delta[linear]))
        return way if way > 0 else float(np.linalg.norm(delta))

    def _start_block(self, now: float) -> None:
        target, speed, pull = self._blocks[0]
        self._power(now)
        exact = np.round(target * self._steps) / self._steps + self._axes.reference
        end = self._axes.move(exact, now, speed * self._feed_percent / 100, pull)
        self._due, self._after = end, self._end_block

    def _end_block(self, now: float) -> None:
        self._blocks.popleft()
        if self._blocks:
            self._start_block(now)

    def _dwell(self, seconds: float, now: float) -> None:
        def rest(at: float) -> bool:
            if self._due is not None or self._blocks:
                return False
            self._due, self._running = at + seconds, lambda later: self._due is None
            return False

        self._begin(rest, now)

    def _home(self, now: float) -> None:
        """Seek the end stops axis by axis, quill first, then set the position to zero."""
        noise = self._rng.normal(0.0, 1.0, AXES) * self._axes.units(self.machine.errors.homing)
        place = self._axes.units(self.machine.home_joints) + noise
        order = [2, 0, 1, 3]
        self._power(now)
        pull = min(self.machine.acceleration)

        def seek(at: float) -> bool:
            if self._due is not None or self._blocks:
                return False
            while order:
                target = self._axes.motors(at).copy()
                target[order[0]] = place[order[0]]
                order.pop(0)
                end = self._axes.move(target, at, self.machine.homing_rate, pull)
                if end > at:
                    self._due = end
                    return False
            self._axes.reference = self._axes.motors(at)
            self._commanded = np.zeros(AXES)
            self._shift = np.zeros(AXES)
            return True

        self._begin(seek, now)


def _number_of(text: str) -> int:
    return int(text) if text.strip().isdigit() and len(text) < 5 else -1


def _parse(text: str) -> tuple[str, dict[str, float]]:
    """Split a line into code and words; words without a valid number are ignored, as in Marlin."""
    found = re.match(r"^([GMT]\d{1,4}(?:\.\d)?)\s*(.*)$", text)
    if found is None:
        return text, {}
    words = {
        letter: float(value)
        for letter, value in re.findall(r"([A-Z])\s*(-?\d+\.?\d*|-?\.\d+)(?=\s|$)", found[2])
    }
    return found[1], words


def make_emulator(
    machine: dict[str, Any], limits: AxisLimits, seed: int, now: float
) -> MarlinEmulator:
    """Create the emulator for a cell (see ``devices.arm_emulator``)."""
    made = MarlinMachine(**machine, max_rate=limits.rates, acceleration=limits.accelerations)
    return MarlinEmulator(made, seed, now)
