"""Trials of a cell with fixed tappers. Each trial is a complete session, and the trials run one
after another."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tapping_cell.mechanics import Tap
from tapping_cell.planning.errors import PlanningError
from tapping_cell.planning.evaluation.task import Results, TrialResult, trial_result
from tapping_cell.planning.evaluation.worlds import scattered
from tapping_cell.planning.fixed_session import FixedTapperSession
from tapping_cell.planning.fixed_solver import GoalSolver
from tapping_cell.planning.fixed_tappers import BESIDES_FLIGHT_S, FixedStrikeSpace
from tapping_cell.planning.interface import Array
from tapping_cell.planning.mounts import moved_mount
from tapping_cell.planning.session import Strike
from tapping_cell.planning.settings import PlannerSettings
from tapping_cell.se2 import displaced, unit_vectors


@dataclass(frozen=True, slots=True)
class FixedEvaluation:
    """Parameters of an evaluation. Lengths in m, angles in rad.

    space: the cell according to its file. goal: x, y, theta in `table`. start_angle: largest
    rotation of the start relative to the goal; starts are anywhere in the working area.
    mount_error: standard deviations of the offset (m) and of the angle (rad) of the true lines,
    which are drawn for each trial. truth: true mechanics; None means the planner's mechanics.
    """

    space: FixedStrikeSpace
    settings: PlannerSettings
    trials: int = 400
    goal: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_angle: float = math.radians(30.0)
    mount_error: tuple[float, float] = (0.0, 0.0)
    truth: Tap | None = None
    adapt: bool = True
    seed: int = 0
    most_taps: int = 40

    def __post_init__(self) -> None:
        """Reject invalid parameters (PlanningError)."""
        if not 1 <= self.trials <= 10**7:
            raise PlanningError(f"{self.trials} trials were requested; give 1 to 10000000")
        if not np.all(np.isfinite(self.goal)):
            raise PlanningError(f"the goal {self.goal} must be three finite numbers")
        if not 0.0 <= self.start_angle <= math.pi:
            raise PlanningError(
                f"the start angle is {math.degrees(self.start_angle):g} degrees; "
                "it must be 0 to 180"
            )
        if not all(0.0 <= error <= 0.1 for error in self.mount_error):
            raise PlanningError(
                f"the mount errors are {1e3 * self.mount_error[0]:g} mm and "
                f"{math.degrees(self.mount_error[1]):g} degrees; they must be 0 to 100 mm and 0 to "
                "5.7 degrees"
            )


def evaluate_fixed(
    evaluation: FixedEvaluation, progress: Callable[[int], None] | None = None
) -> Results:
    """Run all trials; ``progress`` is called with the number of trials just finished."""
    solver, rows = GoalSolver(), []
    for stream in np.random.SeedSequence(evaluation.seed).spawn(evaluation.trials):
        rows.append(_run_one(evaluation, solver, np.random.default_rng(stream)))
        if progress is not None:
            progress(1)
    return Results.of_trials(rows)


def _run_one(
    evaluation: FixedEvaluation, solver: GoalSolver, rng: np.random.Generator
) -> TrialResult:
    space, settings = evaluation.space, evaluation.settings
    true, goal = _true_space(evaluation, rng), np.array(evaluation.goal)
    area = space.area
    radius, angle = area.radius * math.sqrt(rng.random()), rng.uniform(-math.pi, math.pi)
    turned = rng.uniform(-evaluation.start_angle, evaluation.start_angle)
    place = np.array([area.x, area.y]) + radius * unit_vectors(angle)
    pose = np.append(place, goal[2] + turned)
    session = FixedTapperSession(
        goal,
        settings,
        space,
        solver,
        adapt=evaluation.adapt,
        most_taps=evaluation.most_taps,
    )
    camera, left, seconds = settings.camera, False, 0.0

    def observe() -> tuple[Array, Array]:
        return pose + camera.deviations * rng.standard_normal(3), camera.covariance

    for decision in session.decisions(observe):
        if not isinstance(decision, Strike):
            continue
        seconds += BESIDES_FLIGHT_S + decision.plan.flight
        pose = displaced(pose, _answer(true, decision, pose, settings, rng))
        left = left or float(area.clearance(pose[:2])) < 0.0
    return trial_result(session, decision, pose, evaluation.most_taps, left, seconds)


def _true_space(evaluation: FixedEvaluation, rng: np.random.Generator) -> FixedStrikeSpace:
    """Return the space with the true mounts and the true mechanics of one trial."""
    space = evaluation.space
    off, turn = evaluation.mount_error
    drawn = rng.standard_normal((len(space.tappers), 2)) * np.array([off, turn])
    made = space.with_mounts(
        [
            moved_mount(tapper.mount, *error)
            for tapper, error in zip(space.tappers, drawn.tolist(), strict=True)
        ]
    )
    if evaluation.truth is not None:
        truth = evaluation.truth
        made.tappers = tuple(replace(tapper, tap=truth) for tapper in made.tappers)
    return made


def _answer(
    true: FixedStrikeSpace,
    strike: Strike,
    pose: Array,
    settings: PlannerSettings,
    rng: np.random.Generator,
) -> Array:
    """Return the true displacement (3,) of a strike, with scatter; zero if the striker misses."""
    index = [tapper.name for tapper in true.tappers].index(strike.plan.tapper)
    tapper, speed = true.tappers[index], strike.plan.striker_speed
    hit = tapper.tap.strike(pose, np.array(tapper.mount), speed)
    if bool(hit.missed) or not 0.0 <= float(hit.travel) <= tapper.stroke:
        return np.zeros(3)
    gains = np.array([[1.0, 1.0, 0.0, 0.0]])
    moved = scattered(hit.displacement[None, :], gains, pose[None, :], settings.scatter, rng)
    return np.asarray(moved[0])
