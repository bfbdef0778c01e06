"""Drivers and emulated devices that run in one thread and in virtual time, as fast as they can be
computed.

While a driver waits, the clock jumps from event to event, so hours of operation take seconds and
every run is repeatable. The drivers are the real drivers; only their transport is replaced.
"""

from __future__ import annotations

import math

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.simulation.fault_layer import FaultLayer

IDLE_READS = 100_000
"""Number of reads at the same virtual time after which the driver counts as stuck in a loop."""


class HangError(Exception):
    """A driver's call exceeded its time limit."""


class VirtualClock:
    """Common virtual time of all lines, s."""

    def __init__(self) -> None:
        self.now = 0.0
        self.limit = float("inf")
        """Virtual time after which a driver's call counts as hanging, s."""
        self._lines: list[FaultLayer] = []
        self._still = 0

    def add(self, line: FaultLayer) -> None:
        """Add a line to this clock."""
        self._lines.append(line)

    def step(self, until: float, reading: FaultLayer | None = None) -> None:
        """Advance to the next event of any line, at most to ``until``. Raises HangError after
        ``limit``.

        ``reading``: line from which the caller awaits bytes.
        """
        times = [t for line in self._lines if (t := line.next_on_line()) is not None]
        if reading is not None and (output := reading.next_event()) is not None:
            times.append(output)
        # If an event is already overdue, it is processed at the current time.
        target = max(min([until, *times]), self.now)
        self._still = self._still + 1 if target == self.now else 0
        self.now = target
        if self.now > self.limit or self._still > IDLE_READS:
            raise HangError(f"a driver's call had not returned at {self.now:.1f} s")
        for line in self._lines:
            line.advance(self.now)


class LineEnd:
    """The host's end of an emulated line: whether it is open, and whether a stop is latched."""

    def __init__(self, layer: FaultLayer, name: str) -> None:
        self.layer = layer
        self._name = name
        self._absences: int | None = None
        self._stopped = False

    @property
    def name(self) -> str:
        """Name for messages."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Whether the line is open, as far as is known."""
        return self._absences is not None

    @property
    def has_vanished(self) -> bool:
        """Whether the port went away after the line was opened, and the driver has not noticed."""
        return self._absences is not None and self._absences != self.layer.absences

    def close(self) -> None:
        """Close the line."""
        self._absences = None

    def release(self) -> None:
        """Release the latch of ``stop``."""
        self._stopped = False

    def _opened(self, now: float) -> None:
        """Open the line of a port that is present, and discard earlier bytes."""
        self._absences = self.layer.absences
        self.layer.take_output(now)

    def _send_stop(self, data: bytes, now: float) -> bool:
        """Latch the stop, write ``data`` and return whether it could be written."""
        self._stopped = True
        if self._absences is None or self.has_vanished:
            return False
        self.layer.receive(data, now)
        return True

    def _require(self) -> None:
        if self._stopped:
            raise HardwareFault(FaultReason.STOPPED, f"{self._name}: a stop is latched")
        if self._absences is None:
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self._name} is not open")
        if self.has_vanished:
            self._absences = None
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self._name} went away")


class VirtualTransport(LineEnd):
    """A :class:`~tapping_cell.hardware.transport.Transport` to one line in virtual time."""

    def __init__(self, line: FaultLayer, clock: VirtualClock, name: str) -> None:
        super().__init__(line, name)
        self._clock = clock
        clock.add(line)

    def now(self) -> float:
        """Return the virtual time, s."""
        return self._clock.now

    def sleep(self, duration: float) -> None:
        """Advance the virtual time by ``duration`` s."""
        end = self._clock.now + duration
        while self._clock.now < end:
            self._clock.step(end)

    def open(self, timeout: float) -> None:
        """Reopen the line, waiting for the port; earlier bytes are discarded."""
        self._absences = None
        deadline = self._clock.now + timeout
        while not self.layer.plugged:
            if self._clock.now >= deadline:
                raise HardwareFault(FaultReason.PORT_MISSING, f"{self._name} is not there")
            self._clock.step(deadline)
        self._opened(self._clock.now)

    def read(self, timeout: float) -> bytes:
        """Return the available bytes, waiting up to ``timeout`` s for the first."""
        deadline = self._clock.now + timeout
        if timeout > 0:
            # Like real time, virtual time must advance during every wait, even if rounding would
            # remove a short wait.
            deadline = max(deadline, math.nextafter(self._clock.now, math.inf))
        while True:
            self._require()
            data = self.layer.take_output(self._clock.now)
            if data or self._clock.now >= deadline:
                return data
            self._clock.step(deadline, self.layer)

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        """Write all of ``data``."""
        self._require()
        self.layer.receive(data, self._clock.now)
        # If the port disappeared during this write, the device may have received some of the bytes
        # or none.
        self._require()

    def stop(self, data: bytes) -> bool:
        """Latch the stop and write ``data``."""
        return self._send_stop(data, self._clock.now)
