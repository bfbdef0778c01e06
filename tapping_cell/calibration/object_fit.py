"""Fit of the object's parameters to records of single taps, with outlier rejection and confidence
intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.estimates import (
    Estimate,
    impact_estimates,
    scatter_estimates,
    slide_estimates,
)
from tapping_cell.calibration.experiment import Experiment
from tapping_cell.calibration.identifiability import Identifiability, identifiability
from tapping_cell.calibration.impact_fit import (
    ImpactFit,
    ImpactModel,
    Strikes,
    contact_frame,
    fit_impact,
)
from tapping_cell.calibration.model_error import (
    Misfit,
    ModelError,
    Taps,
    lack_of_fit,
    model_errors,
)
from tapping_cell.calibration.paper_criterion import PaperFit, paper_fit
from tapping_cell.calibration.prediction import Launches, RunErrors, run_errors
from tapping_cell.calibration.screening import MIN_TRIALS, Used, enough, run_of, screen
from tapping_cell.calibration.slide_curves import TORQUE_FACTORS, SlideCurves
from tapping_cell.calibration.sliding_fit import SlideFit, fit_slides
from tapping_cell.calibration.trials import LeftOut
from tapping_cell.configuration.objects import GRAVITY, ObjectFile
from tapping_cell.mechanics import Body, InvalidParameterError, Polygon, Striker
from tapping_cell.se2 import Array

_OUTLIER = 6.0  # robust standard deviations
_MIN_FRICTION_SPREAD = 0.01
_MISFIT = 5.0
_MAX_OUTLIERS = 0.25
_CORRELATED = 0.9
_MIN_SPEED_ERROR = 0.01  # smallest relative error of the striker's speed that is reported


class SpeedPoint(NamedTuple):
    """Mean and standard deviation of the measured speeds of the tapper at one setting, in m/s. The
    setting is the draw of the tapper's spring in m (NaN if it has none) or the commanded speed."""

    draw: float
    commanded: float
    measured: float
    scatter: float
    trials: int


@dataclass(frozen=True, slots=True, eq=False)
class ObjectFit:
    """Result of the verb ``object fit``. Arrays have one entry for each trial used."""

    content: ObjectFile
    estimates: tuple[Estimate, ...]
    used: tuple[Used, ...]
    left_out: tuple[LeftOut, ...]
    labels: tuple[str, ...]
    slide: SlideFit
    impact: ImpactFit | None
    paper: PaperFit
    measured: Launches
    by_sliding: Launches
    by_tapping: Launches
    runs: tuple[RunErrors, ...]
    identifiability: Identifiability | None
    misfits: tuple[Misfit, ...]
    model_errors: tuple[ModelError, ...]
    tapper: tuple[SpeedPoint, ...]
    sentences: tuple[str, ...]

    def estimate(self, name: str) -> Estimate:
        """Return the estimate of that name; raise KeyError if there is none."""
        for entry in self.estimates:
            if entry.name == name:
                return entry
        raise KeyError(name)


