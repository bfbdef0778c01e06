"""Contact between the striker's ball and the object, integrated in time.

Along the normal, ball and object act on each other like a spring with the indentation d. Loading
follows F = k d; unloading follows the steeper F = (k / e^2) (d - d0), where d0 is the indentation
that remains. The spring therefore returns the fraction e^2 of the work, and e is the restitution at
any speed and for any masses (Walton and Braun, Journal of Rheology 30, 1986). Along the tangent,
the contact sticks or slides according to Coulomb's law; a sticking contact may also be compliant
(Maw, Barber and Fawcett, Wear 38, 1976). This model is independent of the planner's impulse model.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tapping_cell.mechanics import Disk, Polygon, Ring, Striker
from tapping_cell.simulation.sliding import Acceleration, Motion

TOUCH_M = 1e-8
"""Maximum distance between ball and object that counts as contact, m."""
SMALLEST_RESTITUTION = 0.05
"""Minimum restitution. With a lower value, the spring of the unloading would be so stiff that very
short steps would be needed."""
_STEPS = 100
"""Number of time steps per contact time (``ContactLaw.contact_time``) in an impact. This number is
high, because the impact determines the object's launch."""
_COARSE_STEPS = 10
"""Number of time steps per contact time if ball and object approach more slowly than ``_SLOW``
(m/s), as in a push."""
_SLOW = 0.005
_FRICTION_EVERY = 8
"""Number of steps between updates of the table's friction. Rare updates suffice, because this
friction is far weaker than the contact force."""
_LONGEST_CONTACT_S = 0.02
"""Maximum duration of a contact in one call of ``collide``, s; a longer contact continues in the
next call."""


@dataclass(frozen=True, slots=True)
class ContactLaw:
    """Parameters of the contact.

    restitution: coefficient of restitution of a head-on impact; friction: Coulomb coefficient;
    contact_time: duration of an elastic central impact, s; tangential_stiffness: ratio of the
    tangential to the normal stiffness, 0 for a tangentially rigid contact; oblique_loss: fraction
    of the restitution that a grazing impact loses, proportional to the squared sine of its angle
    from the normal.
    """

    restitution: float
    friction: float
    contact_time: float
    tangential_stiffness: float = 0.0
    oblique_loss: float = 0.0


@dataclass(slots=True)
class Flight:
    """A released striker: centre and velocity of its ball in ``table`` (m, m/s), its axis, and the
    remaining travel of its stroke (m). ``dent``: residual indentation of the last contact, m; 0 as
    soon as the ball has left it."""

    x: float
    y: float
    vx: float
    vy: float
    axis: tuple[float, float]
    left: float
    dent: float = 0.0

    @property
    def speed(self) -> float:
        """Speed along the axis, m/s."""
        return self.vx * self.axis[0] + self.vy * self.axis[1]

    def fly(self, time: float) -> None:
        """Move without contact for ``time`` s. The bearing guides the striker along its axis, so a
        sideways velocity is set to zero."""
        speed = self.speed
        self.vx, self.vy = speed * self.axis[0], speed * self.axis[1]
        self.x += time * self.vx
        self.y += time * self.vy
        self.left -= time * speed


class Outline:
    """Outline of a body for its contact with the striker's ball."""

    def __init__(self, body: Disk | Ring | Polygon, centre: tuple[float, float]) -> None:
        """``centre``: the centre of mass in the object's frame, m."""
        self._centre = centre
        self._radius = None if isinstance(body, Polygon) else body.radius
        self._corners: list[tuple[float, float]] = []
        self._edges: list[tuple[float, float, float]] = []
        if isinstance(body, Polygon):
            self._corners = [(x - centre[0], y - centre[1]) for x, y in body.points.tolist()]
            directions = np.roll(body.points, -1, axis=0) - body.points
            self._edges = [
                (x / length, y / length, length)
                for (x, y), length in zip(
                    directions.tolist(), body.edge_lengths.tolist(), strict=True
                )
            ]

    def nearest(self, motion: Motion, x: float, y: float) -> tuple[float, float, float]:
        """Return the distance of a point in ``table`` from the outline (m, negative inside), and
        the outward unit normal at the nearest point."""
        cos, sin = math.cos(motion.theta), math.sin(motion.theta)
        dx, dy = x - motion.x, y - motion.y
        px, py = cos * dx + sin * dy, cos * dy - sin * dx
        distance, nx, ny = self._nearest(px, py)
        return distance, cos * nx - sin * ny, sin * nx + cos * ny

    def _nearest(self, px: float, py: float) -> tuple[float, float, float]:
        if self._radius is not None:
            dx, dy = px + self._centre[0], py + self._centre[1]
            away = math.hypot(dx, dy) or 1e-12
            return away - self._radius, dx / away, dy / away
        inside, best = -math.inf, (1.0, 0.0)
        outside, out = math.inf, (1.0, 0.0)
        for (cx, cy), (tx, ty, length) in zip(self._corners, self._edges, strict=True):
            dx, dy = px - cx, py - cy
            height = dx * ty - dy * tx
            if height > inside:
                inside, best = height, (ty, -tx)
            along = min(max(dx * tx + dy * ty, 0.0), length)
            ox, oy = dx - along * tx, dy - along * ty
            away = math.hypot(ox, oy)
            if away < outside:
                outside, out = away, (ox, oy)
        if inside <= 0 or outside == 0.0:
            return inside, *best
        return outside, out[0] / outside, out[1] / outside


