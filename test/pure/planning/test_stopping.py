import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.planning import stopping_box
from tapping_cell.planning.stopping import FALSE_STOPS, stopping_share


@pytest.mark.parametrize("noise", [0.05, 0.1, 0.2])
def test_the_share_of_false_stops_is_as_promised(noise):
    share = stopping_share(noise)
    rng = np.random.default_rng(1)
    measured = rng.uniform(-share, share, 4_000_000)
    true = measured + noise * rng.standard_normal(measured.size)
    false = np.mean(np.abs(true) > 1.0)
    deviation = math.sqrt(FALSE_STOPS / measured.size)
    assert false == pytest.approx(FALSE_STOPS, abs=4 * deviation)


@given(st.floats(0.001, 0.3), st.floats(0.001, 0.3))
def test_more_noise_means_a_smaller_box(one, other):
    low, high = sorted((one, other))
    assert stopping_share(high) <= stopping_share(low) + 1e-9


def test_a_perfect_camera_uses_the_whole_tolerance():
    assert stopping_box(0.001, 0.02, 0.0, 0.0) == (0.001, 0.02, True)


def test_the_papers_camera_is_too_coarse_and_the_box_says_so():
    box = stopping_box(0.001, math.radians(1.0), 0.0007, math.radians(0.8))
    assert not box.camera_suffices


def test_a_share_given_by_the_user_is_taken():
    box = stopping_box(0.002, 0.01, 0.0001, 0.001, 0.5)
    assert (box.distance, box.rotation) == (0.001, 0.005)
