"""Axis positions of the emulated arm over time: trapezoidal moves, holds, backlash,
repeatability."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HISTORY = 3.0
"""Time for which past positions are kept, s; longer than a camera's latency."""


@dataclass(frozen=True, slots=True)
class Phase:
    """An interval of constant acceleration along the line of a move."""

    start: float
    duration: float
    place: float
    speed: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class Profile:
    """Distance along the line of a move as a function of time."""

    phases: tuple[Phase, ...]

    @property
    def end(self) -> float:
        """End of the motion, s."""
        last = self.phases[-1]
        return last.start + last.duration

    def at(self, time: float) -> tuple[float, float]:
        """Return distance and speed along the line at ``time``."""
        chosen = self.phases[0]
        for phase in self.phases:
            if phase.start <= time:
                chosen = phase
        t = min(max(time - chosen.start, 0.0), chosen.duration)
        return (
            chosen.place + chosen.speed * t + chosen.acceleration * t * t / 2,
            chosen.speed + chosen.acceleration * t,
        )

    def brake(self, time: float, deceleration: float) -> Profile:
        """Return the same motion up to ``time``, followed by braking to rest."""
        place, speed = self.at(time)
        kept = tuple(
            replace(phase, duration=min(phase.duration, time - phase.start))
            for phase in self.phases
            if phase.start < time
        )
        return Profile((*kept, Phase(time, speed / deceleration, place, speed, -deceleration)))


def trapezoid(start: float, length: float, speed: float, acceleration: float) -> Profile:
    """Return a trapezoidal velocity profile over ``length``, from rest to rest, that starts at time
    ``start``."""
    ramp = min(speed / acceleration, math.sqrt(length / acceleration))
    peak = acceleration * ramp
    cruise = max(length - peak * ramp, 0.0) / peak if peak > 0 else 0.0
    climbed = peak * ramp / 2
    return Profile(
        (
            Phase(start, ramp, 0.0, 0.0, acceleration),
            Phase(start + ramp, cruise, climbed, peak, 0.0),
            Phase(start + ramp + cruise, ramp, length - climbed, peak, -acceleration),
        )
    )


@dataclass(frozen=True, slots=True)
class AxisErrors:
    """Errors of the true arm that do not appear in the controller's reports; in joint order, rad or
    m.

    ``offset``: true joint minus reported joint after homing. ``backlash``: full play of the drive.
    ``repeatability``: standard deviation of the end position at the same target; one error is drawn
    per move. ``homing``: standard deviation of the home switches' positions; one error is drawn per
    homing.
    """

    offset: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    backlash: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    repeatability: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    homing: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Piece:
    """One straight move of the motors, and the resulting joint motion."""

    start: float
    origin: Array
    direction: Array
    """Unit vector; zeros at rest."""
    profile: Profile
    play: Array
    """Joint values at the start, with the effect of the backlash but without random errors."""
    noise_before: Array
    noise_after: Array
    length: float

    def motors(self, time: float) -> Array:
        """Return the motor values at ``time``."""
        distance, _ = self.profile.at(time)
        return self.origin + self.direction * distance

    def joints(self, time: float, backlash: Array) -> Array:
        """Return the joint values with backlash and repeatability at ``time``."""
        motors = self.motors(time)
        distance, _ = self.profile.at(time)
        part = distance / self.length if self.length > 0 else 1.0
        noise = self.noise_before + part * (self.noise_after - self.noise_before)
        return self.drive(motors, backlash) + noise

    def drive(self, motors: Array, backlash: Array) -> Array:
        """Return the joint values that follow from the motor values with backlash (play operator).
        The result is exact, because no axis reverses within a piece."""
        return np.asarray(np.clip(self.play, motors - backlash / 2, motors + backlash / 2))


