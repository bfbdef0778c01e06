"""Parameters of an evaluation and results of its trials."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.evaluation.tracks import rotation_gain, track_of
from tapping_cell.planning.evaluation.worlds import AbstractWorld, World
from tapping_cell.planning.gains import Slid
from tapping_cell.planning.interface import Array
from tapping_cell.planning.session import Decision, Done, GoalSession, Strike
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.planning.strike import StrikeSpace
from tapping_cell.planning.tap_times import OBJECTIVES, TapTimes
from tapping_cell.se2 import Pose, unit_vectors

TRUTH = math.inf
"""Value of ``Evaluation.track`` with which the true gains are known after the first tap."""


class End(IntEnum):
    """End of a trial."""

    DONE = 0
    ENDLESS = 1
    REFUSED_BEFORE = 2
    REFUSED_LATER = 3


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Method, task and simulated world of one evaluation. Lengths in m, angles in rad.

    goal: dx, dy and rotation from the start.
    world: simulation of a tap; None means ``AbstractWorld`` with the scatter of the settings.
    random_tasks: largest distance and rotation of tasks drawn for each trial; replaces goal.
    gain_bias: systematic errors of the object's distance and rotation gains, as shares; their signs
        are random in each trial.
    unknown: largest factors by which the true distance gain and the true rotation per distance
        deviate in either direction; the factors are drawn for each trial (uniformly in the
        logarithm).
    off_centre: standard deviation of both components of the offset in ``Gains``, rad/m.
    torque_factor: largest factor by which the true torque factor differs from the assumed one; it
        changes the true rotation per distance in addition to ``unknown``.
    track: images per second of the camera that follows the slide; 0: poses at rest only; TRUTH: the
        true gains are known after the first tap, which no track can exceed (open table only).
    probe: begin with probe taps (only on a table).
    objective: "taps" or "time"; "time" requires a table and a ``clock``.
    clock: factory of the clock that computes the durations of taps. With None, no durations are
        computed.
    mean_tap: mean duration of a tap of the cell's arm, s. It is used for trials on an open table,
        where the arm's position is not defined. With NaN, no durations are computed.
    space: factory of the table, arm and striker for trials with starts and goals all over a table.
        It must be picklable, because every process calls it. None means an open table.
    """

    planner: str
    settings: PlannerSettings
    trials: int = 2000
    goal: tuple[float, float, float] = (0.010, 0.0, 0.17453292519943295)
    random_tasks: tuple[float, float] | None = None
    world: World | None = None
    gain_bias: tuple[float, float] = (0.0, 0.0)
    unknown: tuple[float, float] = (1.0, 1.0)
    torque_factor: float = 1.0
    off_centre: float = 0.0
    track: float = 0.0
    adapt: bool = False
    seed: int = 0
    most_taps: int = 100
    probe: bool = False
    space: Callable[[], StrikeSpace] | None = None
    objective: str = "taps"
    clock: Callable[[], TapClock] | None = None
    mean_tap: float = math.nan

    def __post_init__(self) -> None:
        """Reject invalid parameters (PlanningError)."""
        if self.objective not in OBJECTIVES:
            raise PlanningError(
                f"the objective is {self.objective!r}; choose one of {', '.join(OBJECTIVES)}"
            )
        if self.objective == "time" and (self.clock is None or self.space is None):
            raise PlanningError(
                "the objective 'time' requires the durations of an arm's motions: evaluate on the "
                "table of a cell with an arm (--table)"
            )
        if not 1 <= self.trials <= 10**8:
            raise PlanningError(f"{self.trials} trials were requested; give 1 to 100000000")
        if not np.all(np.isfinite(self.goal)):
            raise PlanningError(f"the goal {self.goal} must be three finite numbers")
        if self.random_tasks is not None and not (
            np.all(np.isfinite(self.random_tasks)) and min(self.random_tasks) >= 0.0
        ):
            raise PlanningError(
                "--random-tasks: the maximum distance (mm) and rotation "
                "(degrees) must be finite and >= 0"
            )
        if not all(0.0 <= abs(bias) <= 0.4 for bias in self.gain_bias):
            raise PlanningError(
                f"the gain bias is {100 * self.gain_bias[0]:g} % in distance and "
                f"{100 * self.gain_bias[1]:g} % in rotation; both must be within +-40 %"
            )

        if not all(1.0 <= factor <= 10.0 for factor in self.unknown):
            raise PlanningError(
                f"the limits of the factors (--unknown) are {self.unknown[0]:g} for the distance "
                f"and {self.unknown[1]:g} for the rotation per distance; both must be 1 to 10"
            )
        if not 1.0 <= self.torque_factor <= 10.0:
            raise PlanningError(
                f"the limit of the torque factor's ratio is {self.torque_factor:g}; it must be 1 "
                "to 10"
            )
        if self.track != 0.0 and not self.adapt:
            raise PlanningError(
                "the planner learns from tracks only with --adapt: add it to --track"
            )
        if self.track == TRUTH and self.space is not None:
            raise PlanningError("--track truth is only for trials on an open table")
        if self.track not in (0.0, TRUTH) and not 10.0 <= self.track <= 1000.0:
            raise PlanningError(f"--track is {self.track:g} Hz; it must be 10 to 1000 Hz, or off")
        if not 0.0 <= self.off_centre <= 10.0:
            raise PlanningError(
                "the rotation per distance of off-centre objects (--off-centre) is "
                f"{1e-3 * math.degrees(self.off_centre):g} degrees per mm; it must be 0 to 0.57"
            )

    @property
    def simulation(self) -> World:
        """Simulation of the taps: ``world`` or, if that is None, commanded displacements with
        scatter."""
        return AbstractWorld(self.settings.scatter) if self.world is None else self.world

    def track_of(
        self, poses: Array, moved: Array, gains: Array, rng: np.random.Generator
    ) -> Slid | None:
        """Return what the tracks of true displacements (n, 3) tell; None without tracks.

        ``poses``: true poses (n, 3) after the tap; ``gains``: true gains (n, 4). Their systematic
        errors ``gain_bias`` belong to the impact, all others to the slide.
        """
        if self.track in (0.0, TRUTH):
            return None
        slide = np.stack([gains[:, 0], gains[:, 1] / gains[:, 0]], axis=-1)
        travel = np.arctan2(moved[:, 1], moved[:, 0]) - poses[:, 2] + moved[:, 2]
        drift = gains[:, 3] * np.cos(travel) - gains[:, 2] * np.sin(travel)
        drift = drift * np.hypot(moved[:, 0], moved[:, 1])
        return track_of(moved, slide, drift, self.track, self.settings.camera, rng)