def fit_object(experiments: Sequence[Experiment], content: ObjectFile, seed: int = 0) -> ObjectFit:
    """Fit the object's parameters; ``content`` provides shape, mass and the previous values.

    Raises:
        RecordError: the records cannot be used; the message gives the reason.
    """
    body = content.body()
    used, left_out = screen(experiments, body, GRAVITY)
    slide = _fit_slides(used, body)
    inconsistent = _inconsistent(used, slide)
    if inconsistent:
        kept = [entry for index, entry in enumerate(used) if index not in inconsistent]
        used, left_out = enough(kept, (*left_out, *inconsistent.values()))
        slide = _fit_slides(used, body)
    _check_range(slide)
    labels = _labels(used)
    numbers = [labels.index(label) for label in labels]
    measured = _measured(used, slide)
    estimates = slide_estimates(slide, numbers, content, seed)
    striker = _striker(experiments)
    sentences: list[str] = []
    try:
        impacts = _fit_impact(used, slide, content, striker, sentences)
    except InvalidParameterError as error:
        raise RecordError(
            f"the impacts do not suit the shape and the mass of '{content.name}': {error} Check "
            "that it is the object that was tapped, and the angles in the records"
        ) from error
    by_tapping = _tapped(used, slide, impacts, body)
    found = None
    misfits: tuple[Misfit, ...] = ()
    errors: tuple[ModelError, ...] = ()
    if impacts is not None:
        impact = impacts.fit
        struck = [numbers[row] for row in impacts.rows]
        taps = _taps(used, labels, measured, by_tapping, impacts.rows)
        misfits, errors = lack_of_fit(taps), model_errors(taps)
        estimates += impact_estimates(impact, struck, content, seed, _inflation(misfits))
        sentences.extend(misfit.sentence() for misfit in misfits)
        sentences.extend(f"{note[0].upper()}{note[1:]}." for note in impact.notes)
        known = _speed_known([used[row] for row in impacts.rows])
        found = identifiability(impacts.model, impact.values, impact.scatter, known)
        sentences.extend(found.sentences)
        estimates += scatter_estimates(taps, impact, struck, content, seed, errors)
        sentences.extend(_prediction_sentence(errors))
    by_sliding = _slid(measured, slide, body)
    sentences.extend(_tapper_sentences(used))
    sentences.extend(_slide_sentences(slide, estimates, labels, body.support_radius))
    return ObjectFit(
        content=content,
        estimates=tuple(estimates),
        used=used,
        left_out=left_out,
        labels=tuple(labels),
        slide=slide,
        impact=None if impacts is None else impacts.fit,
        paper=paper_fit(measured, labels, body, GRAVITY, (slide.friction, slide.torque_factor)),
        measured=measured,
        by_sliding=by_sliding,
        by_tapping=by_tapping,
        runs=run_errors(labels, measured, by_sliding, by_tapping),
        identifiability=found,
        misfits=misfits,
        model_errors=errors,
        tapper=_tapper(used),
        sentences=tuple(sentences),
    )


def _fit_slides(used: Sequence[Used], body: Body) -> SlideFit:
    return fit_slides([entry.motion for entry in used], body, GRAVITY)


def _check_range(slide: SlideFit) -> None:
    """Raise RecordError if the fitted torque factor is at the limit of its range."""
    low, high = TORQUE_FACTORS
    if not 1.01 * low < slide.torque_factor < 0.99 * high:
        raise RecordError(
            f"the best torque factor, {slide.torque_factor:.3g} with a friction of "
            f"{slide.friction:.3g}, is at the limit of its range ({low:g} to {high:g}): the "
            "units of displacement, rotation or spin, the sign of the rotation (counter-clockwise "
            "is positive), or the radius in the object file, are wrong"
        )


def _labels(used: Sequence[Used]) -> list[str]:
    """Return the name of each trial's run. If there are several folders, the number of the folder
    precedes the name."""
    folders = list(dict.fromkeys(run_of(entry.trial)[0] for entry in used))
    several = len(folders) > 1
    return [
        (f"{folders.index(folder) + 1}." if several else "") + str(run)
        for folder, run in (run_of(entry.trial) for entry in used)
    ]


def _inconsistent(used: Sequence[Used], slide: SlideFit) -> dict[int, LeftOut]:
    """Find outliers, such as trials disturbed by a hand or by a bump in the table."""
    own = np.log(slide.own_friction)
    centred = own - np.median(own)
    width = max(1.4826 * float(np.median(np.abs(centred))), _MIN_FRICTION_SPREAD)
    width_each = np.maximum(width, np.nan_to_num(slide.own_friction_std, posinf=1.0))
    usual = max(float(np.median(slide.misfit)), 1.0)
    found: dict[int, LeftOut] = {}
    for index, entry in enumerate(used):
        reason = ""
        if abs(centred[index]) > _OUTLIER * width_each[index]:
            reason = (
                f"its friction differs by {100 * math.expm1(centred[index]):+.0f} % from that of "
                "the other trials"
            )
        elif slide.misfit[index] > _MISFIT * usual:
            what = "track" if entry.motion.slide is not None else "initial velocity"
            times = slide.misfit[index] / usual
            reason = f"the residual of its {what} is {times:.0f} times the usual residual"
        if reason:
            sentence = f"the object does not slide as in the other trials: {reason}"
            found[index] = entry.trial.left_out("disturbed", sentence)
    if len(found) > _MAX_OUTLIERS * len(used):
        raise RecordError(
            f"{len(found)} of {len(used)} trials are inconsistent with the others. The first is "
            f"{next(iter(found.values()))}. The records may contain several objects or "
            "tables, or wrong units; fit them separately"
        )
    return found


