"""Sliding of disks and rings compared with an independent integration, and general properties of
the motion."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from sliding_reference import disk_force_and_torque, integrate, ring_force_and_torque

from tapping_cell.mechanics import Disk, InvalidParameterError, Ring, Sliding
from tapping_cell.mechanics.slide_table import slide_table

DISK = Disk(radius=0.048, mass=0.2455, height=0.012)
RING = Ring(radius=0.03, mass=0.1, height=0.01)
PAPER = Sliding(DISK, friction=0.17, torque_factor=3.64)
KAPPAS = (0.2, 0.75, 1.0, 2.0, 3.64)
SPIN_RATIOS = (1e-9, 1e-4, 0.03, 0.4, 0.99, 1.01, 3.0, 60.0, 1e6)
bodies = st.sampled_from([DISK, RING])
kappas = st.sampled_from(KAPPAS)
sizes = st.floats(1e-3, 10.0)
either = st.one_of(sizes, sizes.map(lambda x: -x))


@pytest.mark.parametrize("body", [DISK, RING], ids=["disk", "ring"])
@pytest.mark.parametrize("kappa", KAPPAS)
def test_rest_agrees_with_a_tight_integration(body, kappa):
    slide = Sliding(body, friction=0.3, torque_factor=kappa, gravity=9.81)
    g, r = 0.3 * 9.81, body.radius
    expected = np.array(
        [integrate(body.support, kappa * body.gamma, 1.0, ratio) for ratio in SPIN_RATIOS]
    ) / [g, g * r, g]
    spins = np.array(SPIN_RATIOS) / r
    scalar = np.array([slide.rest(1.0, w) for w in spins])
    many = np.stack(slide.rest(np.ones(len(spins)), spins), axis=1)
    assert np.abs(scalar / expected - 1).max() < 1e-8
    assert np.abs(many / expected - 1).max() < 1e-8


@given(bodies, kappas, st.lists(st.tuples(either, either), min_size=1, max_size=20))
def test_rest_inverts_launch_for_arrays(body, kappa, wanted):
    slide = Sliding(body, 0.17, kappa)
    distance, rotation = np.array(wanted).T
    again = slide.rest(*slide.launch(distance, rotation))
    assert np.abs(again.distance / distance - 1).max() < 1e-9
    assert np.abs(again.rotation / rotation - 1).max() < 1e-9


@pytest.mark.parametrize("body", [DISK, RING], ids=["disk", "ring"])
@pytest.mark.parametrize("kappa", KAPPAS)
def test_round_trip_from_pure_sliding_to_pure_spinning(body, kappa):
    slide = Sliding(body, 0.17, kappa)
    ratio = np.concatenate([np.geomspace(1e-12, 1e12, 5001), [0.0]])
    sign = np.where(np.arange(ratio.size) % 3 == 0, -1.0, 1.0)
    for distance, rotation in ((sign, ratio), (ratio, sign)):
        again = slide.rest(*slide.launch(distance, rotation))
        assert np.allclose(again.distance, distance, rtol=1e-9, atol=0)
        assert np.allclose(again.rotation, rotation, rtol=1e-9, atol=0)


@given(bodies, kappas, either, either)
def test_scalar_and_array_results_agree(body, kappa, speed, spin):
    slide = Sliding(body, 0.17, kappa)
    assert np.array(slide.rest(np.array([speed]), np.array([spin])))[:, 0] == pytest.approx(
        np.array(slide.rest(speed, spin)), rel=1e-12
    )
    assert np.array(slide.launch(np.array([speed]), np.array([spin])))[:, 0] == pytest.approx(
        np.array(slide.launch(speed, spin)), rel=1e-12
    )


@given(bodies, kappas, either, either, st.floats(0.01, 100))
def test_the_distance_scales_with_the_square_of_the_velocity(body, kappa, speed, spin, c):
    slide = Sliding(body, 0.17, kappa)
    near, far = slide.rest(speed, spin), slide.rest(c * speed, c * spin)
    expected = (c**2 * near.distance, c**2 * near.rotation, c * near.duration)
    assert far == pytest.approx(expected, rel=1e-9)


@given(bodies, kappas, sizes, sizes, st.floats(0.01, 2), st.floats(0.01, 2), st.floats(0.1, 20))
def test_mass_size_and_friction_scale_out(body, kappa, speed, rim, mass, radius, friction):
    other = type(body)(radius, mass, 0.01)
    here = Sliding(body, 0.17, kappa).rest(speed, rim / body.radius)
    there = Sliding(other, friction, kappa).rest(speed, rim / radius)
    ratio = 0.17 / friction
    assert there.distance == pytest.approx(here.distance * ratio, rel=1e-9)
    assert there.rotation * radius == pytest.approx(here.rotation * body.radius * ratio, rel=1e-9)
    assert there.duration == pytest.approx(here.duration * ratio, rel=1e-9)


@given(bodies, kappas, sizes, sizes)
def test_mirror_images(body, kappa, speed, spin):
    slide = Sliding(body, 0.17, kappa)
    x, theta, t = slide.rest(speed, spin)
    assert slide.rest(-speed, spin) == pytest.approx((-x, theta, t), rel=1e-15)
    assert slide.rest(speed, -spin) == pytest.approx((x, -theta, t), rel=1e-15)


@pytest.mark.parametrize("body", [DISK, RING], ids=["disk", "ring"])
@pytest.mark.parametrize("kappa", KAPPAS)
def test_more_speed_or_spin_increases_distance_and_rotation(body, kappa):
    slide = Sliding(body, 0.17, kappa)
    rising = np.geomspace(1e-3, 1e3, 4000)
    for arguments in (
        (rising, np.full_like(rising, 1 / body.radius)),
        (np.ones_like(rising), rising),
    ):
        distance, rotation, duration = slide.rest(*arguments)
        assert (np.diff(duration) > 0).all()
        # Rotation reduces the friction against translation, and translation reduces the friction
        # against rotation.
        assert (np.diff(distance) > 0).all() and (np.diff(rotation) > 0).all()


@given(bodies, kappas, either)
def test_a_slide_without_spin_is_straight(body, kappa, speed):
    distance, rotation, duration = Sliding(body, 0.17, kappa).rest(speed, 0.0)
    g = 0.17 * 9.81
    assert distance == pytest.approx(math.copysign(speed**2 / (2 * g), speed), rel=1e-12)
    assert rotation == 0.0
    assert duration == pytest.approx(abs(speed) / g, rel=1e-12)


@given(kappas, either)
def test_a_launch_without_speed_is_a_spin_in_place(kappa, spin):
    slide = Sliding(DISK, 0.17, kappa)
    distance, rotation, _ = slide.rest(0.0, spin)
    slowing = kappa * 2 * 0.17 * 9.81 / DISK.radius * 2 / 3
    assert distance == 0.0
    assert rotation == pytest.approx(math.copysign(spin**2 / (2 * slowing), spin), rel=1e-12)


def test_zero_launch_gives_zero_displacement():
    assert PAPER.rest(0.0, 0.0) == (0.0, 0.0, 0.0)
    assert PAPER.launch(0.0, 0.0) == (0.0, 0.0)
    assert not np.any(PAPER.rest(np.zeros(3), 0.0))
    assert not np.any(PAPER.launch(np.zeros(3), np.zeros(3)))


@pytest.mark.parametrize(
    "kappa, ratio",
    [
        (0.5, 0.0),
        (0.74, 0.0),
        (1.0, 0.6530),
        (1.2, 0.821),
        (1.5, 1.000),
        (1.8, 1.484),
        (2.0, math.inf),
        (3.64, math.inf),
    ],
)
def test_a_disk_ends_at_its_terminal_ratio(kappa, ratio):
    assert slide_table("disk", 2 * kappa).terminal_ratio == pytest.approx(ratio, abs=5e-4)


def test_a_thin_ring_ends_at_the_ratio_one():
    assert slide_table("ring", 1.0).terminal_ratio == pytest.approx(1.0, abs=1e-6)
    slide = Sliding(RING, 0.17)
    far = slide.rest(0.3, 0.3 / RING.radius).distance
    assert far == pytest.approx(math.pi / 2 * 0.3**2 / (2 * 0.17 * 9.81), rel=1e-9)


def test_the_taps_of_the_paper_are_reproduced():
    speed, spin = PAPER.launch(0.010, math.radians(3))
    assert speed == pytest.approx(0.1818, abs=5e-5)
    assert spin == pytest.approx(1.355, abs=5e-4)
    assert PAPER.launch(0.0017, 0.0).speed == pytest.approx(0.0753, abs=5e-5)


def test_the_approximation_for_small_spin_holds():
    g = 0.17 * 9.81
    for speed, spin in ((0.2, 0.01), (0.2, 2.0), (0.2, 0.2 / 0.048)):
        x, theta, _ = PAPER.rest(speed, spin)
        assert x == pytest.approx(speed**2 / (2 * g), rel=0.08)
        assert theta == pytest.approx(speed * spin / (g * (1 + 2 * 3.64 / 4)), rel=0.013)


def test_results_broadcast_and_unpack():
    distance, rotation, duration = PAPER.rest(np.ones((3, 1)), np.arange(4.0))
    assert distance.shape == rotation.shape == duration.shape == (3, 4)
    assert isinstance(PAPER.rest(1, 2).distance, float)
    assert PAPER.rest(1, 2).lateral == 0
    assert np.shape(PAPER.launch([0.01, 0.02], 0.0).speed) == (2,)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_non_finite_values_are_refused(wrong):
    for call in (PAPER.rest, PAPER.launch):
        for arguments in ((wrong, 1.0), (1.0, wrong), (np.array([1.0, wrong]), 1.0)):
            with pytest.raises(InvalidParameterError, match="finite"):
                call(*arguments)
    with pytest.raises(InvalidParameterError, match="finite"):
        PAPER.profile(0.1, 0.1, [0.0, wrong])


@pytest.mark.parametrize(
    "name, value",
    [("friction", 0.0), ("friction", -0.1), ("torque_factor", 0.0), ("gravity", math.nan)],
)
def test_parameters_out_of_range_are_refused(name, value):
    with pytest.raises(InvalidParameterError, match=name.replace("_", " ")):
        Sliding(DISK, **{"friction": 0.17, name: value})


@pytest.mark.parametrize("body", [DISK, RING], ids=["disk", "ring"])
@pytest.mark.parametrize("kappa", [0.5, 1.0, 3.64])
def test_the_remainder_of_a_slide_is_a_slide(body, kappa):
    slide = Sliding(body, 0.17, kappa)
    speed, spin = np.array([0.3, -0.2, 0.01]), np.array([1.0, -9.0, 12.0])
    end = slide.rest(speed, spin)
    times = np.linspace(0, 0.98 * end.duration.min(), 400)
    profile = slide.profile(speed, spin, times)
    left = slide.rest(profile.speed, profile.spin)
    assert profile.speed.shape == (3, 400)
    assert np.allclose(profile.distance + left.distance, end.distance[:, None], rtol=1e-12)
    assert np.allclose(times + left.duration, end.duration[:, None], rtol=1e-12)
    assert np.allclose(profile.rotation + left.rotation, end.rotation[:, None], rtol=1e-12)


def test_a_profile_begins_and_ends():
    end = PAPER.rest(0.18, 1.4)
    profile = PAPER.profile(0.18, 1.4, [0.0, end.duration, 9.0])
    assert profile.speed == pytest.approx([0.18, 0, 0], abs=1e-12)
    assert profile.spin == pytest.approx([1.4, 0, 0], abs=1e-12)
    assert profile.distance == pytest.approx([0, end.distance, end.distance], rel=1e-12)
    assert profile.rotation == pytest.approx([0, end.rotation, end.rotation], rel=1e-12)
    with pytest.raises(InvalidParameterError, match="0 or more"):
        PAPER.profile(0.18, 1.4, [-0.1])


@pytest.mark.parametrize(
    "body, kappa, v0, w0",
    [
        (DISK, 3.64, 0.18, 3.0),
        (DISK, 1.0, 0.2, 20.0),
        (RING, 0.5, 0.2, 0.01),
        (RING, 3.0, 0.01, 20.0),
    ],
)
def test_profiles_agree_with_solve_ivp(body, kappa, v0, w0):
    slide = Sliding(body, 0.17, kappa)
    friction = disk_force_and_torque if body is DISK else ring_force_and_torque
    g, r = 0.17 * 9.81, body.radius

    def motion(_, y):
        force, torque = friction(y[0] / (r * y[1]))
        return [-g * force, -kappa * body.gamma * g / r * torque, y[0], y[1]]

    times = np.linspace(0, 0.99 * slide.rest(v0, w0).duration, 60)
    exact = solve_ivp(
        motion,
        (0, times[-1]),
        [v0, w0, 0, 0],
        t_eval=times,
        rtol=1e-10,
        atol=1e-14,
        method="DOP853",
    ).y
    for got, want in zip(slide.profile(v0, w0, times)[1:], exact, strict=True):
        assert np.abs(got - want).max() < 1e-7 * np.abs(want).max()


@settings(max_examples=settings.default.max_examples // 5)
@given(st.floats(0.05, 20.0), st.sampled_from(["disk", "ring"]))
def test_any_torque_factor_has_a_table(kappa, support):
    table = slide_table(support, kappa)
    for ratio in (1e-6, 0.5, 1.0, 2.0, 1e6):
        exact = integrate(support, kappa, 1.0, ratio)
        assert np.abs(np.array(table.rest(1.0, ratio)) / exact - 1).max() < 5e-8


def test_a_table_is_kept():
    assert slide_table("disk", 7.28) is slide_table("disk", 7.28)
