"""The simulated cell as a gymnasium environment."""

import math
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.planning import PlanningError, make_planner
from tapping_cell.se2 import Pose, difference
from tapping_cell.tapping_env import MOST_TAPS, TappingEnv

NAME = "tapping_cell.tapping_env:Tapping-v0"
GOAL = {"goal": (0.010, 0.0, math.radians(10.0))}


@pytest.fixture(scope="module")
def env():
    return TappingEnv()


def action_of(planner, observation):
    """Return the displacement that a planning method chooses on the line to the goal."""
    left = difference(observation[:3], observation[3:])
    distance, heading = math.hypot(left[0], left[1]), math.atan2(left[1], left[0])
    tap = planner.choose(distance, left[2])
    along = float(tap.distance)
    return np.array([along * math.cos(heading), along * math.sin(heading), float(tap.rotation)])


def test_gymnasiums_checker_accepts_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # The largest action is 0.12 m; a checker that knows only -1 to 1 asks for a scaled space.
        warnings.filterwarnings("ignore", message=".*normalized action space.*")
        check_env(gymnasium.make(NAME).unwrapped, skip_render_check=True)


def test_a_planning_method_reaches_the_goal_and_the_end_is_true(env):
    planner = make_planner("exact", env.settings)
    for seed in range(4):
        observation, info = env.reset(seed=seed, options=GOAL)
        assert not info["reached"]
        ended, taps = False, 0
        while not ended and taps < MOST_TAPS:
            observation, reward, ended, _, info = env.step(action_of(planner, observation))
            taps += 1
            assert reward == -1.0
        assert info == {"reached": True, "inside": True, "possible": True}
        assert taps <= 6


def test_the_same_seed_gives_the_same_episode(env):
    def episode():
        seen = [env.reset(seed=3, options=GOAL)[0]]
        return np.array([*seen, *(env.step(np.array([0.01, 0.0, 0.05]))[0] for _ in range(2))])

    first = episode()
    assert np.array_equal(first, episode())
    assert not np.array_equal(first[0], env.reset(seed=4, options=GOAL)[0])


@given(action=st.tuples(*[st.floats(-0.2, 0.2)] * 2, st.floats(-7.0, 7.0)))
@settings(max_examples=10)
def test_every_action_is_a_tap_that_the_mechanics_allow(env, action):
    limits = env.settings
    dx, dy, turn = env.limited(np.array(action))
    size = math.hypot(dx, dy)
    assert limits.smallest_distance <= size * (1 + 1e-9)
    assert size <= limits.largest_distance * (1 + 1e-9)
    assert abs(turn) <= limits.cone_slope * size * (1 + 1e-9)
    observation = env.reset(seed=1)[0]
    after, _, ended, _, info = env.step(np.array(action))
    assert env.observation_space.contains(after) and (not ended or info["reached"])
    if info["possible"]:
        moved = difference(observation[:3], after[:3])
        assert math.hypot(moved[0] - dx, moved[1] - dy) <= 0.3 * size + 1e-3


def test_leaving_the_table_costs_more_than_any_number_of_taps(env):
    """The object starts near the edge, and is tapped in all directions."""
    ends = []
    for heading in np.linspace(0.0, 2 * math.pi, 12, endpoint=False):
        env.reset(seed=0)
        env._table.place(Pose(0.95 * env._cell.file.table.length / 2, 0.0, 0.0))
        env._seen = env._observe()[0]
        action = 0.12 * np.array([math.cos(heading), math.sin(heading), 0.0])
        observation, reward, ended, _, info = env.step(action)
        assert not info["reached"] and env.observation_space.contains(observation)
        left = abs(env._table.pose.x) > env._cell.file.table.length / 2
        assert ended == left and (reward < -MOST_TAPS) == left
        ends.append(left)
    assert any(ends) and not all(ends)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"gaol": (0.01, 0.0, 0.0)}, "gaol"),
        ({"goal": 0.01}, "dtheta"),
        ({"goal": (5.0, 0.0, 0.0)}, "outside the table"),
        ({"goal": (math.nan, 0.0, 0.0)}, "finite"),
    ],
)
def test_an_impossible_option_is_refused(env, options, expected):
    with pytest.raises(PlanningError, match=expected):
        env.reset(seed=0, options=options)


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_gymnasiums_vector_classes_run_it(mode):
    vector = gymnasium.make_vec(NAME, num_envs=2, vectorization_mode=mode)
    try:
        observations, _ = vector.reset(seed=5)
        assert observations.shape == (2, 6) and not np.array_equal(*observations)
        observations, rewards, *_ = vector.step(vector.action_space.sample())
        assert observations.shape == (2, 6) and rewards.tolist() == [-1.0, -1.0]
    finally:
        vector.close()


def test_too_many_taps_truncate_the_episode():
    env = gymnasium.make(NAME)
    env.reset(seed=2)
    ends = [env.step(np.array([0.002 * (-1) ** tap, 0.0, 0.0]))[2:4] for tap in range(MOST_TAPS)]
    assert ends[-1] == (False, True) and not any(truncated for _, truncated in ends[:-1])
