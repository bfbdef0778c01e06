import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tapping_cell.planning import (
    CameraNoise,
    Gains,
    PlanningError,
    Scatter,
    keep_gains,
    load_gains,
)
from tapping_cell.planning.gains import HIGHEST, LOWEST
from tapping_cell.planning.kept_gains import gains_file

SCATTER, CAMERA = Scatter(), CameraNoise(1e-4, math.radians(0.1))


def learn(true, taps, seed=0, scatter=SCATTER):
    rng = np.random.default_rng(seed)
    gains = Gains.start()
    for _ in range(taps):
        length, heading, turn = rng.uniform(0.005, 0.03), rng.uniform(-3, 3), 0.1
        noise = rng.standard_normal(3)
        moved = length * true[0] * (1 + scatter.distance * noise[0])
        angle = heading + true[2] + scatter.direction * noise[1]
        gains = gains.observe(
            [length * math.cos(heading), length * math.sin(heading), turn],
            [
                moved * math.cos(angle),
                moved * math.sin(angle),
                turn * true[1] * (1 + scatter.rotation * noise[2]),
            ],
            scatter,
            CAMERA,
        )
    return gains


@pytest.mark.parametrize("true", [(1.06, 0.9, 0.02), (0.85, 1.15, -0.03), (1.0, 1.0, 0.0)])
def test_steady_gains_are_learnt_within_their_own_deviation(true):
    gains = learn(true, 60)
    assert np.all(np.abs(gains.value - true) < 4 * np.sqrt(gains.variance) + 1e-3)
    assert np.sqrt(gains.variance[0]) < 0.01


def test_the_error_is_as_large_as_the_filter_says():
    rng = np.random.default_rng(5)
    squares = []
    for seed in range(300):
        true = np.array([1.0, 1.0, 0.0]) + rng.standard_normal(3) * [0.06, 0.10, 0.01]
        gains = learn(true, 6, seed)
        squares.append((gains.value - true) ** 2 / gains.variance)
    assert np.all(np.abs(np.mean(squares, axis=0) - 1.0) < 0.35)


def test_a_bumped_object_is_not_a_gain():
    gains = learn((1.0, 1.0, 0.0), 10)
    after = gains.observe([0.01, 0.0, 0.05], [-0.02, 0.03, 1.0], SCATTER, CAMERA)
    assert np.array_equal(after.value, gains.value)
    assert float(after.outliers) == 1 and float(after.taken) == float(gains.taken)


def test_a_sudden_true_change_is_believed_in_the_end():
    gains = learn((1.0, 1.0, 0.0), 30)
    for _ in range(30):
        gains = gains.observe([0.02, 0.0, 0.1], [0.028, 0.0, 0.1], SCATTER, CAMERA)
    assert gains.value[0] == pytest.approx(1.4, abs=0.03)


def test_a_tap_without_rotation_says_nothing_about_the_rotation():
    start = Gains.start()
    gains = start.observe([0.02, 0.0, 0.0], [0.021, 0.0, 0.001], SCATTER, CAMERA)
    assert gains.value[1] == start.value[1] and gains.variance[1] == start.variance[1]


@given(
    st.lists(st.tuples(*[st.floats(-0.2, 0.2)] * 6), min_size=1, max_size=20),
    st.floats(0.0, 0.3),
)
def test_whatever_is_measured_the_gains_stay_within_bounds(taps, scatter):
    gains = Gains.start()
    for numbers in taps:
        gains = gains.observe(numbers[:3], numbers[3:], Scatter(scatter, scatter, 0.02), CAMERA)
        assert np.all(gains.value >= LOWEST) and np.all(gains.value <= HIGHEST)
        assert np.all(gains.variance >= 0.0) and np.all(np.isfinite(gains.variance))


def test_a_pose_that_is_not_known_counts_as_an_outlier():
    gains = Gains.start().observe([0.01, 0, 0], [math.nan] * 3, SCATTER, CAMERA)
    assert float(gains.outliers) == 1 and np.all(np.isfinite(gains.value))


@given(*[st.floats(-0.1, 0.1)] * 3)
def test_command_and_predict_are_inverse(dx, dy, turn):
    gains = Gains(np.array([1.1, 0.8, 0.05]), np.ones(3), np.zeros(()), np.zeros(()))
    distance, planned, heading = gains.to_plan([dx, dy, turn])
    assert np.allclose(gains.predict(gains.command(distance, planned, heading)), [dx, dy, turn])


def test_many_objects_at_once_are_the_same_as_each_alone():
    rng = np.random.default_rng(2)
    asked, seen = rng.normal(0, 0.02, (50, 3)), rng.normal(0, 0.02, (50, 3))
    together = Gains.start((50,)).observe(asked, seen, SCATTER, CAMERA)
    for row in range(50):
        alone = Gains.start().observe(asked[row], seen[row], SCATTER, CAMERA)
        assert np.allclose(alone.value, together.value[row])
        assert np.allclose(alone.variance, together.variance[row])


def test_kept_gains_come_back_and_a_damaged_file_is_named():
    name = "my disk / no. 3"
    assert np.array_equal(load_gains(name, "domain0").value, Gains.start().value)
    gains = learn((1.05, 0.95, 0.01), 5)
    path = keep_gains(name, "domain0", gains)
    assert path == gains_file(name, "domain0") and path.parent.name == "domain0"
    assert np.array_equal(load_gains(name, "domain0.left").value, Gains.start().value)
    assert np.allclose(load_gains(name, "domain0").value, gains.value)
    assert np.allclose(load_gains(name, "domain0").variance, gains.variance)
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "distance": 17.0}))
    with pytest.raises(PlanningError, match=r"no\._3\.json.*distance is 17\.0.*0\.5 to 2"):
        load_gains(name, "domain0")
    path.write_text("{")
    with pytest.raises(PlanningError, match="delete it"):
        load_gains(name, "domain0")
