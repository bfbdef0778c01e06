"""Emulator of a Grbl 1.1 controller with an arm: a state machine in simulated time.

It follows Grbl's documentation and has its own line parser, independent of the driver's codec.
Real-time bytes take effect immediately, and lines wait for space in the planner buffer. Each move
has a trapezoidal velocity profile within the rates and accelerations of the axes, and every move
ends at rest. Unsupported commands are rejected with Grbl's error number, never silently accepted.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tapping_cell.simulation.arm_emulator import ArmEmulator, AxisLimits
from tapping_cell.simulation.device_emulator import earliest
from tapping_cell.simulation.grbl_machine import GrblMachine, default_settings
from tapping_cell.simulation.grbl_program import Line, Modal, Refused, read_line
from tapping_cell.simulation.joint_motion import Array
from tapping_cell.simulation.motor_axes import AXES

RECEIVE_BUFFER = 128
"""Size of the receive buffer; further bytes are lost (Grbl's RX_BUFFER_SIZE)."""
PLANNER_BLOCKS = 15
LINE_LENGTH = 80
"""Maximum length of a line (Grbl's LINE_BUFFER_SIZE)."""
LINE_TIME = 0.001
"""Processing time of a line, s."""
HOLD = 255
"""Value of the hold setting (``$1`` in Grbl) at which the motors always keep their torque."""


@dataclass(slots=True)
class _Block:
    """A planned move: target in machine units, speed in units/s, acceleration in units/s2."""

    target: Array
    speed: float
    acceleration: float
    jog: bool


class GrblEmulator(ArmEmulator):
    """One emulated board with its arm."""

    def __init__(self, machine: GrblMachine | None = None, seed: int = 0, now: float = 0.0) -> None:
        self.machine = machine or GrblMachine()
        super().__init__(self.machine, seed)
        self._variant = self.machine.variant
        self._settings = default_settings(self._variant) | self.machine.settings
        self._names = dict(self._variant.names)
        self._homed = False
        self.finds_switches = True
        """Whether homing finds the home switches; otherwise it ends with alarm 9."""
        self._boots_until: float | None = None
        self._feed_override = 100
        self._waiting_for_block: Callable[[float], None] | None = None
        self._waiting_for_rest: Callable[[float], None] | None = None
        self._systems = {number: np.zeros(AXES) for number in range(54, 60)}
        self._restart(now, hard=True)

    # Interface to the simulated world.

    def enter_sleep(self, now: float) -> None:
        """Cut the motors' power and end any move, as ``$SLP`` from another sender does."""
        self._axes.freeze(now)
        self._blocks.clear()
        self._state = "Sleep"
        self._axes.disable(now)

    def push(self, joints: tuple[float, float, float, float], now: float) -> None:
        """Simulate a person who pushes the resting, unpowered arm to ``joints``. The controller
        does not detect this motion."""
        self.advance(now)
        self._axes.push(joints, now)

    def hit_limit(self, now: float) -> None:
        """Close a limit switch; this causes alarm 1."""
        self.advance(now)
        self._alarm(1, now)

    # DeviceEmulator interface.

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes; real-time bytes are processed immediately."""
        self.advance(now)
        for byte in data:
            if byte == 0x18:
                self._soft_reset(now)
            elif byte == ord("?"):
                if self._busy != "Home" or self._variant.reports_while_homing:
                    self._report(now)
            elif byte == ord("!"):
                self._hold(now)
            elif byte == ord("~"):
                self._resume(now)
            elif byte == 0x85:
                self._cancel_jog(now)
            elif byte == 0x90:
                self._feed_override = 100
            elif byte == 0x92:
                self._feed_override = max(self._feed_override - 10, 10)
            elif byte < 0x80 and len(self._received) < RECEIVE_BUFFER:
                self._received.append(byte)
        self._work(now)

    def advance(self, now: float) -> None:
        """Process all events that are due by ``now``."""
        while self._due is not None and self._due <= now:
            due, self._due = self._due, None
            after, self._after = self._after, None
            if after is not None:
                after(due)
            self._work(due)
        if self._boots_until is not None and self._boots_until <= now:
            booted, self._boots_until = self._boots_until, None
            self._greet(booted)
        self._idle_out(now)

    def next_event(self) -> float | None:
        """Return the time when the next motion or transmission ends."""
        return earliest(self._due, self._boots_until, self._output.next_time())

    def power_cycle(self, now: float) -> None:
        """Cycle the power; the arm stays in place and all volatile state is lost."""
        self.advance(now)
        self._axes.freeze(now)
        self._axes.reference = self._axes.motors(now)
        self._output.clear()
        self._restart(now, hard=True)

    # Reset and alarms.

    def _restart(self, now: float, hard: bool, delay: float = 0.0) -> None:
        self._received = bytearray()
        self._blocks: deque[_Block] = deque()
        self._parser_position = self._machine_position(now)
        self._modal = Modal()
        self._shift = np.zeros(AXES)
        self._held = False
        self._busy = ""
        self._due = self._after = None
        self._waiting_for_block = self._waiting_for_rest = None
        self._present_acceleration = 1.0
        self._reports = 0
        self._feed_override = 100
        if hard:
            self._state = "Alarm" if int(self._settings[22]) & 1 else "Idle"
            self._homed = False
            self._boots_until = None
        self._power(now)
        if delay:
            self._boots_until = now + delay
        else:
            self._greet(now)

    def _greet(self, now: float) -> None:
        """Send the greeting; lines received while the board started are lost."""
        self._received.clear()
        self._output.put(self._variant.banner, now)
        if self._state != "Alarm":
            return
        self._output.put(b"[MSG:'$H'|'$X' to unlock]\r\n", now)
        if self._variant.unhomed_alarm is not None and not self._homed:
            self._output.put(b"ALARM:%d\r\n" % self._variant.unhomed_alarm, now)

    # Torque.

    def _hold_setting(self) -> float:
        name = self._variant.hold_name
        return float(self._names[name]) if name else self._settings[1]

    def _idle_out(self, now: float) -> None:
        """Cut the motors' power once they have been idle for the time of Grbl's setting ``$1``."""
        if self._due is not None or self._blocks:
            self._rests_since = None
            return
        if self._rests_since is None:
            self._rests_since = now
        hold = self._hold_setting()
        if hold != HOLD and now >= self._rests_since + hold / 1e3:
            self._axes.disable(self._rests_since + hold / 1e3)

    def _soft_reset(self, now: float) -> None:
        homing = self._busy == "Home"
        delay = 0.0
        if self._axes.stop_abruptly(now):
            self._state = "Alarm"
            self._output.put(b"ALARM:6\r\n" if homing else b"ALARM:3\r\n", now)
            delay = self._variant.reset_delay
            self._homed = False
        elif self._state != "Alarm":
            self._state = "Idle"
        self._restart(now, hard=False, delay=delay)

    def _alarm(self, code: int, now: float) -> None:
        self._axes.freeze(now)
        self._blocks.clear()
        self._busy = ""
        self._due = self._after = self._waiting_for_block = self._waiting_for_rest = None
        self._state = "Alarm"
        self._homed = False
        if self._variant.alarm_cuts_torque:
            self._axes.disable(now)
        self._output.put(b"ALARM:%d\r\n" % code, now)

    # Real-time commands.

    def _shown_state(self, now: float) -> str:
        if self._state in ("Alarm", "Check", "Sleep"):
            return self._state
        if self._held:
            return "Hold:1" if self._axes.moving(now) else "Hold:0"
        if self._busy:
            return self._busy
        return "Run" if self._blocks or self._due is not None else "Idle"

    def _report(self, now: float) -> None:
        machine, offset = self._machine_position(now), self._work_offset()
        place = (
            f"MPos:{self._shown(machine)}"
            if int(self._settings[10]) & 1
            else f"WPos:{self._shown(machine - offset)}"
        )
        fields = [self._shown_state(now), place, "FS:0,0"]
        bit = self._variant.offset_bit
        if self._reports == 0 and (not bit or int(self._settings[10]) & bit):
            fields.append("WCO:" + self._shown(offset))
            self._reports = 30 if fields[0] == "Idle" else 10
        else:
            self._reports = max(self._reports - 1, 0)
            if self._reports == 1:
                fields.append(f"Ov:{self._feed_override},100,100")
        self._output.put(f"<{'|'.join(fields)}>\r\n".encode(), now)

    def _shown(self, values: Array) -> str:
        """Format axis values as in a status report, for all axes of the firmware build."""
        padded = [*(values + 0.0).tolist(), *[0.0] * self._variant.axes][: self._variant.axes]
        return ",".join(f"{value:.3f}" for value in padded)

    def _hold(self, now: float) -> None:
        if self._busy not in ("Run", "Jog") or self._held or self._state != "Idle":
            return
        self._held = True
        self._due = self._axes.brake(now, self._present_acceleration)
        self._after = None
        if self._busy == "Jog":
            self._blocks.clear()

    def _resume(self, now: float) -> None:
        if not self._held or self._axes.moving(now):
            return
        self._held = False
        if self._blocks:
            self._begin(now)
        else:
            self._finish_block(now)

    def _cancel_jog(self, now: float) -> None:
        if self._busy == "Jog":
            self._blocks.clear()
            self._due = self._axes.brake(now, self._present_acceleration)
            self._after = self._finish_block

    # Lines.

    def _work(self, now: float) -> None:
        """Process received lines until one has to wait."""
        while self._waiting_for_block is None and self._waiting_for_rest is None:
            end = next((i for i, b in enumerate(self._received) if b in b"\r\n"), None)
            if end is None:
                return
            line = bytes(self._received[:end])
            del self._received[: end + 1]
            try:
                if len(line) > LINE_LENGTH:
                    raise Refused(14)
                self._take(line.decode("ascii", "replace"), now)
            except Refused as refused:
                self._output.put(b"error:%d\r\n" % refused.code, now + LINE_TIME)

    def _ok(self, now: float) -> None:
        self._output.put(b"ok\r\n", now + LINE_TIME)

    def _take(self, text: str, now: float) -> None:
        text = re.sub(r"\([^)]*\)|;.*", "", text).replace(" ", "").upper()
        if not text:
            self._ok(now)
        elif text.startswith("$"):
            self._system(text, now)
        elif self._state in ("Alarm", "Sleep"):
            raise Refused(9)
        else:
            self._gcode(text, now, jog=False)

    def _system(self, text: str, now: float) -> None:
        idle = self._shown_state(now) in ("Idle", "Alarm", "Check")
        send = self._output.put
        if text in ("$$", "$I", "$#") and not idle:
            # While the axes move, real firmware refuses these commands, but not $G.
            raise Refused(8)
        if text == "$$":
            for number, value in sorted(self._listed().items()):
                real = number >= 100 or number in (11, 12, 24, 25, 27)
                shown = f"{value:.3f}" if real else f"{value:g}"
                send(f"${number}={shown}\r\n".encode(), now)
        elif text == "$I":
            for line in self._variant.information:
                send(line + b"\r\n", now)
        elif text == "$G":
            send(f"[GC:{self._modal}]\r\n".encode(), now)
        elif text == "$#":
            for system, place in self._systems.items():
                send(f"[G{system}:{','.join(f'{v:.3f}' for v in place)}]\r\n".encode(), now)
            send(f"[G92:{','.join(f'{v:.3f}' for v in self._shift)}]\r\n".encode(), now)
        elif text == "$X":
            bit = self._variant.locked_until_homed_bit
            if self._state == "Alarm" and int(self._settings[22]) & bit and not self._homed:
                raise Refused(46)
            if self._state == "Alarm":
                self._state = "Idle"
                self._power(now)
                send(b"[MSG:Caution: Unlocked]\r\n", now)
        elif text == "$H":
            if not int(self._settings[22]) & 1:
                raise Refused(5)
            if not idle:
                raise Refused(8)
            self._home(now)
            return
        elif text == "$SLP":
            self.enter_sleep(now)
        elif text.startswith("$J="):
            if self._shown_state(now) not in ("Idle", "Jog"):
                raise Refused(9)
            self._gcode(text[3:], now, jog=True)
            return
        elif found := re.fullmatch(r"\$(/[A-Z_/]+)(?:=(.+))?", text):
            self._named(found[1].lower(), found[2], now)
        elif found := re.fullmatch(r"\$(\d{1,3})=(-?[\d.]+)", text):
            if not idle:
                raise Refused(8)
            if int(found[1]) not in self._settings:
                raise Refused(3)
            try:
                self._settings[int(found[1])] = float(found[2])
            except ValueError:
                raise Refused(2) from None
        else:
            raise Refused(3)
        self._ok(now)

    def _listed(self) -> dict[int, float]:
        """Return the settings that ``$$`` lists; the settings per axis are listed for all axes of
        the firmware build."""
        variant = self._variant
        shown = {}
        for number, value in self._settings.items():
            is_mask = 44 <= number <= 47
            if number in variant.unlisted or (is_mask and number not in variant.homing_masks):
                continue
            if number >= 100 and number % 10 >= variant.axes:
                continue
            shown[number] = value
        return shown

    def _named(self, name: str, value: str | None, now: float) -> None:
        """Report or set a named setting."""
        if name not in self._names:
            raise Refused(3)
        if value is None:
            self._output.put(f"${name}={self._names[name]}\r\n".encode(), now)
        else:
            self._names[name] = value.lower()

    def _gcode(self, text: str, now: float, jog: bool) -> None:
        letters = self.machine.letters[: self._variant.axes]
        line = read_line(text, letters, self._modal)
        modal, axes = line.modal, line.axes
        if jog and (line.action is not None or not axes or line.feed is None):
            raise Refused(16)
        if line.action == 4:
            self._modal = modal
            self._when_still(now, lambda at: self._dwell(line.pause, at))
            return
        if line.action == 92:
            if not axes:
                raise Refused(26)
            for axis, place in axes.items():
                self._shift[axis] = (
                    self._parser_position[axis] - self._systems[modal.system][axis] - place
                )
            self._modal = modal
            self._reports = 0
            self._ok(now)
            return
        if line.action == 92.1:
            self._shift = np.zeros(AXES)
            self._reports = 0
        if axes:
            self._plan(line, jog, now)
            return
        if modal.system != self._modal.system:
            self._reports = 0
        self._modal = modal
        self._ok(now)

    def _plan(self, line: Line, jog: bool, now: float) -> None:
        """Queue a straight move, or wait for space in the planner buffer."""
        modal, axes, feed = line.modal, line.axes, line.feed
        machine_frame = line.action == 53
        target = self._parser_position.copy()
        offset = np.zeros(AXES) if machine_frame else self._systems[modal.system] + self._shift
        for axis, value in axes.items():
            target[axis] = target[axis] + value if modal.incremental else value + offset[axis]
        rapid = modal.motion == 0 and not jog
        if not rapid and (modal.feed <= 0 or (modal.inverse_time and feed is None)):
            raise Refused(22)
        if self._settings[20]:
            travels = self._per_axis(130)
            if np.any(target > 1e-9) or np.any(target < -travels - 1e-9):
                if jog:
                    raise Refused(15)
                self._alarm(2, now)
                raise Refused(9)
        block = self._block(modal, target, rapid, jog)
        if not jog:
            self._modal = modal
        self._parser_position = target
        if block is None:
            self._ok(now)
            return

        def enqueue(at: float) -> None:
            self._blocks.append(block)
            self._ok(at)
            if self._due is None and not self._held:
                self._begin(at)

        if len(self._blocks) >= PLANNER_BLOCKS:
            self._waiting_for_block = enqueue
        else:
            enqueue(now)

    def _block(self, modal: Modal, target: Array, rapid: bool, jog: bool) -> _Block | None:
        """Return a block at the programmed feed rate, limited by each axis's maximum rate and
        acceleration."""
        start = self._parser_position
        delta = target - start
        length = float(np.linalg.norm(delta))
        if length == 0:
            return None
        unit = np.abs(delta) / length
        rates = self._per_axis(110) / 60
        pulls = self._per_axis(120)
        used = unit > 1e-12
        speed = float(np.min(rates[used] / unit[used]))
        if not rapid:
            asked = modal.feed * length if modal.inverse_time else modal.feed
            speed = min(speed, asked / 60)
        return _Block(target, speed, float(np.min(pulls[used] / unit[used])), jog)

    # Motion.

    def _begin(self, now: float) -> None:
        block = self._blocks[0]
        self._power(now)
        speed = block.speed * self._feed_override / 100
        self._busy = "Jog" if block.jog else "Run"
        self._present_acceleration = block.acceleration
        steps = self._per_axis(100)
        target = np.round(block.target * steps) / steps
        self._due = self._axes.move(target + self._axes.reference, now, speed, block.acceleration)
        self._after = self._finish_block

    def _finish_block(self, now: float) -> None:
        if self._blocks:
            self._blocks.popleft()
        else:
            # After a cancelled move, the parser continues from the position of the axes.
            self._parser_position = self._machine_position(now)
        self._busy = ""
        waiting = self._waiting_for_block or (None if self._blocks else self._waiting_for_rest)
        if self._blocks:
            self._begin(now)
        if waiting is not None:
            self._waiting_for_block = self._waiting_for_rest = None
            waiting(now)

    def _when_still(self, now: float, act: Callable[[float], None]) -> None:
        """Call ``act`` when all queued moves are finished."""
        if self._due is None and not self._blocks:
            act(now)
        else:
            self._waiting_for_rest = act

    def _dwell(self, seconds: float, now: float) -> None:
        self._waiting_for_rest = _nothing
        self._busy = "Run"

        def done(at: float) -> None:
            self._busy = ""
            self._waiting_for_rest = None
            self._ok(at)

        self._due, self._after = now + seconds, done

    def _home(self, now: float) -> None:
        """Seek the home switches axis by axis (quill first), pull off, and set the machine
        position."""
        self._state, self._busy = "Idle", "Home"
        self._power(now)
        self._waiting_for_rest = _nothing
        errors = self.machine.errors
        noise = self._rng.normal(0.0, 1.0, AXES) * self._axes.units(errors.homing)
        place = self._axes.units(self.machine.home_joints) + noise
        pull_off = self._settings[27]
        seek, slow = self._settings[25] / 60, self._settings[24] / 60
        homing = [axis for axis in (2, 0, 1, 3) if self._homes(axis)]
        steps: list[tuple[Array, float]] = []
        here = self._axes.motors(now).copy()
        for axis in homing:
            for value, speed in (
                (place[axis] + pull_off, seek),
                (place[axis], slow),
            ):
                here = here.copy()
                here[axis] = value
                steps.append((here, speed))

        def following(at: float) -> None:
            if not self.finds_switches:
                # Real firmware then resets itself.
                self._alarm(9, at)
                self._restart(at, hard=False, delay=self._variant.reset_delay)
                return
            while steps:
                target, speed = steps.pop(0)
                acceleration = float(np.min(self._per_axis(120)))
                end = self._axes.move(target, at, speed, acceleration)
                if end > at:
                    self._present_acceleration = acceleration
                    self._due, self._after = end, following
                    return
            homed = self._machine_position(at)
            homed[homing] = self._homed_place()[homing]
            self._axes.reference = self._axes.motors(at) - homed
            self._parser_position = homed
            self._busy = ""
            self._homed = True
            self._waiting_for_rest = None
            self._ok(at)

        following(now)

    def _homes(self, axis: int) -> bool:
        variant = self._variant
        if variant.homing_masks:
            return any(int(self._settings[n]) >> axis & 1 for n in variant.homing_masks)
        if variant.ends_at_place:
            letter = self.machine.letters[axis].lower()
            return int(self._names[f"/axes/{letter}/homing/cycle"]) > 0
        return axis not in variant.unhomed_axes

    def _homed_place(self) -> Array:
        """Return the machine position at the end of homing."""
        variant = self._variant
        if variant.ends_at_place:
            names = [f"/axes/{letter.lower()}/homing/mpos_mm" for letter in self.machine.letters]
            return np.array([float(self._names[name]) for name in names])
        if variant.forces_origin or (variant.homing_masks and int(self._settings[22]) & 8):
            return np.zeros(AXES)
        pull_off = self._settings[27]
        toward_low = (int(self._settings[23]) >> np.arange(AXES)) & 1 == 1
        return np.where(toward_low, pull_off - self._per_axis(130), -pull_off)

    def _per_axis(self, first: int) -> Array:
        """Return four consecutive settings, one per axis."""
        return np.array([self._settings[first + axis] for axis in range(AXES)], dtype=float)

    def _machine_position(self, now: float) -> Array:
        steps = self._per_axis(100)
        counts = np.round(self._axes.counted(now) * steps)
        return np.asarray(counts / steps, dtype=float)

    def _work_offset(self) -> Array:
        return np.asarray(self._systems[self._modal.system] + self._shift, dtype=float)


def _nothing(now: float) -> None:
    """Do nothing. This action is used during a dwell and during homing, because both end the wait
    themselves. While an action waits, no further lines are processed."""


def make_emulator(
    machine: dict[str, Any], limits: AxisLimits, seed: int, now: float
) -> GrblEmulator:
    """Create the emulator for a cell (see ``devices.arm_emulator``)."""
    settings = default_settings()
    for axis, (rate, acceleration, travel) in enumerate(zip(*limits, strict=True)):
        # Grbl's rates are in units/min.
        settings[110 + axis], settings[120 + axis] = 60 * rate, acceleration
        settings[130 + axis] = travel
    return GrblEmulator(GrblMachine(**machine, settings=settings), seed, now)