def _striker(experiments: Sequence[Experiment]) -> Striker | None:
    strikers = {e.header.striker.striker() for e in experiments if e.header.striker is not None}
    if len(strikers) > 1:
        raise RecordError("the experiments were made with different strikers; fit them separately")
    return next(iter(strikers), None)


def predict(fit: ObjectFit, experiments: Sequence[Experiment]) -> tuple[RunErrors, ...]:
    """Compute the relative errors of the fit's predictions for each run of ``experiments``. These
    experiments must not have been used in the fit.

    Raises:
        RecordError: the records cannot be used.
    """
    body = fit.content.body()
    new = _unseen(fit, experiments)
    by_sliding = _slid(new.measured, fit.slide, body)
    by_tapping = _tapped(new.used, fit.slide, new.impacts, body)
    return run_errors(_labels(new.used), new.measured, by_sliding, by_tapping)


class _Unseen(NamedTuple):
    """Trials that were not used in a fit, their launches, and their strikes with the fitted impact
    model. The last item is None if the impact was not fitted or no ``experiment.yaml`` describes
    the striker."""

    used: tuple[Used, ...]
    measured: Launches
    impacts: _Impacts | None


def _unseen(fit: ObjectFit, experiments: Sequence[Experiment]) -> _Unseen:
    body = fit.content.body()
    used, _ = screen(experiments, body, GRAVITY)
    own = _fit_slides(used, body)
    striker = _striker(experiments)
    impacts = None
    if fit.impact is not None and striker is not None:
        strikes, known = _strikes(used, own, body)
        rows = np.flatnonzero(known)
        model = ImpactModel(strikes.of(rows), body, striker, dict(fit.impact.values))
        impacts = _Impacts(fit.impact, model, rows)
    return _Unseen(used, _measured(used, own), impacts)


def _measured(used: Sequence[Used], slide: SlideFit) -> Launches:
    return Launches(
        slide.speed,
        slide.spin,
        np.array([entry.motion.displacement for entry in used]),
        np.array([entry.motion.rotation for entry in used]),
    )


class _Impacts(NamedTuple):
    """Fit of the impact, its model, and the indices of the fitted trials."""

    fit: ImpactFit
    model: ImpactModel
    rows: NDArray[np.intp]


def _fit_impact(
    used: Sequence[Used],
    slide: SlideFit,
    content: ObjectFile,
    striker: Striker | None,
    sentences: list[str],
) -> _Impacts | None:
    if striker is None:
        sentences.append("No experiment.yaml describes the striker, so the impact is not fitted.")
        return None
    body = content.body()
    strikes, known = _strikes(used, slide, body)
    rows = np.flatnonzero(known)
    if rows.size < len(used):
        sentences.append(
            f"{len(used) - rows.size} of {len(used)} trials have no striker speed, incidence "
            "or (for polygons) contact angle: the impact is "
            + ("fitted without them." if rows.size >= MIN_TRIALS else "not fitted.")
        )
    if rows.size < MIN_TRIALS:
        return None
    # A new fit starts from the model's own constants, not from the scales of the previous fit.
    old = {"restitution": content.restitution, "contact_friction": content.contact_friction}
    scales = {"scale_b1": 1.0, "scale_b2": 1.0, "scale_b3": 1.0}
    model = ImpactModel(strikes.of(rows), body, striker, old | scales)
    return _Impacts(fit_impact(model), model, rows)


