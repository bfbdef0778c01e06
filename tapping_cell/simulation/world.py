"""Simulation of table, object and striker: the object's pose as a function of time after a tap.

The striker's flight, its contacts with the object and the slide are integrated in time with the
true parameters (``TruthFile``). Time is passed as an argument. The step lengths depend only on the
motion, so the final pose of the object does not depend on the times of the calls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tapping_cell.configuration.objects import GRAVITY, ObjectFile
from tapping_cell.mechanics import Striker
from tapping_cell.se2 import Pose, wrap_angle
from tapping_cell.simulation.collision import Solid
from tapping_cell.simulation.contact import TOUCH_M, Contact, ContactLaw, Flight, Outline
from tapping_cell.simulation.sliding import LONGEST_STEP_S, Motion, Slide, TableFriction
from tapping_cell.simulation.support import sample_support
from tapping_cell.simulation.truth import TruthFile

_SHORTEST_STEP_S = 2e-6
"""Minimum time step of the striker's flight close to the object, s."""


@dataclass(frozen=True, slots=True)
class _Scatter:
    """Random deviation of one tap from the deterministic mechanics."""

    faster: float
    spinnier: float
    turn: float

    def apply(self, before: Motion, after: Motion) -> Motion:
        """Return the motion after a contact, with random errors in the change of velocity and
        spin."""
        vx, vy = after.vx - before.vx, after.vy - before.vy
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        return after._replace(
            vx=before.vx + self.faster * (cos * vx - sin * vy),
            vy=before.vy + self.faster * (sin * vx + cos * vy),
            omega=before.omega + self.faster * self.spinnier * (after.omega - before.omega),
        )


@dataclass(slots=True)
class _Tap:
    """A released striker and the random deviations of its tap."""

    flight: Flight
    scatter: _Scatter
    ends: float = math.inf
    hit: bool = False


