"""A body sliding on the table, integrated in time from the friction under each support point.

The integration is deliberately independent of the closed forms of ``tapping_cell.mechanics``:
support, table and friction law may be more general than those forms allow. The friction at each
support point opposes the point's velocity v + omega x r and is proportional to the point's fraction
of the weight. The sum of the friction torques is multiplied by the torque factor, a correction that
Huang and Mason found by experiment (section 3.1.2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST_LOSS = 0.1
"""Maximum fraction of the speed that friction removes in one step. This limit keeps the change of
direction small and shortens the steps as the body comes to rest."""
LONGEST_STEP_S = 0.005
PATCH_STEP_M = 0.001
"""Maximum distance per step on a table whose friction depends on the position, m."""
STOP_SPEED = 0.0002
"""Speed of the body's rim, m/s, below which the body is set to rest, because it would slide less
than 0.1 um further."""
_LONGEST_SLIDE_S = 60.0
_STILL = 1e-9
"""Speed of a support point, m/s, below which its friction decreases to zero, because a point at
rest has no direction of motion."""


class Motion(NamedTuple):
    """Pose and twist of the centre of mass in ``table``; m, rad, s."""

    x: float
    y: float
    theta: float
    vx: float = 0.0
    vy: float = 0.0
    omega: float = 0.0

    @property
    def at_rest(self) -> bool:
        """True when nothing moves."""
        return self.vx == 0.0 and self.vy == 0.0 and self.omega == 0.0


class Acceleration(NamedTuple):
    """Linear acceleration of the centre of mass, m/s^2, and angular acceleration, rad/s^2."""

    x: float
    y: float
    angular: float


@dataclass(frozen=True, slots=True)
class TableFriction:
    """Friction of the table.

    friction: coefficient of a fast slide outside every patch; torque_factor: factor on the friction
    torque; slope: tilt in rad, downhill along +x and +y; anisotropy: ratio of the friction across
    the grain to that along it (their geometric mean is ``friction``); grain: direction of the grain
    in rad; slow_rise: relative increase of the friction at very low speed; with the speed v, the
    increase decays as exp(-v / slow_speed); viscous: relative increase per m/s; patches: discs (x,
    y, radius, factor) in table, m, that multiply the friction by the factor; gravity in m/s^2.
    """

    friction: float
    torque_factor: float
    gravity: float
    slope: tuple[float, float] = (0.0, 0.0)
    anisotropy: float = 1.0
    grain: float = 0.0
    slow_rise: float = 0.0
    slow_speed: float = 0.02
    viscous: float = 0.0
    patches: tuple[tuple[float, float, float, float], ...] = ()


class Slide:
    """Equations of motion of one body on one table."""

    def __init__(
        self, points: Array, grip: Array, friction: TableFriction, gyration_squared: float
    ) -> None:
        """``points``: support points (n, 2) in m from the centre of mass, in the object's axes.
        ``grip``: fraction (n,) of the total grip at each point. ``gyration_squared``: moment of
        inertia divided by mass, m^2."""
        self._x, self._y = (np.ascontiguousarray(column) for column in points.T)
        self._grip = grip
        self._friction = friction
        self._gyration_squared = gyration_squared
        self.reach = float(np.max(np.hypot(self._x, self._y)))
        self._pull = tuple(friction.gravity * math.sin(slope) for slope in friction.slope)
        self._speed_law = friction.slow_rise != 0.0 or friction.viscous != 0.0
        self._along = 1.0 / math.sqrt(friction.anisotropy)
        self._across = math.sqrt(friction.anisotropy)

    def speed(self, motion: Motion) -> float:
        """Return an upper bound of the speed of all support points, m/s."""
        return math.hypot(motion.vx, motion.vy) + self.reach * abs(motion.omega)

    def stays(self, motion: Motion) -> bool:
        """Return whether friction holds a body at rest on the tilted table."""
        law = self._friction
        grip = float(np.sum(self._grip_at(motion)))
        hold = min(self._along, self._across) * law.friction * (1 + law.slow_rise) * grip
        return math.hypot(*self._pull) <= hold * law.gravity

    def acceleration(self, motion: Motion) -> Acceleration:
        """Return the acceleration of a moving body due to friction and to the table's tilt."""
        law = self._friction
        cos, sin = math.cos(motion.theta), math.sin(motion.theta)
        # Velocities in the object's axes, in which the support points are fixed.
        ux = cos * motion.vx + sin * motion.vy - motion.omega * self._y
        uy = cos * motion.vy - sin * motion.vx + motion.omega * self._x
        grip = self._grip_at(motion)
        speed = np.hypot(ux, uy)
        if self._speed_law:
            grip = grip * (
                1 + law.slow_rise * np.exp(-speed / law.slow_speed) + law.viscous * speed
            )
        if law.anisotropy == 1.0:
            scale = grip / np.maximum(speed, _STILL)
            fx, fy = scale * ux, scale * uy
        else:
            fx, fy = self._anisotropic_force(ux, uy, grip, law.grain - motion.theta)
        push = law.friction * law.gravity
        drag_x, drag_y = push * float(fx.sum()), push * float(fy.sum())
        torque = push * float(self._x @ fy - self._y @ fx)
        return Acceleration(
            self._pull[0] - (cos * drag_x - sin * drag_y),
            self._pull[1] - (sin * drag_x + cos * drag_y),
            -law.torque_factor * torque / self._gyration_squared,
        )

    def step(self, motion: Motion, longest: float = LONGEST_STEP_S) -> tuple[Motion, float]:
        """Make one fourth-order Runge-Kutta step; return the motion after the step and the step's
        length in s, which is 0 if friction stops the body at once.

        The step is as long as the accuracy allows, at most ``longest``. The returned velocity is
        zero if the body has come to rest and friction holds it.
        """
        speed = self.speed(motion)
        if speed < STOP_SPEED and self.stays(motion):
            return Motion(motion.x, motion.y, motion.theta), 0.0
        first = self.acceleration(motion)
        braking = math.hypot(first.x, first.y) + self.reach * abs(first.angular)
        length = min(longest, LONGEST_STEP_S)
        if braking > 0:
            length = min(length, LARGEST_LOSS * max(speed, STOP_SPEED) / braking)
        if self._friction.patches and speed > 0:
            length = min(length, PATCH_STEP_M / speed)
        rates = [_rate(motion, first)]
        for share in (0.5, 0.5, 1.0):
            ahead = _moved(motion, rates[-1], share * length)
            rates.append(_rate(ahead, self.acceleration(ahead)))
        mean = [(a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(*rates, strict=True)]
        after = _moved(motion, mean, length)
        if self.speed(after) < STOP_SPEED and self.stays(after):
            after = Motion(after.x, after.y, after.theta)
        return after, length

    def rest(self, motion: Motion) -> tuple[Motion, float]:
        """Integrate until the body is at rest; return its final motion and the elapsed time in s.

        Raises:
            ValueError: friction does not stop the body within a minute, as on a steep slope.
        """
        elapsed = 0.0
        while not motion.at_rest:
            motion, length = self.step(motion)
            elapsed += length
            if elapsed > _LONGEST_SLIDE_S:
                raise ValueError(
                    f"the object still slides after {_LONGEST_SLIDE_S:.0f} s; is the table too "
                    "steep or the friction too low?"
                )
        return motion, elapsed

    def _grip_at(self, motion: Motion) -> Array:
        """Return the grip of every support point, including the factors of the table's patches at
        the point."""
        if not self._friction.patches:
            return self._grip
        cos, sin = math.cos(motion.theta), math.sin(motion.theta)
        x = motion.x + cos * self._x - sin * self._y
        y = motion.y + sin * self._x + cos * self._y
        grip = self._grip
        for middle_x, middle_y, radius, factor in self._friction.patches:
            within = (x - middle_x) ** 2 + (y - middle_y) ** 2 < radius**2
            grip = np.where(within, factor * grip, grip)
        return grip

    def _anisotropic_force(
        self, ux: Array, uy: Array, grip: Array, grain: float
    ) -> tuple[Array, Array]:
        """Return the friction force if friction depends on the direction. The limit curve is an
        ellipse, and the force is the point of this curve that dissipates the most power."""
        cos, sin = math.cos(grain), math.sin(grain)
        along = self._along * (cos * ux + sin * uy)
        across = self._across * (cos * uy - sin * ux)
        scale = grip / np.maximum(np.hypot(along, across), _STILL)
        along, across = self._along * scale * along, self._across * scale * across
        return cos * along - sin * across, sin * along + cos * across


def _rate(motion: Motion, acceleration: Acceleration) -> tuple[float, ...]:
    return (*motion[3:], *acceleration)


def _moved(motion: Motion, rate: Sequence[float], length: float) -> Motion:
    return Motion(*(value + length * change for value, change in zip(motion, rate, strict=True)))
