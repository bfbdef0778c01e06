"""Simulation of a faulty serial line between a driver and an emulated device.

The layer wraps an emulator and is itself an emulator, so it works behind a pseudo-terminal or a
virtual line. Each fault is tied to the n-th byte of one direction. Faults are scripted, or drawn
from a seed with :func:`random_fault`, so every run can be repeated exactly.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from tapping_cell.simulation.device_emulator import DeviceEmulator, TimedBytes, earliest


class FaultKind(Enum):
    """Kinds of line faults."""

    DROP = "drop"
    """Bytes are lost."""
    DELAY = "delay"
    """This byte and the bytes that follow within ``duration`` arrive late, in order."""
    DUPLICATE = "duplicate"
    """A sequence of bytes is received twice."""
    FLIP = "flip"
    """One bit changes."""
    SPLIT = "split"
    """A short pause within a line."""
    MERGE = "merge"
    """Bytes are held back and arrive together with the following bytes."""
    STALL = "stall"
    """Neither direction transmits for a while."""
    HANG_UP = "hang_up"
    """The port disappears and returns; bytes in transmission are lost."""
    RESET = "reset"
    """The board restarts."""


class Direction(Enum):
    """Direction of transmission."""

    TO_DEVICE = "to_device"
    TO_HOST = "to_host"


@dataclass(frozen=True, slots=True)
class LineFault:
    """One fault at byte number ``byte`` (from 0) of a direction."""

    kind: FaultKind
    direction: Direction
    byte: int
    length: int = 1
    """Number of bytes that are dropped, duplicated or merged."""
    duration: float = 0.0
    """Duration of a delay, a pause, a stall or an absence, s."""
    bit: int = 0


def random_fault(
    rng: np.random.Generator, direction: Direction, first: int, span: int
) -> LineFault:
    """Return a fault of a random kind at a random byte: one of the ``span`` bytes that begin with
    number ``first``."""
    kind = list(FaultKind)[int(rng.integers(len(FaultKind)))]
    longest = {
        FaultKind.DELAY: 1.5,
        FaultKind.SPLIT: 0.05,
        FaultKind.MERGE: 0.2,
        FaultKind.STALL: 4.0,
        FaultKind.HANG_UP: 3.0,
    }.get(kind, 0.0)
    return LineFault(
        kind,
        direction,
        first + int(rng.integers(max(span, 1))),
        int(rng.integers(1, 30)),
        float(rng.uniform(0.0, longest)),
        int(rng.integers(8)),
    )


class _Channel(TimedBytes):
    """One direction of the line: counts the bytes and holds back those that a fault delays."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        self._free = 0.0
        self._dropping = 0
        self._run = b""
        self._run_left = 0
        self._merge_left = 0
        self._merge_until = 0.0

    @property
    def undisturbed(self) -> bool:
        """Whether the bytes that enter now are not affected by an earlier fault."""
        return not (self._dropping or self._run_left or self._merge_left)

    def put(self, data: bytes, now: float) -> None:
        """Add bytes that no fault affects."""
        self._queue.append((max(now, self._free), data))

    def feed(self, byte: int, now: float, fault: LineFault | None) -> None:
        """Add one byte, changed by the fault that is tied to it, if any."""
        if fault is not None:
            if fault.kind is FaultKind.DROP:
                self._dropping = fault.length
            elif fault.kind in (FaultKind.DELAY, FaultKind.SPLIT, FaultKind.STALL):
                self.hold(now + fault.duration)
            elif fault.kind is FaultKind.FLIP:
                byte ^= 1 << fault.bit
            elif fault.kind is FaultKind.DUPLICATE:
                self._run, self._run_left = b"", fault.length
            elif fault.kind is FaultKind.MERGE:
                self._merge_left, self._merge_until = fault.length, now + fault.duration
        if self._dropping:
            self._dropping -= 1
            return
        self._put_byte(byte, now)
        if self._run_left:
            self._run += bytes((byte,))
            self._run_left -= 1
            if not self._run_left:
                for again in self._run:
                    self._put_byte(again, now)

    def _put_byte(self, byte: int, now: float) -> None:
        due = max(now, self._free)
        if self._merge_left:
            self._merge_left -= 1
            if self._merge_left:
                due = max(due, self._merge_until)
            else:
                # All bytes to be merged have arrived: deliver them together with the last one.
                self._queue = deque((min(at, due), held) for at, held in self._queue)
        self._queue.append((due, bytes((byte,))))

    def hold(self, until: float) -> None:
        """Delay all bytes that enter from now on until ``until``."""
        self._free = max(self._free, until)

    def hold_all(self, until: float) -> None:
        """Delay all bytes until ``until``, including those in transmission."""
        self.hold(until)
        self._queue = deque((max(at, until), held) for at, held in self._queue)

    def last_time(self) -> float:
        """Return the time when the last bytes in transmission arrive; -inf if there are none."""
        return max((due for due, _ in self._queue), default=-math.inf)

    def clear(self) -> None:
        """Discard the bytes in transmission."""
        self._queue.clear()
        self._free = 0.0
        self._dropping = self._run_left = self._merge_left = 0


