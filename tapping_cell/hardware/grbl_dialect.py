"""Dialect of the Grbl 1.1 family for an arm that is controlled in joint space."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from tapping_cell.hardware import controller_needs, grbl
from tapping_cell.hardware.axis_units import check_letters
from tapping_cell.hardware.controller_needs import ControllerNeeds
from tapping_cell.hardware.controllers import ControllerWiring
from tapping_cell.hardware.dialect import AXIS_COUNT, Axes, AxisReading, Firmware
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.finding import Finding
from tapping_cell.hardware.grbl_controllers import GRBL, ORIGIN_BIT, GrblController, identify
from tapping_cell.hardware.line_dialect import LineDialect
from tapping_cell.hardware.transport import Transport

REPLY_TIMEOUT = 0.5
"""Longest wait for an answer, s; a report takes up to 10 ms, the answer to `$$` up to 100 ms."""
REST_TIMEOUT = 15.0
"""Longest wait, before homing, for the end of a move that another program started, s."""
EARLY = 0.002
"""Time before the computed end of a move at which polling starts, s. Polling starts early because a
move starts before its ``ok`` arrives."""
POLL_PERIODS = (0.002, 0.02)
"""First and longest time between status queries at the end of a move, s; the time doubles with each
query. During the move the controller is not queried."""
HOMING_REQUIRED = 46
"""Error number with which grblHAL refuses to unlock before homing (bit 2 of ``$22``)."""
LOCKED = {
    "Alarm": "locked by an alarm",
    "Hold": "in a feed hold",
    "Door": "held by its safety door",
    "Sleep": "asleep",
    "Check": "in check mode",
}
"""States in which the controller accepts no motion until the state is cleared."""
POWERLESS = ("Alarm", "Sleep")
"""States in which the motors are or may have been without power."""
DEFAULT_LETTERS = "XYZABCUVW"
"""Axis order in the reports of controllers that do not list their axes."""
OFFSET_TOLERANCE = 0.002
"""Maximum difference between a reported work offset and the offset of the declared position, units:
both positions and the offset are rounded to 0.001."""
HOMED_TOLERANCE = 0.05
"""Maximum difference between the actual and the expected machine position after homing, units."""
RESETS = 3
"""Maximum number of soft resets sent while waiting for the banner."""
RESET_TIME = 1.5
"""Longest wait for the banner after a soft reset, s; FluidNC takes 0.5 s after an alarm."""
IDENTIFICATIONS = 5
"""Maximum number of repeated ``$I`` queries until two consecutive answers agree."""
MARKERS = (1001, 9999)
"""Range of the marker numbers, each of which identifies the answer to one resynchronisation."""
DRAIN_SILENCE = 0.05
"""Time without received bytes after which the line counts as drained, s."""
DRAIN_ROUNDS = 100
"""Maximum number of reads while draining a line that never falls silent."""
MARK_LINE = b"G18\n"
"""Sets a modal state that does not affect straight moves and that every reset clears. If this state
is still set after a reconnect, the controller was not reset."""


@dataclass(frozen=True, slots=True)
class GrblSettings:
    """Wiring of the controller and requirements on its settings."""

    letters: str = "XYZA"
    """Axis letters of shoulder, elbow, quill, tool."""
    expected: Mapping[int, float] = field(default_factory=lambda: {13: 0.0})
    """Required value of each setting, by its number. The default, 13: 0, requires reports in mm and
    degrees."""
    needs: ControllerNeeds = field(default_factory=ControllerNeeds)
    """Requirements on ``$100`` to ``$133``."""
    home_place: tuple[float, float, float, float] | None = None
    """Machine position after homing, in degrees and mm. If None, it is computed from the
    controller's settings."""
    without_switch: tuple[int, ...] = ()
    """Axes, 0 to 3, that homing does not move; a person moves them to their marks beforehand."""
    needs_homing: bool = False
    """True if homing must be enabled in the controller."""

    def __post_init__(self) -> None:
        check_letters(self.letters)


