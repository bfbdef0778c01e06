"""Marlin 2 dialect: one numbered line in flight at a time, and no line is executed twice."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from tapping_cell.hardware import controller_needs, marlin
from tapping_cell.hardware.axis_units import check_letters
from tapping_cell.hardware.controller_needs import ControllerNeeds
from tapping_cell.hardware.controllers import ControllerWiring
from tapping_cell.hardware.dialect import AXIS_COUNT, Axes, AxisReading, Firmware
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.line_dialect import LineDialect
from tapping_cell.hardware.transport import Transport

SILENCE = 2.5
"""Longest silence after a line that takes long (``LONG_CODES``), s. While the board processes such
a line, it sends ``busy`` about every 2 s."""
SHORT_SILENCE = 0.6
"""Longest silence after any other line, s; such a line is answered immediately."""
LONG_CODES = ("M400", "G28")
REPEAT_SILENCE = 0.4
"""Longest silence after a line is resent, s. This time is short, because the board does not answer
a resent line that it has already accepted."""
DRAIN_SILENCE = 0.05
"""Time without received bytes after which the line counts as drained, s."""
POLL_PERIOD = 0.02
"""Time between position queries while the last steps of a move are made, s."""
REST_S = 0.2
"""The arm counts as at rest if two queries, this time apart (s), return the same step counts. Even
a slow move makes a step in this time."""
EARLY = 0.003
"""Time before the computed end of a move at which polling starts, s. Polling starts early because a
move starts before its ``ok`` arrives."""
FIRST_NUMBERS = (1000, 100_000_000)
"""Range of the first line number; a board that was reset counts from 0 instead."""
RESET_PAUSE = 0.5
"""Time for which the port stays closed, so that its DTR line resets a halted board, s."""
Answer = TypeVar("Answer")
NO_EMERGENCY_PARSER = (
    "this Marlin is built without EMERGENCY_PARSER: a stop halts it (M112) until its board is reset"
)
SET = "{name}{value}, then M500"
"""Command that sets and stores a value."""
PREPARATION = ("G21", "G90", "M220 S100", "M84 S0", "M17")
"""Codes sent at every connect: mm, absolute positions, no speed override, no idle timeout of the
motors, motors on."""
SAME = 0.03
"""Distance between a sent and a reported target that its rounding can cause, units."""
RECOVERIES = 8
"""Maximum number of times that a line is resent before the connection counts as lost."""
KEPT_LINES = 4
"""Number of sent lines that can be repeated if the board requests them."""
IDENTIFICATIONS = 6
"""Maximum number of ``M115`` queries until two consecutive answers agree."""


@dataclass(frozen=True, slots=True)
class MarlinSettings:
    """Wiring of the controller and requirements on its settings."""

    letters: str = "XYZA"
    """Axis letters of shoulder, elbow, quill, tool."""
    needs: ControllerNeeds = field(default_factory=ControllerNeeds)
    """Requirements on M92, M201, M203 and M211, if the firmware reports them."""

    def __post_init__(self) -> None:
        check_letters(self.letters)


class MarlinDialect(LineDialect[marlin.Frame]):
    """Driver of one Marlin controller; see :class:`~tapping_cell.hardware.dialect.ArmDialect`."""

    def __init__(
        self,
        transport: Transport,
        settings: MarlinSettings | None = None,
        draw_number: Callable[[int], int] = secrets.randbelow,
    ) -> None:
        super().__init__(transport, marlin.decode)
        self._settings = settings or MarlinSettings()
        self._draw_number = draw_number
        self._number = 0
        self._answered_before = False
        self._renumberings = 0
        self._sent: dict[int, bytes] = {}
        self._connected = False
        self._halted_why = ""
        self._emergency_parser = False
        self._steps: dict[str, float] = {}
        self._offset: dict[str, float] = {}
        """Reported position minus step counts, in axis units, while the arm is at rest. It is not 0
        if the firmware has a workspace offset (``G92``) or a home offset (``M206``)."""
        self._target: Axes | None = None
        """Target of the last move; None if the present target is not known."""

    @property
    def stop_bytes(self) -> bytes:
        """``M410`` if the firmware has the emergency parser, else ``M112``; both unnumbered."""
        return marlin.QUICK_STOP if self._emergency_parser else marlin.KILL

    @property
    def opening_stop_bytes(self) -> bytes:
        """``M410``. ``M112`` would halt a board at rest until its reset button is pressed. Without
        the emergency parser, the arm completes the moves that the board has accepted."""
        return marlin.QUICK_STOP

    def connect(self, deadline: float) -> Firmware:
        """Identify the firmware, detect a reset from the line numbers, and set the modes.

        A board that answered before and is silent on a newly opened port is halted: NEEDS_PERSON.
        """
        firmware, findings = self.inspect(deadline)
        controller_needs.refuse(findings)
        self._prepare(deadline)
        if not firmware.continued:
            self._offset = self._offset_before_homing(deadline)
        self._connected = True
        return firmware

    def inspect(self, deadline: float) -> tuple[Firmware, list[Finding]]:
        """Identify the firmware and compare its settings with the required ones; nothing moves."""
        self._buffer = b""
        self._frames.clear()
        self._connected = False
        self._halted_why = ""
        continued = self._number > 0 and self._keeps_count(deadline)
        try:
            self._begin_numbers(deadline)
        except HardwareFault as fault:
            if self._answered_before and fault.reason is FaultReason.UNKNOWN_FIRMWARE:
                raise self._halt_fault() from fault
            raise
        name = self._identify(deadline)
        self._answered_before = True
        self._steps = self._figures("M92", deadline)
        findings = self._compare(deadline)
        remarks = () if self._emergency_parser else (NO_EMERGENCY_PARSER,)
        return Firmware("Marlin", name, continued, remarks), findings

    def store(self, finding: Finding, deadline: float) -> None:
        """Raise ValueError: a person must correct every finding of this dialect. The torque at
        standstill is never a finding, because it is set at every connect."""
        raise ValueError(f"{finding.setting} must be set by a person")

    def _prepare(self, deadline: float) -> None:
        """Set absolute positions in mm, full speed, and motors that always keep their torque."""
        for code in PREPARATION:
            self._order(code, deadline)

    def read(self, deadline: float) -> AxisReading:
        """Query ``M114``; return the step counts if reported, else the commanded values.

        The answer has no checksum, but that of an arm at rest contains the position twice. If both
        positions are equal, the answer is accepted; otherwise the query is repeated until two
        consecutive answers agree.
        """
        last: marlin.Position | None = None
        while True:
            frame, asked = self._position(deadline)
            if self._is_at_rest(frame) or (last is not None and _agree(last, frame)):
                return self._reading(frame, asked)
            last = frame

    def _position(self, deadline: float) -> tuple[marlin.Position, float]:
        """Query ``M114``; return the answer and the time of the query."""
        while True:
            asked = self._transport.now()
            for frame in self._command("M114", deadline):
                if isinstance(frame, marlin.Position):
                    return frame, asked
            # Either the answer was garbled, or a stray `ok` was taken for the answer. Discard all
            # received data and query again.
            self._settle(deadline)
            self.counters.retries += 1

    def _settled_position(self, deadline: float) -> marlin.Position:
        """Return the position of the arm at rest."""
        return _asked_twice(lambda: self._position(deadline)[0])

    def _start_move(self, target: Axes, feed: float, deadline: float) -> None:
        """Queue one move, or two if the displacement to which the feed would refer is so small that
        the firmware's rounding to steps would change the speed of the other axes."""
        start, self._target = self._target, None
        if start is None:
            start = self.read(deadline).axes
        for letters, values, speed in marlin.feed_parts(
            self._settings.letters, start, target, feed
        ):
            self._order(marlin.move_code(letters, values, speed), deadline)
        self._target = target

    def finish_move(
        self, expected_end: float, deadline: float, within: Callable[[Axes], bool]
    ) -> AxisReading:
        """Wait until the step counts match the commanded position, and return the position.

        ``M400`` is sent if the firmware reports no counts, or if the axes still move at
        ``expected_end``. The ``ok`` of ``M400`` arrives at the end of the move.
        """
        while (left := expected_end - EARLY - self._transport.now()) > 0:
            self._pump(left)
        if self._steps:
            frame, asked = self._position(deadline)
            if self._is_at_rest(frame):
                return self._reading(frame, asked)
        self._command("M400", deadline)
        while (reading := self.read(deadline)).moving:
            self._pump(POLL_PERIOD)
        return reading

    def idle(self, duration: float) -> None:
        """Process incoming data; raise if it reports a restart or a halt."""
        self._pump(duration)

    def home(self, axes: Axes | None, deadline: float) -> None:
        """Send ``G28`` and ``G92``, and verify that ``G28`` ran.

        The board accepts a line only if its number follows that of the previous line. If it accepts
        the position query after ``G28``, it has therefore also accepted ``G28``, unless the line
        numbering was restarted meanwhile.
        """
        beginnings, began = self._renumberings, self._transport.now()
        try:
            self._order("G28", deadline)
            if axes is not None:
                self.set_position(axes, deadline)
            else:
                self._offset = self._offset_at_rest(self._settled_position(deadline))
        except HardwareFault as fault:
            if fault.reason is FaultReason.TIMEOUT:
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"homing has not ended within {self._transport.now() - began:.0f} s "
                    "(arm.homing_timeout): check for an axis that does not reach its end stop "
                    f"(last error: {fault})",
                ) from fault
            if fault.reason in (FaultReason.ALARM, FaultReason.REJECTED):
                raise HardwareFault(
                    FaultReason.HOMING_FAILED, f"homing failed: {fault}: check the end stops"
                ) from fault
            raise
        if self._renumberings != beginnings:
            raise HardwareFault(
                FaultReason.HOMING_FAILED,
                "the line numbering was restarted during homing, so it is unknown whether the "
                "controller executed the homing command: home again",
            )

    def set_position(self, axes: Axes, deadline: float) -> None:
        """Declare the position with ``G92``. In some builds of the firmware, ``G92`` changes only
        the reported position; in others, it changes the step counts too. The difference between
        position and step counts is therefore measured."""
        self._order("G92" + marlin.axis_text(self._settings.letters, axes), deadline)
        self._offset = self._offset_at_rest(self._settled_position(deadline), axes)

    def clear(self, deadline: float) -> None:
        """Restart the line numbering. If the board is silent, reopen the port; this resets a halted
        board if the wiring of the board supports it."""
        self._connected = False
        self._halted_why = ""
        self._pump(0.0)
        self._frames.clear()
        try:
            self._begin_numbers(min(deadline, self._transport.now() + 1.0))
        except HardwareFault as fault:
            if fault.reason not in (FaultReason.TIMEOUT, FaultReason.UNKNOWN_FIRMWARE):
                raise
            self._transport.close()
            self._transport.sleep(RESET_PAUSE)
            self._transport.open(max(deadline - self._transport.now(), 0.1))
            self._buffer = b""
            try:
                self._begin_numbers(deadline)
            except HardwareFault as still:
                raise self._halt_fault() from still
        self._prepare(deadline)
        self._connected = True

    # Lines.

    def _order(self, code: str, deadline: float) -> None:
        """Send a line; raise REJECTED if the firmware does not support its code."""
        for frame in self._command(code, deadline):
            if isinstance(frame, marlin.Unknown):
                raise HardwareFault(
                    FaultReason.REJECTED,
                    f"the controller does not support {frame.code!r}: build its firmware"
                    " with that code",
                )

    def _command(self, code: str, deadline: float) -> list[marlin.Frame]:
        """Send one line and recover from errors; return the frames received before its ``ok``."""
        self._pump(0.0)
        self._frames.clear()
        self._number += 1
        number = self._number
        kept = {sent: line for sent, line in self._sent.items() if sent > number - KEPT_LINES}
        self._sent = {**kept, number: marlin.numbered(number, code)}
        self._transport.write(self._sent[number])
        frames: list[marlin.Frame] = []
        longest = patience = SILENCE if code in LONG_CODES else SHORT_SILENCE
        strange = 0
        for _ in range(RECOVERIES):
            outcome = self._await(number, patience, deadline, frames)
            if outcome is None:
                return frames
            if outcome == number + 1:
                # The board requests the next line, so it has received this one and only the `ok`
                # was lost.
                return frames
            if outcome < 0:
                if self._resend_unanswered(number, longest, deadline):
                    return frames
                outcome = number
            if outcome not in self._sent:
                if outcome == 1:
                    raise self._note_restart()
                strange += 1
                if strange > 1:
                    # The board has requested an unknown line twice, so this is not a transmission
                    # error. The board counts lines differently and rejects all lines of the driver.
                    self._begin_numbers(deadline)
                    self._number += 1
                    number = self._number
                    self._sent[number] = marlin.numbered(number, code)
                outcome = number
            for again in range(outcome, number + 1):
                self._transport.write(self._sent[again])
                self.counters.resends += 1
            patience = REPEAT_SILENCE if outcome == number else longest
        raise self._answer_timeout(code)

    def _await(
        self, number: int, patience: float, deadline: float, frames: list[marlin.Frame]
    ) -> int | None:
        """Await the answer to a line. Return the number of the line that the board requests, None
        if it only answered ``ok``, or -1 if it was silent."""
        wanted: int | None = None
        busy = False
        while True:
            until = min(deadline, self._transport.now() + patience)
            frame = self._next(until)
            if frame is None:
                if self._transport.now() >= deadline:
                    raise self._busy_timeout() if busy else self._answer_timeout(f"line {number}")
                return -1 if wanted is None else wanted
            if isinstance(frame, marlin.Ok):
                return wanted
            if isinstance(frame, marlin.Resend):
                wanted = frame.number
            elif isinstance(frame, marlin.LineError):
                if self._connected and frame.last_line == 0 and number > 1:
                    raise self._note_restart()
            elif isinstance(frame, marlin.Busy):
                busy = True
            else:
                frames.append(frame)
                if isinstance(frame, marlin.Position) and frame.with_ok:
                    return wanted

    def _resend_unanswered(self, number: int, patience: float, deadline: float) -> bool:
        """Resend a line that the board did not answer; return whether the board has executed it.

        The board ignores a line that it has already executed, so if there is
        again no answer, a query with the next line number is sent. The board answers this query
        with ``ok`` if it has executed the line, and with ``Resend`` if the line never arrived.
        """
        self.counters.timeouts += 1
        self._transport.write(self._sent[number])
        self.counters.resends += 1
        frames: list[marlin.Frame] = []
        outcome = self._await(number, REPEAT_SILENCE, deadline, frames)
        if outcome is None or outcome == number + 1:
            return True
        if outcome >= 0:
            return False
        # The number of the query is not used again, even if the query is not answered: it may still
        # arrive at the board, which would ignore a second line with the same number.
        self._number = number + 1
        self._sent[number + 1] = marlin.numbered(number + 1, "M114")
        self._transport.write(self._sent[number + 1])
        outcome = self._await(number + 1, patience, deadline, frames)
        if outcome is None or outcome == number + 2:
            return True
        # If the board requests the query again, it has executed the line before the query.
        return outcome == number + 1

    def _take(self, frame: marlin.Frame) -> None:
        if isinstance(frame, marlin.Halted) and self._connected:
            self._halted_why = frame.why
            raise HardwareFault(
                FaultReason.ALARM,
                f"the arm's controller halted: {frame.why}: make the cell safe, clear the fault"
                " and home again",
            )
        if isinstance(frame, marlin.Start) and self._connected:
            raise self._note_restart()
        self._frames.append(frame)

    # Connecting.

    def _keeps_count(self, deadline: float) -> bool:
        """Return whether the board still has the driver's last line number; if so, the board was
        not reset."""
        known = set(self._sent) | {self._number}
        self._transport.write(marlin.numbered(self._number + 2, "M114"))
        until = min(deadline, self._transport.now() + 1.0)
        while (frame := self._next(until)) is not None:
            if isinstance(frame, marlin.Start):
                return False
            if isinstance(frame, marlin.LineError) and frame.last_line is not None:
                return frame.last_line in known
            if isinstance(frame, marlin.Resend):
                return frame.number - 1 in known
        return False

    def _begin_numbers(self, deadline: float) -> None:
        """Set a random line number with ``M110``, repeated until it is answered."""
        low, high = FIRST_NUMBERS
        self._renumberings += 1
        self._number = low + self._draw_number(high - low)
        self._sent = {}
        line = marlin.numbered(self._number, f"M110 N{self._number}")
        while True:
            self._transport.write(b"\n" + line)
            until = min(deadline, self._transport.now() + 0.3)
            while (frame := self._next(until)) is not None:
                if isinstance(frame, marlin.Ok):
                    self._settle(deadline)
                    return
            if until >= deadline:
                raise HardwareFault(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"nothing on {self._transport.name} answers like Marlin"
                    f" ({self.counters.bad_lines} unreadable lines): check the port, the baud"
                    " rate and arm.dialect in the cell file; if the board is halted, press its"
                    " reset button",
                )
            self.counters.retries += 1

    def _settle(self, deadline: float) -> None:
        """Read until the line is silent, so that no stray ``ok`` of a repeated line is left."""
        while self._transport.now() < deadline and self._pump(DRAIN_SILENCE):
            self._frames.clear()
        self._frames.clear()

    def _identify(self, deadline: float) -> str:
        """Send ``M115`` until two answers agree, because answers have no checksum.

        If a garbled line hid the emergency parser, a stop would halt the board needlessly. If a
        garbled line reported an emergency parser that does not exist, a stop would have no effect.
        """
        before: tuple[str, bool] | None = None
        for _ in range(IDENTIFICATIONS):
            frames = self._command("M115", deadline)
            names = [f.name for f in frames if isinstance(f, marlin.FirmwareName)]
            capabilities = {f.name: f.present for f in frames if isinstance(f, marlin.Capability)}
            identity = (names[0], capabilities.get("EMERGENCY_PARSER", False)) if names else None
            if identity is None or identity != before:
                self.counters.retries += before is not None or identity is None
                before = identity
                continue
            name, self._emergency_parser = identity
            if not name.startswith("Marlin"):
                raise HardwareFault(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"firmware {name!r} is not supported: this driver supports Marlin; correct "
                    "arm.dialect in the cell file",
                )
            return name.removeprefix("Marlin").strip()
        raise HardwareFault(
            FaultReason.UNKNOWN_FIRMWARE,
            f"the controller on {self._transport.name} does not report its firmware (M115): "
            "check arm.dialect in the cell file",
        )

    def _figures(self, code: str, deadline: float) -> dict[str, float]:
        """Return a code's reported values of the four axes; empty if they are not reported."""
        letters = self._settings.letters

        def ask() -> dict[str, float]:
            for frame in self._command(code, deadline):
                if (
                    isinstance(frame, marlin.AxisFigures)
                    and frame.code == code
                    and set(letters) <= set(frame.values)
                ):
                    return {axis: frame.values[axis] for axis in letters}
            return {}

        return _asked_twice(ask)

    def _compare(self, deadline: float) -> list[Finding]:
        """Compare steps, rates, accelerations and soft end stops with the required ones."""
        needs = self._settings.needs
        if needs == ControllerNeeds():
            return []

        def columns(code: str, figures: dict[str, float]) -> tuple[list[str], list[float]]:
            return [f"{code} {axis}" for axis in figures], list(figures.values())

        findings = controller_needs.exactly(*columns("M92", self._steps), needs.steps, SET)
        for code, needed in (("M203", needs.speed), ("M201", needs.acceleration)):
            figures = columns(code, self._figures(code, deadline))
            findings += controller_needs.at_least(*figures, needed, SET)

        def ask_soft_endstops() -> list[marlin.SoftEndstops]:
            frames = self._command("M211", deadline)
            return [frame for frame in frames if isinstance(frame, marlin.SoftEndstops)]

        frames = _asked_twice(ask_soft_endstops)
        if any(frame.on for frame in frames):
            free = {
                axis: frame.high[axis] - frame.low[axis]
                for frame in frames
                for axis in self._settings.letters
                if axis in frame.low and axis in frame.high
            }
            if len(free) == AXIS_COUNT:
                span = columns("M211 range", free)
                findings += controller_needs.at_least(*span, needs.travel, "M211 S0")
            elif needs.travel is not None:
                findings.append(
                    Finding(
                        "M211",
                        "on",
                        "must be off, because the limits of the axes are not reported",
                        False,
                        "M211 S0, then M500",
                    )
                )
        return findings

    def _offset_before_homing(self, deadline: float) -> dict[str, float]:
        """Return the offset that the board has kept from an earlier session; empty if the arm
        moves."""
        self._offset = {}
        before: marlin.Position | None = None
        # Two answers suffice unless one of them is garbled.
        for _ in range(3):
            frame, _ = self._position(deadline)
            if self._is_at_rest(frame):
                break
            if frame == before:
                return self._offset_at_rest(frame)
            before = frame
            self._pump(REST_S)
        return {}

    def _offset_at_rest(
        self, frame: marlin.Position, declared: Axes | None = None
    ) -> dict[str, float]:
        """Return reported position minus step counts of the axes on which they differ.

        ``declared``: the position that was set, which is more exact than the reported one.
        """
        letters = self._settings.letters
        offset = {}
        for axis, letter in enumerate(letters):
            steps, count = self._steps.get(letter), frame.counts.get(letter)
            if steps is None or count is None or letter not in frame.commanded:
                return {}
            if abs(frame.commanded[letter] - count / steps) > _rounding(steps):
                exact = frame.commanded[letter] if declared is None else declared[axis]
                offset[letter] = exact - count / steps
        return offset

    def _is_at_rest(self, frame: marlin.Position) -> bool:
        """Return whether an answer contains all axes, with a commanded position that equals the
        step counts."""
        if not set(self._settings.letters) <= set(frame.commanded):
            return False
        reading = self._reading(frame, 0.0)
        return reading.measured and not reading.moving

    def _reading(self, frame: marlin.Position, asked: float) -> AxisReading:
        letters = self._settings.letters
        missing = [letter for letter in letters if letter not in frame.commanded]
        if missing:
            raise HardwareFault(
                FaultReason.UNKNOWN_FIRMWARE,
                f"the controller reports no axis {', '.join(missing)}: build its firmware with"
                f" {AXIS_COUNT} axes, or correct arm.axis_letters in the cell file",
            )
        commanded = tuple(frame.commanded[letter] for letter in letters)
        if self._target is not None and math.dist(commanded, self._target) > SAME:
            self._target = None  # the move was stopped, or another program has moved the arm
        if not self._steps or not set(letters) <= set(frame.counts):
            return AxisReading(commanded, False, "", False, asked)
        actual = tuple(frame.counts[a] / self._steps[a] + self._offset.get(a, 0.0) for a in letters)
        moving = any(
            abs(a - c) > _rounding(self._steps[letter])
            for a, c, letter in zip(actual, commanded, letters, strict=True)
        )
        return AxisReading(actual, moving, "", True, asked)

    def _halt_fault(self) -> HardwareFault:
        why = f" ({self._halted_why})" if self._halted_why else ""
        return HardwareFault(
            FaultReason.NEEDS_PERSON,
            f"the arm's controller on {self._transport.name} no longer answers; its Marlin "
            f"firmware has probably halted{why}: press the reset button on its board, and check "
            "power and cable, then clear the fault and home again",
        )

    def _note_restart(self) -> HardwareFault:
        """Discard the line number of before the restart; return the fault to raise."""
        self._connected = False
        self._number = 0
        return HardwareFault(
            FaultReason.BOARD_RESET,
            f"the arm's controller on {self._transport.name} restarted: its position is lost;"
            " clear the fault and home again",
        )

    def _busy_timeout(self) -> HardwareFault:
        self.counters.timeouts += 1
        return HardwareFault(
            FaultReason.TIMEOUT,
            "the controller still reports that it is busy: wait until its motion has ended, then"
            " try again; if it stays busy, restart the controller",
        )

    def _answer_timeout(self, what: str) -> HardwareFault:
        self.counters.timeouts += 1
        if self._halted_why:
            return self._halt_fault()
        return HardwareFault(
            FaultReason.TIMEOUT,
            f"no answer to {what} from the arm's controller on {self._transport.name} in time:"
            " check power, cable and baud rate",
        )


def _asked_twice(ask: Callable[[], Answer]) -> Answer:
    """Ask until two consecutive answers are equal, because an answer has no checksum."""
    before = ask()
    while (answer := ask()) != before:
        before = answer
    return answer


def _agree(first: marlin.Position, second: marlin.Position) -> bool:
    """Return whether two answers have the same commanded position; the step counts of a moving arm
    change between them."""
    return first.commanded == second.commanded and first.counts.keys() == second.counts.keys()


def _rounding(steps: float) -> float:
    """Return the largest difference between reported position and step count of an axis at rest, in
    axis units: the rounding of the report to 0.01, and one step."""
    return 0.006 + 1 / steps


def make_dialect(
    transport: Transport, wiring: ControllerWiring, draw_number: Callable[[int], int]
) -> MarlinDialect:
    """Create the dialect for a cell (see ``controllers``)."""
    return MarlinDialect(transport, MarlinSettings(wiring.letters, wiring.needs), draw_number)
