"""The simulated slide, integrated point by point, compared with closed forms and physical laws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from tapping_cell.mechanics import Disk, Polygon, Ring, Sliding
from tapping_cell.simulation.sliding import Motion, Slide, TableFriction
from tapping_cell.simulation.support import sample_support
from tapping_cell.simulation.truth import SupportTruth

GRAVITY = 9.81
DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
SQUARE = Polygon(((-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04)), 0.2, 0.012)
PLAIN = TableFriction(friction=0.17, torque_factor=1.0, gravity=GRAVITY)
EVEN = SupportTruth()


def slide_of(
    body: Disk | Ring | Polygon, friction: TableFriction = PLAIN, support: SupportTruth = EVEN
) -> Slide:
    points, grip = sample_support(body, support)
    centred = points - np.array(support.mass_offset)
    return Slide(centred, grip, friction, body.inertia / body.mass)


@given(
    speed=st.floats(0.05, 0.8),
    spin=st.floats(-10.0, 10.0),
    friction=st.floats(0.1, 0.4),
    torque_factor=st.floats(0.5, 4.0),
    body=st.sampled_from([DISK, Ring(radius=0.04, mass=0.2, height=0.01), SQUARE]),
)
def test_a_uniform_body_slides_as_in_the_closed_forms(speed, spin, friction, torque_factor, body):
    law = replace(PLAIN, friction=friction, torque_factor=torque_factor)
    end, duration = slide_of(body, law).rest(Motion(0.0, 0.0, 0.0, speed, 0.0, spin))
    sliding = Sliding(body, friction=friction, torque_factor=torque_factor, gravity=GRAVITY)
    dx, dy, rotation = sliding.displace((speed, 0.0, spin)).tolist()
    way = math.hypot(dx, dy) + body.support_radius * abs(rotation)
    assert math.hypot(end.x - dx, end.y - dy) < 0.01 * way
    assert body.support_radius * abs(end.theta - rotation) < 0.01 * way
    assert duration == pytest.approx(float(sliding.rest(speed, spin).duration), rel=0.01, abs=2e-3)


@settings(max_examples=settings.default.max_examples // 5)
@given(vx=st.floats(0.05, 0.5), spin=st.floats(-8.0, 8.0), anisotropy=st.floats(0.5, 2.0))
def test_the_time_steps_are_short_enough_for_all_friction_laws_combined(vx, spin, anisotropy):
    """The reference integrates the same forces with another method and a small tolerance."""
    law = replace(
        PLAIN,
        slope=(0.004, -0.003),
        anisotropy=anisotropy,
        grain=0.6,
        slow_rise=0.5,
        slow_speed=0.05,
        viscous=0.4,
    )
    support = SupportTruth(pressure="pads", lean=(0.1, 0.2), mass_offset=(0.004, -0.002))
    slide = slide_of(DISK, law, support)

    def rates(_: float, state: np.ndarray) -> list[float]:
        return [*state[3:], *slide.acceleration(Motion(*state))]

    def stopped(_: float, state: np.ndarray) -> float:
        return slide.speed(Motion(*state)) - 0.002

    stopped.terminal = True  # type: ignore[attr-defined]
    exact = solve_ivp(
        rates, (0, 10), [0, 0, 0, vx, 0, spin], "DOP853", None, events=stopped, rtol=1e-8, atol=1e-9
    ).y[:, -1]
    end, _ = slide.rest(Motion(0.0, 0.0, 0.0, vx, 0.0, spin))
    way = math.hypot(exact[0], exact[1]) + 0.048 * abs(exact[2])
    assert math.hypot(end.x - exact[0], end.y - exact[1]) < 2e-3 * way + 5e-6
    assert 0.048 * abs(end.theta - exact[2]) < 2e-3 * way + 5e-6


@settings(max_examples=settings.default.max_examples // 5)
@given(speed=st.floats(0.02, 1.0), heading=st.floats(-3.0, 3.0), friction=st.floats(0.1, 0.5))
def test_without_spin_it_is_a_straight_slide_of_v_squared_over_two_mu_g(speed, heading, friction):
    launch = Motion(0.1, -0.2, 0.5, speed * math.cos(heading), speed * math.sin(heading))
    end, elapsed = slide_of(DISK, replace(PLAIN, friction=friction)).rest(launch)
    expected = speed**2 / (2 * friction * GRAVITY)
    moved = np.array(end[:2]) - [0.1, -0.2]
    assert math.hypot(*moved) == pytest.approx(expected, rel=1e-4, abs=1e-7)
    assert math.atan2(moved[1], moved[0]) == pytest.approx(heading, abs=1e-6)
    assert end.theta == pytest.approx(0.5, abs=1e-9)
    assert elapsed == pytest.approx(speed / (friction * GRAVITY), abs=1e-3)


@settings(max_examples=settings.default.max_examples // 5)
@given(vx=st.floats(-0.5, 0.5), vy=st.floats(-0.5, 0.5), spin=st.floats(-8.0, 8.0))
def test_energy_never_increases(vx: float, vy: float, spin: float) -> None:
    body = Polygon(((0.04, 0.0), (0.0, 0.05), (-0.03, -0.02)), mass=0.3, height=0.01)
    law = replace(PLAIN, torque_factor=2.0, anisotropy=1.7, grain=1.0, slow_rise=-0.3, viscous=1.0)
    slide = slide_of(body, law)
    motion, before = Motion(0.0, 0.0, 0.0, vx, vy, spin), math.inf
    while not motion.at_rest:
        energy = body.mass * (motion.vx**2 + motion.vy**2) / 2 + body.inertia * motion.omega**2 / 2
        assert energy <= before * (1 + 1e-9)
        before = energy
        motion, _ = slide.step(motion)


def test_a_tilted_table_deflects_slides_but_does_not_move_objects_at_rest() -> None:
    tilted = slide_of(DISK, replace(PLAIN, slope=(0.02, 0.0)))
    speed, pull = 0.3, GRAVITY * math.sin(0.02)
    end, _ = tilted.rest(Motion(0.0, 0.0, 0.0, speed))
    assert end.x == pytest.approx(speed**2 / (2 * (0.17 * GRAVITY - pull)), rel=1e-4)
    assert tilted.stays(Motion(0.0, 0.0, 0.0))
    steep = slide_of(DISK, replace(PLAIN, friction=0.015, slope=(0.02, 0.0)))
    assert not steep.stays(Motion(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="still slides"):
        steep.rest(Motion(0.0, 0.0, 0.0, 0.01))


@pytest.mark.parametrize(("heading", "power"), [(0.4, -0.5), (0.4 + math.pi / 2, 0.5)])
def test_friction_is_lower_along_the_grain_than_across(heading: float, power: float) -> None:
    """The friction is mu / sqrt(ratio) along the grain and mu sqrt(ratio) across it."""
    ratio, speed = 1.6, 0.3
    slide = slide_of(DISK, replace(PLAIN, anisotropy=ratio, grain=0.4))
    end, _ = slide.rest(Motion(0.0, 0.0, 0.0, speed * math.cos(heading), speed * math.sin(heading)))
    expected = speed**2 / (2 * 0.17 * ratio**power * GRAVITY)
    assert math.hypot(end.x, end.y) == pytest.approx(expected, rel=1e-3)
    assert math.atan2(end.y, end.x) == pytest.approx(heading, abs=1e-3)


def test_friction_that_depends_on_speed() -> None:
    """Without rotation, the distance is an integral: x = int v dv / (mu(v) g)."""
    law = replace(PLAIN, slow_rise=0.8, slow_speed=0.04, viscous=1.5)
    end, _ = slide_of(DISK, law).rest(Motion(0.0, 0.0, 0.0, 0.25))

    def share(speed: float) -> float:
        factor = 1 + 0.8 * math.exp(-speed / 0.04) + 1.5 * speed
        return speed / (0.17 * factor * GRAVITY)

    assert end.x == pytest.approx(quad(share, 0, 0.25)[0], rel=1e-3)


def test_a_table_patch_has_its_own_friction() -> None:
    """The object slides onto a patch that covers a half-plane and loses energy there at another
    rate."""
    law = replace(PLAIN, patches=((1.05, 0.0, 1.0, 2.5),))
    small = Disk(radius=0.002, mass=0.1, height=0.01)
    end, _ = slide_of(small, law).rest(Motion(0.0, 0.0, 0.0, 0.6))
    work = 0.6**2 / 2 / (0.17 * GRAVITY) - 0.05
    assert end.x == pytest.approx(0.05 + work / 2.5, rel=2e-3)
    whole = slide_of(DISK, replace(PLAIN, patches=((0.0, 0.0, 1.0, 0.5),)))
    end, _ = whole.rest(Motion(0.0, 0.0, 0.0, 0.3))
    assert end.x == pytest.approx(0.3**2 / (0.17 * GRAVITY), rel=1e-3)


def test_a_disk_supported_at_its_rim_slides_like_a_ring_of_the_same_inertia() -> None:
    law = replace(PLAIN, torque_factor=1.3)
    slide = slide_of(DISK, law, SupportTruth(pressure="rim"))
    end, _ = slide.rest(Motion(0.0, 0.0, 0.0, 0.2, 0.0, 4.0))
    # The ring's moment of inertia is m R^2, which is twice the disk's. Therefore, the ring's torque
    # factor is doubled, too.
    ring = Sliding(Ring(0.048, 0.2455, 0.012), friction=0.17, torque_factor=2.6, gravity=GRAVITY)
    distance, rotation, _ = ring.rest(0.2, 4.0)
    assert end.x == pytest.approx(float(distance), rel=5e-3)
    assert end.theta == pytest.approx(float(rotation), rel=5e-3)


def test_three_support_points_carry_loads_given_by_the_centre_of_mass() -> None:
    support = SupportTruth(pressure="three_points", feet_radius=1.0, mass_offset=(0.012, 0.0))
    points, grip = sample_support(DISK, support)
    assert grip @ points == pytest.approx([0.012, 0.0], abs=1e-12)
    # Expected value: equilibrium of the moments about the line through the two feet at x = -R / 2.
    assert grip[0] == pytest.approx((0.012 + 0.024) / 0.072)


@pytest.mark.parametrize("pressure", ["even", "rim", "three_points", "pads"])
@pytest.mark.parametrize("body", [DISK, Ring(0.03, 0.1, 0.01), SQUARE])
def test_the_pressure_is_centred_under_the_centre_of_mass(body, pressure):
    points, grip = sample_support(
        body, SupportTruth(pressure=pressure, mass_offset=(0.004, -0.003), edge_weight=0.5)
    )
    assert grip.sum() == pytest.approx(1.0)
    assert np.all(grip >= 0)
    assert grip @ points == pytest.approx([0.004, -0.003], abs=1e-9)


def test_a_centre_of_mass_outside_the_support_is_refused() -> None:
    support = SupportTruth(pressure="three_points", feet_radius=0.3, mass_offset=(0.03, 0.0))
    with pytest.raises(ValueError, match="tip over"):
        sample_support(DISK, support)


@pytest.mark.parametrize("body", [DISK, Ring(radius=0.03, mass=0.1, height=0.01)])
def test_the_sampled_support_has_the_correct_width(body: Disk | Ring) -> None:
    points, grip = sample_support(body, EVEN)
    second = float(grip @ np.sum(points**2, axis=1))
    assert second == pytest.approx(body.inertia / body.mass, rel=0.01)
