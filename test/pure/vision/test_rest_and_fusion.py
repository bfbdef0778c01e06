"""Rest is reported soon, but never during a motion; fusion is a mean that tolerates outliers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.se2 import wrap_angle
from tapping_cell.vision.fusion import fuse
from tapping_cell.vision.rest_detection import Track

SIGMA = np.array([3e-6, 3e-6, 1.0e-4])
COVARIANCE = np.diag(SIGMA**2)
FRAME = 1.0 / 30.0


def measured(random: np.random.Generator, pose: np.ndarray) -> np.ndarray:
    noisy = pose + random.normal(0.0, SIGMA)
    noisy[2] = wrap_angle(noisy[2])
    return noisy


@given(
    st.integers(0, 2**31),
    st.floats(0.05, 0.3),
    st.floats(-np.pi, np.pi),
    st.floats(0.0, 1.0),
    st.floats(-3.1, 3.1),
)
def test_rest_is_declared_within_150_ms(seed, speed, direction, phase, angle):
    """A slide with a deceleration of 0.17 g ends at time 0. The phase of the frames is random."""
    random = np.random.default_rng(seed)
    track = Track()
    deceleration = 1.67
    end = np.array([0.1, -0.05, angle])
    stop = -speed / deceleration
    for k in range(-20, 6):
        time = (k + phase) * FRAME
        left = 0.5 * deceleration * min(time, 0.0) ** 2 if time > stop else 0.5 * speed * -stop
        pose = end - left * np.array([np.cos(direction), np.sin(direction), 20.0])
        motion = track.add(10.0 + time, measured(random, pose), COVARIANCE)
        # Exclude frames in which the struck object has not yet moved measurably, and those just
        # before rest.
        if (time - stop) * speed > 1e-4 and deceleration * -time > 0.0005:
            assert motion.rest_since is None
        if time >= 0.15 - FRAME:
            assert motion.rest_since is not None
    assert motion.rest_since >= 10.0 - FRAME
    assert np.all(np.abs(motion.pose[:2] - end[:2]) < 5 * SIGMA[:2])


def delay_of_rest(random: np.random.Generator, rate: float, lose: bool) -> float:
    """Return the time at which rest is reported after a slide of random friction and speed that
    ends at time 0.

    The noise is that of the tracker: larger during the motion, when edges are measured, and smaller
    when the object hardly moves, because all pixels are used.
    """
    track = Track()
    deceleration, speed = random.uniform(0.3, 5.0), random.uniform(0.02, 0.6)
    direction, turn = random.uniform(-np.pi, np.pi), random.uniform(-25.0, 25.0)
    begin, phase = -speed / deceleration, random.uniform()
    lost = int(random.integers(-3, 3)) if lose else None
    before = -1.0
    for k in range(int(begin * rate) - 4, 20):
        time = (k + phase) / rate
        if k == lost:
            continue
        way = 0.5 * deceleration * (begin**2 - np.clip(time, begin, 0.0) ** 2)
        pose = np.array([0.1, 0.0, 1.0])
        pose += way * np.array([np.cos(direction), np.sin(direction), turn])
        sigma = SIGMA if way - before > 1e-4 else SIGMA / 3.0
        before = way
        motion = track.add(10.0 + time, pose + random.normal(0.0, sigma), np.diag(sigma**2))
        # Exclude frames in which the struck object has not yet moved measurably, and those just
        # before rest.
        if begin < time < -0.0005 / deceleration and way > 1e-4:
            assert motion.rest_since is None
        if time > 0.0 and motion.rest_since is not None:
            return time
    raise AssertionError("rest was not declared")


@pytest.mark.parametrize(
    ("rate", "lose", "share"), [(30.0, False, 1.0), (60.0, False, 1.0), (30.0, True, 0.97)]
)
def test_rest_within_150_ms_at_other_rates_frictions_and_with_a_frame_lost(rate, lose, share):
    random = np.random.default_rng(6)
    delays = np.array([delay_of_rest(random, rate, lose) for _ in range(100)])
    assert (delays <= 0.150).mean() >= share
    assert delays.max() <= 0.2


@given(st.integers(0, 2**31), st.floats(0.0005, 0.02), st.floats(-np.pi, np.pi))
def test_a_creeping_object_is_never_reported_at_rest(seed, speed, direction):
    random = np.random.default_rng(seed)
    track = Track()
    step = speed * FRAME * np.array([np.cos(direction), np.sin(direction), 0.0])
    for k in range(120):
        motion = track.add(k * FRAME, measured(random, k * step), COVARIANCE)
        assert motion.rest_since is None


def test_velocity_is_estimated_while_sliding():
    random = np.random.default_rng(1)
    track = Track()
    velocity = np.array([0.12, -0.05, 1.5])
    for k in range(60):
        motion = track.add(k * FRAME, measured(random, k * FRAME * velocity), COVARIANCE)
        if k > 2:
            assert motion.velocity == pytest.approx(velocity, abs=0.02)


def test_rest_ends_at_the_first_displaced_frame_and_tolerates_one_glitch():
    random = np.random.default_rng(2)
    track = Track()
    home = np.array([0.0, 0.0, 3.14159])
    for k in range(40):
        motion = track.add(k * FRAME, measured(random, home), COVARIANCE)
    assert motion.frames == 40
    glitch = track.add(40 * FRAME, home + np.array([0.0005, 0.0, 0.0]), COVARIANCE)
    assert glitch.rest_since is None
    back = track.add(41 * FRAME, measured(random, home), COVARIANCE)
    assert back.rest_since == 0.0
    assert back.frames == 41
    for k in range(42, 50):
        gone = track.add(
            k * FRAME, measured(random, home + np.array([0.0005, 0.0, 0.0])), COVARIANCE
        )
    assert gone.rest_since >= 42 * FRAME
    assert gone.pose[0] == pytest.approx(0.0005, abs=1e-5)


def test_a_gap_resets_the_fusion():
    track = Track()
    for k in range(10):
        motion = track.add(k * FRAME, np.zeros(3), COVARIANCE)
    assert motion.rest_since is not None
    assert track.add(5.0, np.zeros(3), COVARIANCE).rest_since is None


def test_fused_error_follows_its_covariance():
    random = np.random.default_rng(3)
    normalised = []
    for _ in range(300):
        root = random.normal(size=(20, 3, 3)) * SIGMA[:, None]
        covariances = root @ np.swapaxes(root, 1, 2) + COVARIANCE
        errors = np.stack([random.multivariate_normal(np.zeros(3), c) for c in covariances])
        true = np.array([0.1, 0.2, np.pi - 1e-5])
        poses = true + errors
        poses[:, 2] = wrap_angle(poses[:, 2])
        mean, covariance = fuse(poses, covariances)
        error = mean - true
        error[2] = wrap_angle(error[2])
        normalised.append(error @ np.linalg.solve(covariance, error))
    # The mean is that of 300 chi-square values with 3 degrees of freedom each. The asserted bounds
    # are at four standard deviations. The fusion gives large errors slightly less weight.
    assert 2.4 < np.mean(normalised) < 3.6


def test_outliers_have_little_influence():
    random = np.random.default_rng(4)
    poses = random.normal(0.0, SIGMA, (40, 3))
    poses[::8] += [0.002, 0.001, 0.02]
    mean, _ = fuse(poses, np.broadcast_to(COVARIANCE, (40, 3, 3)))
    assert np.all(np.abs(mean) < 2.0 * SIGMA)
