"""The simulated table, object and striker: a tap in, a pose over time out.

The world has parameters of its own (``TruthFile``); the planner's model is only where the impact is
computed, with the true coefficients, after which the slide is integrated in time.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.configuration.objects import GRAVITY, ObjectFile
from tapping_cell.mechanics import Striker, Tap
from tapping_cell.se2 import Pose, wrap_angle
from tapping_cell.simulation.sliding import Motion, Support, advance, sample_support
from tapping_cell.simulation.truth import TruthFile


@dataclass(frozen=True, slots=True)
class Launch:
    """A tap that is on its way: when the striker meets the object, and the twist that it gives."""

    time: float
    twist: tuple[float, float, float]


class World:
    """One object on one table. Times in s, never going back from call to call."""

    def __init__(
        self, content: ObjectFile, striker: Striker, stroke: float, truth: TruthFile, seed: int
    ) -> None:
        """``stroke``: how far the tip travels at most when it is released, in m."""
        self._content = content
        self._truth = truth
        self._stroke = stroke
        self._true_content = _true_object(content, truth)
        self._tap: Tap = self._true_content.tap(striker)
        self._body = self._true_content.body()
        points, weights = sample_support(self._body, truth.support.edge_weight, truth.support.lean)
        self._support = Support(
            points=points,
            weights=weights,
            friction=self._true_content.friction,
            torque_factor=self._true_content.torque_factor,
            gravity=GRAVITY,
            slope=truth.support.slope,
        )
        self._random = np.random.default_rng(seed)
        # Of its own: how a tap scatters does not depend on whether it is measured.
        self._gate_random = np.random.default_rng([seed, 1])
        self._motion = Motion(truth.object_start)
        self._time = -math.inf
        self._launches: deque[Launch] = deque()

    @property
    def outline(self) -> NDArray[np.float64]:
        """The object's outline in its own frame, shape (n, 2), in m, counter-clockwise."""
        angles = np.linspace(-math.pi, math.pi, 96, endpoint=False)
        return np.asarray(self._body.boundary(angles))

    @property
    def at_rest(self) -> bool:
        """True when the object neither moves nor is about to be hit."""
        return self._motion.at_rest and not self._launches

    @property
    def pose(self) -> Pose:
        """Where the object is at the time that the world was last advanced to."""
        x, y, theta = self._motion.pose
        return Pose(x, y, float(wrap_angle(theta)))

    def reseed(self, seed: int) -> None:
        """Begin the random numbers anew."""
        self._random = np.random.default_rng(seed)

    def place(self, pose: Pose) -> None:
        """Put the object somewhere, at rest."""
        self._launches.clear()
        self._motion = Motion((pose.x, pose.y, pose.theta))

    def random_pose(self, length: float, width: float, margin: float) -> Pose:
        """A pose anywhere on a table of that size, at least ``margin`` m off its edges."""
        reach = np.maximum(np.array([length, width]) / 2 - margin, 0.0)
        x, y = self._random.uniform(-reach, reach)
        return Pose(float(x), float(y), float(self._random.uniform(-math.pi, math.pi)))

    def strike(self, tip: Pose, tip_height: float, speed: float, now: float) -> bool:
        """Release the striker at a true tip pose in ``table`` with a speed in m/s.

        Returns whether it will hit: a striker above the object's top, below the table, beside the
        object or farther from it than the stroke hits nothing.
        """
        if not 0 < tip_height < self._content.height:
            return False
        self.advance(now)
        scatter = self._truth.scatter
        true_speed = speed * self._truth.impact.striker_speed_factor
        result = self._tap.strike(self._motion.pose, tip, true_speed)
        if bool(result.missed) or float(result.travel) > self._stroke:
            return False
        faster = 1 + scatter.speed * self._random.standard_normal()
        spinnier = 1 + scatter.spin * self._random.standard_normal()
        turn = scatter.direction * self._random.standard_normal()
        cos, sin = math.cos(turn), math.sin(turn)
        vx, vy, omega = (faster * float(value) for value in result.twist)
        self._launches.append(
            Launch(
                now + float(result.travel) / true_speed,
                (cos * vx - sin * vy, sin * vx + cos * vy, spinnier * omega),
            )
        )
        return True

    def gate_speed(self, speed: float) -> float:
        """What the tapper's gate measures, m/s, of a striker released with a commanded speed."""
        impact = self._truth.impact
        noise = impact.gate_noise * self._gate_random.standard_normal()
        return speed * impact.striker_speed_factor * (1 + float(noise))

    def advance(self, now: float) -> None:
        """Let the object slide until ``now``."""
        if math.isinf(self._time):
            self._time = now
        while self._time < now:
            until = now
            if self._launches and self._launches[0].time <= now:
                until = max(self._time, self._launches[0].time)
            self._slide(until)
            if self._launches and self._launches[0].time <= until:
                launch = self._launches.popleft()
                # An object hit while it still moves keeps what it had: impulses add.
                vx, vy, omega = np.add(self._motion.twist, launch.twist).tolist()
                self._motion = replace(self._motion, twist=(vx, vy, omega))

    def _slide(self, until: float) -> None:
        if until > self._time:
            self._motion = advance(
                self._motion,
                self._support,
                self._body.mass,
                self._body.inertia,
                until - self._time,
            )
        self._time = until


def _true_object(content: ObjectFile, truth: TruthFile) -> ObjectFile:
    """The object as it really is."""
    return replace(
        content,
        friction=content.friction * truth.support.friction_factor,
        torque_factor=content.torque_factor * truth.support.torque_factor_factor,
        restitution=min(1.0, content.restitution * truth.impact.restitution_factor),
        contact_friction=content.contact_friction * truth.impact.contact_friction_factor,
    )
