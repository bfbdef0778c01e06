"""Lack of fit is detected only where it exists, and prediction intervals contain new taps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tapping_cell.calibration.experiment import StrikerSection
from tapping_cell.calibration.model_error import Taps, lack_of_fit, model_errors
from tapping_cell.calibration.object_fit import ObjectFit, fit_object
from tapping_cell.calibration.prediction import Launches
from tapping_cell.cli.simulated_single_taps import Design, simulated_experiment
from tapping_cell.configuration.cell import load_cell
from tapping_cell.simulation.truth import ImpactTruth, ScatterTruth, SupportTruth, TruthFile

RUNS = 4
STRIKER = StrikerSection(0.1, 0.0054, "free")
DESIGN = Design(trials=6)


def taps(
    random: np.random.Generator,
    trials: int = 10,
    setting: float = 0.0,
    place: float = 0.0,
    direction: float = 0.0,
) -> Taps:
    """Return taps with a scatter of 5 % in distance and 15 % in rotation, and with effects that the
    model does not contain."""
    count = RUNS * trials
    runs = np.repeat(np.arange(RUNS), trials)
    contact, travel = random.uniform(-math.pi, math.pi, (2, count))
    side = np.where(np.arange(count) % 2, 1.0, -1.0)
    predicted = Launches(np.ones(count), side, np.full(count, 0.03), 0.05 * side)
    off = setting * random.standard_normal(RUNS)[runs] + direction * np.cos(2 * travel + 0.3)
    distance = predicted.distance * (1 + off + 0.05 * random.standard_normal(count))
    rotation = predicted.rotation * (1 + 0.15 * random.standard_normal(count))
    rotation += place * np.abs(predicted.rotation) * np.cos(contact - 1.0)
    measured = Launches(predicted.speed, predicted.spin, distance, rotation)
    return Taps(measured, predicted, [str(run) for run in runs], contact, travel)


def test_a_model_that_fits_is_not_reported_as_wrong() -> None:
    """With six tests at a level of 0.001 each, 1.8 of 300 fits are expected to fail."""
    random = np.random.default_rng(1)
    assert sum(bool(lack_of_fit(taps(random))) for _ in range(300)) <= 7


@pytest.mark.parametrize(
    ("wrong", "quantity"),
    [("setting", "distance"), ("place", "rotation"), ("direction", "distance")],
)
def test_the_cause_of_a_model_error_is_named(wrong: str, quantity: str) -> None:
    size = {"setting": 0.1, "place": 0.25, "direction": 0.1}[wrong]
    found = 0
    for seed in range(20):
        misfits = lack_of_fit(taps(np.random.default_rng(seed), **{wrong: size}))
        if misfits and (misfits[0].quantity, misfits[0].cause) == (quantity, wrong):
            assert 0.3 * size < misfits[0].size < 1.7 * size
            assert "does not fit" in misfits[0].sentence()
            found += 1
    assert found >= 17


@pytest.mark.parametrize("setting", [0.0, 0.1])
@pytest.mark.parametrize("place", [0.0, 0.25])
def test_intervals_contain_new_taps_at_new_settings(setting: float, place: float) -> None:
    random = np.random.default_rng(5)
    held: dict[str, list[float]] = {"distance": [], "rotation": []}
    for _ in range(200):
        errors = model_errors(taps(random, setting=setting, place=place))
        new = taps(random, setting=setting, place=place).deviations()
        for error in errors:
            held[error.quantity].append(
                float(np.mean(np.abs(new[error.quantity]) < error.half_width))
            )
    for shares in held.values():
        assert 0.93 < np.mean(shares) < 0.985


def fitted(truth: TruthFile, assumed: float = 0.2, design: Design = DESIGN) -> ObjectFit:
    disk = replace(load_cell().object, contact_friction=assumed)
    scattered = replace(truth, scatter=ScatterTruth(0.025, 0.05, 0.01745))
    experiment = simulated_experiment(load_cell().object, STRIKER, scattered, design, 3)
    return fit_object([experiment], disk)


def test_the_model_error_of_the_simulated_world_is_detected() -> None:
    """The lack of fit has a known cause: a centre of mass off by 2.4 mm, or a contact that differs
    from Routh's model."""
    assert not fitted(TruthFile((0.0, 0.0, 0.0))).misfits
    off_centre = fitted(
        TruthFile((0.0, 0.0, 0.0), support=SupportTruth(mass_offset=(0.002, 0.0014)))
    )
    assert [(m.quantity, m.cause) for m in off_centre.misfits] == [("rotation", "place")]
    oblique = fitted(
        TruthFile((0.0, 0.0, 0.0), impact=ImpactTruth(tangential_stiffness=0.8, oblique_loss=0.5))
    )
    assert ("distance", "setting") in {(m.quantity, m.cause) for m in oblique.misfits}
    # The scatter that the planner receives includes the model's error.
    assert oblique.estimate("scatter_distance").value > 0.08
    assert any("For 95 % of new taps" in sentence for sentence in oblique.sentences)


@pytest.mark.parametrize("assumed", [0.2, 0.1])
def test_contacts_that_appear_to_stick_give_no_friction_bound(assumed: float) -> None:
    """With small incidences the friction is not determined, so no value is reported."""
    design = Design(
        runs=((0.02, math.radians(5)), (0.02, math.radians(20)), (0.04, math.radians(12)))
    )
    fit = fitted(
        TruthFile((0.0, 0.0, 0.0), impact=ImpactTruth(tangential_stiffness=0.8)), assumed, design
    )
    friction = fit.estimate("contact_friction")
    assert not friction.fitted
    assert friction.value <= 0.2 + 1e-9
    assert not any("at least" in sentence for sentence in fit.sentences)
