"""The track of a slide, from the observations that the planner receives anyway."""

from __future__ import annotations

import math

import numpy as np
import pytest
from logic_parts import alone

from tapping_cell.configuration.assembly import make_tap
from tapping_cell.configuration.cell import load_cell
from tapping_cell.logic.cell_monitor import CellMonitor
from tapping_cell.logic.clock import Now, to_stamp
from tapping_cell.logic.poses import covariance_to_message, from_message, to_message
from tapping_cell.mechanics import Sliding
from tapping_cell.messages import ObjectState, PoseWithCovariance
from tapping_cell.planning.track import launch_from, slid_of
from tapping_cell.se2 import Pose
from tapping_cell.vision.rest_detection import RestSettings, Track

NOISE = np.array([3e-5, 3e-5, math.radians(0.03)])
SPEED, SPIN, HEADING = 0.2, 1.2, 0.7
BEFORE = Pose(0.02, -0.01, 0.4)
LAUNCH_S = 0.5123


def observed(true: Sliding, rate: float, seed: int, dropped: float = 0.0) -> list[ObjectState]:
    """Return the observations of an object that is tapped at ``LAUNCH_S``."""
    rng, track, states = np.random.default_rng(seed), Track(RestSettings()), []
    time = np.arange(0.0, 1.6, 1.0 / rate)
    slide = true.profile(SPEED, SPIN, np.maximum(time - LAUNCH_S, 0.0))
    for now, way, turn in zip(time, slide.distance, slide.rotation, strict=True):
        if abs(now - LAUNCH_S - 0.1) < 0.1 and rng.uniform() < dropped:
            continue
        step = np.array([way * math.cos(HEADING), way * math.sin(HEADING), turn])
        pose = np.array(BEFORE) + step
        motion = track.add(now, pose + NOISE * rng.standard_normal(3), np.diag(NOISE**2))
        state = ObjectState(
            visible=True, at_rest=motion.rest_since is not None, frames_fused=motion.frames
        )
        state.header.stamp = to_stamp(round(1e9 * (100.0 + now)))
        if motion.rest_since is not None:
            state.at_rest_since = to_stamp(round(1e9 * (100.0 + motion.rest_since)))
        state.pose = PoseWithCovariance(
            pose=to_message(Pose(*motion.pose)), covariance=covariance_to_message(motion.covariance)
        )
        states.append(state)
    return states


@pytest.mark.parametrize(("rate", "dropped"), [(30.0, 0.0), (60.0, 0.4), (120.0, 0.0)])
@pytest.mark.parametrize("friction", [0.5, 1.0, 2.0])
def test_friction_and_torque_factor_follow_from_the_observations(
    rate: float, dropped: float, friction: float
) -> None:
    model = make_tap(load_cell()).sliding
    true = Sliding(model.body, friction * model.friction, 0.6 * model.torque_factor)
    went = float(true.rest(SPEED, SPIN).distance)
    launched = model.rest(SPEED, SPIN)
    slope = float(launched.rotation) / float(launched.distance)
    found = 0
    for seed in range(6):
        monitor = CellMonitor(0.5)
        rest = ObjectState()
        for state in observed(true, rate, seed, dropped):
            monitor.on_objects(alone(state), Now(0.0, 0))
            rest = state if state.at_rest else rest
        track = monitor.track(rest)
        after = from_message(rest.pose.pose)
        launch = None if track is None else launch_from(track, BEFORE, after, model)
        slid = None if launch is None else slid_of(launch, BEFORE, after, model)
        if slid is None or not np.isfinite(slid.slope):
            continue
        found += 1
        gain = math.log(went / float(slid.distance))
        limits = 4 * np.hypot([float(slid.distance_std), float(slid.slope_std)], [0.02, 0.04])
        assert gain == pytest.approx(-math.log(friction), abs=limits[0])
        assert abs(math.log(float(slid.slope) / slope)) < limits[1]
    # At 30 Hz, one or two images show the shortest of these slides.
    too_short = rate == 30.0 and friction == 2.0
    assert found >= (0 if too_short else 3 if dropped else 5)


def test_a_slide_that_was_hidden_has_no_track() -> None:
    model = make_tap(load_cell()).sliding
    monitor = CellMonitor(0.5)
    rest = ObjectState()
    for state in observed(model, 30.0, 1):
        if state.at_rest:
            monitor.on_objects(alone(state), Now(0.0, 0))
            rest = state
    assert monitor.track(rest) is None


def test_the_track_of_a_tap_begins_when_the_tap_is_planned() -> None:
    model = make_tap(load_cell()).sliding
    monitor = CellMonitor(0.5)
    for state in observed(model, 120.0, 1):
        monitor.on_objects(alone(state), Now(0.0, 0))
    assert monitor.object is not None and monitor.track(monitor.object) is not None
    monitor.begin_track()
    assert monitor.track(monitor.object) is None
