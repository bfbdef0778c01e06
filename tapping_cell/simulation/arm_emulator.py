"""Common part of the emulated arm controllers: motors, output, and what the world can observe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tapping_cell.simulation.device_emulator import DeviceEmulator, OutputQueue
from tapping_cell.simulation.motor_axes import ArmMachine, Joints, MotorAxes


class AxisLimits(NamedTuple):
    """Limits of each axis in the controller's units: units/s, units/s2 and units."""

    rates: tuple[float, ...]
    accelerations: tuple[float, ...]
    travels: tuple[float, ...]


class ArmEmulator(DeviceEmulator, ABC):
    """One emulated controller board with its arm."""

    def __init__(self, machine: ArmMachine, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._output = OutputQueue(machine.reply_latency, 10 / machine.baud)
        self._axes = MotorAxes(machine, self._rng)
        self._due: float | None = None
        """End of the current motion, s; None while nothing moves."""
        self._after: Callable[[float], None] | None = None
        """Action at ``_due``."""
        self._rests_since: float | None = None

    def joints(self, time: float) -> Joints:
        """Return the true joints (rad, rad, m, rad) at ``time``; reported values may differ."""
        return self._axes.joints(time)

    def moving(self, time: float) -> bool:
        """Return whether the motors move the axes at ``time``."""
        return self._axes.moving(time)

    @property
    def holds(self) -> bool:
        """Whether the motors have torque."""
        return self._axes.powered

    @abstractmethod
    def enter_sleep(self, now: float) -> None:
        """Cut the motors' power and end any move."""

    @abstractmethod
    def advance(self, now: float) -> None:
        """Process all events that are due by ``now``."""

    def take_output(self, now: float) -> bytes:
        """Return the bytes transmitted by ``now``."""
        self.advance(now)
        return self._output.take(now)

    def _power(self, now: float) -> None:
        """Enable the motors. If the quill sank while they had no power, the quill is now held at
        its lower position, but the step count still gives the position before it sank."""
        self._axes.enable(now)
        self._rests_since = now
