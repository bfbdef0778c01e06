"""Records of single taps computed by the mechanics, with measured initial velocities."""

import math
from pathlib import Path

import numpy as np

from tapping_cell.calibration.experiment import ExperimentFile, StrikerSection, write_header
from tapping_cell.calibration.trials import Track, Trial, append_trial
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import load_object
from tapping_cell.mechanics import Impact, Sliding

DISK = load_object(shared_folder() / "objects" / "aluminium_disk.yaml")
STRIKER = StrikerSection(0.1, 0.0054, "free")
TRUE = {"friction": 0.21, "torque_factor": 2.6, "restitution": 0.75, "contact_friction": 0.24}
RUNS = ((0.5, 20.0), (0.7, 20.0), (0.55, 45.0), (0.8, 45.0))


def taps(
    noise=(0.0, 0.0),
    scatter=(0.0, 0.0),
    seed=0,
    runs=RUNS,
    trials=10,
    content=DISK,
    true=TRUE,
    striker=STRIKER,
):
    """Return trials with initial velocities; ``noise`` and ``scatter`` of speed and spin are
    relative."""
    random = np.random.default_rng(seed)
    body = content.body()
    impact = Impact(body, striker.striker(), true["restitution"], true["contact_friction"])
    sliding = Sliding(body, true["friction"], true["torque_factor"])
    for run, (speed, incidence) in enumerate(runs, start=1):
        for number in range(1, trials + 1):
            angle = math.radians(incidence) * (1 if number % 2 else -1)
            hit = impact.strike(speed, angle, (-body.support_radius, 0.0))
            faster = 1 + scatter[0] * random.standard_normal()
            v = faster * float(np.hypot(*hit.velocity))
            w = faster * float(hit.spin) * (1 + scatter[1] * random.standard_normal())
            distance, rotation, _ = sliding.rest(v, w)
            contact = random.uniform(-3, 3)
            yield Trial(
                run=run,
                trial=number,
                striker_speed=speed,
                striker_speed_measured=speed,
                incidence=angle,
                contact_angle=contact,
                start_theta=0.0,
                displacement=float(distance),
                rotation=float(rotation),
                direction=contact
                + math.pi
                + math.atan2(float(hit.velocity[1]), float(hit.velocity[0])),
                initial_speed=v * (1 + noise[0] * random.standard_normal()),
                initial_spin=w * (1 + noise[1] * random.standard_normal()),
            )


def write(folder: Path, trials, **header) -> Path:
    """Write the records into a folder and return it."""
    keys = {"striker": STRIKER, "object": DISK} | header
    write_header(folder, ExperimentFile(1, "2026-01-01T00:00:00+00:00", "simulated", **keys))
    for trial in trials:
        append_trial(folder, trial)
    return folder


def track(speed=0.3, spin=2.0, rate=30.0, sliding=None, impact=0.41, start=(0.1, -0.05, 0.3)):
    """Return the exact track of one slide along x, sampled at ``rate`` Hz."""
    sliding = sliding or Sliding(DISK.body(), 0.21, 2.6)
    time = np.arange(0.0, impact + float(sliding.rest(speed, spin).duration) + 0.3, 1 / rate)
    profile = sliding.profile(speed, spin, np.maximum(time - impact, 0.0))
    unknown = np.full(time.shape, math.nan)
    x, theta = start[0] + profile.distance, start[2] + profile.rotation
    return Track(time, x, np.full(time.shape, start[1]), theta, unknown, unknown)
