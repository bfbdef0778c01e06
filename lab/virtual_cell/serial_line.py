"""Host side of an emulated serial line, for drivers that run in a fiber."""

from __future__ import annotations

import math
from collections.abc import Callable

from lab.virtual_cell.scheduler import Fiber, Scheduler, Timer
from tapping_cell.hardware.faults import FaultReason, HardwareFault
from tapping_cell.simulation.fault_layer import FaultLayer
from tapping_cell.simulation.virtual_line import LineEnd


class SerialLine(LineEnd):
    """A board connected by a line that may fail. The board keeps running while the host does not
    read."""

    def __init__(self, scheduler: Scheduler, layer: FaultLayer, name: str) -> None:
        super().__init__(layer, name)
        self.fiber: Fiber | None = None
        """Fiber in which the driver runs."""
        self.before_write: Callable[[], None] = lambda: None
        """Called before bytes are sent; it may freeze the process."""
        self._scheduler = scheduler
        self._offset = 0.0
        self._reading = False
        self._event: Timer | None = None
        self.schedule()

    def set_clock(self, offset: float) -> None:
        """Set the host's steady clock to the time of the run plus ``offset`` in s."""
        self._offset = offset

    # Events of the board

    def schedule(self) -> None:
        """Schedule the board's next event; call this method after every action on the board."""
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

    def now(self) -> float:
        """Return the time of the host's steady clock, s."""
        return self._scheduler.now + self._offset

    def sleep(self, duration: float) -> None:
        """Sleep for ``duration`` s."""
        self._wait_until(self._scheduler.now + duration)

    def open(self, timeout: float) -> None:
        """Wait for the port and open it; bytes received before are discarded."""
        self._absences = None
        deadline = self._scheduler.now + timeout
        while not self.layer.plugged:
            if self._scheduler.now >= deadline:
                raise HardwareFault(FaultReason.PORT_MISSING, f"{self._name} is not there")
            self._wait_until(min(self._scheduler.now + 0.05, deadline))
        self._opened(self._scheduler.now)
        self.schedule()

    def close(self) -> None:
        """Close the line."""
        super().close()
        self._reading = False

    def read(self, timeout: float) -> bytes:
        """Return the available bytes; wait up to ``timeout`` s for the first one."""
        deadline = self._scheduler.now + timeout
        if timeout > 0:
            # A timeout may be so short that adding it to the time changes nothing. Time must
            # advance in every wait nevertheless.
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
        # Raise a fault if the port vanished during the write, because it is then unknown which
        # bytes were sent.
        self._require()

    def stop(self, data: bytes) -> bool:
        """Latch the stop and write ``data``. May be called from inside or outside the fiber."""
        self._stopped = True
        if self.fiber is not None and self._reading:
            self.fiber.wake()
        sent = self._send_stop(data, self._scheduler.now)
        if sent:
            self.schedule()
        return sent

    def _wait_until(self, time: float) -> None:
        assert self.fiber is not None, "a driver called a blocking function outside its fiber"
        self.fiber.wait_until(time)


class BusyLine(SerialLine):
    """A line that cannot be opened, because another process has opened it."""

    def schedule(self) -> None:
        """Do nothing: the other process schedules the board's events."""

    def open(self, timeout: float) -> None:
        """Raise the fault of a locked port."""
        raise HardwareFault(FaultReason.PORT_BUSY, f"{self.name} is in use by another process")
