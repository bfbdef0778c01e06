"""Tapper driver: charge, fire once within a time window, and report reliably what happened.

A shot can be fired only within a time window that begins at the last check before FIRE. FIRE
contains a deadline in the board's own time, and the board rejects FIRE after this deadline. The
clocks need no synchronisation: the driver queries the board's time, then asks its caller whether
the shot is still allowed, and only then sends FIRE. Regardless of any delay by this process, the
operating system or the line, the board fires before the deadline or not at all.

A shot is never fired twice. If the board receives a request again with the same sequence number, it
does not execute the request but repeats its reply. This driver never retries a shot whose FIRE may
have been sent.

If the reply to FIRE is missing, a further request determines the outcome. Once the board has
received this request, it no longer accepts FIRE, which has an older sequence number. The reply to
the request contains the last shot fired. If this reply is missing too, or the boot number has
changed, the outcome is UNKNOWN: check with the camera, do not fire again.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from tapping_cell.hardware import tapper_protocol as protocol
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.line_quality import ReceivedBytes
from tapping_cell.hardware.tapper_protocol import (
    Command,
    Mode,
    OtherFirmware,
    Reply,
    Result,
    State,
)
from tapping_cell.hardware.transport import Transport

PROTOCOL_VERSION = "2"
"""Major version of the protocol that this driver supports. A board with version 1 is rejected: its
FIRE has no deadline, so the board could fire long after the last check."""
CLOCK_TOLERANCE = 0.01
"""Maximum relative difference in rate between the board's clock and this computer's clock. The
board's ceramic resonator is accurate to 0.5 %."""
LONGEST_CHARGE = 10.0
"""Time after which the board discharges by itself, counted from CHARGE, s. It is the longest that
the board accepts: charging takes up to ``charge_timeout``, and the arm may be late by 3 s."""
RETURNING = frozenset({State.RELEASING, State.DISCHARGING, State.HOMING})
"""Transient states that lead to a state in which the board can charge."""


class FireOutcome(Enum):
    """Outcome of one shot."""

    FIRED = "fired"
    NOT_FIRED = "not_fired"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class FireResult:
    """Result of :meth:`TapperDriver.fire`; ``sentence`` gives the reason if the tapper has not
    fired."""

    outcome: FireOutcome
    shot: int
    sentence: str = ""
    fault: HardwareFault | None = None
    """Reason why the board refused to fire; None if the last check refused."""


@dataclass(frozen=True, slots=True)
class TapperSettings:
    """Timeouts and periods of the driver, s."""

    reply_timeout: float = 0.06
    """Longest wait for the reply before a request is repeated. For comparison, the transmission of
    a frame of 100 bytes takes 9 ms at 115200 baud."""
    fire_reply_timeout: float = 0.03
    """Longest wait for the reply before FIRE is repeated; shorter than the window, so that a lost
    frame can be resent within the window."""
    attempts: int = 5
    charge_timeout: float = 7.0
    """Longest charging time: the firmware's LONGEST_DRAW_STEPS (12000) at 2000 steps/s, plus a
    margin."""
    home_timeout: float = 8.0
    """Longest duration of homing and of the carriage's return to its front end."""
    poll_period: float = 0.002
    """Time between status requests while charging; far below the 500 ms without a frame after which
    the tapper discharges."""
    mode: Mode = Mode.RUN
    """Mode that the board is set to when a session is opened."""

    def __post_init__(self) -> None:
        if self.attempts < 1 or min(self.reply_timeout, self.fire_reply_timeout) <= 0:
            raise ValueError(
                f"attempts is {self.attempts}, reply_timeout {self.reply_timeout:g} s and"
                f" fire_reply_timeout {self.fire_reply_timeout:g} s: attempts must be at least 1,"
                " and both timeouts must be above 0"
            )
        if self.poll_period + self.reply_timeout > protocol.SILENCE_LIMIT / 2:
            raise ValueError(
                f"the sum of poll_period ({self.poll_period:g} s) and reply_timeout"
                f" ({self.reply_timeout:g} s) must be at most {protocol.SILENCE_LIMIT / 2:g} s,"
                f" half of the tapper's silence limit of {protocol.SILENCE_LIMIT:g} s"
            )