class GrblDialect(LineDialect[grbl.Frame]):
    """Driver of one Grbl controller; see :class:`~tapping_cell.hardware.dialect.ArmDialect`."""

    def __init__(self, transport: Transport, settings: GrblSettings | None = None) -> None:
        super().__init__(transport, grbl.decode)
        self._settings = settings or GrblSettings()
        self._offset: tuple[float, ...] | None = None
        self._connected = False
        self._marked = False
        """Whether the controller had the mark (``MARK_LINE``) when it was last queried."""
        self._offset_frozen = False
        self._controller: GrblController = GRBL
        self._forces_origin = False
        self._columns = list(range(AXIS_COUNT))
        """Places of shoulder, elbow, quill and tool in a reported position."""
        self._homed_place: list[float | None] = []
        self._axis_count = 0
        self._homing_problem = ""
        self._feed_override = 100
        self._unanswered = False
        """Whether the controller may still answer an earlier line."""
        self._marker = MARKERS[0]
        self._asked = 0.0
        self._asked_since = 0.0

    @property
    def stop_bytes(self) -> bytes:
        """Feed hold and soft reset."""
        return grbl.STOP

    @property
    def opening_stop_bytes(self) -> bytes:
        """Feed hold and soft reset; afterwards the arm must be homed, as after every stop."""
        return grbl.STOP

    def connect(self, deadline: float) -> Firmware:
        """Identify the controller and check its version and settings; raise if they are
        unsuitable."""
        firmware, findings = self.inspect(deadline)
        controller_needs.refuse(findings)
        self._connected = True
        return firmware

    def inspect(self, deadline: float) -> tuple[Firmware, list[Finding]]:
        """Identify the firmware and compare its settings with the required ones; nothing moves."""
        offset = self._offset if self._offset_frozen else None
        self._reset_state()
        self._axis_count = 0
        self._connected = False
        banner = self._drain() or self._await_first_status(deadline)
        if banner is not None:
            self._await_first_status(deadline)
        self._await_answerable(deadline)
        version = self._identify(deadline, banner)
        self._transport.write(grbl.FULL_FEED)
        findings = self._compare_with_retry(deadline)
        continued = self._marked and banner is None and self._has_mark(deadline)
        self._marked = continued
        if continued and offset is not None:
            self._offset, self._offset_frozen = offset, True
        return Firmware(self._controller.name, version, continued), findings

    def store(self, finding: Finding, deadline: float) -> None:
        """Send the command of a finding that may be stored without a person at the arm."""
        if not finding.storable:
            raise ValueError(f"{finding.setting} must be set by a person")
        self._command(finding.command.partition(";")[0].encode() + b"\n", deadline)

    def read(self, deadline: float) -> AxisReading:
        """Query the status until two consecutive reports agree on the state and the position.

        The line has no checksum; requiring two equal reports makes a garbled digit harmless. The
        work offset is sent at least every 30th report, so the first reading may take that many
        reports.
        """
        last: grbl.Status | None = None
        while True:
            status = self._ask_status(deadline)
            if last is not None and self._agree(last, status):
                return self._reading(status)
            last = status

    def _start_move(self, target: Axes, feed: float, deadline: float) -> None:
        """Send one move. If the answer is lost, the position read back shows whether the move was
        executed."""
        line = grbl.move_line(self._settings.letters, target, feed)
        try:
            self._command(line, min(deadline, self._transport.now() + REPLY_TIMEOUT))
        except HardwareFault as fault:
            if fault.reason is not FaultReason.TIMEOUT:
                raise
            # The move's `ok` is late or lost. Wait until the controller has processed the line:
            # before that, a report "Idle" may come from an arm that has not started to move.
            self.counters.retries += 1
            self._resynchronise(deadline)

    def finish_move(
        self, expected_end: float, deadline: float, within: Callable[[Axes], bool]
    ) -> AxisReading:
        """Wait until ``expected_end``, then poll until a report shows the axes at rest, or two
        consecutive reports show them beyond a joint limit."""
        while (left := expected_end - EARLY - self._transport.now()) > 0:
            self._pump(left)
        pause, longest = POLL_PERIODS
        beyond = False
        while True:
            # Even after the deadline, a query may take REPLY_TIMEOUT: a move that ends late does
            # not mean that the controller is silent.
            status = self._ask_status(max(deadline, self._transport.now() + REPLY_TIMEOUT))
            if status.state == "Alarm":
                raise self._alarm_fault("the controller is in alarm")
            if status.state in LOCKED:
                raise HardwareFault(
                    FaultReason.REJECTED,
                    f"the controller went into {status.state} during a move: find the cause "
                    "at the cell, then clear the fault",
                )
            if not _moving(status) and self._work_position(status) is not None:
                return self._reading(status)
            if self._transport.now() >= deadline:
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"the controller still reports {status.state}" + self._override_text(),
                )
            place = self._work_position(status)
            before, beyond = beyond, place is not None and not within(self._in_order(place))
            if before and beyond:
                return self._reading(status)
            self._pump(pause)
            pause = min(2 * pause, longest)

    def idle(self, duration: float) -> None:
        """Process incoming data; raise if it contains a banner or an alarm."""
        self._pump(duration)
        self._frames.clear()

    def home(self, axes: Axes | None, deadline: float) -> None:
        """Run ``$H``; the machine position afterwards proves that homing ran.

        Neither the line nor its ``ok`` has a checksum, and one wrong bit turns ``$H`` into ``$X``,
        which is also answered with ``ok``. A controller that still executes a move of a terminated
        program rejects ``$H``, so this call waits for the end of the move. The wait is limited,
        because a garbled feed rate can make a move extremely slow. If an axis has no switch, an
        operator must move it to its mark before homing. An arm that still moves cannot be at this
        mark, so homing is then refused.
        """
        patience = min(deadline, self._transport.now() + REST_TIMEOUT)
        while _moving(self._ask_status(deadline)) and self._transport.now() < patience:
            if self._settings.without_switch:
                raise HardwareFault(FaultReason.HOMING_FAILED, self._mark_problem())
            self._pump(POLL_PERIODS[1])
        # The settings may have been changed since the connection was made, so compare them again.
        controller_needs.refuse(self._compare_with_retry(deadline))
        if self._homing_problem:
            raise HardwareFault(FaultReason.HOMING_FAILED, self._homing_problem)
        began = self._transport.now()
        try:
            self._command(b"$H\n", deadline)
        except HardwareFault as fault:
            if fault.reason is FaultReason.TIMEOUT:
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"homing has not ended within {self._transport.now() - began:.0f} s "
                    "(arm.homing_timeout): check for an axis that does not reach its switch",
                ) from fault
            if fault.reason in (FaultReason.ALARM, FaultReason.REJECTED):
                if fault.reason is FaultReason.ALARM:
                    self._await_restart(deadline)
                raise HardwareFault(
                    FaultReason.HOMING_FAILED,
                    f"homing failed: {fault}: check the home switches and $22 to $27",
                ) from fault
            raise
        self._offset, self._offset_frozen = None, False
        while _moving(status := self._ask_status(deadline)):
            self._pump(POLL_PERIODS[1])
        if self._home_deviation(status):
            # The report may have been garbled, so query again before homing counts as failed.
            self.counters.retries += 1
            self._check_homed(self._ask_status(deadline))
        if axes is not None:
            self.set_position(axes, deadline)

    def _await_restart(self, deadline: float) -> None:
        """Wait for the greeting of a controller that resets itself after homing has failed, so that
        the next reading does not report the reset as a fault of its own."""
        self._connected = self._marked = False
        self._await_banner(min(deadline, self._transport.now() + RESET_TIME))
        self._drain()
        self._connected, self._unanswered = True, False

    def set_position(self, axes: Axes, deadline: float) -> None:
        """Set the position with ``G92``, then the mark with ``MARK_LINE``. A reset clears both, so
        as long as the mark is set, the position is valid."""
        self._offset, self._offset_frozen = None, False
        self._command(grbl.set_position_line(self._settings.letters, axes), deadline)
        self._command(MARK_LINE, deadline)
        self._offset = self._declared_offset(axes, deadline)
        # From here on, this offset is kept, and offsets in later reports are ignored. If a bit
        # error turns a later line into a G92, the following moves end at wrong machine positions.
        # The position check detects this, because it uses the kept offset.
        self._offset_frozen = True
        self._marked = True

    def _declared_offset(self, axes: Axes, deadline: float) -> tuple[float, ...]:
        """Query until a report contains the work offset; return the offset.

        The report also contains the machine position, from which the offset of the declared
        position ``axes`` follows. An offset that differs may be garbled, so it is returned only if
        the next one is equal: the line that declared the position was then garbled.
        """
        before: tuple[float, ...] | None = None
        while True:
            status = self._ask_status(deadline)
            if status.offset is None or not status.machine:
                continue
            places = zip(
                self._in_order(status.machine), self._in_order(status.offset), axes, strict=False
            )
            fits = all(abs(m - o - a) <= OFFSET_TOLERANCE for m, o, a in places)
            if fits or status.offset == before:
                return status.offset
            before = status.offset

    def clear(self, deadline: float) -> None:
        """Send a soft reset and unlock; the arm must be homed again afterwards."""
        self._reset_state()
        self._connected = False
        self._marked = False
        for _ in range(RESETS):
            self._transport.write(grbl.SOFT_RESET)
            # Answers from before the reset may still be on the line, so wait for the banner.
            if self._await_banner(min(deadline, self._transport.now() + RESET_TIME)):
                break
            self.counters.retries += 1
        self._drain()
        self._await_first_status(deadline)
        # If the controller stays locked until it is homed, the fault is cleared nevertheless.
        self._command(b"$X\n", deadline, accepted=HOMING_REQUIRED)
        self._offset = None
        self._connected = True

    def _reset_state(self) -> None:
        self._buffer = b""
        self._frames.clear()
        self._offset, self._offset_frozen = None, False
        self._unanswered = False

    def _take(self, frame: grbl.Frame) -> None:
        if isinstance(frame, grbl.Status):
            if self._axis_count and len(frame.machine or frame.work or ()) != self._axis_count:
                self.counters.bad_lines += 1
                return
            if frame.offset is not None and not self._offset_frozen:
                self._offset = frame.offset
            if frame.feed_override is not None:
                self._feed_override = frame.feed_override
        if self._connected and isinstance(frame, grbl.Banner):
            self._connected = False
            self._marked = False
            raise HardwareFault(
                FaultReason.BOARD_RESET,
                f"the arm's controller on {self._transport.name} restarted: its position is lost;"
                " clear the fault and home again",
            )
        if self._connected and isinstance(frame, grbl.Alarm):
            meanings = {**grbl.ALARMS, **self._controller.alarms}
            raise self._alarm_fault(meanings.get(frame.code, "unknown to this driver"), frame.code)
        self._frames.append(frame)

    def _await(self, until: float) -> grbl.Frame | None:
        """Return the next frame; if no frame is received by ``until``, count a timeout and return
        None."""
        frame = self._next(until)
        self.counters.timeouts += frame is None
        return frame

    def _timeout_fault(self, waiting_for: str) -> HardwareFault:
        return HardwareFault(
            FaultReason.TIMEOUT,
            f"no {waiting_for} from the arm's controller on {self._transport.name} within"
            f" {self._transport.now() - self._asked_since:.1f} s: check power, cable and baud rate",
        )

    def _ask_status(self, deadline: float) -> grbl.Status:
        """Query one status report, repeating lost queries; earlier answers are discarded."""
        self._pump(0.0)
        self._frames.clear()
        self._asked_since = self._transport.now()
        while True:
            self._asked = self._transport.now()
            self._transport.write(grbl.STATUS_QUERY)
            until = min(deadline, self._asked + REPLY_TIMEOUT)
            while (frame := self._await(until)) is not None:
                if isinstance(frame, grbl.Status):
                    return frame
            if until >= deadline:
                raise self._timeout_fault("status report")
            self.counters.retries += 1

    def _command(
        self, line: bytes, deadline: float, accepted: int | None = None
    ) -> list[grbl.Frame]:
        """Send one line, wait for its ``ok``, and return the frames received before it.
        ``accepted``: error number that counts as ``ok``.

        An ``ok`` does not state which line it answers. If the ``ok`` of an earlier line is
        outstanding, it is awaited first, so that it is not mistaken for the answer to this line.
        """
        if self._unanswered:
            self._resynchronise(deadline)
        self._pump(0.0)
        self._frames.clear()
        self._asked_since = self._transport.now()
        self._unanswered = True
        self._transport.write(line)
        frames: list[grbl.Frame] = []
        while (frame := self._await(deadline)) is not None:
            if isinstance(frame, grbl.Ok) or _has_code(frame, accepted):
                self._unanswered = False
                return frames
            if isinstance(frame, grbl.Error):
                self._unanswered = False
                meaning = grbl.ERRORS.get(frame.code, "see the controller's documentation")
                reason = FaultReason.ALARM if frame.code == 9 else FaultReason.REJECTED
                raise HardwareFault(
                    reason,
                    f"the controller refused {line.decode().strip()!r} with error {frame.code}:"
                    f" {meaning}",
                )
            frames.append(frame)
        raise self._timeout_fault(f"answer to {line.decode().strip()!r}")

    def _resynchronise(self, deadline: float) -> None:
        """Wait until the controller has processed every line sent so far.

        Sends a new number as the feed rate and queries the modes, which include the feed rate. A
        mode report with this number proves that all earlier lines were processed. The ``ok`` that
        follows this report is the last outstanding one. Raises ALARM if the controller does not
        accept the feed because of an alarm.
        """
        self._asked_since = self._transport.now()
        while True:
            first, last = MARKERS
            self._marker = self._marker + 1 if self._marker < last else first
            self._transport.write(grbl.marker_lines(self._marker))
            until = min(deadline, self._transport.now() + REPLY_TIMEOUT)
            if self._marker_arrives(until):
                self._unanswered = False
                return
            if until >= deadline:
                raise self._timeout_fault("answer to its lines")
            self.counters.retries += 1

    def _marker_arrives(self, until: float) -> bool:
        """Return whether the mode report with the marker, and then its ``ok``, arrive by
        ``until``."""
        locked = reported = False
        while (frame := self._await(until)) is not None:
            if reported:
                if isinstance(frame, grbl.Ok):
                    return True
            elif isinstance(frame, grbl.Error):
                locked = locked or frame.code == 9
            elif isinstance(frame, grbl.Message) and frame.kind == "GC":
                if locked:
                    raise self._alarm_fault("it accepts no lines")
                reported = grbl.modal_feed(frame.text) == self._marker
        return False

    def _await_first_status(self, deadline: float) -> grbl.Banner | None:
        """Query until a status report arrives. Return the banner that was received before this
        report, or None. A banner shows that the controller was reset."""
        banner: grbl.Banner | None = None
        while True:
            self._transport.write(grbl.STATUS_QUERY)
            until = min(deadline, self._transport.now() + 0.2)
            while (frame := self._await(until)) is not None:
                if isinstance(frame, grbl.Banner):
                    banner = frame
                elif isinstance(frame, grbl.Status):
                    return banner
            if until >= deadline:
                raise HardwareFault(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"nothing on {self._transport.name} answers like a Grbl controller"
                    f" ({self.counters.bad_lines} unreadable lines): check the port, the baud"
                    " rate and the dialect parameter",
                )
            self.counters.retries += 1

    def _await_answerable(self, deadline: float) -> None:
        """Wait for the end of a motion; raise if the controller is in a state in which it refuses
        queries.

        Firmwares of this family refuse ``$I`` and ``$$`` (error 8) except at rest or in alarm. A
        controller continues its moves even if its cable is unplugged.
        """
        began = self._transport.now()
        patience = max(deadline, began + REPLY_TIMEOUT)
        while _moving(status := self._ask_status(patience)):
            if self._transport.now() + REPLY_TIMEOUT >= patience:
                raise HardwareFault(
                    FaultReason.TIMEOUT,
                    f"the arm is still moving after {self._transport.now() - began:.1f} s: wait"
                    " until it stops, then connect again",
                )
            self._pump(POLL_PERIODS[1])
        if status.state in LOCKED and status.state != "Alarm":
            raise HardwareFault(
                FaultReason.REJECTED,
                f"the arm's controller is {LOCKED[status.state]} and reports no settings: make"
                " the cell safe, then clear (Clear on the page, or python -m tapping_cell clear),"
                " which resets the controller",
            )

    def _await_banner(self, until: float) -> bool:
        """Wait for the greeting after a reset; return whether it was received."""
        while (frame := self._next(until)) is not None:
            if isinstance(frame, grbl.Banner):
                return True
        return False

    def _drain(self) -> grbl.Banner | None:
        """Read until the line is silent, so that old answers are not mistaken for new answers."""
        banner: grbl.Banner | None = None
        for _ in range(DRAIN_ROUNDS):
            received = self._pump(DRAIN_SILENCE)
            banner = next((f for f in reversed(self._frames) if isinstance(f, grbl.Banner)), banner)
            self._frames.clear()
            if not received:
                break
        return banner

    def _query(self, line: bytes, deadline: float) -> list[grbl.Frame]:
        """Send a query up to three times, and wait for each answer for at most the reply
        timeout."""
        for attempt in range(3):
            try:
                return self._command(line, min(deadline, self._transport.now() + REPLY_TIMEOUT))
            except HardwareFault as fault:
                last = attempt == 2 or self._transport.now() >= deadline
                if fault.reason not in (FaultReason.TIMEOUT, FaultReason.REJECTED) or last:
                    raise
                self.counters.retries += 1
        raise AssertionError("unreachable")

    def _identify(self, deadline: float, banner: grbl.Banner | None) -> str:
        """Identify the controller and count its axes; return its version."""
        # Answers have no checksum. If a line is lost, the controller may be taken for a different
        # one, so query until two consecutive answers agree.
        messages = self._information(deadline)
        for _ in range(IDENTIFICATIONS):
            again = self._information(deadline)
            if identify(again) == identify(messages):
                break
            self.counters.retries += 1
            messages = again
        identity = identify(messages)
        letters = DEFAULT_LETTERS
        if identity is not None:
            self._controller = identity.controller
            self._forces_origin = identity.forces_origin
            letters = identity.letters or letters
            version = identity.version
        else:
            reported = next((m.text.strip() for m in messages if m.kind == "VER"), "")
            if reported:
                raise HardwareFault(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"Grbl version {reported!r} is not supported: this driver supports Grbl 1.1, "
                    "grbl-Mega-5X, grblHAL and FluidNC 3 and 4",
                )
            if banner is None:
                raise HardwareFault(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"the controller on {self._transport.name} answers but reports no Grbl "
                    "version: check the dialect parameter",
                )
            self._controller, self._forces_origin = GRBL, False
            version = banner.version
        count = self._count_axes(deadline)
        known = letters[:count]
        missing = [letter for letter in self._settings.letters if letter not in known]
        if count < AXIS_COUNT or missing:
            raise HardwareFault(
                FaultReason.UNKNOWN_FIRMWARE,
                f"{self._controller.name} {version} on {self._transport.name} has {count} "
                f"axes ({known}), but {AXIS_COUNT} are needed ({self._settings.letters}): build "
                f"its firmware with {AXIS_COUNT} axes, use another controller, or correct "
                "arm.axis_letters",
            )
        self._columns = [letters.index(letter) for letter in self._settings.letters]
        self._axis_count = count
        return version

    def _information(self, deadline: float) -> list[grbl.Message]:
        """Return the messages in the answer to ``$I``."""
        frames = self._query(b"$I\n", deadline)
        return [frame for frame in frames if isinstance(frame, grbl.Message)]

    def _count_axes(self, deadline: float) -> int:
        """Return the number of axes once two consecutive reports agree on it."""
        before = 0
        while True:
            status = self._ask_status(deadline)
            count = len(status.machine or status.work or ())
            if count == before:
                return count
            before = count

    def _compare_with_retry(self, deadline: float) -> list[Finding]:
        """Return the findings of ``_compare``. If a setting is not as required, the settings are
        queried once more, because a line of the answer may have been garbled."""
        findings = self._compare(deadline)
        if self._homing_problem or not all(finding.met for finding in findings):
            self.counters.retries += 1
            findings = self._compare(deadline)
        return findings

    def _compare(self, deadline: float) -> list[Finding]:
        """Compare the controller's settings with the required ones."""
        frames = self._query(b"$$\n", deadline)
        found = {frame.number: frame.value for frame in frames if isinstance(frame, grbl.Setting)}
        controller, settings = self._controller, self._settings
        shown = {number: f"{value:g}" for number, value in found.items()}
        findings: list[Finding] = []
        if controller.has_files:
            self._learn_homed_place_by_name(deadline)
            held = self._read_setting(controller.hold_setting, deadline)
            inches = self._read_setting("$/report_inches", deadline)
            findings.append(
                Finding(
                    "$/report_inches",
                    inches,
                    "must be false, so that positions are reported in degrees and mm",
                    inches.lower() == "false",
                    "$/report_inches=false",
                    storable=True,
                )
            )
        else:
            self._learn_homed_place(found)
            held = shown.get(1, "missing")
        findings.append(
            Finding(
                controller.hold_setting,
                held,
                "must be 255: otherwise the motors lose their torque at standstill and the "
                "arm sinks unnoticed",
                held == "255",
                f"{controller.hold_setting}=255{controller.store_note}",
                storable=True,
            )
        )
        mask = found.get(10)
        findings.append(
            Finding(
                "$10",
                shown.get(10, "missing"),
                controller.report_meaning,
                mask is not None and int(mask) & controller.report_bits == controller.report_bits,
                f"$10={int(mask or 0) | controller.report_bits}",
                storable=True,
            )
        )
        if settings.needs_homing:
            findings.append(
                Finding(
                    "$22",
                    shown.get(22, "missing"),
                    "must be 1: this arm finds its position by homing",
                    int(found.get(22, 0)) % 2 == 1,
                    "" if controller.has_files else f"$22={int(found.get(22, 0)) | 1}",
                )
            )
            if self._homing_problem:
                findings.append(Finding("homing", "incomplete", self._homing_problem, False))
        for number, value in settings.expected.items():
            if number not in found and controller.has_files and number == 13:
                continue
            actual = found.get(number)
            findings.append(
                Finding(
                    f"${number}",
                    shown.get(number, "missing"),
                    f"must be {value:g}",
                    actual is not None
                    and abs(actual - value) <= controller_needs.TOLERANCE * max(abs(value), 1.0),
                    "" if actual is None else f"${number}={value:g}",
                    storable=number == 13,
                )
            )
        return findings + self._limits(found)

    def _read_setting(self, name: str, deadline: float) -> str:
        """Query a setting by its name; "missing" if the controller does not have it."""
        try:
            frames = self._query(name.encode() + b"\n", deadline)
        except HardwareFault as fault:
            if fault.reason is not FaultReason.REJECTED:
                raise
            return "missing"
        texts = {frame.name: frame.text for frame in frames if isinstance(frame, grbl.NamedSetting)}
        return texts.get(name[1:], "missing").strip()

    def _limits(self, found: Mapping[int, float]) -> list[Finding]:
        """Compare steps, rates, accelerations and travels with the required ones.

        A controller with files may leave out any of these numbers. If another controller leaves out
        a number, its line was lost.
        """
        needs, columns = self._settings.needs, self._columns
        may_leave_out = self._controller.has_files

        def four(first: int) -> tuple[list[str], list[float | None]]:
            numbers = [first + column for column in columns]
            values = [found.get(number) for number in numbers]
            return [f"${n}" for n in numbers], [] if may_leave_out and None in values else values

        command = "{name}={value}"
        findings = controller_needs.exactly(*four(100), needs.steps, command)
        # Grbl's rates are in units/min.
        per_minute = None
        if needs.speed is not None:
            a, b, c, d = needs.speed
            per_minute = (60 * a, 60 * b, 60 * c, 60 * d)
        findings += controller_needs.at_least(*four(110), per_minute, command)
        findings += controller_needs.at_least(*four(120), needs.acceleration, command)
        if found.get(20, 0.0 if may_leave_out else 1.0):
            findings += controller_needs.at_least(*four(130), needs.travel, command)
        return findings

    # Position at the end of homing.

    def _learn_homed_place(self, found: Mapping[int, float]) -> None:
        """Compute the machine position after homing from ``$$``.

        Homing ends at a distance of $27 (pull-off) from the end of travel that has the switch; $23
        tells which end this is. In some builds, the position after homing is set to zero.
        """
        self._homing_problem = ""
        self._homed_place = list(self._settings.home_place or ())
        needed = [23, 27, *(130 + column for column in self._columns)]
        missing = [f"${number}" for number in needed if number not in found]
        if not self._homed_place:
            if missing:
                self._homing_problem = (
                    f"the controller does not list {', '.join(missing)}, so the position "
                    "after homing is unknown: connect again; if it persists, set "
                    "arm.home_place"
                )
                return
            forced = self._forces_origin or (
                bool(self._controller.homing_masks) and bool(int(found.get(22, 0)) & ORIGIN_BIT)
            )
            towards_low, pull_off = int(found[23]), found[27]
            self._homed_place = [
                0.0
                if forced
                else pull_off - found[130 + column]
                if towards_low >> column & 1
                else -pull_off
                for column in self._columns
            ]
        masks = [int(found[n]) for n in self._controller.homing_masks if n in found]
        for axis, column in enumerate(self._columns):
            if axis in self._settings.without_switch:
                self._homed_place[axis] = None
            elif masks and not any(mask >> column & 1 for mask in masks):
                first = self._controller.homing_masks[0]
                self._homing_problem = (
                    f"the controller's homing leaves out axis {self._settings.letters[axis]}"
                    f" (${first} to ${first + 3}): add it there, or name its joint in"
                    " arm.axes_without_switch"
                )

    def _learn_homed_place_by_name(self, deadline: float) -> None:
        """Read the homed position from the controller's named settings."""
        self._homing_problem = ""
        self._homed_place = list(self._settings.home_place or (None,) * AXIS_COUNT)
        for axis, letter in enumerate(self._settings.letters):
            if axis in self._settings.without_switch:
                self._homed_place[axis] = None
                continue
            section = f"$/axes/{letter.lower()}/homing"
            cycle = self._read_setting(f"{section}/cycle", deadline)
            if not cycle.lstrip("-").isdigit() or int(cycle) < 1:
                self._homing_problem = (
                    f"the controller's homing leaves out axis {letter} ({section}/cycle is"
                    f" {cycle}): give it a cycle, or name its joint in arm.axes_without_switch"
                )
            elif self._settings.home_place is None:
                text = self._read_setting(f"{section}/mpos_mm", deadline)
                try:
                    self._homed_place[axis] = float(text)
                except ValueError:
                    self._homing_problem = (
                        f"the controller does not report {section}/mpos_mm, so the position "
                        "after homing is unknown: connect again; if it persists, set "
                        "arm.home_place"
                    )

    def _home_deviation(self, status: grbl.Status) -> str:
        """Return what a report says of the axes that are not at their expected positions after
        homing; empty if every axis that homing moves is there."""
        if status.machine is None:
            return "no position"
        place = self._in_order(status.machine)
        wrong = [
            f"{letter} at {found:g} instead of {wanted:g}"
            for letter, found, wanted in zip(
                self._settings.letters, place, self._homed_place, strict=False
            )
            if wanted is not None and abs(found - wanted) > HOMED_TOLERANCE
        ]
        return ", ".join(wrong)

    def _check_homed(self, status: grbl.Status) -> None:
        """Raise HOMING_FAILED unless every axis that homing moves is at its expected position."""
        if wrong := self._home_deviation(status):
            raise HardwareFault(
                FaultReason.HOMING_FAILED,
                f"after homing the controller reports {wrong}, "
                "which does not match its settings: home again; if it persists, set "
                "arm.home_place, or name joints that have no switch in "
                "arm.axes_without_switch",
            )

    def _has_mark(self, deadline: float) -> bool:
        frames = self._query(b"$G\n", deadline)
        return any(
            isinstance(frame, grbl.Message) and frame.kind == "GC" and "G18" in frame.text.split()
            for frame in frames
        )

    def _reading(self, status: grbl.Status) -> AxisReading:
        axes = self._in_order(self._work_position(status) or ())
        return AxisReading(
            axes,
            _moving(status),
            LOCKED.get(status.state, ""),
            True,
            self._asked,
            status.state in POWERLESS,
        )

    def _in_order(self, position: Sequence[float]) -> tuple[float, ...]:
        """Return the four axes of a reported position, in joint order."""
        return tuple(position[column] for column in self._columns)

    def _mark_problem(self) -> str:
        letters = ", ".join(self._settings.letters[axis] for axis in self._settings.without_switch)
        return (
            f"the arm is moving, so axis {letters}, which has no home switch, is not at its marked"
            " position: wait until the arm stops, clear the fault, move the axis there by hand,"
            " then home again"
        )

    def _override_text(self) -> str:
        if self._feed_override == 100:
            return ""
        return (
            f" with a feed override of {self._feed_override} %: set it back to 100 % at the"
            " controller"
        )

    def _agree(self, first: grbl.Status, second: grbl.Status) -> bool:
        """Return whether two reports agree: both moving, or at rest at the same position."""
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
        """Return the work position; None if no offset has been received yet."""
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


def _has_code(frame: grbl.Frame, code: int | None) -> bool:
    return isinstance(frame, grbl.Error) and frame.code == code


def _moving(status: grbl.Status) -> bool:
    return status.state in ("Run", "Jog", "Home") or (
        status.state == "Hold" and status.substate != 0
    )


def make_dialect(
    transport: Transport, wiring: ControllerWiring, _: Callable[[int], int]
) -> GrblDialect:
    """Create the dialect for a cell (see ``controllers``)."""
    settings = GrblSettings(
        letters=wiring.letters,
        expected={13: 0.0} | dict(wiring.settings),  # 13: 0 requires reports in mm and degrees
        needs=wiring.needs,
        home_place=wiring.home_place,
        without_switch=wiring.without_switch,
        needs_homing=wiring.needs_homing,
    )
    return GrblDialect(transport, settings)
