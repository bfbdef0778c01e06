"""The host's end of an emulated serial line, for drivers that run in a fiber."""

from __future__ import annotations

import math
from collections.abc import Callable

from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.verification.scheduler import Fiber, Scheduler, Timer


class SerialLine:
    """A board behind a line that may fail. Keeps the board going while nobody reads."""

    def __init__(self, scheduler: Scheduler, layer: FaultLayer, name: str) -> None:
        self.layer = layer
        self.fiber: Fiber | None = None
        """The fiber that the driver runs in."""
        self.before_write: Callable[[], None] = lambda: None
        """Called before bytes go out: where a process may be frozen."""
        self._scheduler = scheduler
        self._name = name
        self._offset = 0.0
        self._absences: int | None = None
        self._stopped = False
        self._reading = False
        self._event: Timer | None = None
        self.schedule()

    def set_clock(self, offset: float) -> None:
        """The host's steady clock shows so much more than the time of the run, s."""
        self._offset = offset

    # Keeping the board going

    def schedule(self) -> None:
        """See to it that the board's next event happens in time; call it after acting on it."""
        due = self.layer.next_on_line()
        if self._reading and (output := self.layer.next_event()) is not None:
            due = output if due is None else min(due, output)
        if self._event is not None:
            if due is not None and self._event.action is not None and self._event.time == due:
                return
            self._event.cancel()
        self._event = None if due is None else self._scheduler.at(due, self._advance)

    def _advance(self) -> None:
        self._event = None
        self.layer.advance(self._scheduler.now)
        if self._reading:
            self._reading = False
            if self.fiber is not None:
                self.fiber.wake()
        self.schedule()

    # Transport

    @property
    def name(self) -> str:
        """Name for messages."""
        return self._name

    @property
    def is_open(self) -> bool:
        """Whether the line is open as far as known."""
        return self._absences is not None

    def now(self) -> float:
        """The host's steady clock, s."""
        return self._scheduler.now + self._offset

    def sleep(self, duration: float) -> None:
        """Let ``duration`` s pass."""
        self._wait_until(self._scheduler.now + duration)

    def open(self, timeout: float) -> None:
        """Open anew, waiting for the port; bytes that came before are dropped."""
        self._absences = None
        deadline = self._scheduler.now + timeout
        while not self.layer.plugged:
            if self._scheduler.now >= deadline:
                raise HardwareFault(FaultReason.PORT_MISSING, f"{self._name} is not there")
            self._wait_until(min(self._scheduler.now + 0.05, deadline))
        self._absences = self.layer.absences
        self.layer.take_output(self._scheduler.now)
        self.schedule()

    def close(self) -> None:
        """Close the line."""
        self._absences = None
        self._reading = False

    def read(self, timeout: float) -> bytes:
        """The bytes at hand, letting up to ``timeout`` s pass for the first."""
        deadline = self._scheduler.now + timeout
        if timeout > 0:
            # Real time passes however short the wait; rounding must not make it stand still.
            deadline = max(deadline, math.nextafter(self._scheduler.now, math.inf))
        while True:
            self._require()
            data = self.layer.take_output(self._scheduler.now)
            if data or self._scheduler.now >= deadline:
                self.schedule()
                return data
            self._reading = True
            self.schedule()
            self._wait_until(deadline)
            self._reading = False

    def write(self, data: bytes, timeout: float = 1.0) -> None:
        """Write all of ``data``."""
        self.before_write()
        self._require()
        self.layer.receive(data, self._scheduler.now)
        self.schedule()
        # A port that vanished under these bytes took some of them or none: who knows.
        self._require()

    def stop(self, data: bytes) -> bool:
        """Latch the stop and write ``data``; from outside the fiber too."""
        self._stopped = True
        if self.fiber is not None and self._reading:
            self.fiber.wake()
        if self._absences is None or self._absences != self.layer.absences:
            return False
        self.layer.receive(data, self._scheduler.now)
        self.schedule()
        return True

    def release(self) -> None:
        """End the latch of ``stop``."""
        self._stopped = False

    def _wait_until(self, time: float) -> None:
        assert self.fiber is not None, "a driver waits outside its fiber"
        self.fiber.wait_until(time)

    def _require(self) -> None:
        if self._stopped:
            raise HardwareFault(FaultReason.STOPPED, f"{self._name}: a stop is latched")
        if self._absences is None:
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self._name} is not open")
        if self._absences != self.layer.absences:
            self._absences = None
            raise HardwareFault(FaultReason.DISCONNECTED, f"{self._name} went away")


class BusyLine(SerialLine):
    """A line that another process has open: it cannot be opened."""

    def schedule(self) -> None:
        """The other process keeps the board going."""

    def open(self, timeout: float) -> None:
        """Fail, as a port that is locked does."""
        raise HardwareFault(FaultReason.PORT_BUSY, f"{self.name} is in use by another process")
