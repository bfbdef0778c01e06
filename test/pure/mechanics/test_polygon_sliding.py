"""Sliding of polygons compared with friction summed over a grid of points, and symmetries of the
motion."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tapping_cell.mechanics import Disk, InvalidParameterError, Polygon, Sliding, polygon_sliding

G = 9.81
SQUARE = Polygon([(0, 0), (0.08, 0), (0.08, 0.08), (0, 0.08)], 0.2, 0.01)
PLATE = Polygon([(0, 0), (0.12, 0), (0.12, 0.04), (0, 0.04)], 0.2, 0.01)
TRIANGLE = Polygon([(0, 0), (0.1, 0), (0, 0.07)], 0.2, 0.01)
BODIES = {"square": SQUARE, "plate": PLATE, "triangle": TRIANGLE}


def grid(body, cells):
    """Return the sample points and their weights. Each triangle between the centre and an edge is
    divided into cells^2 small triangles."""
    first, second = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    upright, inverted = first + second < cells, first + second < cells - 1
    share = (
        np.concatenate(
            [
                np.stack([first[upright], second[upright]], axis=1) + 1 / 3,
                np.stack([first[inverted], second[inverted]], axis=1) + 2 / 3,
            ]
        )
        / cells
    )
    a, b = body.points, np.roll(body.points, -1, axis=0)
    points = share[:, :1, None] * a.T + share[:, 1:, None] * b.T
    area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    weights = np.broadcast_to(area / (body.area * cells**2), (len(share), len(a)))
    return points.transpose(0, 2, 1).reshape(-1, 2), weights.ravel()


def brute_force(body, friction, kappa, speed, spin, direction, cells=40):
    """Return distance, rotation, duration and drift with Coulomb friction at each point of a
    grid."""
    points, weights = grid(body, cells)
    g, gyration2 = friction * G, body.radius_of_gyration**2

    def motion(_, state):
        vx, vy, omega, _, _, angle = state
        cos, sin = math.cos(angle), math.sin(angle)
        rx, ry = cos * points[:, 0] - sin * points[:, 1], sin * points[:, 0] + cos * points[:, 1]
        ux, uy = vx - omega * ry, vy + omega * rx
        size = np.hypot(ux, uy) + 1e-12
        ux, uy = ux / size, uy / size
        torque = weights @ (rx * uy - ry * ux)
        return [
            -g * weights @ ux,
            -g * weights @ uy,
            -kappa * g * torque / gyration2,
            vx,
            vy,
            omega,
        ]

    ax, ay = math.cos(direction), math.sin(direction)
    start = [speed * ax, speed * ay, spin, 0, 0, 0]
    energy = speed**2 + gyration2 * spin**2

    def stopped(_, state):
        return state[0] ** 2 + state[1] ** 2 + gyration2 * state[2] ** 2 - 1e-8 * energy

    stopped.terminal = True
    end = solve_ivp(motion, (0, 10), start, rtol=1e-7, atol=1e-11, events=stopped)
    x, y, angle = end.y[3:, -1]
    return np.array([ax * x + ay * y, angle, end.t[-1], ax * y - ay * x])


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize(
    "kappa, speed, spin, direction",
    [(1.0, 0.3, 3.0, 0.0), (3.64, 0.3, 3.0, 0.5), (1.0, 0.05, 20.0, 2.0), (2.17, 0.2, -12.0, -1.0)],
)
def test_rest_agrees_with_brute_force_integration(name, kappa, speed, spin, direction):
    body = BODIES[name]
    expected = brute_force(body, 0.17, kappa, speed, spin, direction)
    rest = Sliding(body, 0.17, kappa).rest(speed, spin, direction)
    assert np.array(rest) == pytest.approx(expected[:3], rel=1e-3)
    assert rest.lateral == pytest.approx(expected[3], abs=1e-3 * abs(expected[0]))


def test_the_lateral_drift_is_significant():
    rest = Sliding(TRIANGLE, 0.17).rest(0.05, 20.0, 2.0)
    assert abs(rest.lateral) > 0.1 * rest.distance


def test_a_square_slides_nearly_like_its_equivalent_disk():
    """Check the accuracy of the axisymmetric approximation for initial motions with R omega up to
    v."""
    generator = np.random.default_rng(0)
    speed = generator.uniform(0.05, 0.5, 200)
    spin = speed / SQUARE.support_radius * generator.uniform(0.05, 1.0, 200)
    for kappa in (1.0, 3.64):
        square = Sliding(SQUARE, 0.17, kappa).rest(speed, spin, generator.uniform(-3, 3, 200))
        disk = Sliding(SQUARE.equivalent_disk(), 0.17, kappa).rest(speed, spin)
        assert np.abs(disk.distance / square.distance - 1).max() < 0.01
        assert np.abs(disk.rotation / square.rotation - 1).max() < 0.04
        assert np.abs(square.lateral / square.distance).max() < 0.015


def test_a_polygon_with_many_sides_slides_like_a_disk():
    angles = np.linspace(0, 2 * math.pi, 120, endpoint=False)
    many = Polygon(0.05 * np.stack([np.cos(angles), np.sin(angles)], axis=1), 0.2, 0.01)
    disk = Sliding(Disk(0.05, 0.2, 0.01), 0.17, 2.0)
    for speed, spin in ((0.3, 1.0), (0.1, 10.0), (0.2, -4.0)):
        got = np.array(Sliding(many, 0.17, 2.0).rest(speed, spin))
        assert got == pytest.approx(np.array(disk.rest(speed, spin)), rel=1e-3)


speeds = st.floats(0.05, 0.5)
spins = st.floats(-10, 10).filter(lambda w: abs(w) > 1e-3)
directions = st.floats(-3, 3)
bodies = st.sampled_from(list(BODIES.values()))


@settings(max_examples=settings.default.max_examples // 5)
@given(bodies, st.floats(0.3, 4.0), speeds, spins, directions)
def test_launch_inverts_rest(body, kappa, speed, spin, direction):
    slide = Sliding(body, 0.17, kappa)
    rest = slide.rest(speed, spin, direction)
    launch = slide.launch(rest.distance, rest.rotation, direction)
    assert launch == pytest.approx((speed, spin), rel=1e-9)


@settings(max_examples=settings.default.max_examples // 12)
@given(bodies, speeds, spins, directions)
def test_twist_for_inverts_displace(body, speed, spin, direction):
    slide = Sliding(body, 0.17, 2.0)
    twist = np.array([[speed * math.cos(direction), speed * math.sin(direction), spin]])
    moved = slide.displace(twist)
    again = slide.displace(slide.twist_for(moved))
    assert np.abs(again - moved)[:, :2].max() < 1e-9 * np.hypot(moved[0, 0], moved[0, 1])
    assert again[0, 2] == pytest.approx(moved[0, 2], rel=1e-9)


@settings(max_examples=settings.default.max_examples // 5)
@given(speeds, spins, directions)
def test_a_square_slides_alike_after_a_quarter_turn_and_in_a_mirror(speed, spin, direction):
    slide = Sliding(SQUARE, 0.17, 2.0)
    here = slide.rest(speed, spin, direction)
    turned = slide.rest(speed, spin, direction + math.pi / 2)
    mirrored = slide.rest(speed, -spin, -direction)
    assert turned == pytest.approx(tuple(here), rel=1e-9)
    assert mirrored == pytest.approx((here[0], -here[1], here[2]), rel=1e-9)
    assert mirrored.lateral == pytest.approx(-here.lateral, abs=1e-9 * here.distance)


@given(bodies, speeds, directions)
@settings(max_examples=settings.default.max_examples // 5)
def test_a_slide_without_spin_is_straight(body, speed, direction):
    rest = Sliding(body, 0.17).rest(speed, 0.0, direction)
    assert rest.distance == pytest.approx(speed**2 / (2 * 0.17 * G), rel=1e-5)
    assert rest.rotation == 0.0
    assert abs(rest.lateral) < 1e-12


def test_friction_is_smooth_where_the_closed_form_is_replaced():
    """Force and torque are continuous where another formula replaces the closed form, and when the
    spin approaches zero."""
    model = Sliding(TRIANGLE, 0.17)._model
    # ratio of speed to spin at which the formula changes
    ratio = TRIANGLE.radius_of_gyration * 50.0
    near, far = (
        model.friction(np.array([0.6]), np.array([0.8]), np.array([s / ratio]))
        for s in (1 + 1e-9, 1 - 1e-9)
    )
    assert np.array(near) == pytest.approx(np.array(far), rel=1e-8)
    torque = [
        float(model.friction(np.array([1.0]), np.array([0.0]), np.array([w]))[2][0])
        for w in (1e-6, 1e-9)
    ]
    assert torque[0] / torque[1] == pytest.approx(1e3, rel=1e-6)


def test_profiles_end_at_the_result_of_rest():
    slide = Sliding(PLATE, 0.17, 2.0)
    rest = slide.rest(0.3, 3.0, 0.4)
    times = np.linspace(0, 1.2 * rest.duration, 200)
    profile = slide.profile(0.3, 3.0, times, direction=0.4)
    assert profile.distance[-1] == pytest.approx(rest.distance, rel=1e-9)
    assert profile.rotation[-1] == pytest.approx(rest.rotation, rel=1e-9)
    assert profile.speed[0] == pytest.approx(0.3) and profile.speed[-1] == 0
    moving = times < 0.9 * rest.duration
    fine = np.gradient(profile.distance, times)
    assert np.abs(fine - profile.speed)[moving].max() < 1e-2 * 0.3


def test_rows_that_stand_still_and_shapes():
    slide = Sliding(SQUARE, 0.17)
    rest = slide.rest([[0.0], [0.2]], [0.0, 1.0, 2.0])
    assert rest.distance.shape == rest.lateral.shape == (2, 3)
    assert tuple(slide.rest(0.0, 0.0)) == (0.0, 0.0, 0.0)
    assert isinstance(slide.rest(0.1, 0.1).distance, float)
    with pytest.raises(InvalidParameterError, match="finite"):
        slide.rest(math.nan, 1.0)


def test_the_inverse_is_found_where_its_fast_method_fails(monkeypatch):
    random = np.random.default_rng(3)
    wanted = random.uniform([-0.1, -0.1, -1.0], [0.1, 0.1, 1.0], (20, 3))
    slide = Sliding(SQUARE, 0.2, 3.64, G).tabulated()
    quick = slide.twist_for(wanted)
    monkeypatch.setattr(polygon_sliding, "_INVERSE_STEPS", 2)
    assert slide.twist_for(wanted) == pytest.approx(quick, rel=1e-7, abs=1e-9)