def _strikes(
    used: Sequence[Used], slide: SlideFit, body: Body
) -> tuple[Strikes, NDArray[np.bool_]]:
    def of_trials(name: str) -> Array:
        return np.array([getattr(entry.trial, name) for entry in used])

    def of_headers(name: str) -> Array:
        return np.array([getattr(entry.header, name) for entry in used])

    commanded, seen = of_trials("striker_speed"), of_trials("striker_speed_measured")
    speed = np.where(np.isnan(seen), commanded, seen)
    given, share = of_trials("striker_speed_std"), of_headers("striker_speed_std")
    contact_angle = of_trials("contact_angle")
    local, inward = contact_frame(body, contact_angle)
    launched = of_trials("direction") - of_trials("start_theta")
    angle = np.remainder(launched - inward + math.pi, math.tau) - math.pi
    place, turn = of_headers("rest_position_std"), of_headers("rest_rotation_std")
    distance = np.array([entry.motion.displacement for entry in used])
    incidence = of_trials("incidence")
    strikes = Strikes(
        speed=speed,
        speed_std=np.where(np.isnan(given), share * speed, given),
        incidence=incidence,
        contact=local,
        launch_speed=slide.speed,
        launch_speed_std=slide.speed_std,
        spin=slide.spin,
        spin_std=slide.spin_std,
        angle=angle,
        angle_std=np.hypot(turn, place * np.hypot(1 / distance, 1 / body.bounding_radius)),
    )
    known = np.isfinite(speed + incidence)
    if isinstance(body, Polygon):
        known &= np.isfinite(contact_angle)
    return strikes, known


def _speed_known(used: Sequence[Used]) -> float:
    """Return the relative standard deviation of the factor common to all striker speeds; inf if
    some speeds were not measured."""
    measured = [not math.isnan(entry.trial.striker_speed_measured) for entry in used]
    if not all(measured):
        return math.inf
    return max(entry.header.striker_speed_std for entry in used) / math.sqrt(len(used))


def _slid(measured: Launches, slide: SlideFit, body: Body) -> Launches:
    """Predict displacements from measured velocities, and velocities from measured
    displacements."""
    curves = SlideCurves(body, GRAVITY)
    log_factor = math.log(slide.torque_factor)
    distance, rotation = _rest(curves, slide, measured.speed, measured.spin)
    speed, spin = curves.launch(measured.distance, measured.rotation, slide.friction, log_factor)
    return Launches(speed, spin, distance, rotation)


def _rest(curves: SlideCurves, slide: SlideFit, speed: Array, spin: Array) -> tuple[Array, Array]:
    rows = np.arange(speed.size)
    friction = np.full(speed.size, slide.friction)
    state, _ = curves.at(
        (speed, spin), np.full(speed.size, math.inf), rows, friction, math.log(slide.torque_factor)
    )
    return state.distance, state.rotation


def _tapped(
    used: Sequence[Used], slide: SlideFit, impacts: _Impacts | None, body: Body
) -> Launches:
    """Predict velocities and displacements from the striker's speed and the incidence alone."""
    columns = np.full((4, len(used)), math.nan)
    if impacts is not None:
        launch = impacts.model.launch(impacts.fit.values)
        speed, spin = launch[:, 0], launch[:, 0] * launch[:, 1]
        curves = SlideCurves(body, GRAVITY)
        columns[:, impacts.rows] = speed, spin, *_rest(curves, slide, speed, spin)
    return Launches(*columns)


def _taps(
    used: Sequence[Used],
    labels: Sequence[str],
    measured: Launches,
    tapped: Launches,
    rows: NDArray[np.intp],
) -> Taps:
    trials = [used[row].trial for row in rows]
    return Taps(
        measured.of(rows),
        tapped.of(rows),
        [labels[row] for row in rows],
        np.array([trial.contact_angle for trial in trials]),
        np.array([trial.direction for trial in trials]),
    )


def _inflation(misfits: Sequence[Misfit]) -> float:
    """Return the factor by which intervals are widened if the runs do not fit the model (Birge
    1932). In this case the runs, not the single taps, count as independent samples.
    """
    ratios = [misfit.inflation for misfit in misfits if misfit.cause == "setting"]
    return math.sqrt(max([1.0, *ratios]))