@dataclass(slots=True)
class TapperCounters:
    """Counters for diagnostics."""

    fired: int = 0
    unknown: int = 0
    late: int = 0
    """Shots that the board rejected because FIRE arrived after its deadline."""
    retries: int = 0
    timeouts: int = 0
    bad_frames: int = 0
    damaged_frames: int = 0
    """Number of bad frames that began or ended like a frame of the tapper."""
    reconnects: int = 0
    stops: int = 0
    last_error: str = ""


class RecordingTapper:
    """State that every tapper driver keeps: counters, the stop latch and the last shots."""

    def __init__(self) -> None:
        self.counters = TapperCounters()
        self.last_reply: Reply | None = None
        """Last reply of the tapper."""
        self._attempted = 0
        self._stopped = threading.Event()

    @property
    def stopped(self) -> bool:
        """True if ``stop`` is latched in this driver."""
        return self._stopped.is_set()

    def _not_fired(self, shot: int, fault: HardwareFault) -> FireResult:
        return FireResult(FireOutcome.NOT_FIRED, shot, str(fault), fault=fault)

    def _unknown_result(self, shot: int, why: str) -> FireResult:
        self.counters.unknown += 1
        return FireResult(
            FireOutcome.UNKNOWN,
            shot,
            f"it is unknown whether shot {shot} was fired ({why}): check where the object is, "
            "do not fire again",
        )

    def _require_no_stop(self) -> None:
        if self._stopped.is_set():
            raise self._record_fault(
                FaultReason.STOPPED,
                "the tapper is stopped: make the cell safe, then clear the fault",
            )

    def _record_fault(self, reason: FaultReason, sentence: str) -> HardwareFault:
        self.counters.last_error = sentence
        return HardwareFault(reason, sentence)


