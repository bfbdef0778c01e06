"""The world's slide, integrated point by point, against the closed forms and against physics."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.mechanics import Disk, Polygon, Ring, Sliding
from tapping_cell.simulation.sliding import Motion, Support, advance, sample_support

GRAVITY = 9.81
DISK = Disk(radius=0.048, mass=0.2455, height=0.012)


def support_of(body: Disk | Ring | Polygon, friction: float, torque_factor: float) -> Support:
    points, weights = sample_support(body)
    return Support(points, weights, friction, torque_factor, GRAVITY)


def rest(motion: Motion, support: Support, body: Disk | Ring | Polygon) -> tuple[Motion, float]:
    """Where a motion ends, and after how long."""
    elapsed = 0.0
    while not motion.at_rest:
        motion = advance(motion, support, body.mass, body.inertia, 0.01)
        elapsed += 0.01
        assert elapsed < 20
    return motion, elapsed


@settings(max_examples=12, deadline=None)
@given(
    speed=st.floats(0.05, 0.8),
    spin=st.floats(-10.0, 10.0),
    friction=st.floats(0.1, 0.4),
    torque_factor=st.floats(0.5, 4.0),
    ring=st.booleans(),
)
def test_a_uniform_body_slides_as_the_closed_forms_say(
    speed: float, spin: float, friction: float, torque_factor: float, ring: bool
) -> None:
    body = Ring(radius=0.04, mass=0.2, height=0.01) if ring else DISK
    support = support_of(body, friction, torque_factor)
    end, _ = rest(Motion((0.0, 0.0, 0.0), (speed, 0.0, spin)), support, body)
    sliding = Sliding(body, friction=friction, torque_factor=torque_factor, gravity=GRAVITY)
    distance, rotation, _ = sliding.rest(speed, spin)
    # 180 to 400 points stand for the surface: their sums differ from the integrals by under 1 % of
    # the way that the rim makes.
    way = float(distance) + body.radius * abs(float(rotation))
    assert end.pose[0] == pytest.approx(float(distance), abs=0.01 * way)
    assert end.pose[2] == pytest.approx(float(rotation), rel=0.015, abs=2e-4)


@settings(max_examples=15, deadline=None)
@given(speed=st.floats(0.02, 1.0), heading=st.floats(-3.0, 3.0), friction=st.floats(0.1, 0.5))
def test_without_spin_it_is_a_straight_slide_of_v_squared_over_two_mu_g(
    speed: float, heading: float, friction: float
) -> None:
    velocity = (speed * math.cos(heading), speed * math.sin(heading), 0.0)
    end, elapsed = rest(Motion((0.1, -0.2, 0.5), velocity), support_of(DISK, friction, 1.0), DISK)
    expected = speed**2 / (2 * friction * GRAVITY)
    moved = np.array(end.pose[:2]) - [0.1, -0.2]
    assert math.hypot(*moved) == pytest.approx(expected, rel=2e-3)
    assert math.atan2(moved[1], moved[0]) == pytest.approx(heading, abs=1e-3)
    assert end.pose[2] == pytest.approx(0.5, abs=1e-3)
    assert elapsed == pytest.approx(speed / (friction * GRAVITY), abs=0.011)


@settings(max_examples=10, deadline=None)
@given(vx=st.floats(-0.5, 0.5), vy=st.floats(-0.5, 0.5), spin=st.floats(-8.0, 8.0))
def test_energy_never_grows(vx: float, vy: float, spin: float) -> None:
    body = Polygon(((0.04, 0.0), (0.0, 0.05), (-0.03, -0.02)), mass=0.3, height=0.01)
    support = support_of(body, 0.2, 2.0)
    motion, before = Motion((0.0, 0.0, 0.0), (vx, vy, spin)), math.inf
    while not motion.at_rest:
        x, y, omega = motion.twist
        energy = body.mass * (x**2 + y**2) / 2 + body.inertia * omega**2 / 2
        assert energy <= before * (1 + 1e-9)
        before = energy
        motion = advance(motion, support, body.mass, body.inertia, 0.02)


def test_a_tilted_table_draws_downhill_but_does_not_move_what_rests() -> None:
    level = support_of(DISK, 0.17, 3.64)
    tilted = replace(level, slope=(0.02, 0.0))
    launch = Motion((0.0, 0.0, 0.0), (0.0, 0.3, 0.0))
    end, _ = rest(launch, tilted, DISK)
    assert end.pose[0] > 1e-4
    still = Motion((0.0, 0.0, 0.0))
    assert advance(still, tilted, DISK.mass, DISK.inertia, 1.0) == still


def test_pressure_at_the_rim_brakes_the_spin_more() -> None:
    points, weights = sample_support(DISK, edge_weight=5.0)
    heavy_rim = Support(points, weights, 0.17, 1.0, GRAVITY)
    launch = Motion((0.0, 0.0, 0.0), (0.0, 0.0, 5.0))
    rim, _ = rest(launch, heavy_rim, DISK)
    even, _ = rest(launch, support_of(DISK, 0.17, 1.0), DISK)
    assert rim.pose[2] < 0.95 * even.pose[2]


@pytest.mark.parametrize("body", [DISK, Ring(radius=0.03, mass=0.1, height=0.01)])
def test_the_sampled_support_is_centred_and_of_the_right_width(body: Disk | Ring) -> None:
    points, weights = sample_support(body)
    assert weights.sum() == pytest.approx(1.0)
    assert np.abs(weights @ points).max() < 0.01 * body.radius
    second = float(weights @ np.sum(points**2, axis=1))
    assert second == pytest.approx(body.inertia / body.mass, rel=0.01)
