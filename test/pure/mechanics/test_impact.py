"""The impact compared with a step-by-step integration of the impulses, and with conservation
laws."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tapping_cell.mechanics import Disk, Impact, InvalidParameterError, Ring, Striker

DISK = Disk(0.048, 0.2455, 0.012)
STICK = Disk(0.01, 0.3, 0.01)
constraints = st.sampled_from(["linear_bearings", "free"])
masses = st.floats(0.01, 2.0)
restitutions = st.floats(0.0, 1.0)
frictions = st.floats(0.02, 2.0)
incidences = st.floats(-1.5, 1.5)
# Contacts whose normal passes far from the centre make B3 large, so that the sliding direction can
# reverse.
contacts = st.tuples(st.floats(-0.1, -0.001), st.floats(-0.1, 0.1))


def step_by_step(impact, incidence, contact, steps=40_000):
    """Integrate Routh's method in small steps of the impulse, without case distinctions: the
    sliding velocity determines each step."""
    b1, b2, b3 = (float(b) for b in impact.inverse_inertias(incidence, contact))
    a_n, a_t = math.cos(incidence), math.sin(incidence)
    mu = impact.friction
    step = a_n / b2 * 4 / steps
    p_n = p_t = 0.0
    end = math.inf
    while p_n < end:
        if math.isinf(end) and -a_n + b2 * p_n - b3 * p_t >= 0:
            end = (1 + impact.restitution) * p_n
        # The tangential impulse that would end the sliding in this step; friction limits it.
        wanted = (a_t + b3 * (p_n + step)) / b1 - p_t
        p_n += step
        p_t += min(max(wanted, -mu * step), mu * step)
    return p_n, p_t


def energy(impact, result, speed=1.0):
    body, striker = impact.body, impact.striker
    after = (
        body.mass * (result.velocity**2).sum(axis=-1)
        + body.inertia * result.spin**2
        + striker.mass * (result.striker_velocity**2).sum(axis=-1)
    )
    return after / 2, striker.mass * speed**2 / 2


@given(constraints, masses, restitutions, frictions, incidences, contacts)
def test_energy_is_never_gained_and_the_impulse_lies_in_the_cone(
    constraint, mass, restitution, friction, incidence, contact
):
    impact = Impact(STICK, Striker(mass, 0.005, constraint), restitution, friction)
    result = impact.strike(1.0, incidence, contact)
    after, before = energy(impact, result)
    assert after <= before * (1 + 1e-12)
    assert result.normal_impulse > 0
    assert abs(result.tangential_impulse) <= friction * result.normal_impulse * (1 + 1e-12)


@pytest.mark.parametrize("constraint", ["linear_bearings", "free"])
def test_the_impact_cases_agree_with_numerical_integration(constraint):
    generator = np.random.default_rng(0)
    seen = set()
    for _ in range(25):
        impact = Impact(
            STICK,
            Striker(generator.uniform(0.05, 1), 0.005, constraint),
            generator.uniform(0, 1),
            generator.uniform(0.05, 0.8),
        )
        incidence = generator.uniform(-1.3, 1.3)
        contact = (generator.uniform(-0.05, -0.005), generator.uniform(-0.05, 0.05))
        result = impact.strike(1.0, incidence, contact)
        expected = step_by_step(impact, incidence, contact)
        assert result.normal_impulse == pytest.approx(expected[0], rel=1e-3)
        assert result.tangential_impulse == pytest.approx(expected[1], abs=1e-3 * expected[0])
        seen.add((float(result.sliding), np.sign(math.sin(incidence))))
    endings = {"stuck" if s == 0 else "slid" if s == -i else "reversed" for s, i in seen}
    assert endings == {"stuck", "slid", "reversed"}


@given(constraints, masses, restitutions, frictions, incidences, contacts)
def test_a_mirrored_impact_has_a_mirrored_result(
    constraint, mass, restitution, friction, incidence, contact
):
    impact = Impact(STICK, Striker(mass, 0.005, constraint), restitution, friction)
    here = impact.strike(1.0, incidence, contact)
    there = impact.strike(1.0, -incidence, (contact[0], -contact[1]))
    assert there.normal_impulse == pytest.approx(here.normal_impulse, rel=1e-12)
    assert there.tangential_impulse == pytest.approx(-here.tangential_impulse, rel=1e-12)
    assert there.spin == pytest.approx(-here.spin, rel=1e-9, abs=1e-12)


@given(constraints, masses, frictions, incidences, contacts)
def test_poisson_scales_the_normal_impulse(constraint, mass, friction, incidence, contact):
    striker = Striker(mass, 0.005, constraint)
    soft, hard = (
        Impact(STICK, striker, e, friction).strike(1.0, incidence, contact) for e in (0.0, 0.6)
    )
    assert hard.normal_impulse == pytest.approx(1.6 * soft.normal_impulse, rel=1e-12)


@given(masses, restitutions)
def test_a_central_impact_matches_the_textbook_formula(mass, restitution):
    impact = Impact(DISK, Striker(mass, 0.005), restitution, 0.2)
    result = impact.strike(2.0, 0.0, (-DISK.radius, 0.0))
    common = mass * 2.0 / (mass + DISK.mass)
    assert result.velocity == pytest.approx(np.array([(1 + restitution) * common, 0]), abs=1e-12)
    assert result.striker_velocity[0] == pytest.approx(
        common - restitution * 2.0 * DISK.mass / (mass + DISK.mass), abs=1e-12
    )
    assert result.spin == 0


@given(constraints, masses, restitutions, frictions, st.floats(-1, 1))
def test_incidence_for_finds_the_impulse(constraint, mass, restitution, friction, share):
    impact = Impact(DISK, Striker(mass, 0.005, constraint), restitution, friction)
    contact = (-DISK.radius, 0.0)
    largest = math.tan(float(impact.largest_impulse_angle(contact)))
    incidence = impact.incidence_for(share * largest, contact)
    assert impact.has_incidence(share * largest, contact) == (not np.isnan(incidence))
    assume(not np.isnan(incidence))
    result = impact.strike(1.0, incidence, contact)
    assert result.tangential_impulse / result.normal_impulse == pytest.approx(
        share * largest, rel=1e-9, abs=1e-12
    )


def test_no_incidence_exceeds_the_friction_limit():
    impact = Impact(DISK, Striker(0.05, 0.005), 0.8, 0.2)
    assert np.isnan(impact.incidence_for([0.21, -0.3], (-DISK.radius, 0.0))).all()
    assert math.tan(float(impact.largest_impulse_angle((-0.048, 0)))) == pytest.approx(0.2)


def test_a_disk_has_the_textbook_constants():
    a_t, a_n = math.sin(0.4), math.cos(0.4)
    contact = (-DISK.radius, 0.0)
    m, ms = DISK.mass, 0.05
    held = Impact(DISK, Striker(ms, 0.005), 0.8, 0.2).inverse_inertias(0.4, contact)
    assert held == pytest.approx((3 / m + a_t**2 / ms, 1 / m + a_n**2 / ms, -a_n * a_t / ms))
    free = Impact(DISK, Striker(ms, 0.005, "free"), 0.8, 0.2).inverse_inertias(0.4, contact)
    assert free == pytest.approx((3 / m + 1 / ms, 1 / m + 1 / ms, 0))
    ring = Ring(0.05, 0.1, 0.01)
    light = Impact(ring, Striker(ms, 0.005, "free"), 0.8, 0.2).inverse_inertias(0, (-0.05, 0))
    assert light[0] == pytest.approx(2 / 0.1 + 1 / ms)


def test_scale_and_constants_calibrate():
    striker, contact = Striker(0.05, 0.005), (-DISK.radius, 0.0)
    plain = Impact(DISK, striker, 0.8, 0.2).inverse_inertias(0.4, contact)
    scaled = Impact(DISK, striker, 0.8, 0.2, scale=(1.5, 0.9, 0.5))
    assert scaled.inverse_inertias(0.4, contact) == pytest.approx(np.array(plain) * [1.5, 0.9, 0.5])
    fitted = Impact(DISK, striker, 0.8, 0.2, constants=(60.0, None, -5.0))
    assert fitted.inverse_inertias(0.4, contact) == pytest.approx((60.0, plain[1], -5.0))


def test_arrays_broadcast():
    impact = Impact(DISK, Striker(0.05, 0.005), 0.8, 0.2)
    result = impact.strike(np.ones((3, 1)), np.linspace(-1, 1, 5), (-0.048, 0.0))
    assert result.spin.shape == (3, 5) and result.velocity.shape == (3, 5, 2)
    assert impact.strike(2.0, 0.3, (-0.048, 0)).spin == pytest.approx(
        2 * impact.strike(1.0, 0.3, (-0.048, 0)).spin
    )


@pytest.mark.parametrize(
    "change, word",
    [
        ({"restitution": 1.1}, "restitution is 1.1"),
        ({"restitution": math.nan}, "restitution"),
        ({"friction": 0.0}, "contact friction is 0.0"),
        ({"scale": (1.0, -1.0, 1.0)}, "scale"),
        ({"scale": (1.0, 1.0)}, "scale"),
        ({"constants": (-1.0, None, None)}, "B1"),
        ({"constants": (1.0, None)}, "constants"),
    ],
)
def test_parameters_out_of_range_are_refused(change, word):
    with pytest.raises(InvalidParameterError, match=word):
        Impact(
            **{
                "body": DISK,
                "striker": Striker(0.05, 0.005),
                "restitution": 0.8,
                "friction": 0.2,
                **change,
            }
        )


def test_strikers_and_strikes_out_of_range_are_refused():
    for arguments in ((0.0, 0.005), (-1.0, 0.005), (0.05, -0.001), (0.05, 0.005, "magnetic")):
        with pytest.raises(InvalidParameterError):
            Striker(*arguments)
    impact = Impact(DISK, Striker(0.05, 0.005), 0.8, 0.2)
    for arguments in ((-1.0, 0.0), (1.0, 2.0), (math.nan, 0.0), (1.0, math.inf)):
        with pytest.raises(InvalidParameterError):
            impact.strike(*arguments, (-0.048, 0.0))
    wild = Impact(DISK, Striker(0.05, 0.005), 0.8, 0.2, scale=(1.0, 1.0, 90.0))
    with pytest.raises(InvalidParameterError, match="Fit"):
        wild.strike(1.0, 0.5, (-0.048, 0.0))
