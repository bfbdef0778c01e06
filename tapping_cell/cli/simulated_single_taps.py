"""Single-tap experiments in the simulated world, without ROS: records with known true parameters.

The world of ``simulation`` integrates each tap in time; none of the fit's equations are used here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tapping_cell.calibration.experiment import Experiment, ExperimentFile, StrikerSection
from tapping_cell.calibration.trials import Track, Trial, completed
from tapping_cell.configuration.objects import GRAVITY, ObjectFile
from tapping_cell.mechanics import Polygon, Striker, Tap
from tapping_cell.se2 import Array, Pose
from tapping_cell.simulation.truth import TruthFile
from tapping_cell.simulation.world import World

_STROKE = 0.05
_STANDOFF = 0.015
_BEFORE_S = 0.3
_AFTER_S = 0.25


@dataclass(frozen=True, slots=True)
class Design:
    """The runs of an experiment, and the noise of the measurement.

    ``runs`` contains a pair for each run: the distance (m) of the slide if the object did not
    rotate, and the incidence (rad). The other fields are standard deviations of the noise: of a
    sample of a track (m, rad), of a pose at rest (m, rad), and of a measured striker speed
    (relative).
    """

    runs: tuple[tuple[float, float], ...] = tuple(
        (distance, math.radians(incidence)) for incidence in (20, 45) for distance in (0.018, 0.036)
    )
    trials: int = 10
    rate: float = 30.0
    track_noise: tuple[float, float] = (0.00003, math.radians(0.05))
    rest_noise: tuple[float, float] = (0.00001, math.radians(0.02))
    speed_noise: float = 0.01


def simulated_trials(
    content: ObjectFile,
    striker: Striker,
    truth: TruthFile,
    design: Design,
    seed: int,
) -> list[Trial]:
    """Return the trials of one experiment with an object ``content`` whose true parameters are
    changed by ``truth``."""
    world = World(content, striker, _STROKE, truth, seed)
    random = np.random.default_rng([seed, 1])
    bench = _Bench(world, content, content.tap(striker), truth, design, random)
    trials: list[Trial] = []
    for run, (distance, incidence) in enumerate(design.runs, start=1):
        for number in range(1, design.trials + 1):
            side = 1 if number % 2 else -1
            trial = bench.tap(distance, side * incidence)
            trials.append(completed(replace(trial, run=run, trial=number)))
    return trials


def simulated_experiment(
    content: ObjectFile,
    striker: StrikerSection,
    truth: TruthFile,
    design: Design,
    seed: int,
    noise_known: bool = True,
) -> Experiment:
    """Return one experiment as it is read from its folder. ``noise_known``: whether the header
    contains the noise of a pose at rest; if it does not, the default values of the header are
    used."""
    header = ExperimentFile(
        format=1,
        made="",
        source="simulated",
        striker=striker,
        camera_rate_hz=design.rate,
    )
    if noise_known:
        position, rotation = design.rest_noise
        header = replace(header, rest_position_std=position, rest_rotation_std=rotation)
    trials = simulated_trials(content, striker.striker(), truth, design, seed)
    return Experiment(Path(), header, tuple(trials), ())


class _Bench:
    """The simulated world, with a camera and a tapper that have no access to the true parameters of
    the world."""

    def __init__(
        self,
        world: World,
        content: ObjectFile,
        tap: Tap,
        truth: TruthFile,
        design: Design,
        random: np.random.Generator,
    ) -> None:
        self._world = world
        self._content = content
        self._tap = tap
        self._factor = truth.impact.striker_speed_factor
        self._design = design
        self._random = random
        self._now = 0.0

    def tap(self, distance: float, incidence: float) -> Trial:
        """Make one tap at a random contact, with the speed that a slide of ``distance`` without
        rotation needs."""
        random, design = self._random, self._design
        x, y = random.uniform(-0.03, 0.03, 2).tolist()
        start = Pose(x, y, float(random.uniform(-math.pi, math.pi)))
        before = self._noisy(start, design.rest_noise)
        tip, speed = self._aim(before, distance, incidence)
        planned = self._tap.strike(_array(before), _array(tip), speed)
        relative = planned.point - [before.x, before.y]
        contact = math.atan2(relative[1], relative[0]) - before.theta
        track, end = self._watch(start, tip, speed)
        after = self._noisy(end, design.rest_noise)
        measured = speed * self._factor * (1 + design.speed_noise * random.standard_normal())
        return Trial(
            run=0,
            trial=0,
            striker_speed=speed,
            striker_speed_measured=measured,
            striker_speed_std=design.speed_noise * measured,
            incidence=float(planned.incidence),
            contact_angle=math.remainder(contact, math.tau),
            start_x=before.x,
            start_y=before.y,
            start_theta=before.theta,
            end_x=after.x,
            end_y=after.y,
            end_theta=after.theta,
            displacement_std=math.sqrt(2) * design.rest_noise[0],
            rotation_std=math.sqrt(2) * design.rest_noise[1],
            camera_rate_hz=design.rate,
            track=track,
        )

    def _aim(self, start: Pose, distance: float, incidence: float) -> tuple[Pose, float]:
        """Return the pose of the tip before the tap, and the required speed."""
        body = self._content.body()
        angle = float(self._random.uniform(-math.pi, math.pi))
        if isinstance(body, Polygon):
            edge = body.edge_normals[self._random.integers(len(body.edge_normals))]
            angle = math.atan2(edge[1], edge[0])
        point, outward = body.boundary(angle), body.normal(angle)
        local = (float(-point @ outward), float(outward[0] * point[1] - outward[1] * point[0]))
        launch = self._tap.impact.strike(1.0, incidence, (local[0], -local[1]))
        wanted = math.sqrt(2 * self._content.friction * GRAVITY * distance)
        axis = math.atan2(-outward[1], -outward[0]) + incidence
        ball = point + self._tap.impact.striker.tip_radius * outward
        tip = ball - _STANDOFF * np.array([math.cos(axis), math.sin(axis)])
        held = start @ Pose(float(tip[0]), float(tip[1]), axis)
        return held, wanted / float(np.hypot(*launch.velocity))

    def _watch(self, start: Pose, tip: Pose, speed: float) -> tuple[Track, Pose]:
        """Strike at a random time between two frames and observe until the object rests."""
        world, rate = self._world, self._design.rate
        world.place(start)
        begun = self._now + float(self._random.uniform(0, 1 / rate))
        times, poses = [], []
        struck, quiet = False, 0
        strike_at = begun + _BEFORE_S
        while quiet < round(_AFTER_S * rate):
            if not struck and begun > strike_at:
                world.strike(tip, self._content.height / 2, speed, strike_at)
                struck = True
            world.advance(begun)
            times.append(begun)
            poses.append(_array(world.pose))
            quiet += struck and world.at_rest
            begun += 1 / rate
        self._now = begun
        seen: Array = np.array(poses)
        sample, turn = self._design.track_noise
        seen += self._random.standard_normal(seen.shape) * [sample, sample, turn]
        known = np.ones(len(times))
        theta: Array = np.unwrap(seen[:, 2]).astype(float)
        return Track(
            np.array(times), seen[:, 0], seen[:, 1], theta, sample * known, turn * known
        ), world.pose

    def _noisy(self, pose: Pose, noise: tuple[float, float]) -> Pose:
        x, y, theta = _array(pose) + self._random.standard_normal(3) * [noise[0], *noise]
        return Pose(float(x), float(y), float(theta))


def _array(pose: Pose) -> Array:
    return np.array([pose.x, pose.y, pose.theta])