class Torque:
    """Whether the motors have power, and the sinking of a quill without power; SI units."""

    def __init__(self, sinks: float, floor: float) -> None:
        self._sinks = sinks
        self._floor = floor
        self._off_since: float | None = None

    @property
    def on(self) -> bool:
        """Whether the motors have power."""
        return self._off_since is None

    def cut(self, time: float) -> None:
        """Cut the motors' power."""
        if self._off_since is None:
            self._off_since = time

    def sunk(self, quill: float, time: float) -> float:
        """Return the distance, m, by which the quill has sunk until ``time``, starting from
        position ``quill``."""
        if self._off_since is None or time <= self._off_since:
            return 0.0
        return min(self._sinks * (time - self._off_since), max(quill - self._floor, 0.0))

    def restore(self) -> None:
        """Restore the motors' power."""
        self._off_since = None


class AxisTrack:
    """Motion of all axes over time, in units that the caller chooses."""

    def __init__(
        self, position: Array, backlash: Array, repeatability: Array, rng: np.random.Generator
    ) -> None:
        self._backlash = np.asarray(backlash, dtype=float)
        self._repeatability = np.asarray(repeatability, dtype=float)
        self._rng = rng
        self._pieces: deque[Piece] = deque()
        start = np.array(position, dtype=float)
        self._rest(start, start, np.zeros(len(start)), -math.inf)

    @property
    def last(self) -> Piece:
        """The newest piece."""
        return self._pieces[-1]

    def moving(self, time: float) -> bool:
        """Return whether the motors move at ``time``."""
        last = self._pieces[-1]
        return last.start <= time < last.profile.end

    def motors(self, time: float) -> Array:
        """Return the motor values at ``time``."""
        return self._piece(time).motors(time)

    def joints(self, time: float) -> Array:
        """Return the true joint values at ``time``, which may be up to :data:`HISTORY` s in the
        past."""
        return self._piece(time).joints(time, self._backlash)

    def move(self, target: Array, start: float, speed: float, acceleration: float) -> float:
        """Start a move from rest and return the time at which it ends."""
        origin, play, noise = self._state(start)
        delta = np.asarray(target, dtype=float) - origin
        length = float(np.linalg.norm(delta))
        if length == 0:
            return start
        piece = Piece(
            start,
            origin,
            delta / length,
            trapezoid(start, length, speed, acceleration),
            play,
            noise,
            self._rng.normal(0.0, 1.0, len(origin)) * self._repeatability,
            length,
        )
        self._append(piece)
        return piece.profile.end

    def brake(self, time: float, deceleration: float) -> float:
        """Brake the current move to rest; return the time when it is at rest."""
        if not self.moving(time):
            return time
        self._pieces[-1] = replace(self.last, profile=self.last.profile.brake(time, deceleration))
        return self.last.profile.end

    def freeze(self, time: float) -> None:
        """End the current move immediately at its present position."""
        if not self.moving(time):
            return
        state = self._state(time)
        self._pieces[-1] = replace(self.last, profile=self.last.profile.brake(time, 1e9))
        self._rest(*state, time)

    def shift(self, motors: Array, time: float) -> None:
        """Set the motor values of a resting arm to ``motors``; the joint values change by the same
        amount.

        Used when the arm slips or is moved by hand.
        """
        old, play, noise = self._state(time)
        new = np.asarray(motors, dtype=float)
        self._rest(new, play + (new - old), noise, time)

    def _state(self, time: float) -> tuple[Array, Array, Array]:
        """Return, for the newest piece, the motor values, the joint values that follow from them
        with backlash, and the random errors of the joint values."""
        motors = self.last.motors(time)
        play = self.last.drive(motors, self._backlash)
        return motors, play, self.last.joints(time, self._backlash) - play

    def _rest(self, motors: Array, play: Array, noise: Array, time: float) -> None:
        still = Profile((Phase(time, 0.0, 0.0, 0.0, 0.0),))
        self._append(Piece(time, motors, np.zeros(len(motors)), still, play, noise, noise, 0.0))

    def _append(self, piece: Piece) -> None:
        self._pieces.append(piece)
        while len(self._pieces) > 1 and self._pieces[1].start < piece.start - HISTORY:
            self._pieces.popleft()

    def _piece(self, time: float) -> Piece:
        for piece in reversed(self._pieces):
            if piece.start <= time:
                return piece
        return self._pieces[0]
