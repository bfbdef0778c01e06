"""The slides used by the fit agree with the mechanics, and the fit recovers known parameters."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom
from single_tap_records import DISK, TRUE, track

from tapping_cell.calibration.bootstrap import spread
from tapping_cell.calibration.slide_curves import SlideCurves
from tapping_cell.calibration.sliding_fit import Motion, fit_slides
from tapping_cell.calibration.track import Slide, slide_of
from tapping_cell.calibration.trials import Trial
from tapping_cell.mechanics import Disk, Polygon, Ring, Sliding
from tapping_cell.simulation.sliding import Motion as SimulatedMotion
from tapping_cell.simulation.sliding import Slide as SimulatedSlide
from tapping_cell.simulation.sliding import TableFriction
from tapping_cell.simulation.support import sample_support
from tapping_cell.simulation.truth import SupportTruth

BODIES = [Disk(0.048, 0.2455, 0.012), Ring(0.05, 0.2, 0.01)]
FACTORS = (0.4, 1.0, 1.9, 3.64, 7.0)
SQUARE = Polygon([(-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04)], 0.2, 0.01)


@pytest.mark.parametrize("body", BODIES, ids=["disk", "ring"])
@given(
    speed=st.floats(0.03, 1.0),
    ratio=st.floats(-8.0, 8.0),
    factor=st.sampled_from(FACTORS),
    share=st.floats(0.0, 1.2),
)
def test_states_match_the_mechanics_model(body, speed, ratio, factor, share):
    sliding = Sliding(body, 0.17, factor)
    spin = ratio * speed / body.support_radius
    rest = sliding.rest(speed, spin)
    time = share * float(rest.duration)
    exact = sliding.profile(speed, spin, [time])
    curves = SlideCurves(body, 9.81)
    launch = (np.array([speed]), np.array([spin]))
    state, _ = curves.at(
        launch, np.array([time]), np.zeros(1, dtype=int), np.array([0.17]), math.log(factor)
    )
    # SlideCurves interpolates between two tabulated torque factors, so it is not exact.
    size = float(rest.distance) + body.support_radius * abs(float(rest.rotation))
    assert state.distance[0] == pytest.approx(float(exact.distance[0]), abs=1e-3 * size)
    turned = body.support_radius * (state.rotation[0] - float(exact.rotation[0]))
    assert abs(turned) < 1e-3 * size
    # The slides with the two tabulated torque factors stop at slightly different times. Between
    # these times, the interpolated speed is inaccurate.
    if abs(share - 1.0) > 0.02:
        assert state.speed[0] == pytest.approx(float(exact.speed[0]), abs=2e-3 * speed)


def motion(speed, spin, sliding, noise=(0.0, 0.0), random=None, **values):
    """Return the measured motion of one slide, with relative noise of its initial velocities."""
    distance, rotation, _ = sliding.rest(speed, spin)
    off = random.standard_normal(2) if random is not None else (0.0, 0.0)
    return Motion(
        displacement=float(distance),
        rotation=float(rotation),
        displacement_std=2e-5,
        rotation_std=5e-4,
        speed=speed * (1 + noise[0] * off[0]),
        spin=spin * (1 + noise[1] * off[1]),
        speed_std=max(noise[0], 0.01) * speed,
        spin_std=max(noise[1], 0.03) * abs(spin),
        **values,
    )


@pytest.mark.parametrize("body", [*BODIES, SQUARE], ids=["disk", "ring", "square"])
@pytest.mark.parametrize("factor", [1.0, 2.17, 4.0])
def test_exact_velocities_give_the_exact_parameters(body, factor):
    sliding = Sliding(body, 0.23, factor).approximated()
    launches = [(v, w) for v in (0.2, 0.3, 0.4) for w in (-2.0, 1.0, 3.0)]
    fit = fit_slides([motion(v, w, sliding) for v, w in launches], body, 9.81)
    assert fit.friction == pytest.approx(0.23, rel=1e-3)
    assert fit.torque_factor == pytest.approx(factor, rel=2e-3)


@pytest.mark.parametrize("rate", [30.0, 60.0, 500.0])
def test_exact_tracks_give_the_exact_parameters_at_any_rate(rate):
    motions = []
    for index, (speed, spin) in enumerate([(0.25, 2.0), (0.35, -3.0), (0.3, 1.0), (0.4, 4.0)]):
        seen = track(speed, spin, rate, impact=0.41 + 0.007 * index)
        slide = slide_of(Trial(1, index, track=seen), 2e-5, 5e-4, rate)
        assert isinstance(slide, Slide)
        motions.append(Motion(slide.displacement, slide.turned, math.inf, math.inf, slide=slide))
    fit = fit_slides(motions, DISK.body(), 9.81)
    assert fit.friction == pytest.approx(TRUE["friction"], rel=2e-3)
    assert fit.torque_factor == pytest.approx(TRUE["torque_factor"], rel=4e-3)
    assert fit.launch_speed == pytest.approx([0.25, 0.35, 0.3, 0.4], rel=2e-3)
    assert fit.impact_time == pytest.approx([0.41, 0.417, 0.424, 0.431], abs=3e-4)


def test_noise_of_the_velocities_does_not_bias_the_torque_factor():
    random = np.random.default_rng(4)
    sliding = Sliding(DISK.body(), 0.2, 2.0)
    launches = random.uniform((0.2, 1.0), (0.4, 4.0), (400, 2))
    motions = [motion(v, w, sliding, (0.04, 0.15), random) for v, w in launches.tolist()]
    fit = fit_slides(motions, DISK.body(), 9.81)
    # Standard errors with 400 taps: 0.4 % (friction) and 1.2 % (torque factor).
    assert fit.friction == pytest.approx(0.2, rel=0.016)
    assert fit.torque_factor == pytest.approx(2.0, rel=0.05)


def test_intervals_have_their_stated_coverage():
    """The estimate is the mean of 40 samples from a skewed distribution, in 4 runs of 10. The score
    of a sample x is the mean minus x."""
    random = np.random.default_rng(0)
    runs = np.repeat([1, 2, 3, 4], 10)
    trials, covered = 300, 0
    for seed in range(trials):
        seen = random.gamma(4.0, 1.0, 40)
        estimate = seen.mean()
        width = spread((estimate - seen)[:, None], np.ones((40, 1, 1)), runs, seed, 400)
        covered += estimate + width.low[0] <= 4.0 <= estimate + width.high[0]
    # If the true coverage is 91 % to 98.5 %, the count is outside a bound with a probability of at
    # most 1e-4 per bound.
    assert binom.ppf(1e-4, trials, 0.91) < covered < binom.ppf(1 - 1e-4, trials, 0.985)


def test_trials_that_determine_nothing_have_no_interval():
    information = np.zeros((8, 2, 2))
    information[:, 0, 0] = 1.0
    with pytest.raises(ValueError, match="determine"):
        spread(np.zeros((8, 2)), information, [1] * 8)


def test_an_off_centre_pressure_is_estimated_without_widening_the_torque_factor_interval():
    """The pressure in the simulated world is off-centre by 1 % of the radius towards +x and 0.75 %
    towards -y."""
    body, random = DISK.body(), np.random.default_rng(6)
    points, grip = sample_support(body, SupportTruth(lean=(0.04, -0.03)))
    law = TableFriction(friction=0.2, torque_factor=2.5, gravity=9.81)
    slide = SimulatedSlide(points, grip, law, body.inertia / body.mass)
    motions = []
    for heading in np.arange(16) * math.tau / 16:
        speed, spin = random.uniform(0.2, 0.3), random.uniform(1.0, 2.0)
        twist = (speed * math.cos(heading), speed * math.sin(heading), spin)
        end, _ = slide.rest(SimulatedMotion(0.0, 0.0, 0.0, *twist))
        motions.append(
            Motion(
                displacement=math.hypot(end[0], end[1]),
                rotation=end[2],
                displacement_std=1e-5,
                rotation_std=5e-4,
                heading=heading - end[2] / 2,
                speed=speed,
                spin=spin,
                speed_std=0.005 * speed,
                spin_std=0.01 * spin,
            )
        )
    fit = fit_slides(motions, body, 9.81)
    assert fit.torque_factor == pytest.approx(2.5, rel=0.02)
    # The weights 1 + l . r / R move the centre of pressure by R l / 4.
    wanted = [body.radius * 0.04 / 4, -body.radius * 0.03 / 4]
    assert fit.pressure_centre == pytest.approx(wanted, abs=0.15 * body.radius * 0.05 / 4)
    blind = fit_slides([replace(m, heading=math.nan) for m in motions], body, 9.81)
    width, wide = (spread(f.score, f.information, [1] * 16).std[1] for f in (fit, blind))
    assert width < 0.4 * wide
