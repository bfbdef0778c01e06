"""Emulated digital output of a robot with its driver and link, in externally controlled time.

A level takes effect with a delay, and requests of one client are processed in order. As is usual
for the outputs of robots, the remote side has no information about shots and deadlines and does not
limit the length of a pulse.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.hardware.output_link import Answer, InputLevel


@dataclass(slots=True)
class OutputFaults:
    """Faults of the network and the robot."""

    present: bool = True
    """Whether the robot's driver is available."""
    silent_inputs: bool = False
    """Whether the guard input and the read-back are no longer published."""
    lost_on: int = 0
    """Number of requests to switch on, beginning with the next one, that are lost with their
    answers."""
    lost_off: int = 0
    refuses: bool = False
    """Whether the robot answers that it did not switch on."""
    refuses_off: bool = False
    """Whether the robot answers that it did not switch off."""
    stuck: bool = False
    """Whether the output stays on although the robot answers that it switched it off."""
    lost_answers: bool = False
    late: float = 0.0
    """Additional delay of a level's effect, in s."""
    broken_wire: bool = False
    """Whether the read-back never reports the output as on."""


@dataclass(slots=True)
class OutputDevice:
    """The output, the guard, and the true state of the coil."""

    latency: float = 0.004
    """Delay from a request to its effect, and delay from the effect to the answer, both in s."""
    guard_closed: bool = True
    faults: OutputFaults = field(default_factory=OutputFaults)
    edges: list[tuple[float, bool]] = field(default_factory=list)
    """Times and levels, in order."""

    def set_at(self, time: float, level: bool) -> None:
        """Set the output to ``level`` at ``time``, or at the time of the previous level if that is
        later."""
        last = self.edges[-1][0] if self.edges else -math.inf
        self.edges.append((max(time, last), level))

    def level(self, time: float) -> bool:
        """Return whether the coil has current."""
        return next((level for at, level in reversed(self.edges) if at <= time), False)

    def pulses(self) -> list[tuple[float, float]]:
        """Return the on and off times of all pulses; infinity if the output stays on."""
        found: list[tuple[float, float]] = []
        since: float | None = None
        for at, level in self.edges:
            if level and since is None:
                since = at
            elif not level and since is not None:
                found.append((since, at))
                since = None
        return found if since is None else [*found, (since, math.inf)]


class VirtualOutputLink:
    """An :class:`~tapping_cell.hardware.output_link.OutputLink` in virtual time.

    ``now``: returns the time, in s. ``sleep``: lets time pass for the driver.
    """

    name = "/robot/set_output"
    other_commanders: tuple[str, ...] = ()

    def __init__(
        self,
        device: OutputDevice,
        now: Callable[[], float],
        sleep: Callable[[float], None],
        interface: str = "service",
        reads_back: bool = True,
        rate: float = 50.0,
    ) -> None:
        self.device = device
        self.interface = interface
        self.times_pulse = interface == "pulse"
        self.reads_back = reads_back
        self.published = {"guard": (-math.inf, math.inf), "read_back": (-math.inf, math.inf)}
        """Times of the first and of the last message of each input."""
        self._now = now
        self._sleep = sleep
        self._period = 1 / rate
        self._answers: dict[int, tuple[float, Answer]] = {}
        self._number = 0
        self._opened = math.inf
        self._stopped = False

    @property
    def is_open(self) -> bool:
        """Whether the output was available at the last ``open``."""
        return not math.isinf(self._opened)

    @property
    def guard(self) -> InputLevel | None:
        """Level of the guard, published at ``rate`` Hz."""
        reported_at = self._last_report_at("guard")
        return None if reported_at is None else InputLevel(self.device.guard_closed, reported_at)

    @property
    def read_back(self) -> InputLevel | None:
        """Level of the output, published at ``rate`` Hz and at each change."""
        reported_at = self._last_report_at("read_back")
        if not self.reads_back or reported_at is None:
            return None
        until = min(self._now(), self.published["read_back"][1])
        changes = [at for at, _ in self.device.edges if reported_at < at <= until]
        reported_at = max([reported_at, *changes])
        return InputLevel(
            self.device.level(reported_at) and not self.device.faults.broken_wire, reported_at
        )

    @property
    def last_on(self) -> float:
        """Time when the read-back last reported the output as on."""
        if not self.reads_back or self.device.faults.broken_wire:
            return -math.inf
        until = self._now()
        ons = [at for at, level in self.device.edges if level and at <= until]
        return until if self.device.level(until) else max(ons, default=-math.inf)

    def now(self) -> float:
        """Return the time of the clock, in s."""
        return self._now()

    def sleep(self, duration: float) -> None:
        """Let ``duration`` s pass."""
        self._sleep(duration)

    def open(self, timeout: float) -> None:
        """Wait until the output is available."""
        self._opened = math.inf
        deadline = self.now() + timeout
        while not self.device.faults.present:
            if self.now() >= deadline:
                raise HardwareFault(FaultReason.PORT_MISSING, f"{self.name} is not there")
            self._sleep(0.05)
        self._opened = self.now()

    def close(self) -> None:
        """Disconnect from the output."""
        self._opened = math.inf

    def stop(self, data: bytes) -> bool:
        """Latch the stop and switch off."""
        self._stopped = True
        self._request(False)
        return self.device.faults.present

    def release(self) -> None:
        """Release the latch of ``stop``."""
        self._stopped = False

    def wait(self, duration: float) -> None:
        """Let ``duration`` s pass."""
        self._require()
        self._sleep(max(duration, 1e-4))
        self._require()

    def switch(self, on: bool) -> int:
        """Send a level."""
        assert not self.times_pulse
        self._require()
        return self._request(on)

    def pulse(self, duration: float) -> int:
        """Send a pulse that the robot times."""
        assert self.times_pulse
        self._require()
        if duration <= 0:
            return self._request(False)
        number = self._request(True)
        if self.device.edges and self.device.edges[-1][1] and not self.device.faults.stuck:
            self.device.set_at(self.device.edges[-1][0] + duration, False)
        return number

    def answer(self, number: int) -> Answer:
        """Return the result of a request."""
        if self.interface != "service":
            return Answer.UNREPORTED
        at, answer = self._answers[number]
        return answer if self.now() >= at else Answer.PENDING

    def _request(self, on: bool) -> int:
        faults, device = self.device.faults, self.device
        self._number += 1
        self._answers[self._number] = (math.inf, Answer.PENDING)
        lost = faults.lost_on if on else faults.lost_off
        if lost > 0:
            if on:
                faults.lost_on -= 1
            else:
                faults.lost_off -= 1
            return self._number
        if not faults.present:
            return self._number
        effect = self.now() + device.latency + faults.late
        refused = faults.refuses if on else faults.refuses_off
        if not refused and (on or not faults.stuck):
            device.set_at(effect, on)
        if not faults.lost_answers:
            result = Answer.REFUSED if refused else Answer.DONE
            self._answers[self._number] = (effect + device.latency, result)
        return self._number

    def _last_report_at(self, name: str) -> float | None:
        """Return the time of the last message of an input; None before the first message."""
        faults = self.device.faults
        first, last = self.published[name]
        if math.isinf(self._opened) or self.now() < first:
            return None
        if faults.silent_inputs or not faults.present:
            return self._opened
        return min(last, max(self._opened, math.floor(self.now() / self._period) * self._period))

    def _require(self) -> None:
        if self._stopped:
            raise HardwareFault(FaultReason.STOPPED, f"{self.name}: a stop is latched")
        if not self.is_open:
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self.name} is not open")
