"""Detection of model misfit by ``fit`` in simulated worlds that differ from its model.

Each experiment fits 40 taps in 4 runs, with incidences of 20 and 45 degrees and distances of 18 and
36 mm. The scatter is 2.5 % in speed, 5 or 15 % in spin, and 1 degree in direction. Then new taps
are compared with their 95 % prediction intervals: 40 taps with the same settings, and 40 taps with
eight other settings (10 to 50 degrees, 12 to 45 mm).
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from single_taps import Design, simulated_experiment

from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.calibration.object_fit import fit_object, predicted_taps
from tapping_cell.configuration.cell import load_cell
from tapping_cell.simulation.truth import (
    ImpactTruth,
    ScatterTruth,
    SupportTruth,
    SurfaceTruth,
    TruthFile,
)

DEFAULT_COUNT = 5
_STRIKER = StrikerSection(mass=0.1, tip_radius=0.0054, constraint="free")
_PLAIN = TruthFile((0.0, 0.0, 0.0))
WORLDS = {
    "as the model": _PLAIN,
    "rim load": replace(_PLAIN, support=SupportTruth(pressure="rim")),
    "mass 2.4 mm off": replace(_PLAIN, support=SupportTruth(mass_offset=(0.002, 0.0014))),
    "friction with speed": replace(
        _PLAIN, surface=SurfaceTruth(slow_rise=0.5, slow_speed=0.05, viscous=0.5)
    ),
    "oblique restitution": replace(
        _PLAIN, impact=ImpactTruth(tangential_stiffness=0.8, oblique_loss=0.5)
    ),
}


def measure(count: int) -> dict[str, Any]:
    """Return the results of ``count`` experiments for each world: how often each misfit was
    detected, and the share of new taps within the prediction interval."""
    return {name: _world(truth, count) for name, truth in WORLDS.items()}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = ["new taps within their 95 % interval, at the fitted settings and at other settings"]
    for name, row in report.items():
        held = "; ".join(
            f"{quantity} {100 * same:.0f} and {100 * other:.0f} %"
            for quantity, (same, other) in row["held"].items()
        )
        found = ", ".join(f"{what} in {number}" for what, number in row["misfits"].items())
        text.append(f"{name:<20} {held}; lack of fit: {found or 'none'} of {row['experiments']}")
    return text


def _world(truth: TruthFile, count: int) -> dict[str, Any]:
    misfits: Counter[str] = Counter()
    held: dict[str, list[list[float]]] = {"distance": [], "rotation": []}
    content = load_cell().object
    for seed in range(count):
        random = np.random.default_rng(seed)
        spin = 0.05 if seed % 2 == 0 else 0.15
        world = replace(truth, scatter=ScatterTruth(0.025, spin, math.radians(1.0)))
        experiment = partial(simulated_experiment, content, _STRIKER, world)
        fit = fit_object([experiment(Design(), 2 * seed)], content)
        misfits.update(f"{misfit.quantity} ({misfit.cause})" for misfit in fit.misfits)
        others = tuple(
            (float(random.uniform(0.012, 0.045)), math.radians(float(random.uniform(10, 50))))
            for _ in range(8)
        )
        new = [
            predicted_taps(fit, [experiment(design, 2 * seed + 1)]).deviations()
            for design in (Design(), Design(runs=others, trials=5))
        ]
        for error in fit.model_errors:
            offs = [np.abs(off[error.quantity]) for off in new]
            inside = [float(np.mean(off[np.isfinite(off)] < error.half_width)) for off in offs]
            held[error.quantity].append(inside)
    return {
        "experiments": count,
        "misfits": dict(misfits),
        "held": {name: np.mean(rows, axis=0).tolist() for name, rows in held.items()},
    }
