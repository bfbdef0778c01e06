"""Report of a fit, with numbers in mm, degrees and percent, for ``report.single_tap_page``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.estimates import Estimate
from tapping_cell.calibration.experiment import Experiment
from tapping_cell.calibration.object_fit import ObjectFit
from tapping_cell.calibration.prediction import Launches, RunErrors
from tapping_cell.calibration.trials import TRIAL_COLUMNS, TRIAL_TITLES
from tapping_cell.cli.objects.fit_labels import shown, speed_lines
from tapping_cell.configuration.objects import GRAVITY
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.mechanics import Profile, Sliding
from tapping_cell.report.single_tap import (
    Motions,
    Parameter,
    ProfileView,
    RunError,
    SingleTapReport,
)
from tapping_cell.report.single_tap_page import write_page
from tapping_cell.report.tables import write_table

SINGLE_TAPS = "single_taps.csv"
_PROFILES = 2
_MARGIN_S = 0.06
_CURVE = 200
_MM, _DEG = 1e3, 180 / math.pi


def write_report(folder: Path, fit: ObjectFit, record: Provenance) -> Path:
    """Write the page and its figures. Return the path of the page."""
    return write_page(report_of(fit, record), folder)


def write_trials(folder: Path, fit: ObjectFit, experiments: Sequence[Experiment]) -> None:
    """Write one row for each trial of the experiments, with the columns of their records."""
    used = {(entry.trial.file, entry.trial.row) for entry in fit.used}
    columns: dict[str, list[Any]] = {name: [] for name in ("records", *TRIAL_TITLES, "used")}
    for experiment in experiments:
        for trial in experiment.trials:
            numbers = [getattr(trial, column.name) for column in TRIAL_COLUMNS]
            names = (str(experiment.folder), trial.run, trial.trial, trial.outcome)
            row = (*names, *numbers, trial.note, (trial.file, trial.row) in used)
            for column, value in zip(columns.values(), row, strict=True):
                column.append(value)
    write_table(folder / SINGLE_TAPS, columns)


def report_of(fit: ObjectFit, record: Provenance) -> SingleTapReport:
    """Convert the fit to the contents of the report."""
    return SingleTapReport(
        title=f"Single taps of the {fit.content.name}",
        made=record.made,
        inputs=record.inputs,
        labels=fit.labels,
        parameters=tuple(_parameter(entry) for entry in fit.estimates),
        measured=_motions(fit.measured),
        by_sliding=_motions(fit.by_sliding),
        by_tapping=_motions(fit.by_tapping),
        own_friction=fit.slide.own_friction,
        profiles=tuple(_profile(fit, index) for index in _shown_trials(fit)),
        runs=tuple(_run(run) for run in fit.runs),
        tapper=tuple(speed_lines(fit)),
        sentences=fit.sentences,
        left_out=tuple(str(entry) for entry in fit.left_out),
        facts=_facts(fit, record),
    )


def _parameter(entry: Estimate) -> Parameter:
    label, factor = shown(entry)
    return Parameter(
        label, factor * entry.old, factor * entry.value, factor * entry.low, factor * entry.high
    )


def _motions(values: Launches) -> Motions:
    return Motions(
        _MM * values.distance, _DEG * values.rotation, _MM * values.speed, _DEG * values.spin
    )


def _run(run: RunErrors) -> RunError:
    return RunError(
        label=run.label,
        trials=run.trials,
        sliding=(100 * run.sliding_distance, 100 * run.sliding_rotation),
        inverse=(100 * run.inverse_speed, 100 * run.inverse_spin),
        impact=(100 * run.impact_speed, 100 * run.impact_spin),
        tap=(100 * run.tap_distance, 100 * run.tap_rotation),
    )


def _shown_trials(fit: ObjectFit) -> list[int]:
    """Return the indices of two trials with tracks: the trial with the largest rotation, and a
    trial of another run with medium rotation."""
    tracked = [i for i, entry in enumerate(fit.used) if entry.motion.slide is not None]
    by_rotation = sorted(tracked, key=lambda i: -abs(fit.measured.rotation[i]))
    chosen = by_rotation[:1]
    for index in by_rotation[len(by_rotation) // 2 :]:
        if len(chosen) < _PROFILES and fit.labels[index] not in {fit.labels[i] for i in chosen}:
            chosen.append(index)
    return chosen


def _profile(fit: ObjectFit, index: int) -> ProfileView:
    """Return one trial together with the slide that the model predicts for its displacement."""
    slide = fit.used[index].motion.slide
    assert slide is not None
    trial = fit.used[index].trial
    time = slide.time - fit.slide.impact_time[index]
    near = (time > -_MARGIN_S) & (time < _duration(fit, index) + _MARGIN_S)
    time, along, rotation = time[near], slide.along[near], slide.rotation[near]
    curve_time, curve = _curve(fit, index, fit.slide.torque_factor)
    plain_time, plain = _curve(fit, index, 1.0)
    steps = np.diff(time)
    # A sample interval that contains the impact gives no valid velocity.
    whole = (time[:-1] > 0) | (time[1:] < 0)
    return ProfileView(
        title=f"run {fit.labels[index]}, trial {trial.trial}: speed",
        seen_time=_MM * time,
        seen_distance=_MM * along,
        seen_rotation=_DEG * rotation,
        rate_time=(_MM * (time[1:] + time[:-1]) / 2)[whole],
        seen_speed=(_MM * np.diff(along) / steps)[whole],
        seen_spin=(_DEG * np.diff(rotation) / steps)[whole],
        curve_time=curve_time,
        curve_distance=_MM * curve.distance,
        curve_rotation=_DEG * curve.rotation,
        curve_speed=_MM * curve.speed,
        curve_spin=_DEG * curve.spin,
        plain_time=plain_time,
        plain_speed=_MM * plain.speed,
        plain_spin=_DEG * plain.spin,
    )


def _sliding(fit: ObjectFit, torque_factor: float) -> Sliding:
    """Return the sliding model of the body. A polygon is replaced by its equivalent disk, as in the
    fit."""
    return Sliding(fit.content.body(), fit.slide.friction, torque_factor, GRAVITY).approximated()


def _curve(fit: ObjectFit, index: int, torque_factor: float) -> tuple[NDArray[np.float64], Profile]:
    """Model a slide with the same displacement as the trial. Return times in ms, and the motion of
    the object at these times."""
    sliding = _sliding(fit, torque_factor)
    distance, rotation = fit.measured.distance[index], fit.measured.rotation[index]
    speed, spin = sliding.launch(float(distance), float(rotation))
    times = np.linspace(0.0, float(sliding.rest(speed, spin).duration), _CURVE, dtype=np.float64)
    return _MM * times, sliding.profile(speed, spin, times)


def _duration(fit: ObjectFit, index: int) -> float:
    sliding = _sliding(fit, fit.slide.torque_factor)
    launch = float(fit.slide.launch_speed[index]), float(fit.slide.launch_spin[index])
    return float(sliding.rest(*launch).duration)


def _facts(fit: ObjectFit, record: Provenance) -> dict[str, str]:
    slide = fit.slide
    facts = {
        "by the paper's criterion": f"friction {fit.paper.friction:.4f}, torque factor "
        f"{fit.paper.torque_factor:.3f}",
        "variation of the friction": f"{100 * slide.friction_scatter:.2f} % from trial to trial "
        "(standard deviation, without the measurement error)",
        f"residual of {record.residual_of}": f"{record.residual:.4f}",
    }
    if math.isfinite(slide.position_rms):
        facts["residual of the tracks' poses"] = (
            f"{_MM * slide.position_rms:.3f} mm and {_DEG * slide.rotation_rms:.3f} degrees rms"
        )
    return facts
