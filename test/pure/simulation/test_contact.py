"""The contact integrated in time, compared with closed forms, an independent integral, and physical
laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tapping_cell.mechanics import Body, Disk, Impact, Polygon, Ring, Striker
from tapping_cell.simulation.contact import Contact, ContactLaw, Flight, Outline
from tapping_cell.simulation.sliding import Acceleration, Motion

DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
SQUARE = Polygon(((-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04)), 0.2, 0.012)
STILL = Motion(0.0, 0.0, 0.0)


def smooth(_: Motion) -> Acceleration:
    """Return the acceleration on a table without friction: zero."""
    return Acceleration(0.0, 0.0, 0.0)


def collided(
    body: Disk | Ring | Polygon,
    striker: Striker,
    law: ContactLaw,
    along: float,
    incidence: float,
    speed: float,
) -> tuple[Motion, Flight, float]:
    """Simulate the impact of a striker that comes from -x and meets the body at y = ``along``."""
    outline = Outline(body, (0.0, 0.0))
    contact = Contact(outline, body.mass, body.inertia, striker, law, smooth)
    if isinstance(body, Polygon):
        x, normal = -0.04, 0.0
    else:
        x = -math.sqrt(body.radius**2 - along**2)
        normal = math.asin(-along / body.radius)
    angle = normal + incidence
    axis = (math.cos(angle), math.sin(angle))
    tip = striker.tip_radius
    ball = (x - tip * math.cos(normal), along - tip * math.sin(normal))
    flight = Flight(*ball, speed * axis[0], speed * axis[1], axis, 1.0)
    motion, time = contact.collide(STILL, flight)
    return motion, flight, time


@given(
    speed=st.floats(0.02, 2.0),
    incidence=st.floats(-1.2, 1.2),
    along=st.floats(-0.04, 0.04),
    restitution=st.floats(0.1, 1.0),
    friction=st.floats(0.05, 0.8),
    striker_mass=st.floats(0.02, 0.5),
    ring=st.booleans(),
)
def test_a_free_striker_launches_a_round_body_as_in_the_closed_form(
    speed, incidence, along, restitution, friction, striker_mass, ring
):
    """If the coefficient B3 of the impact is 0, sliding does not affect the motion in the normal
    direction. All definitions of restitution then agree."""
    body = Ring(0.05, 0.1, 0.01) if ring else DISK
    striker = Striker(striker_mass, 0.0054, "free")
    law = ContactLaw(restitution, friction, 1e-4)
    motion, flight, _ = collided(body, striker, law, along, incidence, speed)
    closed = Impact(body, striker, restitution, friction).strike(
        speed, incidence, (-body.bounding_radius, 0.0)
    )
    size = float(np.hypot(*closed.velocity))
    # The contact point moves along the edge during the contact, which the closed form neglects.
    way = speed * law.contact_time / body.bounding_radius
    off = (0.005 + 3 * way) * size
    assert math.hypot(motion.vx, motion.vy) == pytest.approx(size, abs=off)
    assert body.radius_of_gyration * abs(motion.omega - float(closed.spin)) < 2 * off
    momentum = body.mass * np.array([motion.vx, motion.vy]) + striker_mass * np.array(
        [flight.vx, flight.vy]
    )
    angle = math.asin(-along / body.bounding_radius) + incidence
    direction = np.array([math.cos(angle), math.sin(angle)])
    assert momentum == pytest.approx(striker_mass * speed * direction, abs=1e-9)


@given(
    incidence=st.floats(-0.9, 0.9),
    along=st.floats(-0.03, 0.03),
    restitution=st.floats(0.2, 0.95),
    friction=st.floats(0.05, 0.8),
    constraint=st.sampled_from(["free", "linear_bearings"]),
)
def test_an_off_centre_contact_matches_the_impact_with_energetic_restitution(
    incidence, along, restitution, friction, constraint
):
    """The reference integrates the same impact over small steps of the normal impulse (Stronge
    1990). It ends when the normal force has done e^2 times as much work in restitution as in
    compression."""
    striker = Striker(0.1, 0.0054, constraint)
    law = ContactLaw(restitution, friction, 5e-5)
    motion, _, _ = collided(SQUARE, striker, law, along, incidence, 0.3)
    p_n, p_t = energetic(SQUARE, striker, restitution, friction, incidence, (-0.04, along), 0.3)
    assume(p_n > 0)
    scale = math.hypot(p_n, p_t)
    assert SQUARE.mass * motion.vx == pytest.approx(p_n, abs=0.01 * scale)
    assert SQUARE.mass * motion.vy == pytest.approx(p_t, abs=0.01 * scale)
    assert SQUARE.inertia * motion.omega == pytest.approx(
        -0.04 * p_t - along * p_n, abs=0.01 * 0.04 * scale
    )


def energetic(
    body: Body,
    striker: Striker,
    restitution: float,
    friction: float,
    incidence: float,
    contact: tuple[float, float],
    speed: float,
) -> tuple[float, float]:
    b1, b2, b3 = (
        float(value)
        for value in Impact(body, striker, restitution, friction).inverse_inertias(
            incidence, contact
        )
    )
    closing, sliding = -speed * math.cos(incidence), -speed * math.sin(incidence)
    step = -closing / b2 / 4000
    p_n = p_t = work = absorbed = 0.0
    for _ in range(60000):
        wanted = -(sliding - b3 * step) / b1
        push = min(max(wanted, -friction * step), friction * step)
        before = closing
        closing += b2 * step - b3 * push
        sliding += b1 * push - b3 * step
        p_n, p_t = p_n + step, p_t + push
        work += step * (before + closing) / 2
        absorbed = min(absorbed, work)
        if closing > 0 and work >= (1 - restitution**2) * absorbed:
            break
    return p_n, p_t


@given(
    incidence=st.floats(-1.2, 1.2),
    stiffness=st.floats(0.1, 1.5),
    restitution=st.floats(0.1, 1.0),
    friction=st.floats(0.0, 1.0),
    along=st.floats(-0.039, 0.039),
)
def test_a_contact_never_creates_energy(incidence, stiffness, restitution, friction, along):
    striker = Striker(0.1, 0.0054, "free")
    law = ContactLaw(restitution, friction, 1e-4, stiffness)
    motion, flight, _ = collided(SQUARE, striker, law, along, incidence, 0.5)
    energy = (
        SQUARE.mass * (motion.vx**2 + motion.vy**2)
        + SQUARE.inertia * motion.omega**2
        + striker.mass * (flight.vx**2 + flight.vy**2)
    ) / 2
    assert energy <= striker.mass * 0.5**2 / 2 * 1.001


def test_the_contact_has_the_duration_of_the_simulation_parameters() -> None:
    law = ContactLaw(1.0, 0.2, 3e-4)
    _, _, time = collided(DISK, Striker(0.1, 0.0054, "free"), law, 0.0, 0.0, 0.3)
    assert time == pytest.approx(3e-4, rel=0.02)


def test_a_tangentially_compliant_contact_returns_sliding_energy() -> None:
    """A rigid contact that sticks keeps no sliding velocity; a tangential spring returns part of it
    in the opposite direction."""
    striker = Striker(0.1, 0.0054, "free")
    rigid, _, _ = collided(DISK, striker, ContactLaw(0.8, 2.0, 1e-4), 0.0, 0.5, 0.3)
    soft, _, _ = collided(DISK, striker, ContactLaw(0.8, 2.0, 1e-4, 0.8), 0.0, 0.5, 0.3)
    assert abs(soft.omega) > 1.2 * abs(rigid.omega)


def test_an_oblique_impact_may_lose_restitution() -> None:
    striker = Striker(0.1, 0.0054, "free")
    straight, oblique = ((0.0, 1.0), (math.pi / 4, 0.75))
    for incidence, expected in (straight, oblique):
        law = ContactLaw(0.8, 0.001, 1e-4, oblique_loss=0.5)
        motion, _, _ = collided(DISK, striker, law, 0.0, incidence, 0.3)
        closed = Impact(DISK, striker, 0.8 * expected, 0.001).strike(0.3, incidence, (-0.048, 0.0))
        assert motion.vx == pytest.approx(float(closed.velocity[0]), rel=5e-3)
