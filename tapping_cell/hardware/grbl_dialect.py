"""The Grbl 1.1 family spoken to an arm in joint space."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from tapping_cell.hardware import controller_needs, grbl
from tapping_cell.hardware.axis_units import check_letters
from tapping_cell.hardware.controller_needs import ControllerNeeds
from tapping_cell.hardware.dialect import (
    AXIS_COUNT,
    AxisReading,
    AxisValues,
    Firmware,
    LineCounters,
)
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.transport import Transport

REPLY_TIMEOUT = 0.5
"""Longest wait for an answer to a question, s: a report comes within 10 ms, a `$$` within 100
ms."""
REST_PATIENCE = 15.0
"""Longest wait for another program's last move to end before homing, s."""
EARLY = 0.002
"""A move is asked after so long before its computed end, s: it began while its ``ok`` was on the
line."""
POLL_PERIODS = (0.002, 0.02)
"""Between status questions when a move is due to end, s: the first, and the longest, to which each
further one grows; during the move the controller is left alone."""
LOCKED = {
    "Alarm": "locked by an alarm",
    "Hold": "in a feed hold",
    "Door": "held by its safety door",
    "Sleep": "asleep",
    "Check": "in check mode",
}
"""States in which no motion is taken until the controller is cleared."""
HOMING_SETTINGS = (23, 27, 130, 131, 132, 133)
"""What says where a homing ends: directions, pull-off, travels."""
HOMED_TOLERANCE = 0.05
"""Difference forgiven between the machine position after homing and the expected one, units."""
RESETS = 3
"""Soft resets sent until the banner comes."""
DRAIN_SILENCE = 0.05
"""Silence after which nothing more is expected to be on the line, s."""
DRAIN_ROUNDS = 100
"""Reads after which a board that never falls silent is asked all the same."""
MARK_LINE = b"G18\n"
"""A modal state that changes nothing for straight moves and that every reset forgets: if it is
still there after a reconnect, the controller was not reset."""


@dataclass(frozen=True, slots=True)
class GrblSettings:
    """How the controller is wired, and what its ``$$`` must say."""

    letters: str = "XYZA"
    """Axis letters of shoulder, elbow, quill, tool."""
    expected: Mapping[int, float] = field(default_factory=lambda: {13: 0.0})
    """Settings that must hold, number to value; 13 = 0 means reports in mm and degrees."""
    needs: ControllerNeeds = field(default_factory=ControllerNeeds)
    """What ``$100`` to ``$133`` must allow."""
    home_place: tuple[float, float, float, float] | None = None
    """Machine position after homing, in degrees and mm; None: as Grbl computes it from ``$$``."""

    def __post_init__(self) -> None:
        check_letters(self.letters)


