import math

import numpy as np
import pytest

from tapping_cell.mechanics import Sliding
from tapping_cell.mechanics.bodies import Disk
from tapping_cell.mechanics.slide_track import Poses, decay_of, launch_of, sampled

DECELERATION, DECAY = 0.17 * 9.81, decay_of(2.0, 3.64)
NOISE = 0.045e-3, math.radians(0.045)


def tracks(count, rate, distance, rotation, rng):
    """Return random slides as the camera sees them, and their true durations and powers."""
    friction, torque = 2 ** rng.uniform(-1, 1, (2, count))
    distances, rotations = np.full(count, distance), np.full(count, rotation)
    duration = np.sqrt(2 * distances / (DECELERATION * friction))
    time = np.tile(np.arange(int(duration.max() * rate) + 5) / rate, (count, 1))
    along, turned = sampled(rng.uniform(1, 2, count) / rate, duration, DECAY / torque, time)
    full = np.ones(time.shape)
    poses = Poses(
        time,
        distances[:, None] * along + NOISE[0] * rng.standard_normal(time.shape),
        rotations[:, None] * turned + NOISE[1] * rng.standard_normal(time.shape),
        NOISE[0] * full,
        NOISE[1] * full,
    )
    return poses, distances, rotations, duration, DECAY / torque


@pytest.mark.parametrize("rate", [30, 120])
@pytest.mark.parametrize("distance, degrees", [(0.02, 5.0), (0.06, 10.0), (0.01, 2.0)])
def test_the_launch_is_found_within_its_stated_deviation(rate, distance, degrees):
    rng = np.random.default_rng(rate)
    poses, d, a, duration, decay = tracks(400, rate, distance, math.radians(degrees), rng)
    launch = launch_of(poses, d, a, DECELERATION, DECAY)
    assert np.isfinite(launch.spin).mean() > 0.98
    for found, true, std in (
        (launch.duration, duration, launch.speed_std),
        (launch.decay, decay, launch.spin_std),
    ):
        off = np.log(found / true) / std
        off = off[np.isfinite(off)]
        assert 0.85 < math.sqrt(float(np.mean(off**2))) < 1.2


def test_dropped_frames_cost_accuracy_but_no_truth():
    rng = np.random.default_rng(5)
    poses, d, a, duration, _ = tracks(400, 60, 0.02, math.radians(4.0), rng)
    dropped = rng.uniform(size=poses.time.shape) < 0.4
    holes = poses._replace(distance=np.where(dropped, math.nan, poses.distance))
    launch = launch_of(holes, d, a, DECELERATION, DECAY)
    off = np.log(launch.duration / duration) / launch.speed_std
    off = off[np.isfinite(off)]
    assert off.size > 350
    assert 0.8 < math.sqrt(float(np.mean(off**2))) < 1.25
    whole = launch_of(poses, d, a, DECELERATION, DECAY)
    assert np.nanmedian(whole.speed_std) < np.nanmedian(launch.speed_std)


def test_one_pose_of_the_moving_object_tells_nothing():
    poses = Poses(*np.array([[[0.0, 0.1, 0.3]], [[0.0, 0.01, 0.02]], [[0.0, 0.05, 0.08]],
                             [[1e-5] * 3], [[1e-4] * 3]]))  # fmt: skip
    launch = launch_of(poses, [0.02], [0.08], DECELERATION, DECAY)
    assert np.isnan(launch.speed) and np.isnan(launch.spin)


@pytest.mark.parametrize("kappa", [2.0, 3.64, 5.0])
def test_the_launch_of_an_exact_slide_of_a_disk(kappa):
    """The power law replaces the exact slide; its error is small beside the scatter of a tap."""
    body = Disk(radius=0.048, mass=0.2455, height=0.012)
    sliding = Sliding(body, 0.17, kappa)
    speed, spin = 0.25, 1.5
    time = np.arange(0.0, 0.3, 1 / 120)
    profile = sliding.profile(speed, spin, time)
    rest = sliding.rest(speed, spin)
    poses = Poses(
        time[None] + 0.004, profile.distance[None], profile.rotation[None],
        np.full((1, time.size), 1e-5), np.full((1, time.size), 1e-4),
    )  # fmt: skip
    launch = launch_of(poses, [rest.distance], [rest.rotation], DECELERATION, DECAY)
    assert launch.speed[0] == pytest.approx(speed, rel=0.02)
    assert launch.spin[0] == pytest.approx(spin, rel=0.03)
    assert launch.time[0] == pytest.approx(0.004, abs=0.002)
