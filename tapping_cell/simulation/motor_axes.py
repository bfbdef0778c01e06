"""Motors and axes of the arm that an emulated controller drives; the controller's step counts may
be wrong.

Axis values are in the controllers' units (deg, deg, mm, deg) and have the motors' directions. Joint
values are in rad, rad, m, rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from tapping_cell.simulation.joint_motion import Array, AxisErrors, AxisTrack, Torque

AXES = 4
QUILL = 2
TO_UNITS = np.array([180 / math.pi, 180 / math.pi, 1e3, 180 / math.pi])
"""Factors from joint values (rad, rad, m, rad) to axis units (deg, deg, mm, deg)."""
SLIP = 0.3
"""Standard deviation of the uncounted motion of an axis during a sudden stop, in axis units."""

Joints = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class ArmMachine:
    """The arm that an emulated controller drives, and its line; joints in rad, rad, m, rad."""

    letters: str = "XYZA"
    axis_sign: tuple[int, int, int, int] = (1, 1, 1, 1)
    start_joints: Joints = (0.6, 0.9, -0.030, 0.2)
    """Position of the arm at power-on."""
    home_joints: Joints = (0.0, math.pi / 2, 0.0, 0.0)
    """Nominal position at the end of homing. The true position differs from it by ``errors``."""
    errors: AxisErrors = field(default_factory=AxisErrors)
    quill_sinks: float = 0.02
    """Sinking speed of the quill while the motors have no power, m/s; 0 with a brake."""
    quill_floor: float = -0.148
    """Position at which a sinking quill comes to rest, m."""
    reply_latency: float = 0.002
    """Latency of the USB adapter and the processor, s."""
    baud: int = 115200


class MotorAxes:
    """Four axes in simulated time; all times in s."""

    def __init__(self, machine: ArmMachine, rng: np.random.Generator) -> None:
        self._sign = np.array(machine.axis_sign, dtype=float)
        self._offset = np.asarray(machine.errors.offset)
        self._rng = rng
        self._torque = Torque(machine.quill_sinks, machine.quill_floor)
        start = self.units(machine.start_joints)
        self._track = AxisTrack(
            start,
            np.abs(self.units(machine.errors.backlash)),
            np.abs(self.units(machine.errors.repeatability)),
            rng,
        )
        self.reference = start
        """Position of the motors, in axis units, at which the controller counts zero steps."""

    def units(self, joints: Joints) -> Array:
        """Convert joint values to axis values (4,) in the controller's units and the motors'
        directions."""
        return np.asarray(np.asarray(joints, dtype=float) * TO_UNITS * self._sign, dtype=float)

    # State

    def joints(self, time: float) -> Joints:
        """Return the true joint values."""
        values = self._of_track(time)
        values[QUILL] -= self._torque.sunk(float(values[QUILL]), time)
        a, b, c, d = (values + self._offset).tolist()
        return a, b, c, d

    def moving(self, time: float) -> bool:
        """Return whether the motors move the axes."""
        return self._track.moving(time)

    @property
    def powered(self) -> bool:
        """Whether the motors have torque."""
        return self._torque.on

    def motors(self, time: float) -> Array:
        """Return the position of the motors in axis units, (4,)."""
        return self._track.motors(time)

    def counted(self, time: float) -> Array:
        """Return the position that the controller counts, in axis units, (4,)."""
        return np.asarray(self._track.motors(time) - self.reference, dtype=float)

    # Motion

    def move(self, target: Array, start: float, speed: float, acceleration: float) -> float:
        """Start a move of the motors to ``target`` (4,) and return the time at which it ends."""
        return self._track.move(target, start, speed, acceleration)

    def brake(self, time: float, deceleration: float) -> float:
        """Brake the move and return the time at which it ends."""
        return self._track.brake(time, deceleration)

    def freeze(self, time: float) -> None:
        """Stop the motors immediately; the step counts remain correct."""
        self._track.freeze(time)

    def stop_abruptly(self, time: float) -> bool:
        """Stop the motors immediately and return whether they were moving. Moving motors coast a
        little, and the controller does not count this motion."""
        if not self._track.moving(time):
            return False
        self._track.freeze(time)
        self._shift(self._rng.normal(0.0, SLIP, AXES), time)
        return True

    def push(self, joints: Joints, time: float) -> None:
        """Simulate a person who pushes the resting, unpowered axes to ``joints``. The controller
        does not count this motion."""
        asked = (np.asarray(joints, dtype=float) - self._offset) * TO_UNITS * self._sign
        self._shift(asked - self._track.motors(time), time)

    # Torque

    def enable(self, time: float) -> None:
        """Enable the motors. If the quill sank while they had no power, the quill is now held at
        its lower position, but the step count still gives the position before it sank."""
        sunk = self._torque.sunk(float(self._of_track(time)[QUILL]), time)
        self._torque.restore()
        if sunk > 0:
            moved = np.zeros(AXES)
            moved[QUILL] = -sunk * TO_UNITS[QUILL] * self._sign[QUILL]
            self._shift(moved, time)

    def disable(self, time: float) -> None:
        """Cut the power of the motors."""
        self._torque.cut(time)

    def _of_track(self, time: float) -> Array:
        return np.asarray(self._track.joints(time) * self._sign / TO_UNITS)

    def _shift(self, moved: Array, time: float) -> None:
        self._track.shift(self._track.motors(time) + moved, time)
        self.reference = self.reference + moved