class FaultLayer:
    """Emulator behind a faulty line.

    ``on_plug`` is called when the port disappears (False) and when it returns (True).
    """

    def __init__(
        self,
        emulator: DeviceEmulator,
        faults: Iterable[LineFault] = (),
        on_plug: Callable[[bool], None] | None = None,
    ) -> None:
        self.emulator = emulator
        self.happened: list[tuple[float, LineFault]] = []
        """Every fault that has occurred, with its time in s."""
        self.absences = 0
        """Number of times that the port has disappeared."""
        self.on_plug = on_plug
        self._to_device, self._to_host = _Channel(), _Channel()
        self._plan: dict[tuple[Direction, int], LineFault] = {}
        self._back_at: float | None = None
        for fault in faults:
            self.add(fault)

    @property
    def plugged(self) -> bool:
        """Whether the port is present."""
        return self._back_at is None

    def count(self, direction: Direction) -> int:
        """Return the number of bytes that have entered the line in a direction."""
        return self._channel(direction).count

    def add(self, fault: LineFault) -> None:
        """Schedule one more fault."""
        self._plan[(fault.direction, fault.byte)] = fault

    @property
    def awaits_fault(self) -> bool:
        """Whether a scheduled fault has not occurred yet."""
        return bool(self._plan)

    def forget(self) -> None:
        """Discard the scheduled faults."""
        self._plan.clear()

    def receive(self, data: bytes, now: float) -> None:
        """Send bytes from the host into the line."""
        self.advance(now)
        self._enter(Direction.TO_DEVICE, data, now)
        self._deliver(now)

    def advance(self, now: float) -> None:
        """Advance the line and the device behind it to ``now``, event by event."""
        while True:
            due = self.next_on_line()
            if due is None or due > now:
                break
            self._step(due)
        self.emulator.advance(now)

    def take_output(self, now: float) -> bytes:
        """Return the bytes that have arrived at the host."""
        self.advance(now)
        self._collect(now)
        return self._to_host.take(now)

    def next_event(self) -> float | None:
        """Return the time of the next event; None if there is none."""
        return earliest(self.next_on_line(), self._to_host.next_time())

    def delivered_by(self, now: float) -> float:
        """Return the time by which the device has received all bytes sent before ``now``."""
        return max(now, self._to_device.last_time())

    def power_cycle(self, now: float) -> None:
        """Restart the board."""
        self.emulator.power_cycle(now)

    def hang_up(self, now: float, duration: float) -> None:
        """Unplug the cable for ``duration`` s; bytes on the line are lost."""
        self._deliver(now)
        self._to_device.clear()
        self._to_host.clear()
        self._back_at = now + duration
        self.absences += 1
        if self.on_plug:
            self.on_plug(False)

    def next_on_line(self) -> float | None:
        """Return the time of the next event; bytes that wait to be read by the host are ignored."""
        return earliest(self.emulator.next_event(), self._to_device.next_time(), self._back_at)

    def disturbs(self, direction: Direction) -> bool:
        """Return whether an earlier fault, for example a long drop, still affects the bytes that
        are sent in this direction."""
        return not self._channel(direction).undisturbed

    def _channel(self, direction: Direction) -> _Channel:
        return self._to_device if direction is Direction.TO_DEVICE else self._to_host

    def _step(self, now: float) -> None:
        if self._back_at is not None and self._back_at <= now:
            self._back_at = None
            if self.on_plug:
                self.on_plug(True)
        self.emulator.advance(now)
        self._deliver(now)
        self._collect(now)

    def _deliver(self, now: float) -> None:
        data = self._to_device.take(now)
        if data:
            self.emulator.receive(data, now)

    def _collect(self, now: float) -> None:
        self._enter(Direction.TO_HOST, self.emulator.take_output(now), now)

    def _enter(self, direction: Direction, data: bytes, now: float) -> None:
        if not data:
            return
        channel = self._channel(direction)
        numbers = range(channel.count, channel.count + len(data))
        planned = any(way is direction and byte in numbers for way, byte in self._plan)
        if not planned and self.plugged and channel.undisturbed:
            channel.count += len(data)
            channel.put(data, now)
            return
        for byte in data:
            fault = self._plan.pop((direction, channel.count), None)
            channel.count += 1
            if fault is not None:
                self.happened.append((now, fault))
                if fault.kind is FaultKind.STALL:
                    for each in (self._to_device, self._to_host):
                        each.hold_all(now + fault.duration)
                elif fault.kind is FaultKind.RESET:
                    self._deliver(now)
                    self.emulator.power_cycle(now)
                elif fault.kind is FaultKind.HANG_UP:
                    self.hang_up(now, fault.duration)
            if self._back_at is None:
                channel.feed(byte, now, fault)
