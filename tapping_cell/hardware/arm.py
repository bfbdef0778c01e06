"""Arm driver: moves a SCARA and verifies every move.

A dialect (:class:`~tapping_cell.hardware.dialect.ArmDialect`) translates the driver's calls to the
language of the controller. A move succeeds when the controller is idle and the position read back
is within tolerance. The arm does not move before homing. After a stop, a reset or an alarm, the
position is no longer trusted, and the arm must be homed again.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

from tapping_cell.hardware.arm_settings import (
    ArmCounters,
    ArmReading,
    ArmSettings,
    HomingStrategy,
)
from tapping_cell.hardware.axis_units import joints_text, to_axes, to_joints
from tapping_cell.hardware.dialect import (
    ArmDialect,
    Axes,
    AxisReading,
    Firmware,
    LineCounters,
    StraightMove,
)
from tapping_cell.hardware.faults import LINE_LOST, FaultReason, HardwareFault
from tapping_cell.hardware.line_quality import ReceivedBytes
from tapping_cell.hardware.motion import Waypoint, check_limits, move_duration
from tapping_cell.hardware.scara import JOINT_LIMITS, Joints, ReachCode, ScaraGeometry
from tapping_cell.hardware.transport import Connection

MOVE_ATTEMPTS = 3
"""Maximum number of attempts to send a move. A move is sent again only if the arm stands at the
move's start or at an intermediate point."""

FRESHNESS = 0.05
"""Maximum age of a reading that is reused at the start of a move, s."""
MIN_FEED = 0.001
"""Lowest feed rate that a move line can contain, units/min."""

HOMING_LOST = frozenset(
    {
        FaultReason.STOPPED,
        FaultReason.ALARM,
        FaultReason.BOARD_RESET,
        FaultReason.POSITION_LOST,
    }
)
"""Faults after which the arm's position is no longer trusted until they are cleared. Failed homing
is not one of them: the arm is not homed then, and can be homed again at once."""


UNANSWERED = (FaultReason.TIMEOUT, FaultReason.UNKNOWN_FIRMWARE, FaultReason.NEEDS_PERSON)
"""Faults that also occur if the replies of the controller are unreadable."""
MIN_BAD_LINES = 3
"""A timeout is attributed to unreadable lines if at least this many lines, and at least half of all
lines of the call, were unreadable."""
MIN_UNREADABLE_BYTES = 100
"""A timeout is also attributed to unreadable lines if at least this many bytes, more than one
reply, contained no readable line. Damage to the ends of lines joins many lines to one."""
OF_A_STOP = (FaultReason.STOPPED, FaultReason.ALARM, FaultReason.BOARD_RESET)
"""Fault reasons that a stop of the arm can cause."""


@dataclass(frozen=True, slots=True)
class _Path:
    """Waypoints of a move, starting at the current position, and the speed of each leg as a
    fraction of the maximum joint speeds."""

    places: tuple[Joints, ...]
    speeds: tuple[float, ...]

    def legs(self) -> Iterator[tuple[Joints, Joints, float]]:
        """Yield the start, end and speed of each leg."""
        for (start, end), speed in zip(pairwise(self.places), self.speeds, strict=True):
            yield start, end, speed


