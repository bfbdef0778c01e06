"""The tapper's driver: draw, fire once, say truly what happened.

A shot is never fired twice: a repeated request carries the same sequence number, which the tapper
answers from memory; a shot whose ``FIRE`` may have gone out is never tried again by this driver.
When the answer stays away, a later request settles it: the tapper takes no older sequence number
after a newer one, and each reply names the last shot fired. When that stays away too, or the boot
number has changed, the outcome is UNKNOWN: look with the camera, never fire again.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from tapping_cell.hardware import tapper_protocol as protocol
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.tapper_protocol import Command, Reply, Result, State
from tapping_cell.hardware.transport import Transport

PROTOCOL_VERSION = "1"
"""First part of the firmware's version that this driver speaks."""
LATEST_FIRE = protocol.SILENCE_LIMIT + 0.15
"""A FIRE frame that is stuck on the line can act no later than this after it was sent, s: by then
the tapper has heard nothing valid for 500 ms and has disarmed itself."""


class FireOutcome(Enum):
    """What became of one shot."""

    FIRED = "fired"
    NOT_FIRED = "not_fired"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class FireResult:
    """Answer of :meth:`TapperDriver.fire`; the sentence says why it is not FIRED."""

    outcome: FireOutcome
    shot: int
    sentence: str = ""


@dataclass(frozen=True, slots=True)
class TapperSettings:
    """Waits of the driver, s."""

    reply_timeout: float = 0.06
    """Before a request is repeated: a frame of 100 bytes takes 9 ms at 115200 baud."""
    attempts: int = 5
    draw_timeout: float = 3.0
    """Longest draw."""
    poll_period: float = 0.002
    """Between status requests while drawing; far below the 500 ms silence limit."""

    def __post_init__(self) -> None:
        if self.attempts < 1 or self.reply_timeout <= 0:
            raise ValueError("at least one attempt and a reply_timeout above 0 are needed")
        if self.poll_period + self.reply_timeout > protocol.SILENCE_LIMIT / 2:
            raise ValueError(
                f"poll_period {self.poll_period:g} s and reply_timeout {self.reply_timeout:g} s are"
                f" too long for the silence limit of {protocol.SILENCE_LIMIT:g} s"
            )


@dataclass(slots=True)
class TapperCounters:
    """Figures for diagnostics."""

    fired: int = 0
    unknown: int = 0
    retries: int = 0
    timeouts: int = 0
    bad_frames: int = 0
    reconnects: int = 0
    stops: int = 0
    last_error: str = ""