def _prediction_sentence(errors: Sequence[ModelError]) -> list[str]:
    if not errors:
        return []
    widths = " and ".join(
        f"{100 * entry.half_width:.0f} % of the predicted {entry.quantity}" for entry in errors
    )
    return [
        "For 95 % of new taps with settings in the range of these runs, the prediction error is at "
        f"most {widths}."
    ]


def _slide_sentences(
    slide: SlideFit, estimates: Sequence[Estimate], labels: Sequence[str], slide_radius: float
) -> list[str]:
    total = slide.information.sum(axis=0)
    covariance = np.linalg.inv(total)
    correlation = covariance[0, 1] / math.sqrt(covariance[0, 0] * covariance[1, 1])
    sentences = []
    if abs(correlation) > _CORRELATED:
        sentences.append(
            f"Friction and torque factor are strongly correlated (correlation {correlation:.2f})."
        )
    offsets = slide.pressure_centre
    deviations = slide_radius * np.sqrt(np.diag(covariance)[2:])
    if any(abs(c) > 3 * d for c, d in zip(offsets, deviations, strict=True)):
        x, y = (1e3 * offset for offset in offsets)
        sentences.append(
            f"The object's centre of pressure is off its middle by ({x:+.2f}, {y:+.2f}) mm in "
            "its own frame, so its rotation depends on the direction of sliding. The "
            "fit accounts for this; the planner does not."
        )
    torque = next(entry for entry in estimates if entry.name == "torque_factor")
    names = np.array(labels)
    each = {
        label: float(np.mean(slide.information[names == label, 1, 1]))
        for label in dict.fromkeys(labels)
    }
    best = max(each, key=each.__getitem__)
    share = (torque.high - torque.low) / (2 * torque.value)
    if share > 0.05:
        more = 10 * each[best]
        after = share * math.sqrt(float(total[1, 1]) / (float(total[1, 1]) + more))
        sentences.append(
            f"The uncertainty of the torque factor is {100 * share:.0f} %. Ten more taps like "
            f"those of run {best}, the most informative run, would reduce it to "
            f"{100 * after:.0f} %. Taps that rotate the object by more than those of "
            f"run {best} are even more informative."
        )
    return sentences


def _tapper_sentences(used: Sequence[Used]) -> list[str]:
    """Report a striker speed that differs significantly from the commanded speed."""
    pairs = np.array([(t.trial.striker_speed_measured, t.trial.striker_speed) for t in used])
    ratios = pairs[np.isfinite(pairs).all(axis=1)]
    if len(ratios) < MIN_TRIALS:
        return []
    off = np.log(ratios[:, 0] / ratios[:, 1])
    mean, standard_error = float(off.mean()), float(off.std(ddof=1)) / math.sqrt(len(off))
    if abs(mean) < max(_MIN_SPEED_ERROR, 3.0 * standard_error):
        return []
    return [
        "The striker's speed differs from the commanded speed by "
        f"{100 * math.expm1(mean):+.1f} %. The fit accounts for this, but the planner does not: "
        f"its distances deviate by {100 * math.expm1(2 * mean):+.0f} % until `calibrate tapper` "
        "has measured the tapper's curve."
    ]


def _tapper(used: Sequence[Used]) -> tuple[SpeedPoint, ...]:
    """Compute the measured striker speed for each draw of the spring, or for each commanded
    speed."""
    settings: dict[tuple[float, float], list[float]] = {}
    for entry in used:
        trial = entry.trial
        if math.isfinite(trial.striker_speed_measured):
            draw = -1.0 if math.isnan(trial.draw) else trial.draw
            key = (draw, round(trial.striker_speed, 6) if draw < 0 else -1.0)
            settings.setdefault(key, []).append(trial.striker_speed_measured)
    return tuple(
        SpeedPoint(
            math.nan if draw < 0 else draw,
            math.nan if commanded < 0 else commanded,
            float(np.mean(speeds)),
            float(np.std(speeds, ddof=1)) if len(speeds) > 1 else math.nan,
            len(speeds),
        )
        for (draw, commanded), speeds in sorted(settings.items())
    )
