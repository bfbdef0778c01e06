"""Benefit of a fit: taps of the optimal planner with the configured and with the fitted object.

The true friction, torque factor, restitution and contact friction are 15 to 20 % higher or lower
than configured. The parameters are fitted to 4 runs of 10 single taps in the simulated world. Then
the planner moves the object by 10 mm and 10 degrees, once with the configured and once with the
fitted parameters. The planner does not learn from taps. Ground truth and scatter are the same in
both cases.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from single_taps import Design, simulated_experiment

from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.calibration.object_file import fit_record, fitted_object
from tapping_cell.calibration.object_fit import fit_object
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import ObjectFile, load_object
from tapping_cell.planning import PlannerSettings, Scatter
from tapping_cell.planning.evaluation import Evaluation, PhysicsWorld, evaluate, summarise
from tapping_cell.simulation.truth import ImpactTruth, ScatterTruth, SupportTruth, TruthFile

# Ratios of true to configured friction, torque factor, restitution and contact friction.
TRUTHS = (
    (1.2, 0.8, 0.8, 1.2),
    (1.2, 1.2, 0.8, 0.8),
    (0.8, 1.2, 1.15, 0.8),  # 1.15, because 1.2 times the configured 0.86 would exceed 1
    (0.8, 0.8, 1.15, 1.2),
    (0.8, 1.2, 0.8, 1.2),
    (1.2, 0.8, 1.15, 0.8),
)
TRIALS = 1000
_STRIKER = StrikerSection(mass=0.1, tip_radius=0.0054, constraint="free")


def measure_loop(trials: int = TRIALS) -> list[dict[str, Any]]:
    """Return the mean number of taps with the configured and the fitted object for each ground
    truth."""
    initial = load_object(shared_folder() / "objects" / "aluminium_disk.yaml")
    report = []
    for seed, (friction, torque, restitution, contact) in enumerate(TRUTHS):
        truth = TruthFile(
            (0.0, 0.0, 0.0),
            support=SupportTruth(friction_factor=friction, torque_factor_ratio=torque),
            impact=ImpactTruth(restitution, contact),
            scatter=ScatterTruth(0.05, 0.15, math.radians(1.0)),
        )
        fitted = fitted_file(initial, _STRIKER, truth, seed)
        true = replace(
            initial,
            friction=friction * initial.friction,
            torque_factor=torque * initial.torque_factor,
            restitution=min(1.0, restitution * initial.restitution),
            contact_friction=contact * initial.contact_friction,
        )
        old, new = (_mean_taps(assumed, true, trials) for assumed in (initial, fitted))
        report.append(
            {
                "truth": (friction, torque, restitution, contact),
                "configured": old,
                "fitted": new,
                "perfect": _mean_taps(true, true, trials),
                "fewer": 1 - new / old,
            }
        )
    return report


def fitted_file(
    content: ObjectFile, striker: StrikerSection, truth: TruthFile, seed: int
) -> ObjectFile:
    """Return the object file that is fitted to 4 runs of 10 single taps in a world."""
    experiment = simulated_experiment(content, striker, truth, Design(), seed, noise_known=False)
    fit = fit_object([experiment], content)
    return fitted_object(fit, fit_record(fit, ()))


def _mean_taps(assumed: ObjectFile, true: ObjectFile, trials: int) -> float:
    """Return the mean number of taps over trials of the paper's task; an unfinished trial counts as
    the maximum number of taps."""
    striker = _STRIKER.striker()
    scatter = Scatter(0.05, 0.15, math.radians(1.0))
    settings = replace(PlannerSettings.for_tap(assumed.tap(striker)), scatter=scatter)
    world = PhysicsWorld(
        model=replace(assumed.tap(striker), smallest_distance=0.0),
        truth=true.tap(striker),
        scatter=scatter,
    )
    evaluation = Evaluation("optimal", settings, trials=trials, world=world)
    return float(summarise(evaluate(evaluation, 1))["taps"]["mean"])