class TapperDriver:
    """One tapper on one line. All calls block and belong to one thread; ``stop`` to any."""

    def __init__(
        self,
        transport: Transport,
        settings: TapperSettings | None = None,
        draw_number: Callable[[int], int] = secrets.randbelow,
    ) -> None:
        self.settings = settings or TapperSettings()
        self.counters = TapperCounters()
        self._transport = transport
        self._draw_number = draw_number
        self._buffer = b""
        self._session = 0
        self._sequence = 0
        self._boot: int | None = None
        self._version = ""
        self._attempted = 0
        self._stopped = threading.Event()

    @property
    def connected(self) -> bool:
        """Whether a session is open as far as known."""
        return self._boot is not None and self._transport.is_open

    @property
    def version(self) -> str:
        """The firmware's version, empty before the first connect."""
        return self._version

    @property
    def stopped(self) -> bool:
        """Whether ``stop`` is latched on this side."""
        return self._stopped.is_set()

    def connect(self, timeout: float = 5.0) -> Reply:
        """Open the line and a new session, which disarms the tapper.

        ``timeout``: longest wait for the port, and then for an answer, s. Raises HardwareFault:
        PORT_MISSING, PORT_BUSY, UNKNOWN_FIRMWARE, STOPPED; the port is closed then, but for a stop.
        """
        again = self._boot is not None
        self._boot = None
        self._transport.open(timeout)
        self.counters.reconnects += again
        try:
            reply = self._greet(self._transport.now() + timeout)
        except HardwareFault as fault:
            if fault.reason is not FaultReason.STOPPED:
                self.close()
            raise
        self._version = reply.version
        self._boot = reply.boot
        return reply

    def _greet(self, deadline: float) -> Reply:
        """HELLO until somebody answers it."""
        self._buffer = b""
        # A number other than any recent one: a stray frame of an old session must not fit.
        self._session = self._draw_number(0xFFFF) + 1
        while True:
            self._sequence = (self._sequence + 1) & 0xFFFF
            frame = protocol.encode(self._session, self._sequence, Command.HELLO)
            reply = self._exchange(frame, self._sequence, attempts=2)
            if reply is not None and reply.result is Result.WELCOME:
                break
            if self._transport.now() > deadline:
                raise self._noted(
                    FaultReason.UNKNOWN_FIRMWARE,
                    f"nothing on {self._transport.name} answers like the tapper: check the port,"
                    " power and that its firmware is loaded",
                )
        if reply.version.split(".")[0] != PROTOCOL_VERSION:
            raise self._noted(
                FaultReason.UNKNOWN_FIRMWARE,
                f"tapper firmware {reply.version or 'without a version'} is not understood: this"
                f" driver speaks version {PROTOCOL_VERSION}; load the firmware of this repository",
            )
        return reply

    def close(self) -> None:
        """Close the line; the tapper disarms itself by the silence."""
        self._boot = None
        self._transport.close()

    def status(self) -> Reply:
        """Ask for the state; also what keeps a drawn tapper alive: call it more often than 500
        ms."""
        return self._request(Command.STATUS)

    def arm(
        self,
        shot: int,
        energy: float,
        timeout: float = 3.0,
        go_on: Callable[[], bool] = lambda: True,
    ) -> Reply:
        """Draw for ``energy`` in J; returns when drawn. The tapper disarms by itself ``timeout`` s
        after the request, or 500 ms after the last frame.

        ``go_on`` is asked every few milliseconds of the draw; when it says no, the tapper is
        disarmed at once and its answer to that is returned. ``shot`` must be above every shot tried
        before. Raises HardwareFault: SHOT_SPENT, INTERLOCK, STOPPED, OUT_OF_RANGE, TIMEOUT,
        BOARD_RESET, REJECTED, DISCONNECTED.
        """
        energy_uj = round(energy * 1e6) if energy == energy and abs(energy) < 1e9 else -1
        if not (0 < shot <= protocol.MAXIMUM_SHOT and 0 < energy_uj <= protocol.MAXIMUM_ENERGY_UJ):
            raise self._noted(
                FaultReason.OUT_OF_RANGE,
                f"shot {shot} with {energy:g} J: the shot must be 1 to {protocol.MAXIMUM_SHOT}, the"
                f" energy above 0 and at most {protocol.MAXIMUM_ENERGY_UJ * 1e-6:g} J",
            )
        if shot <= self._attempted:
            raise self._noted(
                FaultReason.SHOT_SPENT,
                f"shot {shot} may have been fired already (last tried: {self._attempted}): take a"
                " new"
                " number",
            )
        reply = self._request(Command.ARM, shot, energy_uj, round(timeout * 1e3))
        if reply.result is not Result.OK:
            raise self._refusal(reply)
        deadline = self._transport.now() + self.settings.draw_timeout
        while reply.state is not State.DRAWN:
            if reply.state is not State.DRAWING or reply.shot != shot:
                raise self._refusal(reply)
            if self._transport.now() > deadline:
                self.disarm()
                raise self._noted(
                    FaultReason.TIMEOUT,
                    f"the tapper was not drawn after {self.settings.draw_timeout:g} s: look whether"
                    " the spring or its motor is blocked",
                )
            if not go_on():
                return self.disarm()
            self._listen(self.settings.poll_period)
            reply = self._request(Command.STATUS)
        if reply.shot != shot or round(reply.energy * 1e6) != energy_uj:
            self.disarm()
            raise self._noted(
                FaultReason.PROTOCOL,
                f"the tapper is drawn for shot {reply.shot} with {reply.energy:g} J, asked was shot"
                f" {shot} with {energy:g} J: it was disarmed",
            )
        return reply

    def fire(self, shot: int) -> FireResult:
        """Release shot ``shot`` once. Never raises for what the line does: the outcome says it.

        With UNKNOWN the call has waited until a release can no longer come. Raises HardwareFault
        SHOT_SPENT for a shot tried before, STOPPED and DISCONNECTED when nothing was sent.
        """
        self._require_session()
        if shot <= self._attempted:
            raise self._noted(
                FaultReason.SHOT_SPENT,
                f"shot {shot} may have been fired already (last tried: {self._attempted}): take a"
                " new"
                " number",
            )
        self._attempted = shot
        boot = self._boot
        sequence = self._next_sequence()
        frame = protocol.encode(self._session, sequence, Command.FIRE, shot)
        sent_at = self._transport.now()
        try:
            reply = self._exchange(frame, sequence, self.settings.attempts)
            if reply is None:
                # A newer sequence number forbids the older one: this settles the outcome.
                sequence = self._next_sequence()
                settle = protocol.encode(self._session, sequence, Command.DISARM)
                reply = self._exchange(settle, sequence, self.settings.attempts)
        except HardwareFault as fault:
            self.counters.last_error = fault.sentence
            return self._unknown(shot, sent_at, fault.sentence)
        if reply is None:
            return self._unknown(shot, sent_at, "the tapper does not answer")
        if reply.boot != boot:
            self._boot = None
            return self._unknown(shot, sent_at, "the tapper restarted")
        if reply.last_fired == shot:
            self.counters.fired += 1
            return FireResult(FireOutcome.FIRED, shot)
        if reply.result is Result.SESSION:
            self._boot = None
        sentence = str(self._refusal(reply))
        return FireResult(FireOutcome.NOT_FIRED, shot, sentence)

    def disarm(self) -> Reply:
        """Let the spring down without a release."""
        return self._request(Command.DISARM)

    def stop(self) -> bool:
        """From any thread: latch the tapper's stop at once; returns whether the byte went out.

        Best effort: the emergency stop is a wire.
        """
        self._stopped.set()
        self.counters.stops += 1
        return self._transport.stop(protocol.STOP)

    def clear(self, timeout: float = 5.0) -> Reply:
        """End the latched stop; the tapper demands that a person acts at the cell as well.

        Raises HardwareFault: NEEDS_PERSON, TIMEOUT, DISCONNECTED.
        """
        self._transport.release()
        self._stopped.clear()
        if not self.connected:
            self.connect(timeout)
        reply = self._request(Command.CLEAR)
        if reply.result is not Result.OK:
            raise self._refusal(reply)
        return reply

    def _unknown(self, shot: int, sent_at: float, why: str) -> FireResult:
        self.counters.unknown += 1
        rest = sent_at + self._patience() - self._transport.now()
        if rest > 0 and not self._stopped.is_set():
            self._transport.sleep(rest)
        return FireResult(
            FireOutcome.UNKNOWN,
            shot,
            f"whether shot {shot} was fired is not known ({why}): look where the object is, do not"
            " fire again",
        )

    def _patience(self) -> float:
        """How long after the first FIRE frame a release may still come, s."""
        return self.settings.reply_timeout * self.settings.attempts + LATEST_FIRE

    def _next_sequence(self) -> int:
        self._sequence = (self._sequence + 1) & 0xFFFF
        return self._sequence

    def _request(self, command: Command, *arguments: int) -> Reply:
        """One request with repeats; raises when there is no answer or another boot answers."""
        self._require_session()
        sequence = self._next_sequence()
        frame = protocol.encode(self._session, sequence, command, *arguments)
        try:
            reply = self._exchange(frame, sequence, self.settings.attempts)
        except HardwareFault as fault:
            self.counters.last_error = fault.sentence
            if fault.reason is FaultReason.DISCONNECTED:
                self._boot = None
            raise
        if reply is None:
            raise self._noted(
                FaultReason.TIMEOUT,
                f"the tapper on {self._transport.name} does not answer {command.value}"
                f" ({self.settings.attempts} tries): check power and cable, then connect again",
            )
        if reply.boot != self._boot or reply.result is Result.SESSION:
            restarted = reply.boot != self._boot
            self._boot = None
            raise self._noted(
                FaultReason.BOARD_RESET,
                f"the tapper on {self._transport.name}"
                f" {'restarted' if restarted else 'was taken over by another session'}: connect"
                " again",
            )
        return reply

    def _exchange(self, frame: bytes, sequence: int, attempts: int) -> Reply | None:
        """Send the same bytes until the reply to this sequence number comes; None if it never
        does."""
        for attempt in range(attempts):
            self.counters.retries += attempt > 0
            self._transport.write(frame)
            until = self._transport.now() + self.settings.reply_timeout
            while (left := until - self._transport.now()) > 0:
                for reply in self._listen(left):
                    if (reply.session, reply.sequence) == (self._session, sequence):
                        return reply
            self.counters.timeouts += 1
        return None

    def _listen(self, wait: float) -> list[Reply]:
        """Replies among the bytes that come within ``wait`` s; returns at the first bytes."""
        self._buffer += self._transport.read(wait)
        replies: list[Reply] = []
        while True:
            decoded = protocol.decode(self._buffer)
            self._buffer = decoded.rest
            if decoded.frame is None:
                return replies
            if isinstance(decoded.frame, Reply):
                replies.append(decoded.frame)
            else:
                self.counters.bad_frames += 1

    def _require_session(self) -> None:
        if self._stopped.is_set():
            raise self._noted(
                FaultReason.STOPPED,
                "the tapper is stopped: make the cell safe, then clear the fault",
            )
        if not self.connected:
            raise self._noted(
                FaultReason.DISCONNECTED,
                f"no session with the tapper on {self._transport.name}: connect first",
            )

    def _refusal(self, reply: Reply) -> HardwareFault:
        """The fault that a refusing reply, or a state that it should not be in, stands for."""
        shot = f"shot {reply.shot}"
        if reply.result is Result.NEEDS_PERSON:
            reason, text = (
                FaultReason.NEEDS_PERSON,
                "the tapper's stop is latched: a person must press the clear button at the cell,"
                " then clear the fault within 10 s",
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
        elif reply.result is Result.SPENT:
            reason, text = (
                FaultReason.SHOT_SPENT,
                f"the tapper has used that shot number (last fired: {reply.last_fired}): take a"
                " greater one",
            )
        elif reply.result is Result.RANGE:
            reason, text = (
                FaultReason.OUT_OF_RANGE,
                "the tapper refused the energy or the timeout as out of its range: check the energy"
                " table against the firmware's build",
            )
        else:
            reason, text = (
                FaultReason.REJECTED,
                f"the tapper answered {reply.result.value} in state {reply.state.value} ({shot}):"
                " it"
                " disarmed itself or was never drawn; draw again",
            )
        return self._noted(reason, text)

    def _noted(self, reason: FaultReason, sentence: str) -> HardwareFault:
        self.counters.last_error = sentence
        return HardwareFault(reason, sentence)