class GrblDialect:
    """One Grbl-family controller; see :class:`~tapping_cell.hardware.dialect.ArmDialect`."""

    def __init__(self, transport: Transport, settings: GrblSettings | None = None) -> None:
        self._transport = transport
        self._settings = settings or GrblSettings()
        self.counters = LineCounters()
        self._buffer = b""
        self._frames: deque[grbl.Frame] = deque()
        self._offset: tuple[float, ...] | None = None
        self._known = False
        self._marked = False
        self._frozen = False
        self._homed_place: tuple[float, ...] = ()
        self._asked = 0.0

    @property
    def stop_bytes(self) -> bytes:
        """Feed hold and soft reset."""
        return grbl.STOP

    def connect(self, deadline: float) -> Firmware:
        """Find out who is there: status, version, settings; refuses what it does not understand."""
        offset = self._offset if self._frozen else None
        self._forget()
        self._known = False
        banner = self._drain() or self._await_first_status(deadline)
        if banner is not None:
            self._await_first_status(deadline)
        version = self._version(deadline, banner)
        self._check_settings(deadline)
        continued = self._marked and banner is None and self._mark_is_there(deadline)
        self._marked = continued
        if continued and offset is not None:
            self._offset, self._frozen = offset, True
        self._known = True
        return Firmware("Grbl", version, continued)

    def read(self, deadline: float) -> AxisReading:
        """Ask for status until two reports in a row agree on the state and the position.

        The line has no checksum; two equal reports make a garbled digit harmless. The work offset
        comes with every 30th report at the latest, so the first reading may take that many.
        """
        last: grbl.Status | None = None
        while True:
            status = self._ask_status(deadline)
            if last is not None and self._agree(last, status):
                return self._reading(status)
            last = status

    def start_move(self, target: AxisValues, feed: float, deadline: float) -> None:
        """Send one move; a lost answer is not repeated: the position read back decides."""
        line = grbl.move_line(self._settings.letters, target, feed)
        try:
            self._command(line, min(deadline, self._transport.now() + REPLY_TIMEOUT))
        except HardwareFault as fault:
            if fault.reason is not FaultReason.TIMEOUT:
                raise
            self.counters.retries += 1

    def finish_move(self, expected_end: float, deadline: float) -> AxisReading:
        """Listen until ``expected_end``, then poll until a report says that the axes rest."""
        while (left := expected_end - EARLY - self._transport.now()) > 0:
            self._pump(left)
        pause, longest = POLL_PERIODS
        while True:
            status = self._ask_status(deadline)
            if status.state == "Alarm":
                raise self._alarm_fault("the controller is in alarm")
            if status.state in LOCKED:
                raise HardwareFault(
                    FaultReason.REJECTED,
                    f"the controller went into {status.state} during a move: look for the cause at"
                    " the cell, then clear the fault",
                )
            if not _moving(status) and self._work_position(status) is not None:
                return self._reading(status)
            self._pump(pause)
            pause = min(2 * pause, longest)

    def idle(self, duration: float) -> None:
        """Listen; a banner or an alarm that comes is raised."""
        self._pump(duration)
        self._frames.clear()

    def home(self, axes: AxisValues | None, deadline: float) -> None:
        """Run ``$H``; the machine position afterwards proves that it ran.

        Neither the line nor its ``ok`` has a checksum: one wrong bit makes ``$X`` of it, which is
        answered with ``ok`` as well. A controller that still makes the last move of a program that
        died refuses ``$H``: it is waited for, but not for ever, for a garbled feed may be tiny.
        """
        patience = min(deadline, self._transport.now() + REST_PATIENCE)
        while _moving(self._ask_status(deadline)) and self._transport.now() < patience:
            self._pump(POLL_PERIODS[1])
        try:
            self._command(b"$H\n", deadline)
        except HardwareFault as fault:
            if fault.reason in (FaultReason.ALARM, FaultReason.REJECTED):
                raise HardwareFault(
                    FaultReason.HOMING_FAILED,
                    f"homing failed: {fault}: check the home switches and $22 to $27",
                ) from fault
            raise
        self._offset, self._frozen = None, False
        while _moving(status := self._ask_status(deadline)):
            self._pump(POLL_PERIODS[1])
        place = status.machine or ()
        if len(place) < AXIS_COUNT or any(
            abs(found - wanted) > HOMED_TOLERANCE
            for found, wanted in zip(place, self._homed_place, strict=False)
        ):
            raise HardwareFault(
                FaultReason.HOMING_FAILED,
                f"after homing the controller stands at {place}, not at {self._homed_place}, where"
                " its settings $23, $27 and $130 to $133 end a homing: home again; if it stays so,"
                " set arm.home_place",
            )
        if axes is not None:
            self.set_position(axes, deadline)

    def set_position(self, axes: AxisValues, deadline: float) -> None:
        """``G92``, which a reset forgets; then the mark that proves no reset happened."""
        self._offset, self._frozen = None, False
        self._command(grbl.set_position_line(self._settings.letters, axes), deadline)
        self._command(MARK_LINE, deadline)
        while self._offset is None:
            self._ask_status(deadline)
        # From here on only the machine position counts: a line that a wrong bit turns into another
        # G92 then shows as an arm that is not where it was sent.
        self._frozen = True
        self._marked = True

    def clear(self, deadline: float) -> None:
        """Soft reset and unlock; the position must be confirmed by homing afterwards."""
        self._forget()
        self._known = False
        self._marked = False
        for _ in range(RESETS):
            self._transport.write(grbl.SOFT_RESET)
            # What the board said before it was reset may still be on the line: wait for the banner.
            if self._await_banner(min(deadline, self._transport.now() + REPLY_TIMEOUT)):
                break
            self.counters.retries += 1
        self._drain()
        self._await_first_status(deadline)
        self._command(b"$X\n", deadline)
        self._offset = None
        self._known = True

    def _forget(self) -> None:
        self._buffer = b""
        self._frames.clear()
        self._offset, self._frozen = None, False

    def _pump(self, wait: float) -> bool:
        """Read for up to ``wait`` s and decode what came; False when nothing came."""
        data = self._transport.read(wait)
        self._buffer += data
        while True:
            decoded = grbl.decode(self._buffer)
            self._buffer = decoded.rest
            if decoded.frame is None:
                return bool(data)
            self._sort(decoded.frame)

    def _sort(self, frame: grbl.Frame) -> None:
        if isinstance(frame, grbl.Bad):
            self.counters.bad_lines += 1
            return
        if isinstance(frame, grbl.Status) and frame.offset is not None and not self._frozen:
            self._offset = frame.offset
        if self._known and isinstance(frame, grbl.Banner):
            self._known = False
            self._marked = False
            raise HardwareFault(
                FaultReason.BOARD_RESET,
                f"the arm's controller on {self._transport.name} restarted: its position is lost;"
                " clear the fault and home again",
            )
        if self._known and isinstance(frame, grbl.Alarm):
            raise self._alarm_fault(
                grbl.ALARMS.get(frame.code, "unknown to this driver"), frame.code
            )
        self._frames.append(frame)

    def _next(self, deadline: float, waiting_for: str) -> grbl.Frame:
        while not self._frames:
            left = deadline - self._transport.now()
            if left <= 0:
                self.counters.timeouts += 1
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"no {waiting_for} from the arm's controller on {self._transport.name} in time:"
                    " check power, cable and baud rate",
                )
            self._pump(left)
        return self._frames.popleft()

    def _ask_status(self, deadline: float) -> grbl.Status:
        """One report, asked for as often as reports get lost; older answers are dropped first."""
        self._pump(0.0)
        self._frames.clear()
        while True:
            self._asked = self._transport.now()
            self._transport.write(grbl.STATUS_QUERY)
            until = min(deadline, self._asked + REPLY_TIMEOUT)
            try:
                while True:
                    frame = self._next(until, "status report")
                    if isinstance(frame, grbl.Status):
                        return frame
            except HardwareFault as fault:
                if fault.reason is not FaultReason.TIMEOUT or until >= deadline:
                    raise
                self.counters.retries += 1

    def _command(self, line: bytes, deadline: float) -> list[grbl.Frame]:
        """Send one line, wait for its ``ok``, return what came before it."""
        self._pump(0.0)
        self._frames.clear()
        self._transport.write(line)
        heard: list[grbl.Frame] = []
        while True:
            frame = self._next(deadline, f"answer to {line.decode().strip()!r}")
            if isinstance(frame, grbl.Ok):
                return heard
            if isinstance(frame, grbl.Error):
                meaning = grbl.ERRORS.get(frame.code, "see the controller's documentation")
                reason = FaultReason.ALARM if frame.code == 9 else FaultReason.REJECTED
                raise HardwareFault(
                    reason,
                    f"the controller refused {line.decode().strip()!r} with error {frame.code}:"
                    f" {meaning}",
                )
            heard.append(frame)

    def _await_first_status(self, deadline: float) -> grbl.Banner | None:
        """Ask until a report comes; a banner on the way is kept: it says the board was reset."""
        banner: grbl.Banner | None = None
        while True:
            self._transport.write(grbl.STATUS_QUERY)
            until = min(deadline, self._transport.now() + 0.2)
            try:
                while True:
                    frame = self._next(until, "status report")
                    if isinstance(frame, grbl.Banner):
                        banner = frame
                    elif isinstance(frame, grbl.Status):
                        return banner
            except HardwareFault as fault:
                if fault.reason is not FaultReason.TIMEOUT:
                    raise
                if until >= deadline:
                    raise HardwareFault(
                        FaultReason.UNKNOWN_FIRMWARE,
                        f"nothing on {self._transport.name} answers like a Grbl controller"
                        f" ({self.counters.bad_lines} unreadable lines): check the port, the baud"
                        " rate and the dialect parameter",
                    ) from fault
                self.counters.retries += 1

    def _await_banner(self, until: float) -> bool:
        """Wait for the greeting that follows a reset."""
        while self._transport.now() < until:
            self._pump(until - self._transport.now())
            while self._frames:
                if isinstance(self._frames.popleft(), grbl.Banner):
                    return True
        return False

    def _drain(self) -> grbl.Banner | None:
        """Let what is on the line run out, so that old answers are not taken for new ones."""
        banner: grbl.Banner | None = None
        for _ in range(DRAIN_ROUNDS):
            heard = self._pump(DRAIN_SILENCE)
            while self._frames:
                frame = self._frames.popleft()
                if isinstance(frame, grbl.Banner):
                    banner = frame
            if not heard:
                break
        return banner

    def _retried(self, line: bytes, deadline: float) -> list[grbl.Frame]:
        """A question that may be asked again: three tries, each as long as a reply takes."""
        for attempt in range(3):
            try:
                return self._command(line, min(deadline, self._transport.now() + REPLY_TIMEOUT))
            except HardwareFault as fault:
                last = attempt == 2 or self._transport.now() >= deadline
                if fault.reason not in (FaultReason.TIMEOUT, FaultReason.REJECTED) or last:
                    raise
                self.counters.retries += 1
        raise AssertionError("unreachable")

    def _version(self, deadline: float, banner: grbl.Banner | None) -> str:
        heard = self._retried(b"$I\n", deadline)
        for frame in heard:
            if isinstance(frame, grbl.Message) and frame.kind == "VER":
                version = frame.text.split(":")[0]
                if not version.startswith("1.1") and not version.startswith("3."):
                    raise HardwareFault(
                        FaultReason.UNKNOWN_FIRMWARE,
                        f"Grbl version {version!r} is not understood: this driver speaks 1.1 (and"
                        " FluidNC 3)",
                    )
                return version
        if banner is not None:
            return banner.version
        raise HardwareFault(
            FaultReason.UNKNOWN_FIRMWARE,
            f"the controller on {self._transport.name} answers but names no Grbl version: check the"
            " dialect parameter",
        )

    def _check_settings(self, deadline: float) -> None:
        heard = self._retried(b"$$\n", deadline)
        found = {frame.number: frame.value for frame in heard if isinstance(frame, grbl.Setting)}
        missing = [f"${number}" for number in HOMING_SETTINGS if number not in found]
        if self._settings.home_place is None and missing:
            raise HardwareFault(
                FaultReason.SETTINGS_MISMATCH,
                f"the controller does not list {', '.join(missing)} in its $$: connect again; if it"
                " stays so, set arm.home_place",
            )
        self._homed_place = self._settings.home_place or _homed_place(found)
        wrong = [
            f"${number} is {found[number]:g}, must be {value:g}"
            if number in found
            else f"${number} is missing, must be {value:g}"
            for number, value in self._settings.expected.items()
            if number not in found
            or abs(found[number] - value) > controller_needs.TOLERANCE * max(abs(value), 1.0)
        ]
        controller_needs.refuse(wrong + self._unmet(found))

    def _unmet(self, found: Mapping[int, float]) -> list[str]:
        """What the controller's steps, rates, accelerations and travels do not allow."""
        needs = self._settings.needs

        def four(first: int) -> tuple[list[str], list[float]]:
            numbers = [first + axis for axis in range(AXIS_COUNT)]
            listed = all(number in found for number in numbers)
            return [f"${n}" for n in numbers], [found[n] for n in numbers] if listed else []

        unmet = controller_needs.exactly(*four(100), needs.steps)
        # Grbl's rates are in units/min.
        per_minute = None
        if needs.speed is not None:
            a, b, c, d = needs.speed
            per_minute = (60 * a, 60 * b, 60 * c, 60 * d)
        unmet += controller_needs.at_least(*four(110), per_minute)
        unmet += controller_needs.at_least(*four(120), needs.acceleration)
        if found.get(20, 0.0):
            unmet += controller_needs.at_least(*four(130), needs.travel)
        return unmet

    def _mark_is_there(self, deadline: float) -> bool:
        heard = self._retried(b"$G\n", deadline)
        return any(
            isinstance(frame, grbl.Message) and frame.kind == "GC" and "G18" in frame.text.split()
            for frame in heard
        )

    def _reading(self, status: grbl.Status) -> AxisReading:
        position = self._work_position(status) or ()
        if len(position) < AXIS_COUNT:
            raise HardwareFault(
                FaultReason.UNKNOWN_FIRMWARE,
                f"the controller reports {len(position)} axes, {AXIS_COUNT} are needed: build its"
                f" firmware with {AXIS_COUNT} axes",
            )
        alarm = LOCKED.get(status.state, "")
        axes = AxisValues(*position[:AXIS_COUNT])
        return AxisReading(axes, _moving(status), alarm, True, self._asked)

    def _agree(self, first: grbl.Status, second: grbl.Status) -> bool:
        """Whether two reports confirm each other: on the move, or at rest in the same place."""
        if self._work_position(second) is None:
            return False
        if _moving(first) and _moving(second):
            return True
        return (
            first.state == second.state
            and first.machine == second.machine
            and (first.work == second.work or first.machine is not None)
        )

    def _work_position(self, status: grbl.Status) -> tuple[float, ...] | None:
        """The position in our own zero; None while the offset has not been heard."""
        if status.work is not None:
            return status.work
        if status.machine is None or self._offset is None:
            return None
        return tuple(m - o for m, o in zip(status.machine, self._offset, strict=False))

    def _alarm_fault(self, meaning: str, code: int | None = None) -> HardwareFault:
        number = "" if code is None else f" {code}"
        return HardwareFault(
            FaultReason.ALARM,
            f"alarm{number} of the arm's controller: {meaning}: make the cell safe, clear the fault"
            " and home again",
        )


def _homed_place(settings: Mapping[int, float]) -> tuple[float, ...]:
    """Where Grbl says the axes are after homing: pulled off ($27) from the end that $23 names."""
    if any(number not in settings for number in HOMING_SETTINGS):
        return ()
    mask, pull_off = int(settings[23]), settings[27]
    return tuple(
        pull_off - settings[130 + axis] if mask >> axis & 1 else -pull_off
        for axis in range(AXIS_COUNT)
    )


def _moving(status: grbl.Status) -> bool:
    return status.state in ("Run", "Jog", "Home") or (
        status.state == "Hold" and status.substate != 0
    )
