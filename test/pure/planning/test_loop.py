"""The closed loop in Python, which docs/planning.md shows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import settings

from tapping_cell.configuration.assembly import make_session, make_strike_space
from tapping_cell.configuration.cell import CameraSection, load_cell
from tapping_cell.planning import Done, FreeSpace, ObserveAgain, PositioningSession, Strike
from tapping_cell.planning.evaluation.worlds import AbstractWorld
from tapping_cell.se2 import displaced

NOISE = CameraSection(position_noise=1e-4, angle_noise=math.radians(0.06))
GOAL = (0.010, 0.0, math.radians(10.0))


def noisy_cell():
    cell = load_cell()
    return replace(cell, file=replace(cell.file, camera=NOISE))


@pytest.fixture(scope="module")
def parts():
    """Planning method, strike space and map of the cell, for sessions of many trials."""
    session = make_session(noisy_cell(), GOAL)
    space = make_strike_space(noisy_cell())
    return session.planner, space, FreeSpace(space)


def event_loop(session, observe):
    """Yield decisions that each follow from one observation."""
    seen, covariance = observe()
    while True:
        decision = session.decide(seen, covariance, observe_again=False)
        yield decision
        before, (seen, covariance) = seen, observe()
        session.observe(decision, before, seen, covariance)


def trial(parts, seed, loop):
    """Return the number of taps of the published task."""
    rng = np.random.default_rng(seed)
    session = PositioningSession(GOAL, *parts)
    camera, world, pose = session.settings.camera, AbstractWorld(), np.zeros(3)

    def observe():
        return pose + camera.deviations * rng.standard_normal(3), camera.covariance

    for decision in loop(session, observe):
        if isinstance(decision, Strike):
            here, commanded = pose[None, :], np.array([decision.commanded])
            moved = world.answer(here, here, commanded, np.array([[1.0, 1.0, 0.0, 0.0]]), rng)
            pose = displaced(pose, moved[0])
        elif not isinstance(decision, ObserveAgain):
            break
    assert isinstance(decision, Done)
    assert np.hypot(*session.residual(pose)[:2]) <= 1e-3
    return session.taps


def test_longer_observations_save_taps(parts):
    seeds = range(2 * settings.default.max_examples)
    longer = [trial(parts, seed, PositioningSession.decisions) for seed in seeds]
    once = [trial(parts, seed, event_loop) for seed in seeds]
    assert max(longer) <= 5
    assert np.mean(once) > 1.1 * np.mean(longer)


def test_the_loop_learns_from_the_mean_of_the_observations(parts):
    """A tap is learnt once, from the fused pose before it and the first pose after it."""
    session = PositioningSession(GOAL, *parts)
    near = np.array(GOAL) - [0.0009, 0.0, 0.0]
    apart = np.array([0.0, 0.0002, 0.0])
    seen = [near + apart + [0.0, 0.0, 2 * math.pi], near - apart, np.zeros(3)]
    covariance = NOISE.position_noise**2 * np.eye(3)
    decisions = session.decisions(lambda: (seen.pop(0), covariance))
    first, second = next(decisions), next(decisions)
    assert isinstance(first, ObserveAgain) and isinstance(second, ObserveAgain)
    assert second.residual == pytest.approx((0.0009, 0.0, 0.0), abs=1e-9)
    sent = []
    session.observe = lambda *arguments: sent.append(arguments)
    assert isinstance(next(decisions), Strike) and not sent
    seen.append(np.array(GOAL))
    assert isinstance(next(decisions), Done)
    ((strike, before, after, noise),) = sent
    assert isinstance(strike, Strike) and np.array_equal(noise, covariance)
    assert before == pytest.approx(2 * near / 3, abs=1e-9)
    assert after == pytest.approx(GOAL)
