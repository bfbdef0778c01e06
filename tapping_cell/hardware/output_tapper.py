"""Driver of a tapper that a digital output fires. The on-time of the output sets the striker's
speed.

It has the interface of :class:`~tapping_cell.hardware.tapper.TapperDriver` but weaker guarantees.
The remote side does not reject a late request, limit the pulse, count shots, or discharge when this
computer stops sending. The driver takes these measures instead:

- If the last check takes longer than ``latency``, nothing is sent.
- A shot number is stored on disk before the shot is sent, so that no restart sends it again.
- The guard must have been reported closed within ``guard_timeout``, and the read-back, if there is
  one, must be off.
- If no read-back showed the output on, the outcome is UNKNOWN, and a camera image must show whether
  the object was hit.
- If the output is not confirmed to be off after the shot, the session ends. A new session begins
  only after this confirmation.

The driver assumes, but cannot enforce, that a request takes effect within ``latency``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tapping_cell.hardware import tapper_protocol as protocol
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.output_link import Answer, OutputLink
from tapping_cell.hardware.tapper import FireOutcome, FireResult, RecordingTapper
from tapping_cell.hardware.tapper_protocol import Mode, Reply, Result, State

VERSION = "digital output"
OFF_TIMEOUT = 1.0
"""Longest wait for the confirmation that the output is off, s."""
WAIT = 0.002
"""Period of the checks for an answer, s."""
LONG_PULSE = 1.2
"""Ratio of the actual to the requested pulse length above which an error is recorded, because the
striker was then faster than planned."""


class ShotMemory(Protocol):
    """Persistent storage of the greatest shot number, which is needed after a restart of the
    process."""

    def recall(self) -> int:
        """Return the greatest shot number that may have been sent, 0 for none.

        Raises ValueError if the stored number cannot be read.
        """

    def keep(self, shot: int) -> None:
        """Store the number so that it survives a power loss. Raises OSError."""


@dataclass(frozen=True, slots=True)
class OutputTapperSettings:
    """Pulse length for each energy of the curve, and assumed timing of the output."""

    energies: tuple[float, ...]
    """Energies in J, increasing."""
    pulses: tuple[float, ...]
    """Pulse length at each energy, s, increasing."""
    latency: float = 0.02
    """Longest time from sending a level until the output has this level, s."""
    guard_timeout: float = 0.5
    """Longest silence of the guard input and of the read-back, s."""

    def pulse_for(self, energy: float) -> float:
        """Return the pulse length in s for an energy in J. Like the striker's speed, it is
        interpolated linearly in the square root of the energy."""
        return float(np.interp(math.sqrt(energy), np.sqrt(self.energies), self.pulses))


class OutputTapperDriver(RecordingTapper):
    """Driver of one tapper on one output. All calls except ``stop`` block and must come from one
    thread."""

    def __init__(
        self, link: OutputLink, settings: OutputTapperSettings, memory: ShotMemory
    ) -> None:
        super().__init__()
        self.settings = settings
        self._link = link
        self._memory = memory
        self._connected = False
        self._ready: tuple[int, float] | None = None
        self._last_fired = 0

    @property
    def connected(self) -> bool:
        """True if the output is available, as far as is known, and was confirmed to be off after it
        was last switched."""
        return self._connected and self._link.is_open

    @property
    def version(self) -> str:
        """Description of the output, in place of a firmware version."""
        return f"{VERSION} by {self._link.interface}" if self._connected else ""

    def connect(self, timeout: float = 5.0) -> Reply:
        """Connect to the output, switch it off, and wait for the guard and the read-back.

        Raises HardwareFault: PORT_MISSING, TIMEOUT, REJECTED, SETTINGS_MISMATCH, STOPPED.
        """
        again, self._connected, self._ready = self._connected, False, None
        try:
            self._attempted = max(self._attempted, self._memory.recall())
        except ValueError as error:
            raise self._record_fault(FaultReason.SETTINGS_MISMATCH, str(error)) from error
        self._link.open(timeout)
        self.counters.reconnects += again
        try:
            self._switch_off()
            self._await_inputs(self._link.now() + timeout)
            self._connected = True
            return self.status()
        except HardwareFault as fault:
            if fault.reason is not FaultReason.STOPPED:
                self.close()
            raise

    def close(self) -> None:
        """Switch off and disconnect from the output."""
        if self._link.is_open and not self._stopped.is_set():
            try:
                self._send_off()
            except HardwareFault as fault:
                self.counters.last_error = fault.sentence
        self._connected, self._ready = False, None
        self._link.close()

    def status(self) -> Reply:
        """Return the state from the guard and the read-back; an output that is on is a fault."""
        self._require()
        self._check_inputs()
        read_back = self._link.read_back
        if read_back is not None and read_back.level:
            self._ready = None
            self._send_off()
            raise self._record_fault(
                FaultReason.REJECTED,
                f"{self._link.name} reads back as on while no shot is under way: switch the"
                " tapper's supply off, and look for another program or a stuck relay",
            )
        return self._reply()

    def charge(
        self,
        shot: int,
        energy: float,
        go_on: Callable[[], bool] = lambda: True,
        timeout: float = 5.0,
        channel: int = 0,
    ) -> Reply:
        """Prepare ``shot`` with the pulse for ``energy`` in J; nothing is switched.

        Only channel 0 exists. Raises HardwareFault: SHOT_SPENT, INTERLOCK, OUT_OF_RANGE, STOPPED,
        DISCONNECTED, REJECTED, SETTINGS_MISMATCH.
        """
        if channel:
            raise self._record_fault(
                FaultReason.SETTINGS_MISMATCH,
                f"channel {channel} was requested, but {self._link.name} fires one tapper, "
                "channel 0; correct the channels in the cell file",
            )
        least, most = self.settings.energies[0], self.settings.energies[-1]
        if not (0 < shot <= protocol.MAXIMUM_SHOT and least <= energy <= most):
            raise self._record_fault(
                FaultReason.OUT_OF_RANGE,
                f"shot number {shot} or energy {energy:g} J is out of range: the number must be 1"
                f" to {protocol.MAXIMUM_SHOT}, the energy {least:g} to {most:g} J"
                " (tapper.energies)",
            )
        self._refuse_spent(shot)
        reply = self.status()
        if not reply.interlock_closed:
            raise self._record_fault(
                FaultReason.INTERLOCK, f"the guard of {self._link.name} is open: close it"
            )
        if go_on():
            self._ready = shot, self.settings.pulse_for(energy)
        return self._reply()

    def fire(self, shot: int, window: float, still_allowed: Callable[[float], bool]) -> FireResult:
        """Switch the output on once, for the pulse of ``shot``.

        ``window`` is ignored; it applies only to boards that have a clock. ``still_allowed``
        is called with the time, on the steady clock, by which the output is off again at the
        latest. This time assumes that every switching of the output takes effect within
        ``latency``. The call returns UNKNOWN only after this time.
        """
        self._require()
        self._refuse_spent(shot)
        if self._ready is None or self._ready[0] != shot:
            sentence = f"the tapper was not prepared for shot {shot}"
            return self._not_fired(shot, HardwareFault(FaultReason.REJECTED, sentence))
        pulse, self._ready = self._ready[1], None
        try:
            self._memory.keep(shot)
        except OSError as error:
            sentence = f"shot {shot} could not be recorded on disk ({error})"
            return self._not_fired(shot, HardwareFault(FaultReason.REJECTED, sentence))
        self._attempted = shot
        if not self.status().interlock_closed:
            sentence = f"the guard of {self._link.name} is open: close it"
            return self._not_fired(shot, HardwareFault(FaultReason.INTERLOCK, sentence))
        asked = self._link.now()
        release_by = asked + self._longest(pulse)
        if not still_allowed(release_by):
            sentence = f"the last check before the pulse forbade shot {shot}"
            return FireResult(FireOutcome.NOT_FIRED, shot, sentence)
        if self._link.now() > asked + self.settings.latency:
            self.counters.late += 1
            sentence = (
                "the last check took longer than tapper.output.latency"
                f" ({1e3 * self.settings.latency:.0f} ms), so nothing was switched: this computer"
                " was too slow"
            )
            return self._not_fired(shot, HardwareFault(FaultReason.TIMEOUT, sentence))
        try:
            on, off = self._send_pulse(pulse)
            self._await_pulse(asked, release_by)
            answers = self._link.answer(on), self._link.answer(off)
        except HardwareFault as fault:
            self._connected = False
            self._sleep_until(release_by)
            return self._unknown_result(shot, fault.sentence)
        return self._judge(shot, asked, *answers)

    def discharge(self) -> Reply:
        """Discard the prepared shot and switch the output off."""
        self._require()
        self._ready = None
        self._switch_off()
        return self.status()

    def stop(self) -> bool:
        """Latch the stop and switch off, from any thread. The stop may be lost on its way, so the
        emergency stop is wired in hardware."""
        self._stopped.set()
        self.counters.stops += 1
        return self._link.stop(b"")

    def clear(self, timeout: float = 5.0) -> Reply:
        """Clear the latched stop. Unlike a tapper board, the output has no clear button that a
        person must press."""
        self._link.release()
        self._stopped.clear()
        return self.connect(timeout)

    # A shot

    def _longest(self, pulse: float) -> float:
        """Return the longest time from the last check until the output is off again, s."""
        return pulse + 2 * self.settings.latency

    def _send_pulse(self, pulse: float) -> tuple[int, int]:
        """Send a pulse; return the request numbers of switching on and off."""
        if self._link.times_pulse:
            number = self._link.pulse(pulse)
            return number, number
        on = self._link.switch(True)
        sent = self._link.now()
        self._sleep_until(sent + pulse)
        off = self._link.switch(False)
        held = self._link.now() - sent
        if held > LONG_PULSE * pulse:
            self.counters.last_error = (
                f"the output was on for {1e3 * held:.1f} ms, but {1e3 * pulse:.1f} ms were "
                "requested: this computer was too slow, so the striker was faster than planned"
            )
        return on, off

    def _await_pulse(self, asked: float, release_by: float) -> None:
        """Wait until the read-back has shown the pulse, at most until ``release_by``."""
        while self._link.now() < release_by and not self._off_since(asked):
            self._link.wait(WAIT)

    def _off_since(self, asked: float) -> bool:
        """Return whether the read-back has shown the output on since ``asked`` and now shows it
        off."""
        return self._link.last_on >= asked and not self._reads_on()

    def _judge(self, shot: int, asked: float, on: Answer, off: Answer) -> FireResult:
        seen = self._link.last_on >= asked
        proven_off = not self._reads_on() if seen else off in (Answer.DONE, Answer.UNREPORTED)
        if not proven_off:
            # Reconnecting switches the output off and waits for the confirmation.
            self._connected = False
            self.counters.last_error = (
                f"{self._link.name} did not confirm that it is off after shot {shot}"
            )
        if seen:
            self.counters.fired += 1
            self._last_fired = shot
            return FireResult(FireOutcome.FIRED, shot)
        if on is Answer.REFUSED and self._link.reads_back:
            sentence = f"{self._link.name} refused to switch on"
            return self._not_fired(shot, HardwareFault(FaultReason.REJECTED, sentence))
        why = (
            "the read-back did not show the output on"
            if self._link.reads_back
            else "the output is not read back"
        )
        return self._unknown_result(shot, why)

    def _refuse_spent(self, shot: int) -> None:
        if shot <= self._attempted:
            raise self._record_fault(
                FaultReason.SHOT_SPENT,
                f"shot {shot} may have been fired already (last sent: {self._attempted}): use a"
                " new number",
            )

    # The output and its inputs

    def _send_off(self) -> int:
        return self._link.pulse(0.0) if self._link.times_pulse else self._link.switch(False)

    def _switch_off(self) -> None:
        """Switch the output off and wait until the answer and the read-back confirm this."""
        number = self._send_off()
        deadline = self._link.now() + OFF_TIMEOUT
        while self._link.answer(number) is Answer.PENDING or self._reads_on():
            if self._link.now() >= deadline:
                self._connected = False
                self.counters.timeouts += 1
                what = "reads back as on" if self._reads_on() else "does not answer"
                raise self._record_fault(
                    FaultReason.TIMEOUT,
                    f"{self._link.name} {what} {OFF_TIMEOUT:g} s after it was switched off: switch"
                    " the tapper's supply off and check the robot's driver",
                )
            self._link.wait(WAIT)
        if self._link.answer(number) is Answer.REFUSED:
            self._connected = False
            raise self._record_fault(
                FaultReason.REJECTED,
                f"{self._link.name} refused to switch off: check the number of the output and"
                " whether the robot's driver may switch it",
            )

    def _reads_on(self) -> bool:
        return self._link.read_back is not None and self._link.read_back.level

    def _await_inputs(self, deadline: float) -> None:
        while self._link.guard is None or (self._link.reads_back and self._link.read_back is None):
            if self._link.now() >= deadline:
                self.counters.timeouts += 1
                what = "guard" if self._link.guard is None else "read_back"
                raise self._record_fault(
                    FaultReason.TIMEOUT,
                    f"no message has arrived on the topic that tapper.output.{what} names: the"
                    " robot's driver must publish a std_msgs/Bool there at least every"
                    f" {self.settings.guard_timeout:g} s",
                )
            self._link.wait(WAIT)

    def _check_inputs(self) -> None:
        """Raise DISCONNECTED if an input has been silent too long."""
        inputs = {"guard": self._link.guard}
        if self._link.reads_back:
            inputs["read_back"] = self._link.read_back
        for name, level in inputs.items():
            silence = math.inf if level is None else self._link.now() - level.received
            if silence > self.settings.guard_timeout:
                self._ready, self._connected = None, False
                raise self._record_fault(
                    FaultReason.DISCONNECTED,
                    f"the topic that tapper.output.{name} names has been silent for"
                    f" {silence:.2f} s (limit {self.settings.guard_timeout:g} s): check the robot's"
                    " driver and the network",
                )

    def _reply(self) -> Reply:
        """Return the known state in the format of the tapper board's reply."""
        guard = self._link.guard
        ready = self._ready
        return Reply(
            session=0,
            sequence=0,
            result=Result.OK,
            state=State.SAFE if ready is None else State.CHARGED,
            shot=self._attempted if ready is None else ready[0],
            energy=0.0,
            interlock_closed=guard is not None and guard.level,
            stop_latched=False,
            last_fired=self._last_fired,
            speed=None,
            boot=0,
            time_ms=0,
            mode=Mode.RUN,
            enabled=False,
            version=VERSION,
        )

    def _sleep_until(self, time: float) -> None:
        self._link.sleep(time - self._link.now())

    def _require(self) -> None:
        self._require_no_stop()
        if not self.connected:
            raise self._record_fault(
                FaultReason.DISCONNECTED, f"{self._link.name} is not connected: connect first"
            )