class TapperDriver(RecordingTapper):
    """Driver of one tapper on one line. All calls except ``stop`` block and must come from one
    thread."""

    def __init__(
        self,
        transport: Transport,
        settings: TapperSettings | None = None,
        draw_number: Callable[[int], int] = secrets.randbelow,
    ) -> None:
        super().__init__()
        self.settings = settings or TapperSettings()
        self._transport = transport
        self._draw_number = draw_number
        self._buffer = b""
        self._session = 0
        self._sequence = 0
        self._boot: int | None = None
        self._version = ""
        self._channels = 1
        self._channel = 0
        self._mode = self.settings.mode
        self._begin_exchange()

    @property
    def connected(self) -> bool:
        """True if a session is open, as far as is known."""
        return self._boot is not None and self._transport.is_open

    def now(self) -> float:
        """Return the time of the host's steady clock, s."""
        return self._transport.now()

    @property
    def port(self) -> str:
        """Name of the line, for messages."""
        return self._transport.name

    @property
    def version(self) -> str:
        """Firmware version; empty before the first connect."""
        return self._version

    @property
    def channels(self) -> int:
        """Number of tappers on the board; 1 before the first connect and for firmware 2.0."""
        return self._channels

    @property
    def mode(self) -> Mode:
        """Mode that the board is kept in: set-up or run."""
        return self._mode

    def connect(self, timeout: float = 5.0) -> Reply:
        """Open the line, begin a new session, which discharges the tapper, and set the mode.

        ``timeout``: longest wait for the port, and then for an answer, s. Raises HardwareFault:
        PORT_MISSING, PORT_BUSY, UNKNOWN_FIRMWARE, PROTOCOL, TIMEOUT, STOPPED. After a fault other
        than STOPPED, the port is closed.
        """
        again = self._boot is not None
        self._boot = None
        self._transport.open(timeout)
        self.counters.reconnects += again
        try:
            reply = self._greet(self._transport.now() + timeout)
            self._version = reply.version
            self._channels = reply.channels
            self._boot = reply.boot
            return self.set_mode(self._mode)
        except HardwareFault as fault:
            if fault.reason is not FaultReason.STOPPED:
                self.close()
            raise

    def _greet(self, deadline: float) -> Reply:
        """Send HELLO until the board answers; return its reply."""
        self._buffer = b""
        self._begin_exchange()
        # The session number is random, so that a stray frame of an old session is very unlikely to
        # match it.
        self._session = self._draw_number(0xFFFF) + 1
        while True:
            self._sequence = (self._sequence + 1) & 0xFFFF
            frame = protocol.encode(self._session, self._sequence, Command.HELLO)
            reply = self._exchange(frame, self._sequence, attempts=2)
            if reply is not None and reply.result is Result.WELCOME:
                break
            if self._transport.now() > deadline:
                self._require_readable()
                raise self._record_fault(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"nothing on {self._transport.name} answers like the tapper: check the port,"
                    " power and that its firmware is loaded",
                )
        if reply.version.split(".")[0] != PROTOCOL_VERSION:
            raise self._firmware_fault(reply.version)
        return reply

    def _firmware_fault(self, version: str) -> HardwareFault:
        return self._record_fault(
            FaultReason.UNKNOWN_FIRMWARE,
            f"tapper firmware {version} uses another protocol than this driver (version"
            f" {PROTOCOL_VERSION}): flash the firmware of this repository (make -C firmware/tapper"
            " flash PORT=...)",
        )

    def close(self) -> None:
        """Close the line; the tapper then discharges after the silence limit."""
        self._boot = None
        self._transport.close()

    def status(self) -> Reply:
        """Query the state. The query also keeps a charged tapper charged: the tapper discharges if
        it receives no frame for 500 ms."""
        return self._request(Command.STATUS)

    def set_mode(self, mode: Mode) -> Reply:
        """Set the board to set-up or run mode, now and at every later ``connect``.

        In set-up mode the board refuses energies above its set-up limit unless the enabling switch
        at the cell is held; releasing the switch discharges energy above the limit. Raises
        HardwareFault: TIMEOUT, BOARD_RESET, STOPPED, DISCONNECTED.
        """
        reply = self._request(Command.MODE, mode)
        if reply.result is not Result.OK or reply.mode is not mode:
            raise self._refusal(reply)
        self._mode = mode
        return reply

    def home(self, go_on: Callable[[], bool] = lambda: True) -> Reply:
        """Verify the striker's position: the spring's carriage moves to its front switch, and
        strikers at fixed mounts must close their switches.

        ``go_on`` is called every few milliseconds. When ``go_on`` returns False, DISCHARGE is sent,
        which stops the carriage, and the reply is returned with the state UNHOMED. Raises
        HardwareFault: HOMING_FAILED, STRIKER_AWAY, INTERLOCK, STOPPED, TIMEOUT, BOARD_RESET,
        DISCONNECTED.
        """
        reply = self._request(Command.HOME)
        if reply.result is not Result.OK:
            raise self._refusal(reply)
        deadline = self._transport.now() + self.settings.home_timeout
        while reply.state is State.HOMING:
            if not go_on():
                return self.discharge()
            if self._transport.now() > deadline:
                self.discharge()
                break
            self._receive(self.settings.poll_period)
            reply = self._request(Command.STATUS)
        if reply.state is not State.SAFE:
            if reply.stop_latched or not reply.interlock_closed:
                raise self._refusal(reply)
            if reply.channels > 1:
                raise self._refusal(reply)
            raise self._record_fault(
                FaultReason.HOMING_FAILED,
                "the tapper's carriage did not find its front switch, or did not leave it: check"
                " the motor's power and enable wire, the switch and its wire (D9)",
            )
        return reply

    def charge(
        self,
        shot: int,
        energy: float,
        go_on: Callable[[], bool] = lambda: True,
        timeout: float = LONGEST_CHARGE,
        channel: int = 0,
    ) -> Reply:
        """Store ``energy`` in J for ``shot`` on a channel; return when charged.

        The tapper discharges automatically ``timeout`` s after the request, or 500 ms after the
        last frame. A carriage at an unknown position is homed first; if the carriage is returning,
        the call waits. Neither is begun again after ``home_timeout``. ``go_on`` is called every few
        milliseconds. When ``go_on`` returns False, DISCHARGE is sent immediately, and the reply is
        returned with a state other than CHARGED. ``shot`` must be greater than every shot number
        charged before, by at most ``MAXIMUM_JUMP``.
        Raises HardwareFault: SHOT_SPENT, INTERLOCK, STOPPED, OUT_OF_RANGE, TIMEOUT, BOARD_RESET,
        REJECTED, DISCONNECTED, HOMING_FAILED, POSITION_LOST, STRIKER_AWAY, SETTINGS_MISMATCH,
        NEEDS_PERSON.
        """
        if not 0 <= channel < self._channels:
            raise self._record_fault(FaultReason.SETTINGS_MISMATCH, self._no_such_channel(channel))
        most_uj = protocol.MAXIMUM_ENERGY_UJ
        if not (0 < shot <= protocol.MAXIMUM_SHOT and 1 <= 1e6 * energy <= most_uj):
            raise self._record_fault(
                FaultReason.OUT_OF_RANGE,
                f"shot number {shot} or energy {energy:g} J is out of range: the number must be 1"
                f" to {protocol.MAXIMUM_SHOT}, the energy 1e-06 to {most_uj * 1e-6:g} J",
            )
        energy_uj = round(1e6 * energy)
        self._refuse_spent(shot)
        until = self._transport.now() + self.settings.home_timeout
        while True:
            reply = self._request(
                Command.CHARGE, shot, energy_uj, round(timeout * 1e3), *_channel_argument(channel)
            )
            if reply.result is Result.NOT_HOMED and reply.state is State.UNHOMED:
                if not go_on():
                    return self.discharge()
                if self._transport.now() > until:
                    raise self._refusal(reply)
                reply = self.home(go_on)
                if reply.state is not State.SAFE:
                    return reply
            elif (
                reply.result in (Result.BUSY, Result.NOT_HOMED)
                and reply.state in RETURNING
                and self._transport.now() < until
            ):
                if not go_on():
                    return self.discharge()
                self._receive(self.settings.poll_period)
            elif reply.result is not Result.OK:
                raise self._refusal(reply)
            else:
                break
        deadline = self._transport.now() + self.settings.charge_timeout
        while reply.state is not State.CHARGED:
            if reply.state is not State.CHARGING or reply.shot != shot:
                raise self._refusal(reply)
            if self._transport.now() > deadline:
                self.discharge()
                raise self._record_fault(
                    FaultReason.TIMEOUT,
                    f"the tapper was not charged after {self.settings.charge_timeout:g} s: check"
                    " whether the spring or its motor is blocked",
                )
            if not go_on():
                return self.discharge()
            self._receive(self.settings.poll_period)
            reply = self._request(Command.STATUS)
        echoed = reply.shot, round(reply.energy * 1e6), reply.channel
        if echoed != (shot, energy_uj, channel):
            self.discharge()
            raise self._record_fault(
                FaultReason.REJECTED,
                f"the tapper is charged for shot {reply.shot} with {reply.energy:g} J on "
                f"channel {reply.channel}, but shot {shot} with {energy:g} J on channel {channel} "
                "was requested, so the tapper was discharged",
            )
        self._channel = channel
        return reply

    def _no_such_channel(self, channel: int) -> str:
        return (
            f"channel {channel} was requested, but the board on {self._transport.name} has "
            f"{self._channels} (firmware {self._version}): correct the channels in the cell "
            "file, or flash the build for more (make -C firmware/tapper DRIVE=SOLENOID "
            "CHANNELS=8 flash PORT=...)"
        )

    def fire(self, shot: int, window: float, still_allowed: Callable[[float], bool]) -> FireResult:
        """Fire the charged ``shot`` once, within ``window`` s from now, or not at all.

        The driver queries the board's time, calls ``still_allowed`` (the last check), and sends
        FIRE with a deadline ``window`` after the board's time. ``still_allowed`` receives the
        latest time of the host's steady clock, in s, at which the release output can still be on;
        the striker's flight time is not included. ``still_allowed`` is called again before each
        repetition of FIRE, whose deadline stays the same. When ``still_allowed`` returns False, the
        tapper is discharged.

        ``window``: at most ``LONGEST_WINDOW``; a line with a USB adapter needs 20 to 40 ms. Before
        UNKNOWN is returned, the call waits until a release is no longer possible. Line errors after
        FIRE was sent are not raised but reported by the outcome. Raises HardwareFault only before
        FIRE is sent, so a raised fault means that this call did not fire the shot: SHOT_SPENT,
        OUT_OF_RANGE, STOPPED, TIMEOUT, BOARD_RESET, DISCONNECTED.
        """
        self._require_session()
        self._refuse_spent(shot)
        if not 1e-3 <= window <= protocol.LONGEST_WINDOW:
            raise self._record_fault(
                FaultReason.OUT_OF_RANGE,
                f"the firing window of shot {shot} is {window:g} s, but must be 0.001 to"
                f" {protocol.LONGEST_WINDOW:g} s",
            )
        sample = self._request(Command.STATUS)
        sampled_at = self._transport.now()
        if sample.state is not State.CHARGED or sample.shot != shot:
            return self._not_fired(shot, self._refusal(sample))
        boot = self._boot
        release_by = self._latest_release(sampled_at, window)
        if not still_allowed(release_by):
            self.discharge()
            sentence = f"the last check before FIRE forbade shot {shot}"
            return FireResult(FireOutcome.NOT_FIRED, shot, sentence)
        self._attempted = shot
        deadline = protocol.deadline_after(sample.time_ms, window)
        try:
            reply = self._send_fire(
                shot,
                deadline,
                lambda: self._transport.now() < sampled_at + window and still_allowed(release_by),
            )
            if reply is None:
                # After this request, the board rejects the older FIRE, so the reply determines the
                # outcome.
                sequence = self._next_sequence()
                settle = protocol.encode(self._session, sequence, Command.DISCHARGE)
                reply = self._exchange(settle, sequence, self.settings.attempts)
        except HardwareFault as fault:
            self.counters.last_error = fault.sentence
            return self._unknown(shot, release_by, fault.sentence)
        if reply is None:
            return self._unknown(shot, release_by, "the tapper does not answer")
        if reply.boot != boot:
            self._boot = None
            return self._unknown(shot, release_by, "the tapper restarted")
        if reply.last_fired == shot:
            self.counters.fired += 1
            return FireResult(FireOutcome.FIRED, shot)
        if reply.result is Result.SESSION:
            self._boot = None
        self.counters.late += reply.result is Result.LATE
        return self._not_fired(shot, self._refusal(reply))

    def _latest_release(self, sampled_at: float, window: float) -> float:
        """Return the latest time at which the release output can still be on, s. This is an upper
        limit: the board read its time before ``sampled_at``, the deadline is ``window`` after this
        reading, and the pulse begins before the deadline."""
        return sampled_at + (window + protocol.LONGEST_PULSE) * (1 + CLOCK_TOLERANCE)

    def _send_fire(self, shot: int, deadline: int, again: Callable[[], bool]) -> Reply | None:
        """Send FIRE and repeat it while ``again`` returns True; return the reply, or None if
        there was none."""
        sequence = self._next_sequence()
        frame = protocol.encode(
            self._session, sequence, Command.FIRE, shot, deadline, *_channel_argument(self._channel)
        )
        timeout = self.settings.fire_reply_timeout
        return self._exchange(frame, sequence, self.settings.attempts, timeout, again)

    def _refuse_spent(self, shot: int) -> None:
        if shot <= self._attempted:
            raise self._record_fault(
                FaultReason.SHOT_SPENT,
                f"shot {shot} may have been fired already (last tried: {self._attempted}): use a"
                " new number",
            )

    def wait_for_return(self, go_on: Callable[[], bool] = lambda: True) -> Reply:
        """After a release, wait until the board is at rest. Return its last reply.

        The state is SAFE when the striker is back, or UNHOMED when the board has stopped waiting
        for the striker. Any other state means that ``go_on`` returned False or the wait timed out.
        Raises HardwareFault: TIMEOUT, BOARD_RESET, STOPPED, DISCONNECTED.
        """
        reply = self._request(Command.STATUS)
        until = self._transport.now() + self.settings.home_timeout
        while reply.state in RETURNING and go_on() and self._transport.now() < until:
            self._receive(self.settings.poll_period)
            reply = self._request(Command.STATUS)
        return reply

    def discharge(self) -> Reply:
        """Discharge the tapper without firing; this also ends homing."""
        return self._request(Command.DISCHARGE)

    def stop(self) -> bool:
        """Latch the tapper's stop immediately, from any thread; return whether it was sent.

        The stop may be lost on its way, so the emergency stop is wired in hardware.
        """
        self._stopped.set()
        self.counters.stops += 1
        return self._transport.stop(protocol.STOP)

    def clear(self, timeout: float = 5.0) -> Reply:
        """Clear the latched stop; the tapper also requires an action by a person at the cell.

        Raises HardwareFault: NEEDS_PERSON, STOPPED, TIMEOUT, BOARD_RESET, DISCONNECTED.
        """
        self._transport.release()
        self._stopped.clear()
        if not self.connected:
            self.connect(timeout)
        reply = self._request(Command.CLEAR)
        if reply.result is not Result.OK:
            raise self._refusal(reply)
        # A stop during ``connect`` leaves the board in the mode in which it begins a session.
        return reply if reply.mode is self._mode else self.set_mode(self._mode)

    def _unknown(self, shot: int, release_by: float, why: str) -> FireResult:
        rest = release_by - self._transport.now()
        if rest > 0:
            # Wait even during a stop, because the stop may have been lost on its way to the board.
            self._transport.sleep(rest)
        return self._unknown_result(shot, why)

    def _next_sequence(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _request(self, command: Command, *arguments: int | Mode) -> Reply:
        """Send one request, repeated until it is answered; raise if no answer arrives or the board
        restarted."""
        self._require_session()
        sequence = self._next_sequence()
        frame = protocol.encode(self._session, sequence, command, *arguments)
        self._begin_exchange()
        try:
            reply = self._exchange(frame, sequence, self.settings.attempts)
        except HardwareFault as fault:
            self.counters.last_error = fault.sentence
            if fault.reason is FaultReason.DISCONNECTED:
                self._boot = None
            raise
        if reply is None:
            self._require_readable()
            raise self._record_fault(
                FaultReason.TIMEOUT,
                f"the tapper on {self._transport.name} does not answer {command.value}"
                f" ({self.settings.attempts} tries): check power and cable, then connect again",
            )
        if reply.boot != self._boot or reply.result is Result.SESSION:
            restarted = reply.boot != self._boot
            self._boot = None
            raise self._record_fault(
                FaultReason.BOARD_RESET,
                f"the tapper on {self._transport.name}"
                f" {'restarted' if restarted else 'was taken over by another session'}: connect"
                " again",
            )
        return reply

    def _begin_exchange(self) -> None:
        """Reset the counts of received bytes and of requests."""
        self._received = ReceivedBytes()
        self._sends = 0
        self._damaged = 0
        """Number of these requests whose answers were damaged."""

    def _require_readable(self) -> None:
        """Raise PROTOCOL if replies were received, but most of them were unreadable."""
        name, received = self._transport.name, self._received
        if received.are_noise:
            what = f"{received.strange} of {received.total} bytes from {name} are not text"
        elif 2 * self._damaged > self._sends:
            what = (
                f"the replies of the tapper on {name} to {self._damaged} of {self._sends} requests"
                " were damaged"
            )
        else:
            return
        raise self._record_fault(
            FaultReason.PROTOCOL,
            f"{what}: check tapper.baud, the cable and its grounding, and that the port is the"
            " tapper's",
        )

    def _exchange(
        self,
        frame: bytes,
        sequence: int,
        attempts: int,
        timeout: float | None = None,
        again: Callable[[], bool] = lambda: True,
    ) -> Reply | None:
        """Send a frame up to ``attempts`` times until its reply arrives; return None without a
        reply.

        ``timeout``: longest wait for each reply, s; None uses ``reply_timeout``. ``again`` is
        called before each repetition; if it returns False, the frame is not sent again.
        """
        patience = self.settings.reply_timeout if timeout is None else timeout
        for attempt in range(attempts):
            if attempt and not again():
                break
            self.counters.retries += attempt > 0
            reply = self._send(frame, sequence, patience)
            if reply is not None:
                return reply
        return None

    def _send(self, frame: bytes, sequence: int, timeout: float) -> Reply | None:
        """Send a frame once; return its reply within ``timeout`` s, or None."""
        self._transport.write(frame)
        self._sends += 1
        damaged = self._damaged_frames()
        until = self._transport.now() + timeout
        while (left := until - self._transport.now()) > 0:
            for reply in self._receive(left):
                if (reply.session, reply.sequence) == (self._session, sequence):
                    self.last_reply = reply
                    return reply
        self.counters.timeouts += 1
        self._damaged += self._damaged_frames() > damaged
        return None

    def _damaged_frames(self) -> int:
        """Return the number of frames so far that the tapper sent and the line damaged.

        In a session, all unreadable bytes come from the tapper, even if neither the beginning nor
        the end of a frame can be recognized. Before a session, another device may have sent these
        bytes.
        """
        return self.counters.bad_frames if self.connected else self.counters.damaged_frames

    def _receive(self, wait: float) -> list[Reply]:
        """Wait up to ``wait`` s for bytes, and return the replies that they complete."""
        data = self._transport.read(wait)
        self._received.take(data)
        self._buffer += data
        replies: list[Reply] = []
        while True:
            decoded = protocol.decode(self._buffer)
            self._buffer = decoded.rest
            if decoded.frame is None:
                return replies
            if isinstance(decoded.frame, Reply):
                replies.append(decoded.frame)
            elif isinstance(decoded.frame, OtherFirmware):
                raise self._firmware_fault(decoded.frame.version)
            else:
                self.counters.bad_frames += 1
                self.counters.damaged_frames += decoded.frame.damaged

    def _require_session(self) -> None:
        self._require_no_stop()
        if not self.connected:
            raise self._record_fault(
                FaultReason.DISCONNECTED,
                f"no session with the tapper on {self._transport.name}: connect first",
            )

    def _refusal(self, reply: Reply) -> HardwareFault:
        """Return the fault for a reply that refuses a request or reports an unexpected state."""
        shot = f"shot {reply.shot}"
        if reply.result is Result.NEEDS_PERSON:
            reason, text = (
                FaultReason.NEEDS_PERSON,
                "the tapper's stop is latched: a person must press the clear button at the cell for"
                " half a second and let it go, then clear the fault within 10 s",
            )
        elif reply.stop_latched or reply.result is Result.STOPPED:
            reason, text = (
                FaultReason.STOPPED,
                "the tapper's stop is latched: make the cell safe, then clear the fault",
            )
        elif not reply.interlock_closed or reply.result is Result.INTERLOCK:
            reason, text = (
                FaultReason.INTERLOCK,
                "the tapper's interlock is open: close the guard",
            )
        elif reply.result is Result.LATE:
            reason, text = (
                FaultReason.TIMEOUT,
                "FIRE reached the tapper after its deadline, so the striker was not fired: this"
                " computer or the line was too slow; reduce the computer's load or use a longer"
                " firing window",
            )
        elif reply.result is Result.SPENT:
            reason, text = (
                FaultReason.SHOT_SPENT,
                f"the tapper has used that shot number or a greater one (last charged:"
                f" {reply.shot}): use a greater number, or reset the count by holding the clear"
                " button at the cell for 5 s while the tapper is at rest",
            )
        elif reply.result is Result.JUMP:
            reason, text = (
                FaultReason.OUT_OF_RANGE,
                f"that shot number is more than {protocol.MAXIMUM_JUMP} above the last"
                " number that the tapper used: use a smaller number",
            )
        elif reply.result is Result.NOT_ENABLED:
            reason, text = (
                FaultReason.NOT_ENABLED,
                "the tapper is in set-up mode: it accepts more than its set-up energy only"
                " while the enabling switch is held; hold it, use less energy, or set run mode",
            )
        elif reply.result is Result.RANGE:
            reason, text = (
                FaultReason.OUT_OF_RANGE,
                "the tapper refused the energy or the timeout as out of its range: check the energy"
                " table against the firmware's build",
            )
        elif reply.result is Result.CHANNEL:
            reason, text = FaultReason.SETTINGS_MISMATCH, self._no_such_channel(reply.channel)
        elif reply.state is State.UNHOMED and reply.channels > 1:
            away = [
                str(channel)
                for channel in range(reply.channels)
                if not reply.at_mounts >> channel & 1
            ]
            which = f"of channel {', '.join(away)}" if away else "released last"
            reason, text = (
                FaultReason.STRIKER_AWAY,
                f"according to its switch, the striker {which} did not leave its mount, or has"
                " not returned to it: free the striker, check its return spring and its switch",
            )
        elif reply.state is State.UNHOMED:
            reason, text = (
                FaultReason.POSITION_LOST,
                "the tapper's carriage is not at the position that its step count indicates: the"
                " motor missed steps or has no power; check the motor and its supply; the carriage"
                " is homed before the next shot",
            )
        elif reply.lacks_switch:
            reason, text = (
                FaultReason.NOT_ENABLED,
                "the enabling switch of set-up mode was released; without it the tapper keeps at"
                " most its set-up energy, so it discharged itself; hold the switch, or use less"
                " energy",
            )
        else:
            reason, text = (
                FaultReason.REJECTED,
                f"the tapper answered {reply.result.value} in state {reply.state.value} ({shot}),"
                " so the requested shot is not charged: it was never charged, or the tapper"
                " discharged itself because it received no request for 0.5 s, or the guard was"
                " opened or the enabling switch of set-up mode released briefly; charge again",
            )
        return self._record_fault(reason, text)


def _channel_argument(channel: int) -> tuple[int, ...]:
    """Return the channel argument of CHARGE and FIRE. Firmware 2.0 accepts no channel argument, so
    channel 0 is never sent."""
    return (channel,) if channel else ()