class Contact:
    """Contact of one tapper's striker with one object."""

    def __init__(
        self,
        outline: Outline,
        mass: float,
        inertia: float,
        striker: Striker,
        law: ContactLaw,
        friction: Callable[[Motion], Acceleration],
    ) -> None:
        """``friction``: acceleration of the object by the table's friction during the contact.
        ``mass`` in kg, ``inertia`` in kg m^2 about the centre of mass."""
        self._outline = outline
        self._mass, self._inertia = mass, inertia
        self._striker_mass = striker.mass
        self._guided = striker.constraint == "linear_bearings"
        self._tip = striker.tip_radius
        self._law = law
        self._friction = friction
        self._stiffness = (math.pi / law.contact_time) ** 2 / (1 / mass + 1 / striker.mass)

    def gap(self, motion: Motion, flight: Flight) -> float:
        """Return the distance between ball and object, m."""
        return self._outline.nearest(motion, flight.x, flight.y)[0] - self._tip + flight.dent

    def closing_speed(self, motion: Motion, flight: Flight) -> float:
        """Return the rate at which the gap decreases, m/s."""
        away, nx, ny = self._outline.nearest(motion, flight.x, flight.y)
        rx, ry = flight.x - away * nx - motion.x, flight.y - away * ny - motion.y
        ux = motion.vx - motion.omega * ry - flight.vx
        uy = motion.vy + motion.omega * rx - flight.vy
        return ux * nx + uy * ny

    def collide(self, motion: Motion, flight: Flight) -> tuple[Motion, float]:
        """Integrate a contact from its beginning until separation; return the object's motion and
        the elapsed time in s. ``flight`` is updated to the striker's motion afterwards."""
        law, tip = self._law, self._tip
        x, y, theta, vx, vy, omega = motion
        approach = self.closing_speed(motion, flight)
        restitution = self._restitution(motion, flight, approach)
        unloading = 1 / restitution**2
        steps = _STEPS if approach > _SLOW else _COARSE_STEPS
        step = law.contact_time * restitution / steps
        loading_stiffness = self._stiffness
        unloading_stiffness = loading_stiffness * unloading
        tangential_stiffness = law.tangential_stiffness * loading_stiffness
        ax, ay = flight.axis
        dent, stretch, elapsed, count = flight.dent, 0.0, 0.0, 0
        drag = Acceleration(0.0, 0.0, 0.0)
        while elapsed < _LONGEST_CONTACT_S:
            if count % _FRICTION_EVERY == 0:
                drag = self._friction(Motion(x, y, theta, vx, vy, omega))
            count += 1
            # Leapfrog: half a step in position, a full step in velocity, half a step in position.
            half = step / 2
            x, y, theta = x + half * vx, y + half * vy, theta + half * omega
            flight.x += half * flight.vx
            flight.y += half * flight.vy
            away, out_x, out_y = self._outline.nearest(Motion(x, y, theta), flight.x, flight.y)
            depth = tip - away
            rx, ry = flight.x - away * out_x - x, flight.y - away * out_y - y
            nx, ny = -out_x, -out_y
            tx, ty = -ny, nx
            lever_n, lever_t = rx * ny - ry * nx, rx * ty - ry * tx
            ux = vx - omega * ry - flight.vx
            uy = vy + omega * rx - flight.vy
            force = max(0.0, unloading_stiffness * (depth - dent))
            if 0 < loading_stiffness * depth < force:
                force = loading_stiffness * depth
                dent = depth * (1 - restitution**2)
            if force == 0.0 and (ux * nx + uy * ny > 0 or depth < dent - TOUCH_M):
                break
            push_n = force * step
            if self._guided:
                a_n, a_t = ax * nx + ay * ny, ax * tx + ay * ty
                b1 = 1 / self._mass + lever_t**2 / self._inertia + a_t**2 / self._striker_mass
                b3 = lever_n * lever_t / self._inertia + a_n * a_t / self._striker_mass
            else:
                b1 = 1 / self._mass + lever_t**2 / self._inertia + 1 / self._striker_mass
                b3 = lever_n * lever_t / self._inertia
            sliding = ux * tx + uy * ty
            most = law.friction * push_n
            if tangential_stiffness > 0:
                stretch += sliding * step
                push_t = -tangential_stiffness * stretch * step
                if abs(push_t) > most:
                    push_t = math.copysign(most, push_t)
                    stretch = -push_t / (tangential_stiffness * step)
            else:
                push_t = min(max(-(sliding + b3 * push_n) / b1, -most), most)
            jx, jy = push_n * nx + push_t * tx, push_n * ny + push_t * ty
            vx += jx / self._mass + step * drag.x
            vy += jy / self._mass + step * drag.y
            omega += (push_n * lever_n + push_t * lever_t) / self._inertia + step * drag.angular
            if self._guided:
                along = (jx * ax + jy * ay) / self._striker_mass
                jx, jy = along * ax, along * ay
            else:
                jx, jy = jx / self._striker_mass, jy / self._striker_mass
            flight.vx -= jx
            flight.vy -= jy
            x, y, theta = x + half * vx, y + half * vy, theta + half * omega
            flight.x += half * flight.vx
            flight.y += half * flight.vy
            flight.left -= step * flight.speed
            if flight.left <= 0 and flight.speed > 0:
                flight.vx = flight.vy = 0.0  # the end of the stroke stops the striker
            elapsed += step
        flight.dent = max(0.0, dent)
        return Motion(x, y, theta, vx, vy, omega), elapsed

    def _restitution(self, motion: Motion, flight: Flight, approach: float) -> float:
        """Return the restitution of an impact with the normal speed ``approach``, m/s."""
        law = self._law
        restitution = law.restitution
        if law.oblique_loss > 0:
            total = math.hypot(motion.vx - flight.vx, motion.vy - flight.vy)
            straight = min(1.0, max(0.0, approach / total)) if total > 0 else 1.0
            restitution *= 1 - law.oblique_loss * (1 - straight**2)
        return max(SMALLEST_RESTITUTION, restitution)