class ArmDriver:
    """Driver of the arm whose controller is connected to ``transport``. All calls except ``stop``
    block and must come from one thread."""

    def __init__(
        self,
        transport: Connection,
        dialect: ArmDialect,
        geometry: ScaraGeometry,
        settings: ArmSettings | None = None,
    ) -> None:
        self.geometry = geometry
        self.settings = settings or ArmSettings()
        self.counters = ArmCounters()
        self._transport = transport
        self._dialect = dialect
        self._firmware: Firmware | None = None
        self._connected = False
        self._homed = False
        self._confirmed: Joints | None = None
        """Position at the end of the last move; None if it is not trusted."""
        self._latest: ArmReading | None = None
        self._fault: HardwareFault | None = None
        self._stopped = threading.Event()
        self._stops_when_opened = False
        self._begin_call()

    @property
    def firmware(self) -> Firmware | None:
        """Firmware that answered at the last connect; None before the first connect."""
        return self._firmware

    @property
    def connected(self) -> bool:
        """True if the line is open and the controller was identified."""
        return self._connected and self._transport.is_open

    @property
    def homed(self) -> bool:
        """True if the joint values can be trusted."""
        return self._homed and not self._stopped.is_set()

    @property
    def fault(self) -> HardwareFault | None:
        """The latched fault or stop, until ``clear_fault``; None when the arm may move."""
        if self._fault is None and self._stopped.is_set():
            return self._stop_fault()
        return self._fault

    def now(self) -> float:
        """Return the current time on the clock that ``ArmReading.stamp`` uses, s."""
        return self._transport.now()

    @property
    def line_counters(self) -> LineCounters:
        """Counts of the dialect's retries, resends, timeouts and unreadable lines."""
        return self._dialect.counters

    def connect(self, timeout: float = 5.0) -> Firmware:
        """Open the line, identify the controller, and read the position.

        ``timeout``: longest wait for the port, and then for the controller's answer, s. Homing
        remains valid after a reconnect only if two conditions are met: the controller proves that
        it was not reset, and the arm has not moved. If connecting fails, the port is closed. Raises
        HardwareFault: PORT_MISSING, PORT_BUSY, UNKNOWN_FIRMWARE, SETTINGS_MISMATCH, TIMEOUT,
        PROTOCOL, NEEDS_PERSON.
        """
        self._begin_call()
        self._connected = False
        self._latest = None
        try:
            self._transport.open(timeout)
            if self._stopped.is_set() or self._stops_when_opened:
                # The stop was requested while the port was closed, and the arm may still complete a
                # move that was sent before, perhaps by an earlier process.
                sent = self._transport.stop(self._dialect.opening_stop_bytes)
                if not self._stopped.is_set():
                    self._transport.release()
                # If the stop was not sent completely, the next attempt sends it.
                self._stops_when_opened = not sent
            if self._firmware is not None:
                self.counters.reconnects += 1
            firmware = self._dialect.connect(self._transport.now() + timeout)
            self._firmware = firmware
            self._connected = True
            reading = self._converted(self._dialect.read(self._reply_deadline()))
        except HardwareFault as fault:
            if fault.reason is not FaultReason.STOPPED:
                self.close()
            raise self._record_fault(fault) from fault.__cause__
        held = self._confirmed is not None and self._agrees(self._confirmed, reading.joints)
        if not (firmware.continued and held and not reading.alarm):
            self._homed = False
            self._confirmed = None
        return firmware

    @property
    def stops_when_opened(self) -> bool:
        """Whether the next ``connect`` stops the arm as soon as the port is open."""
        return self._stops_when_opened

    def stop_when_opened(self) -> None:
        """Let the next ``connect`` stop the arm as soon as the port is open, without a latch."""
        self._stops_when_opened = True

    def close(self) -> None:
        """Close the line; the next connect decides whether homing remains valid."""
        self._connected = False
        self._transport.close()

    def home(self, strategy: HomingStrategy) -> Joints:
        """Home the arm or declare its position, depending on ``strategy``. Motion is allowed once
        the position read back has been verified.

        Raises HardwareFault: HOMING_FAILED, POSITION_MISMATCH, OUT_OF_RANGE, ALARM, STOPPED.
        """
        self._require_ready(homed=False)
        self._homed = False
        self._confirmed = self._latest = None
        try:
            if strategy is HomingStrategy.FIRMWARE:
                joints = self._home_by_firmware()
            else:
                joints = self._declare(strategy)
        except HardwareFault as fault:
            if fault.reason is FaultReason.TIMEOUT:
                raise self._stop_after(fault) from fault
            raise self._record_fault(fault) from fault.__cause__
        self._confirmed = joints
        self._homed = True
        return joints

    def read(self) -> ArmReading:
        """Read the arm's state from the controller; joint values are invalid before homing."""
        self._require_line()
        try:
            self._latest = self._read()
        except HardwareFault as fault:
            raise self._record_fault(fault) from fault.__cause__
        return self._latest

    def read_joints(self) -> Joints:
        """Return the joint values of the arm at rest, as the start of a path.

        A joint that is beyond its limit by no more than the position tolerance is returned at its
        limit, so that a path may keep this joint. If the arm moves, its rest is awaited. Raises
        NOT_HOMED before homing, and TIMEOUT if the arm does not come to rest.
        """
        self._require_ready(homed=True)
        reading = self._recent() or self.read()
        if reading.moving:
            try:
                self._latest = reading = self._read_at_rest()
            except HardwareFault as fault:
                raise self._record_fault(fault) from fault.__cause__
        return self._within_limits(reading.joints)

    def move_to(
        self,
        joints: Iterable[float],
        speed: float = 0.5,
        deadline: float | None = None,
        via: Iterable[float] | None = None,
        via_speed: float | None = None,
    ) -> ArmReading:
        """Move straight in joint space; return when the arm is idle and the position read back is
        within tolerance.

        ``speed``: fraction of the maximum joint speeds, in (0, 1]. ``deadline``: latest
        end of the move on the transport's clock; None: derived from the move's duration. ``via``:
        intermediate joints. The arrival at ``via`` is not verified, so the move must be harmless
        even if ``via`` is skipped. ``via_speed``: speed up to ``via``. Raises HardwareFault:
        OUT_OF_RANGE, NOT_HOMED, POSITION_LOST, POSITION_MISMATCH, TIMEOUT (the arm is then
        stopped), ALARM, STOPPED, BOARD_RESET, REJECTED, DISCONNECTED.
        """
        goal = Joints(*joints)
        first_speed = speed if via_speed is None else via_speed
        for fraction in (first_speed, speed):
            if not 0 < fraction <= 1:
                sentence = (
                    f"speed is {fraction:g}, but must be above 0 and at most 1 (a fraction of the "
                    "maximum joint speeds)"
                )
                raise HardwareFault(FaultReason.OUT_OF_RANGE, sentence)
        legs = (goal,) if via is None else (Joints(*via), goal)
        for leg in legs:
            check_limits(self.geometry, leg)
        self._require_ready(homed=True)
        speeds = (speed,) if via is None else (first_speed, speed)
        try:
            return self._move(legs, speeds, deadline)
        except HardwareFault as fault:
            raise self._record_fault(fault) from fault.__cause__

    def follow(self, path: Iterable[Waypoint]) -> ArmReading:
        """Move to each waypoint in turn, settle, and verify the end; raises as ``move_to``."""
        last: Joints | None = None
        for waypoint in path:
            self.move_to(
                waypoint.joints, waypoint.speed, via=waypoint.via, via_speed=waypoint.via_speed
            )
            last = waypoint.joints
        return self.settle(last)

    def settle(self, goal: Joints | None) -> ArmReading:
        """Wait until ``settle_time`` has passed since the last move and verify ``goal`` again."""
        self._require_ready(homed=True)
        rested = self._latest.stamp if self._latest is not None else self._transport.now()
        try:
            self._wait(rested + self.settings.settle_time)
            reading = self._arrive(self._transport.now(), self._reply_deadline())
            if goal is not None and not self._agrees(goal, reading.joints):
                # The report may have been garbled, so read again before the move counts as failed.
                reading = self._read()
                if reading.moving or not self._agrees(goal, reading.joints):
                    raise self._mismatch_fault(goal, reading.joints)
        except HardwareFault as fault:
            raise self._record_fault(fault) from fault.__cause__
        return reading

    def stop(self) -> bool:
        """Stop the arm immediately and latch the stop until ``clear_fault``. May be called from any
        thread.

        Returns whether the stop bytes were sent. If not, the next ``connect`` sends a stop, even
        after ``clear_fault``. The stop may be lost on its way, so the emergency stop is wired in
        hardware.
        """
        self._stopped.set()
        self.counters.stops += 1
        sent = self._transport.stop(self._dialect.stop_bytes)
        if not sent:
            self._stops_when_opened = True
        return sent

    def clear_fault(self, timeout: float = 5.0) -> None:
        """Clear a latched fault or stop, and reopen the line if it was lost.

        After a stop, an alarm or a reset the arm must be homed again.
        """
        self._begin_call()
        first = self._fault
        must_unlock = self._stopped.is_set() or first is not None
        if must_unlock:
            self._homed = False
            self._confirmed = None
        self._fault = None
        self._transport.release()
        self._stopped.clear()
        try:
            if not self.connected or self._stops_when_opened:
                self._connect_to_locked(timeout)
            if must_unlock or self._dialect.read(self._reply_deadline()).alarm:
                self._homed = False
                self._confirmed = None
                self._dialect.clear(self._transport.now() + timeout)
        except HardwareFault as fault:
            if fault.reason is FaultReason.NEEDS_PERSON:
                self.close()
            noted = self._record_fault(fault)
            if must_unlock and noted.reason in LINE_LOST:
                # The loss of the connection is not latched, because the next connect restores the
                # connection. An earlier fault stays latched.
                self._fault = first
            elif must_unlock:
                # A fault that could not be cleared stays latched.
                self._fault = first or noted
            raise noted from fault.__cause__
        self._fault = None

    def _connect_to_locked(self, timeout: float) -> None:
        """Connect. A controller that refuses queries because it is in a sleep or hold state is
        reset first."""
        try:
            self.connect(timeout)
        except HardwareFault as fault:
            if fault.reason is not FaultReason.REJECTED:
                raise
        else:
            return
        self._transport.open(timeout)
        self._dialect.clear(self._transport.now() + timeout)
        self._fault = None
        self.connect(timeout)

    def _move(
        self, legs: tuple[Joints, ...], speeds: tuple[float, ...], deadline: float | None
    ) -> ArmReading:
        path = _Path((self._start().joints, *legs), speeds)
        duration, began = self._duration(path), self._transport.now()
        if deadline is None:
            deadline = began + self.settings.move_factor * duration + self.settings.move_margin
        try:
            reading, failure = self._follow(path, deadline)
        except HardwareFault as fault:
            if fault.reason is FaultReason.TIMEOUT:
                raise self._stop_after(
                    HardwareFault(
                        FaultReason.TIMEOUT,
                        f"a move that should take {duration:.2f} s had not ended"
                        f" {self._transport.now() - began:.2f} s after it was sent ({fault})",
                    )
                ) from fault
            if fault.reason is FaultReason.REJECTED:
                raise self._stop_after(fault) from fault
            raise
        if failure is not None:
            failure = self._beyond_limit(reading.joints) or failure
            if reading.moving:
                raise self._stop_after(failure)
        self._confirmed = reading.joints
        if failure is not None:
            raise failure
        self._latest = reading
        self.counters.moves += 1
        return reading

    def _start(self) -> ArmReading:
        """Verify that the arm is still where the last move ended, and return the reading."""
        start = self._recent() or self._read()
        self._latest = None
        if start.alarm:
            raise HardwareFault(
                FaultReason.ALARM,
                f"the arm's controller is {start.alarm}: clear the fault and home again",
            )
        if self._confirmed is None:
            raise HardwareFault(
                FaultReason.POSITION_LOST,
                "the arm's last move was not confirmed; the arm is now at"
                f" {joints_text(start.joints)}: clear the fault and home again",
            )
        if not self._agrees(self._confirmed, start.joints):
            raise HardwareFault(
                FaultReason.POSITION_LOST,
                f"the arm is at {joints_text(start.joints)}, but its last confirmed position is"
                f" {joints_text(self._confirmed)}: it was moved or its controller restarted; clear"
                " the fault and home again",
            )
        return start

    def _follow(self, path: _Path, deadline: float) -> tuple[ArmReading, HardwareFault | None]:
        """Send a path, and repeat the remaining part if a line was lost or rejected.

        Returns the last reading, and the fault that prevented the arm from reaching the end of the
        path (None if the arm is there).
        """
        goal = path.places[-1]
        for attempt in range(MOVE_ATTEMPTS):
            self.counters.retries += attempt > 0
            # From here on, the arm may be anywhere on the path, so its position is not confirmed.
            self._confirmed = None
            refusal = self._send(path, deadline)
            if refusal is None:
                reading = self._arrive(self._transport.now() + self._duration(path), deadline)
            elif len(path.places) > 2:
                # The move before the rejected line may still be in progress, so wait for its end.
                self._arrive(self._transport.now(), deadline)
            if refusal is not None or not self._agrees(goal, reading.joints):
                # The report may have been garbled, so read again before the move counts as failed.
                reading = self._read()
            if not reading.moving and self._agrees(goal, reading.joints):
                return reading, None
            stands = [n for n, p in enumerate(path.places[:-1]) if self._agrees(p, reading.joints)]
            if reading.moving or not stands:
                break
            path = _Path(path.places[stands[-1] :], path.speeds[stands[-1] :])
        return reading, refusal or self._mismatch_fault(goal, reading.joints)

    def _duration(self, path: _Path) -> float:
        return sum(move_duration(self.geometry, a, b, speed) for a, b, speed in path.legs())

    def _send(self, path: _Path, deadline: float) -> HardwareFault | None:
        """Send the moves of a path; return the fault if the controller rejected one of them."""
        moves: list[StraightMove] = []
        for start, goal, speed in path.legs():
            target = self._to_axes(goal)
            length = math.dist(self._to_axes(start), target)
            time = max(
                abs(b - a) / (v * speed)
                for a, b, v in zip(start, goal, self.geometry.max_speed, strict=True)
            )
            if time == 0:
                continue
            moves.append(StraightMove(target, max(60 * length / time, MIN_FEED)))
        try:
            self._dialect.start_moves(moves, deadline)
        except HardwareFault as fault:
            if fault.reason is FaultReason.UNREACHABLE:
                # The fault was found before anything was sent, so the arm is still at the start of
                # the path.
                self._confirmed = path.places[0]
            if fault.reason is not FaultReason.REJECTED:
                raise
            return fault
        return None

    def _arrive(self, expected_end: float, deadline: float) -> ArmReading:
        """Wait until the arm is at rest, or until it moves beyond a joint limit, and return the
        reading."""
        return self._in_joints(self._dialect.finish_move(expected_end, deadline, self._axes_within))

    def _home_by_firmware(self) -> Joints:
        home = None if self.settings.home_joints is None else Joints(*self.settings.home_joints)
        axes = None if home is None else self._to_axes(home)
        self._dialect.home(axes, self._transport.now() + self.settings.homing_timeout)
        joints = self._read_at_rest().joints
        if home is None:
            check_limits(self.geometry, self._within_limits(joints))
        elif not self._agrees(home, joints):
            raise self._mismatch_fault(home, joints)
        return joints

    def _declare(self, strategy: HomingStrategy) -> Joints:
        reading = self._read()
        if reading.alarm:
            raise HardwareFault(
                FaultReason.ALARM,
                f"the arm's controller is {reading.alarm}: clear the fault before homing"
                f" (arm.homing is '{strategy.value}')",
            )
        if reading.moving:
            raise HardwareFault(
                FaultReason.HOMING_FAILED,
                f"the arm is moving, now at {joints_text(reading.joints)}: wait until it stops, "
                "then home again",
            )
        home = self.settings.home_joints
        if strategy is HomingStrategy.NONE or home is None:
            check_limits(self.geometry, self._within_limits(reading.joints))
            return reading.joints
        target = Joints(*home)
        self._dialect.set_position(self._to_axes(target), self._reply_deadline())
        reading = self._read()
        if not self._agrees(target, reading.joints):
            raise self._mismatch_fault(target, reading.joints)
        return reading.joints

    def _recent(self) -> ArmReading | None:
        """Return the last reading if it is recent enough for the start of a move, else None."""
        fresh = self._latest
        if fresh is None or self._transport.now() - fresh.stamp > FRESHNESS:
            return None
        return fresh

    def _read(self) -> ArmReading:
        return self._in_joints(self._dialect.read(self._reply_deadline()))

    def _read_at_rest(self) -> ArmReading:
        """Read; if the arm moves, wait until it is at rest, and read again."""
        reading, deadline = self._read(), self._reply_deadline()
        while reading.moving:
            self._arrive(self._transport.now(), deadline)
            reading = self._read()
        return reading

    def _in_joints(self, reading: AxisReading) -> ArmReading:
        if reading.powerless and self._homed:
            raise HardwareFault(
                FaultReason.POSITION_LOST,
                f"the arm's controller is {reading.alarm}: its motors may have been without "
                "power, so the arm's position is unknown: clear the fault and home again",
            )
        return self._converted(reading)

    def _converted(self, reading: AxisReading) -> ArmReading:
        """Convert a reading to joint values, even if the position cannot be trusted."""
        return ArmReading(
            self._to_joints(reading.axes),
            reading.moving,
            reading.alarm,
            reading.measured,
            reading.asked,
        )

    def _to_axes(self, joints: Joints) -> Axes:
        return to_axes(self.settings.axis_sign, self._dialect.units, joints)

    def _to_joints(self, axes: Axes) -> Joints:
        return Joints(*to_joints(self.settings.axis_sign, self._dialect.units, axes))

    def _reply_deadline(self) -> float:
        return self._transport.now() + self.settings.reply_timeout

    def _wait(self, until: float) -> None:
        """Wait, and let the dialect process incoming data so that a stop is not missed."""
        while (left := until - self._transport.now()) > 0:
            self._dialect.idle(left)

    def _agrees(self, first: Joints, second: Joints) -> bool:
        angle, quill = self.settings.tolerance_angle, self.settings.tolerance_quill
        tolerances = (angle, angle, quill, angle)
        return all(abs(a - b) <= t for a, b, t in zip(first, second, tolerances, strict=True))

    def _within_limits(self, joints: Joints) -> Joints:
        """Return the joints at their limits if they are beyond them by no more than the tolerance:
        the controller rounds the position that it reports."""
        limits = zip(joints, self.geometry.lower, self.geometry.upper, strict=True)
        nearest = Joints(*(min(max(joint, low), high) for joint, low, high in limits))
        return nearest if self._agrees(nearest, joints) else joints

    def _beyond_limit(self, joints: Joints) -> HardwareFault | None:
        """Return the fault of an arm that is beyond a joint limit; None if it is not."""
        code, _ = self.geometry.limit_excess(self._within_limits(joints))
        if code is ReachCode.REACHED:
            return None
        joint = Joints._fields[JOINT_LIMITS.index(code)]
        # The end stop blocks the joint while the controller goes on counting steps.
        return HardwareFault(
            FaultReason.POSITION_LOST,
            f"the arm was sent to {joints_text(joints)}, where its {joint} is beyond its limit, "
            "perhaps by a damaged line: it may have hit its end stop, so look for damage, then "
            "clear the fault and home again",
        )

    def _axes_within(self, axes: Axes) -> bool:
        return self._beyond_limit(self._to_joints(axes)) is None

    def _mismatch_fault(self, goal: Joints, found: Joints) -> HardwareFault:
        return HardwareFault(
            FaultReason.POSITION_MISMATCH,
            f"the arm is at {joints_text(found)}, but should be at {joints_text(goal)} (tolerance "
            f"{math.degrees(self.settings.tolerance_angle):.3f} deg for a rotary joint, "
            f"{self.settings.tolerance_quill * 1e3:.2f} mm for the quill): check for an obstacle "
            "or a noisy line, then try again",
        )

    def _begin_call(self) -> None:
        """Begin to count the bytes and lines that are received during a call of the driver."""
        counters = self._dialect.counters
        counters.received = ReceivedBytes()
        self._lines_before = counters.lines, counters.bad_lines

    def _diagnose(self, fault: HardwareFault) -> HardwareFault:
        """If unreadable replies caused the fault, return a PROTOCOL fault instead. While
        connecting, replies that are text but cannot be decoded come from another firmware:
        UNKNOWN_FIRMWARE is then returned.
        """
        counters = self._dialect.counters
        lines = counters.lines - self._lines_before[0]
        bad = counters.bad_lines - self._lines_before[1]
        received, name = counters.received, self._transport.name
        if fault.reason in UNANSWERED and received.are_noise:
            what = f"{received.strange} of {received.total} bytes from {name} are not text"
        elif fault.reason is FaultReason.TIMEOUT and bad >= max(MIN_BAD_LINES, 0.5 * lines):
            what = f"{bad} of {lines} lines from the arm's controller on {name} were unreadable"
        elif (
            fault.reason is FaultReason.TIMEOUT
            and bad == lines
            and received.total >= MIN_UNREADABLE_BYTES
        ):
            what = (
                f"{received.total} bytes from the arm's controller on {name} contained no readable"
                " line"
            )
        else:
            return fault
        if not self._connected and not received.are_noise:
            return HardwareFault(
                FaultReason.UNKNOWN_FIRMWARE,
                f"{what}: check arm.dialect, the port, arm.baud and the cable",
            )
        return HardwareFault(
            FaultReason.PROTOCOL,
            f"{what}: check arm.baud, the cable and its grounding, and that the port is the arm's",
        )

    def _require_line(self) -> None:
        self._begin_call()
        if self._stopped.is_set():
            raise self._fault or self._stop_fault()
        if not self.connected:
            raise HardwareFault(
                FaultReason.DISCONNECTED,
                f"the arm on {self._transport.name} is not connected: connect first",
            )

    def _require_ready(self, homed: bool) -> None:
        self._require_line()
        if self._fault is not None:
            raise self._fault
        if homed and not self._homed:
            raise HardwareFault(FaultReason.NOT_HOMED, "the arm is not homed: home it first")

    def _record_fault(self, fault: HardwareFault) -> HardwareFault:
        """Record a fault in the driver's state and return the fault to raise.

        If a fault is latched, the latched fault is returned instead of a later one, because later
        faults are often consequences of the first: an alarm can be followed by a restart, and a
        stop causes an alarm.
        """
        if self._stopped.is_set() and fault.reason in OF_A_STOP:
            # The alarm or reset that a stop causes in the controller is not a separate fault.
            fault = self._fault or self._stop_fault()
        if fault is self._fault:
            return fault
        fault = self._diagnose(fault)
        self.counters.last_error = fault.sentence
        if fault.reason is FaultReason.DISCONNECTED:
            self._connected = False
        if fault.reason in HOMING_LOST:
            fault = self._latch(fault)
        return fault

    def _latch(self, fault: HardwareFault) -> HardwareFault:
        """Latch the first fault until it is cleared; the position is no longer trusted."""
        self._homed = False
        self._confirmed = None
        self._fault = self._fault or fault
        return self._fault

    def _stop_after(self, fault: HardwareFault) -> HardwareFault:
        """Stop the arm after a motion has failed, and latch the fault."""
        fault = self._diagnose(fault)
        result = (
            "the arm was stopped: "
            if self.stop()
            else "a stop could not be sent to the arm, so it may still be moving: press the "
            "emergency stop, then "
        )
        return self._latch(
            HardwareFault(fault.reason, f"{fault}; {result}clear the fault and home again")
        )

    def _stop_fault(self) -> HardwareFault:
        quill = (
            ""
            if self.settings.quill_brake
            else "; a stop can cut the motors' power, and a quill without a brake then sinks"
        )
        return HardwareFault(
            FaultReason.STOPPED,
            f"the arm was stopped: make the cell safe, clear the fault and home again{quill}",
        )