class TapClock(TapTimes, Protocol):
    """Computes the durations of trials on a table."""

    @property
    def parked(self) -> Array:
        """Initial pose of the arm's tip: x, y, height, yaw (4,)."""
        ...

    def tap(self, tip: Array, before: Pose, strike: Strike) -> tuple[float, Array]:
        """Return the duration of a tap, s, and the pose of the arm's tip (4,) after the tap.

        ``tip``: pose of the arm's tip before the tap, (4,). ``before``: pose of the object for
        which the tap was planned.
        """
        ...


class Results(NamedTuple):
    """Results of trials, one entry per trial.

    taps: number of fired taps. end: an ``End``. inside: whether the true pose is within the full
    tolerance. distance, rotation: true residual, m and rad.
    over_edge: whether the object's bounding circle ever came to rest across the table's edge.
    seconds: total duration of the taps, s; NaN if unknown.
    """

    taps: NDArray[np.int64]
    end: NDArray[np.int64]
    inside: NDArray[np.bool_]
    distance: Array
    rotation: Array
    over_edge: NDArray[np.bool_]
    seconds: Array

    @classmethod
    def of_trials(cls, rows: Sequence[TrialResult]) -> Results:
        """Return the results of trials that were run one after another."""
        return cls(*(np.array(column) for column in zip(*rows, strict=True)))


TrialResult = tuple[int, int, bool, float, float, bool, float]
"""Result of one trial: one entry of each array of ``Results``."""


def trial_result(
    session: GoalSession,
    decision: Decision,
    pose: Array,
    most_taps: int,
    over_edge: bool,
    seconds: float,
) -> TrialResult:
    """Return the result of a session that ended with ``decision``; ``pose``: true pose (3,)."""
    if isinstance(decision, Done):
        end = End.DONE
    elif session.taps >= most_taps:
        end = End.ENDLESS
    else:
        end = End.REFUSED_BEFORE if session.taps == 0 else End.REFUSED_LATER
    error = session.residual(pose)
    distance, rotation = math.hypot(error[0], error[1]), float(error[2])
    within = bool(session.settings.within_tolerance(error))
    return session.taps, int(end), within, distance, rotation, over_edge, seconds


def draw_tasks(evaluation: Evaluation, count: int, rng: np.random.Generator) -> Array:
    """Draw the displacements from start to goal, (count, 3)."""
    if evaluation.random_tasks is None:
        return np.tile(np.asarray(evaluation.goal, dtype=float), (count, 1))
    far, turn = evaluation.random_tasks
    distance = rng.uniform(0.0, far, count)
    heading = rng.uniform(-np.pi, np.pi, count)
    moved = distance[:, None] * unit_vectors(heading)
    return np.column_stack([moved, rng.uniform(-turn, turn, count)])


def draw_gains(evaluation: Evaluation, count: int, rng: np.random.Generator) -> Array:
    """Draw true gains of distance and rotation and the two components of the offset (rad/m),
    (count, 4)."""
    signs = rng.choice([-1.0, 1.0], size=(count, 2))
    bias = 1.0 + signs * np.asarray(evaluation.gain_bias)
    factor: Array = np.ones((count, 2))
    if evaluation.unknown != (1.0, 1.0) or evaluation.torque_factor != 1.0:
        share = rng.uniform(-1.0, 1.0, (count, 2))
        drawn = np.asarray(evaluation.unknown) ** share
        drawn[:, 1] *= rotation_gain(evaluation.torque_factor ** -share[:, 1])
        factor = np.stack([drawn[:, 0], drawn[:, 0] * drawn[:, 1]], axis=-1)
    off: Array = np.zeros((count, 2))
    if evaluation.off_centre > 0.0:
        off = evaluation.off_centre * rng.standard_normal((count, 2))
    return np.concatenate([bias * factor, off], axis=1)
