"""Simulated tracks of slides: poses measured by the camera while the object moves."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.mechanics.slide_track import Poses, decay_of, launch_of, sampled
from tapping_cell.planning.gains import Slid
from tapping_cell.planning.interface import Array
from tapping_cell.planning.settings import CameraNoise

DECELERATION = 0.17 * 9.81
"""Expected deceleration, m/s^2: the friction of the paper's disk (Huang and Mason, section 3.1)."""

DECAY = decay_of(2.0, 3.64)
"""Expected power of the spin for the paper's disk and torque factor (section 3.1.2)."""

FUSED = 9
"""Number of images that an observation at rest fuses; one image has three times its noise."""

INSTANT = 1.5e-4
"""Standard deviation of the time to which an image of a moving object corresponds, s (measured, see
``vision/object_follower.py``)."""

MOST_POSES = 400


def rotation_gain(torque_ratio: Array) -> Array:
    """Return the factor of the rotation per distance for a torque factor that is ``torque_ratio``
    times the expected one."""
    return np.asarray(DECAY / (1.0 + (DECAY - 1.0) * torque_ratio))


def track_of(
    moved: Array,
    slide_gains: Array,
    drift: Array,
    rate: float,
    camera: CameraNoise,
    rng: np.random.Generator,
) -> Slid:
    """Simulate the tracks of true displacements (n, 3) and evaluate them.

    slide_gains: gains (n, 2) of distance and rotation due to the slide. drift: rotation (n,), rad,
    that an offset of the friction causes during the slide. rate: of the camera, Hz. The first image
    comes at a random time.
    """
    count = len(moved)
    distance = np.hypot(moved[:, 0], moved[:, 1])
    duration = np.sqrt(2.0 * np.maximum(distance, 1e-9) * slide_gains[:, 0] / DECELERATION)
    decay = DECAY / slide_gains[:, 1]
    poses = min(math.ceil(float(duration.max(initial=0.0)) * rate) + 4, MOST_POSES)
    time = np.broadcast_to(np.arange(poses) / rate, (count, poses))
    launched = rng.uniform(1.0, 2.0, count) / rate
    along, turned = sampled(launched, duration, decay, time)
    # Friction at an offset turns an object that was launched without spin.
    power = np.where(np.abs(decay - 2.0) < 1e-3, 2.001, decay)[:, None]
    drifted = (power * along - 2.0 * turned) / (power - 2.0)
    speed = 2.0 * distance / duration
    spin = decay * moved[:, 2] / duration
    once = math.sqrt(FUSED)
    position_std = np.hypot(once * camera.position, INSTANT * speed)[:, None]
    angle_std = np.hypot(once * camera.angle, INSTANT * spin)[:, None]
    noise = rng.standard_normal((2, count, poses))
    shape = (count, poses)
    seen = Poses(
        time,
        distance[:, None] * along + position_std * noise[0],
        (moved[:, 2] - drift)[:, None] * turned + drift[:, None] * drifted + angle_std * noise[1],
        np.broadcast_to(np.maximum(position_std, 1e-7), shape),
        np.broadcast_to(np.maximum(angle_std, 1e-6), shape),
    )
    launch = launch_of(seen, distance, moved[:, 2], DECELERATION, DECAY)
    return Slid(
        launch.speed**2 / (2.0 * DECELERATION),
        2.0 * launch.spin / (DECAY * launch.speed),
        2.0 * launch.speed_std,
        launch.spin_std,
    )
