"""Simulations of taps: the commanded displacement with scatter, or the physics of impact and
slide."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np

from tapping_cell.mechanics import Tap
from tapping_cell.mechanics.tap import tips_at_rest
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import Scatter


@dataclass(frozen=True, slots=True)
class AbstractWorld:
    """Simulation in which the object moves as commanded, changed only by gains and scatter."""

    scatter: Scatter = field(default_factory=Scatter)
    model: None = None

    def answer(
        self,
        poses: Array,
        seen: Array,
        commanded: Array,
        gains: Array,
        rng: np.random.Generator,
    ) -> Array:
        """Return the true displacements (n, 3) of commanded taps, for true poses (n, 3), measured
        poses ``seen`` (n, 3) and true gains (n, 4)."""
        return scattered(commanded, gains, poses, self.scatter, rng)


@dataclass(frozen=True, slots=True)
class PhysicsWorld:
    """Simulation of the arm's rounded strike pose, the impact and the slide with the true
    mechanics.

    model: the planner's mechanics, which convert a displacement to a strike.
    truth: the true mechanics.
    standoff: distance from the tip at rest to the contact, m.
    round_position, round_angle: the tip's pose at rest is rounded to multiples of these values (m,
        rad) in the table frame, as in section 5 of the paper; 0 means no rounding. The planner
        ignores the rounding.
    speed_factor: ratio of the true to the commanded speed of the striker.
    """

    model: Tap
    truth: Tap
    scatter: Scatter = field(default_factory=Scatter)
    standoff: float = 0.015
    round_position: float = 0.0
    round_angle: float = 0.0
    speed_factor: float = 1.0

    def answer(
        self,
        poses: Array,
        seen: Array,
        commanded: Array,
        gains: Array,
        rng: np.random.Generator,
    ) -> Array:
        """Return the true displacements (n, 3) of taps that are planned for the measured poses
        ``seen`` (n, 3)."""
        plan = self.model.plan(commanded, seen)
        tips = tips_at_rest(plan.strike_pose, self.standoff, self.round_position, self.round_angle)
        moved = self.truth.outcome(poses, tips, self.speed_factor * plan.striker_speed)
        return scattered(moved, gains, poses, self.scatter, rng)


def scattered(
    moved: Array, gains: Array, poses: Array, scatter: Scatter, rng: np.random.Generator
) -> Array:
    """Apply constant gains (n, 4) and random scatter to displacements (n, 3) at poses (n, 3).

    Zero displacements remain zero, and no tap moves the object backwards.
    """
    noise = rng.standard_normal((3, moved.shape[0]))
    asked = np.hypot(moved[:, 0], moved[:, 1])
    size = gains[:, 0] * asked
    hit = size > 0.0
    safe = np.where(hit, size, 1.0)
    length = np.maximum(size + scatter.along(size) * noise[0], 0.0)
    travel = np.arctan2(moved[:, 1], moved[:, 0])
    heading = travel + scatter.across(size) / safe * noise[2]
    frame = travel - poses[:, 2]
    drift = gains[:, 3] * np.cos(frame) - gains[:, 2] * np.sin(frame)
    turn = moved[:, 2] * gains[:, 1] + size * drift
    turn = turn + np.copysign(scatter.turning(turn), turn) * noise[1]
    taps = np.stack([length * np.cos(heading), length * np.sin(heading), turn], axis=-1)
    return np.where(hit[:, None], taps, 0.0)


class World(Protocol):
    """Interface of a simulation of commanded taps.

    model: mechanics with which the planner converts displacements to strikes; None if every
    displacement is possible.
    """

    @property
    def model(self) -> Tap | None:
        """Mechanics with which the planner converts displacements to strikes; None if every
        displacement is possible."""

    def answer(
        self,
        poses: Array,
        seen: Array,
        commanded: Array,
        gains: Array,
        rng: np.random.Generator,
    ) -> Array:
        """Return the true displacements (n, 3) of commanded taps, for true poses (n, 3), measured
        poses ``seen`` (n, 3) and true gains (n, 4)."""


@runtime_checkable
class TrackedWorld(Protocol):
    """Interface of a simulation that computes the motion of an object in time."""

    def path(self) -> tuple[Array, Array]:
        """Return times (n,) at equal steps, s, and the true poses (n, 3) at these times, from
        before the last simulated tap until the object is at rest."""


START_REACH = 0.1
"""Starts are drawn in a square on the open table, at any angle. This is half the width of the
square, m."""


def draw_starts(count: int, rng: np.random.Generator) -> Array:
    """Draw start poses of the objects for trials on an open table, (count, 3)."""
    place = rng.uniform(-START_REACH, START_REACH, (count, 2))
    return np.concatenate([place, rng.uniform(-math.pi, math.pi, (count, 1))], axis=1)
