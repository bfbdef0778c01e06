import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ive

from tapping_cell.planning import (
    Done,
    ObserveAgain,
    PlannerSettings,
    PositioningSession,
    make_planner,
    stopping_box,
)
from tapping_cell.planning.stopping import CONFIDENCE, inside_probability, stopping_share


def covariance(x, y, turn, correlation=0.0):
    return np.array(
        [[x * x, correlation * x * y, 0.0], [correlation * x * y, y * y, 0.0], [0, 0, turn**2]]
    )


@pytest.mark.parametrize(
    ("residual", "spread"),
    [
        ((0.7, 0.2, 0.1), covariance(0.2, 0.05, 0.1)),
        ((0.9, 0.0, 0.0), covariance(0.1, 0.1, 0.05, 0.8)),
        ((-0.3, -0.85, 0.6), covariance(0.05, 0.1, 0.2, -0.5)),
        ((1.0, 0.0, 0.0), covariance(0.015, 0.015, 0.01)),
    ],
)
def test_the_probability_of_being_inside_matches_sampled_poses(residual, spread):
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(residual, spread, 1_000_000)
    position = np.mean(np.hypot(drawn[:, 0], drawn[:, 1]) <= 1.0)
    beyond = np.mean(np.abs(drawn[:, 2]) > 1.0)
    found = float(inside_probability(residual, spread, 1.0, 1.0))
    assert found == pytest.approx(position - beyond, abs=2e-3)


@given(
    st.floats(-1.3, 1.3),
    st.floats(-1.3, 1.3),
    st.floats(-1.3, 1.3),
    st.sampled_from([1e-6, 0.015, 0.05, 0.1, 0.25]),
)
def test_nothing_is_reported_done_below_the_confidence_level(x, y, turn, noise):
    """Independent reference: random samples of the true pose around the observation."""
    found = float(inside_probability((x, y, turn), np.eye(3) * noise**2, 1.0, 1.0))
    if found < CONFIDENCE:
        return
    rng = np.random.default_rng(0)
    true = np.array([x, y, turn]) + noise * rng.standard_normal((40_000, 3))
    inside = np.mean((np.hypot(true[:, 0], true[:, 1]) <= 1.0) & (np.abs(true[:, 2]) <= 1.0))
    assert inside >= CONFIDENCE - 4 * math.sqrt(CONFIDENCE * (1 - CONFIDENCE) / 40_000)


def test_a_nearly_perfect_camera_makes_no_false_claim_at_the_edge_of_the_box(space, free):
    session = PositioningSession((0, 0, 0), make_planner("exact", PlannerSettings()), space, free)
    spread = covariance(15e-6, 15e-6, 1e-4)
    assert isinstance(session.decide((0.00095, 0, 0), spread), Done)
    for distance in (0.00097, 0.000998, 0.001, 0.0010014):
        assert not isinstance(session.decide((distance, 0, 0), spread), Done)


def test_an_uncertain_observation_is_repeated_before_another_tap(space, free):
    session = PositioningSession((0, 0, 0), make_planner("exact", PlannerSettings()), space, free)
    spread = covariance(1e-4, 1e-4, 1e-3)
    doubtful = session.decide((0.0009, 0, 0), spread)
    assert isinstance(doubtful, ObserveAgain) and 0.5 < doubtful.probability < CONFIDENCE
    at_last = session.decide((0.0009, 0, 0), spread, observe_again=False)
    assert not isinstance(at_last, ObserveAgain | Done)
    assert not isinstance(session.decide((0.01, 0, 0), spread), ObserveAgain)


@given(st.floats(0.001, 0.3), st.floats(0.001, 0.3))
def test_more_noise_means_a_smaller_box(one, other):
    low, high = sorted((one, other))
    assert stopping_share(high) <= stopping_share(low) + 1e-9


def test_a_perfect_camera_uses_the_whole_tolerance():
    assert stopping_box(0.001, 0.02, 0.0, 0.0) == (0.001, 0.02, True)


def test_the_camera_of_the_paper_is_too_coarse_for_the_box():
    box = stopping_box(0.001, math.radians(1.0), 0.0007, math.radians(0.8))
    assert not box.camera_suffices


def test_a_share_given_by_the_user_is_used():
    box = stopping_box(0.002, 0.01, 0.0001, 0.001, 0.5)
    assert (box.distance, box.rotation) == (0.001, 0.005)


@pytest.mark.parametrize("relative", [1e-4, 0.01, 0.1, 0.5, 2.0])
def test_an_isotropic_observation_matches_a_fine_quadrature(relative):
    """Independent reference: the Rice distribution of the distance, integrated numerically."""
    rng = np.random.default_rng(4)
    distance = np.abs(1.0 + relative * rng.normal(0.0, 2.0, 200))
    heading = rng.uniform(0.0, 7.0, 200)
    residual = np.stack(
        [distance * np.cos(heading), distance * np.sin(heading), np.zeros(200)], axis=-1
    )
    found = inside_probability(residual, covariance(relative, relative, 1e-3), 1.0, 1.0)
    step = min(1.0, 12.0 * relative) / 20_000
    radius = 1.0 - step * (np.arange(20_000) + 0.5)
    for index in range(0, 200, 25):
        product = radius * distance[index] / relative**2
        gap = radius - distance[index]
        density = radius / relative**2 * np.exp(-0.5 * (gap / relative) ** 2) * ive(0, product)
        assert found[index] == pytest.approx(density.sum() * step, abs=1e-6)


def test_far_and_near_observations_give_the_same_result_together_and_alone():
    rng = np.random.default_rng(5)
    residual = rng.uniform(-3.0, 3.0, (50, 3))
    spread = covariance(0.2, 0.1, 0.3, 0.5)
    together = inside_probability(residual, spread, 1.0, 1.0)
    alone = [float(inside_probability(each, spread, 1.0, 1.0)) for each in residual]
    assert together == pytest.approx(alone, abs=1e-12)