class World:
    """One object on one table. Times are in s and must not decrease between calls."""

    def __init__(
        self,
        content: ObjectFile,
        striker: Striker,
        stroke: float,
        truth: TruthFile,
        random: int | np.random.Generator,
    ) -> None:
        """``stroke``: maximum travel of the released tip, m. ``random``: seed or generator of the
        random errors.

        Raises:
            ValueError: the true centre of mass is not over the object's support.
        """
        self._height = content.height
        self._striker = striker
        self._truth = truth
        self._stroke = stroke
        body = content.body()
        offset = truth.support.mass_offset
        points, grip = sample_support(body, truth.support)
        surface = truth.surface
        friction = TableFriction(
            friction=content.friction * truth.support.friction_factor,
            torque_factor=content.torque_factor * truth.support.torque_factor_ratio,
            gravity=GRAVITY,
            slope=truth.support.slope,
            anisotropy=surface.anisotropy,
            grain=surface.grain,
            slow_rise=surface.slow_rise,
            slow_speed=surface.slow_speed,
            viscous=surface.viscous,
            patches=tuple((*patch.middle, patch.radius, patch.factor) for patch in surface.patches),
        )
        inertia = body.inertia * truth.support.inertia_factor
        self._slide = Slide(points - np.array(offset), grip, friction, inertia / body.mass)
        law = ContactLaw(
            restitution=min(1.0, content.restitution * truth.impact.restitution_factor),
            friction=content.contact_friction * truth.impact.contact_friction_factor,
            contact_time=truth.impact.contact_time,
            tangential_stiffness=truth.impact.tangential_stiffness,
            oblique_loss=truth.impact.oblique_loss,
        )
        self._outline, self._inertia, self._law = Outline(body, offset), inertia, law
        self._body = body
        self._contact = self._contact_with(striker)
        self.solid = Solid.of(body, offset, inertia)
        """The object's shape for collisions with other objects."""
        self._random = np.random.default_rng(random)
        # Speed measurements and errors of the end position have their own random generators, so
        # that they do not change the other random errors of the taps.
        self._gate_random, self._end_random = self._random.spawn(2)
        self._tap: _Tap | None = None
        self._now = -math.inf
        # Times of the beginning and the end of the current step, and the motions at these times.
        self._begun = self._done = -math.inf
        self._before = self._after = self._centred(Pose(*truth.object_start))

    @property
    def outline(self) -> NDArray[np.float64]:
        """Outline of the object in its own frame, shape (n, 2), in m, counter-clockwise."""
        angles = np.linspace(-math.pi, math.pi, 96, endpoint=False)
        return np.asarray(self._body.boundary(angles))

    @property
    def at_rest(self) -> bool:
        """True when the object neither moves nor is about to be hit."""
        return self._tap is None and self._after.at_rest and self._done <= self._now

    @property
    def struck(self) -> bool:
        """True while a released striker may hit the object."""
        return self._tap is not None

    @property
    def pose(self) -> Pose:
        """Pose of the object at the time of the last ``advance``."""
        motion = self._motion()
        x, y = self._truth.support.mass_offset
        cos, sin = math.cos(motion.theta), math.sin(motion.theta)
        return Pose(
            motion.x - (cos * x - sin * y),
            motion.y - (sin * x + cos * y),
            float(wrap_angle(motion.theta)),
        )

    @property
    def twist(self) -> tuple[float, float, float]:
        """Present velocity (m/s, in table) and spin (rad/s) of the centre of mass."""
        motion = self._motion()
        return motion.vx, motion.vy, motion.omega

    @property
    def motion(self) -> Motion:
        """Pose and twist of the centre of mass at the last ``advance``."""
        return self._motion()

    def go_on(self, motion: Motion) -> None:
        """Continue with a new motion of the centre of mass, after a collision."""
        self._cut(motion)

    def _contact_with(self, striker: Striker) -> Contact:
        return Contact(
            self._outline,
            self._body.mass,
            self._inertia,
            striker,
            self._law,
            self._slide.acceleration,
        )

    def reseed(self, seed: int) -> None:
        """Restart the random numbers with a new seed."""
        self._random = np.random.default_rng(seed)
        self._end_random = self._random.spawn(2)[1]

    def place(self, pose: Pose) -> None:
        """Place the object at a pose, at rest."""
        self._tap = None
        self._cut(self._centred(pose))

    def take_striker(self, striker: Striker, stroke: float) -> None:
        """Change the striker and its stroke in m, because each of several tappers has its own
        striker and stroke."""
        self._stroke = stroke
        if striker != self._striker:
            self._striker, self._contact = striker, self._contact_with(striker)

    def strike(self, tip: Pose, tip_height: float, speed: float, now: float) -> bool:
        """Release the striker at a true tip pose in ``table`` with a speed in m/s.

        Returns whether the striker will hit the object at the object's current pose. A striker
        misses if it is above the object's top, below the table, beside the object, or farther away
        than the stroke.
        """
        self.advance(now)
        self._cut(self._motion())
        self._tap = None
        if not 0 < tip_height < self._height or speed <= 0:
            return False
        flight = self._released(tip, speed * self._truth.impact.striker_speed_factor)
        meets = self._meets(replace(flight))
        if not meets and self._after.at_rest:
            return False
        scatter = self._truth.scatter
        draws = self._random.standard_normal(3).tolist()
        self._tap = _Tap(
            flight,
            _Scatter(
                1 + scatter.speed * draws[0],
                1 + scatter.spin * draws[1],
                scatter.direction * draws[2],
            ),
        )
        return meets

    def travel_to_meet(self, tip: Pose, tip_height: float, speed: float) -> float:
        """Return the distance in m that a released striker travels until it meets the object at the
        object's current pose; inf if it misses."""
        if not 0 < tip_height < self._height or speed <= 0:
            return math.inf
        return self._travel(self._released(tip, speed))

    def gate_speed(self, speed: float) -> float:
        """Return the measurement of the tapper's speed gate, m/s, for a commanded striker speed."""
        impact = self._truth.impact
        noise = impact.gate_noise * self._gate_random.standard_normal()
        return speed * impact.striker_speed_factor * (1 + float(noise))

    def advance(self, now: float) -> None:
        """Advance the simulation to ``now``."""
        if math.isinf(self._now):
            self._begun = self._done = now
        self._now = max(self._now, now)
        while self._done < self._now:
            if self._tap is None and self._after.at_rest and self._slide.stays(self._after):
                self._begun = self._done = self._now
                self._before = self._after
            else:
                self._step()

    def settle(self, longest: float = 60.0) -> float:
        """Advance until the object is at rest, for at most ``longest`` s; return the time
        reached."""
        until = self._now + longest
        while not self.at_rest and self._now < until:
            self.advance(min(until, max(self._done, math.nextafter(self._now, math.inf))))
        return self._now

    def _step(self) -> None:
        """Make one step of a contact, a flight or a slide."""
        self._begun, self._before = self._done, self._after
        tap = self._tap
        if tap is None:
            self._after, length = self._slide.step(self._before)
        else:
            length = self._step_with(tap)
        self._done = self._begun + length

    def _step_with(self, tap: _Tap) -> float:
        """Make a time step while a striker is released; return the length of the step in s."""
        contact, flight, before = self._contact, tap.flight, self._before
        gap = contact.gap(before, flight)
        closing = contact.closing_speed(before, flight)
        if gap <= TOUCH_M and closing > 0:
            after, length = contact.collide(before, flight)
            self._after = tap.scatter.apply(before, after)
            if not tap.hit:
                tap.hit, self._after = True, self._with_shifted_end(self._after)
            tap.ends = min(tap.ends, self._begun + self._truth.impact.follow_through)
            self._end(tap, self._begun + length)
            return length
        speed = flight.speed
        longest = min(LONGEST_STEP_S, max(flight.left / speed, _SHORTEST_STEP_S))
        if closing > 0:
            longest = min(longest, max(gap / closing, _SHORTEST_STEP_S))
        while True:
            after, length = before, longest
            if not (before.at_rest and self._slide.stays(before)):
                after, length = self._slide.step(before, longest)
            ahead = replace(flight)
            ahead.fly(length)
            if contact.gap(after, ahead) >= -TOUCH_M or length <= _SHORTEST_STEP_S:
                break
            longest = length / 2
        if contact.gap(after, ahead) > ahead.dent:
            ahead.dent = 0.0
        tap.flight, self._after = ahead, after
        self._end(tap, self._begun + length)
        return length

    def _with_shifted_end(self, launch: Motion) -> Motion:
        """Change the launch so that the slide ends with random errors, whose standard deviations
        are ``position_floor`` and ``angle_floor``.

        The errors of the end pose are converted to errors of the launch. A launch with speed v and
        spin omega, and with the decelerations a and alpha at the beginning of the slide, ends after
        the distance x = v^2 / 2 a and, for small spins, the rotation theta = omega v / (a + alpha v
        / omega).
        """
        scatter, speed = self._truth.scatter, math.hypot(launch.vx, launch.vy)
        if speed <= 0 or scatter.position_floor == scatter.angle_floor == 0:
            return launch
        along, across, turn = self._end_random.standard_normal(3).tolist()
        spin = 0.01 * speed / self._body.support_radius
        probe = self._slide.acceleration(launch._replace(omega=spin))
        slowing = -(probe[0] * launch.vx + probe[1] * launch.vy) / speed
        distance = speed**2 / (2 * slowing)
        faster = math.sqrt(max(1 + scatter.position_floor * along / distance, 0.0))
        aside = math.atan2(scatter.position_floor * across, distance)
        spinnier = scatter.angle_floor * turn * (slowing / speed - probe[2] / spin)
        cos, sin = faster * math.cos(aside), faster * math.sin(aside)
        return launch._replace(
            vx=cos * launch.vx - sin * launch.vy,
            vy=sin * launch.vx + cos * launch.vy,
            omega=faster * launch.omega + spinnier,
        )

    def _end(self, tap: _Tap, time: float) -> None:
        """Retract the striker if it has reached the end of its stroke, if the time ``tap.ends`` has
        come, or if it can no longer meet the object."""
        flight = tap.flight
        over = flight.left <= 0 or flight.speed <= 0 or time >= tap.ends
        if over or (self._after.at_rest and not self._meets(replace(flight))):
            self._tap = None

    def _released(self, tip: Pose, speed: float) -> Flight:
        """Return a released striker. A tip that overlaps the object is first moved back along its
        axis until it is outside."""
        axis = (math.cos(tip.theta), math.sin(tip.theta))
        flight = Flight(tip.x, tip.y, speed * axis[0], speed * axis[1], axis, self._stroke)
        while (gap := self._contact.gap(self._after, flight)) < 0:
            back = max(-gap, TOUCH_M)
            flight.x -= back * flight.axis[0]
            flight.y -= back * flight.axis[1]
        return flight

    def _meets(self, flight: Flight) -> bool:
        """Return whether a striker that continues to move would meet the object at the object's
        current pose."""
        return math.isfinite(self._travel(flight))

    def _travel(self, flight: Flight) -> float:
        """Return the distance that the striker still travels until it meets the object; inf if it
        misses."""
        nearest, left = math.inf, flight.left
        while flight.left > 0:
            gap = self._contact.gap(self._after, flight)
            if gap <= TOUCH_M:
                meets = self._contact.closing_speed(self._after, flight) > 0
                return left - flight.left if meets else math.inf
            if gap > nearest:
                # The outline is convex, so a gap that has begun to increase never decreases again.
                return math.inf
            nearest = gap
            flight.fly(max(gap, TOUCH_M) / flight.speed)
        return math.inf

    def _motion(self) -> Motion:
        """Return the current motion, interpolated within the current step by a cubic polynomial."""
        before, after = self._before, self._after
        length = self._done - self._begun
        if self._now >= self._done or length <= 0:
            return after
        share = (self._now - self._begun) / length
        bend = share * share * (3 - 2 * share)
        start = length * share * (1 - share) ** 2
        end = -length * share * share * (1 - share)
        where = [
            (1 - bend) * a + bend * b + start * u + end * v
            for a, b, u, v in zip(before[:3], after[:3], before[3:], after[3:], strict=True)
        ]
        twist = [u + share * (v - u) for u, v in zip(before[3:], after[3:], strict=True)]
        return Motion(*where, *twist)

    def _cut(self, motion: Motion) -> None:
        """From the current time on, continue with another motion."""
        self._begun = self._done = self._now
        self._before = self._after = motion

    def _centred(self, pose: Pose) -> Motion:
        """Return the motion of the centre of mass of an object at rest whose frame is at
        ``pose``."""
        x, y = self._truth.support.mass_offset
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        return Motion(pose.x + cos * x - sin * y, pose.y + sin * x + cos * y, pose.theta)
