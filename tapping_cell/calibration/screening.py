"""Selection of the trials that a fit may use.

Invalid and doubtful trials are rejected with file, row and reason. A file is rejected if most of
its rows are invalid.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import Experiment, ExperimentFile
from tapping_cell.calibration.sliding_fit import Motion
from tapping_cell.calibration.track import Rejection, slide_of
from tapping_cell.calibration.trials import LeftOut, Trial
from tapping_cell.mechanics import Body

MIN_RUNS = 2
MIN_IN_RUN = 3
MIN_TRIALS = 8
_MIN_MOTION = 0.0002  # m
_MIN_SPEED = 0.02  # m/s; at a friction of 0.2 the object slides 0.1 mm
_FRICTION = (0.005, 5.0)
# Plausible range of the ratio 2 (spin / speed) / (rotation / distance), with spin and speed at
# launch. The ratio is about 1 + gamma kappa / 4. The range contains the ratios of all torque
# factors kappa of up to 20, with a tolerance for noise.
_SPIN_GAIN = (0.3, 30.0)
# range of launch speed over striker speed; the ratio is 2 for an elastic impact of a heavy striker
_STRIKER_GAIN = (0.01, 2.5)
_RATE = (0.5, 2.0)
_SPEED_SHARE, _SPIN_SHARE = 0.03, 0.08  # default relative standard deviations
_OTHER_NOISE = 6.0  # standard deviations
_TRACK_POINTS = 2


class Used(NamedTuple):
    """A usable trial, its slide, and the header of its experiment."""

    trial: Trial
    motion: Motion
    header: ExperimentFile


class Screened(NamedTuple):
    """Usable and rejected trials."""

    used: tuple[Used, ...]
    left_out: tuple[LeftOut, ...]


def screen(experiments: Sequence[Experiment], body: Body, gravity: float) -> Screened:
    """Select the usable trials of all experiments. Runs of different folders remain separate.

    Raises:
        RecordError: most rows of a file have wrong units, or too few trials or runs are left.
    """
    used: list[Used] = []
    left_out: list[LeftOut] = []
    for experiment in experiments:
        left_out.extend(experiment.left_out)
        wrong: Counter[str] = Counter()
        total: Counter[str] = Counter()
        first: dict[str, LeftOut] = {}
        for trial in experiment.trials:
            total[trial.file] += 1
            found = _judge(trial, experiment.header, body, gravity)
            if isinstance(found, Motion):
                used.append(Used(trial, found, experiment.header))
                continue
            row = trial.left_out(*found)
            left_out.append(row)
            if found.reason == "units" or (found.reason == "missed" and trial.outcome == "ok"):
                wrong[trial.file] += 1
                first.setdefault(trial.file, row)
        for file, count in wrong.items():
            if count > total[file] / 2:
                raise RecordError(
                    f"{file}: in {count} of {total[file]} rows the units are wrong or the object "
                    f"hardly moved. The first of them is row {first[file].row} "
                    f"({first[file].reason}): {first[file].sentence}"
                )
    return enough(used, left_out)


def enough(used: Sequence[Used], left_out: Sequence[LeftOut]) -> Screened:
    """Remove runs with too few trials.

    Raises:
        RecordError: too few trials or runs are left.
    """
    sizes = Counter(run_of(entry.trial) for entry in used)
    kept, dropped = [], list(left_out)
    for entry in used:
        size = sizes[run_of(entry.trial)]
        if size >= MIN_IN_RUN:
            kept.append(entry)
            continue
        sentence = (
            f"run {entry.trial.run} has {size} usable trials; at least {MIN_IN_RUN} are needed"
        )
        dropped.append(entry.trial.left_out("short run", sentence))
    runs = {run_of(entry.trial) for entry in kept}
    if len(runs) < MIN_RUNS or len(kept) < MIN_TRIALS:
        reasons = "; ".join(str(row) for row in dropped[:3])
        raise RecordError(
            f"{len(kept)} usable trials in {len(runs)} runs are too few for a fit; at least "
            f"{MIN_TRIALS} trials are needed, in at least {MIN_RUNS} runs of at least "
            f"{MIN_IN_RUN} usable trials each"
            + (f". Left out: {reasons}" + (" ..." if len(dropped) > 3 else "") if dropped else "")
        )
    return Screened(tuple(kept), tuple(dropped))


def run_of(trial: Trial) -> tuple[str, int]:
    """Return the key of a trial's run: its folder and its number."""
    return trial.file.rpartition("/")[0], trial.run


def _judge(trial: Trial, header: ExperimentFile, body: Body, gravity: float) -> Motion | Rejection:
    """Return the trial's slide, or the reason for its rejection."""
    if trial.outcome != "ok":
        return Rejection(trial.outcome, f"the recorded outcome is '{trial.outcome}'")
    if not math.isfinite(trial.displacement + trial.rotation):
        if trial.track is not None:
            return _from_track(trial, header, math.inf, math.inf, gravity)
        return Rejection(
            "not measured",
            "displacement or rotation is missing; give both, or the poses before and after the tap",
        )
    spread = _or(trial.displacement_std, math.sqrt(2) * header.rest_position_std)
    turn_spread = _or(trial.rotation_std, math.sqrt(2) * header.rest_rotation_std)
    rejection = _against_poses(trial, spread, turn_spread)
    if rejection is not None:
        return rejection
    # A high initial speed without displacement indicates a wrong unit, not a miss. This case is
    # handled below.
    still = not trial.initial_speed > _MIN_SPEED
    if still and trial.displacement < max(_MIN_MOTION, _OTHER_NOISE * spread):
        return Rejection(
            "missed", f"the object moved by only {1e3 * trial.displacement:.3g} mm: a miss"
        )
    radius, gamma = body.support_radius, body.gamma
    if radius * abs(trial.rotation) > 3 * gamma * trial.displacement:
        return Rejection(
            "units",
            f"a rotation of {trial.rotation:.4g} rad over {trial.displacement:.4g} m is "
            "larger than a tap can give; check that rotation_rad is in rad (not in degrees) and "
            "displacement_m in m (not in mm)",
        )
    if math.isfinite(trial.initial_speed + trial.initial_spin):
        return _from_velocities(trial, spread, turn_spread, body, gravity)
    if trial.track is None:
        return Rejection(
            "no velocity", "neither the initial velocities nor a track of poses are given"
        )
    return _from_track(trial, header, spread, turn_spread, gravity)


def _against_poses(trial: Trial, spread: float, turn_spread: float) -> Rejection | None:
    """Check that displacement and rotation agree with the poses, if all are given."""
    by_poses = math.hypot(trial.end_x - trial.start_x, trial.end_y - trial.start_y)
    off = abs(by_poses - trial.displacement)
    if off > max(_MIN_MOTION, 0.02 * by_poses, _OTHER_NOISE * spread):
        units = max(by_poses, trial.displacement) > 100 * min(by_poses, trial.displacement)
        return Rejection(
            "units" if units else "inconsistent",
            f"displacement_m is {trial.displacement:.4g}, but the start and end poses are "
            f"{by_poses:.4g} m apart" + ("; is one of them in mm?" if units else ""),
        )
    turned = trial.end_theta - trial.start_theta - trial.rotation
    turned = abs(math.remainder(turned, math.tau)) if math.isfinite(turned) else 0.0
    if turned > max(0.005, 0.02 * abs(trial.rotation), _OTHER_NOISE * turn_spread):
        return Rejection(
            "inconsistent",
            f"rotation_rad is {trial.rotation:.4g}, but the start and end poses differ by "
            f"{trial.end_theta - trial.start_theta:.4g} rad; is one of them in degrees?",
        )
    return None


def _from_velocities(
    trial: Trial, spread: float, turn_spread: float, body: Body, gravity: float
) -> Motion | Rejection:
    speed, spin, distance = trial.initial_speed, trial.initial_spin, trial.displacement
    friction = speed**2 / (2 * gravity * distance)
    if not _FRICTION[0] < friction < _FRICTION[1]:
        return Rejection(
            "units",
            f"initial_speed {speed:.4g} m/s with a displacement of {distance:.4g} m implies a "
            f"friction of {friction:.3g}; {_remedy(speed, distance, gravity)}",
        )
    striker = _or(trial.striker_speed_measured, trial.striker_speed)
    if not _STRIKER_GAIN[0] < _or(speed / striker, 1.0) < _STRIKER_GAIN[1]:
        return Rejection(
            "units",
            f"initial_speed is {speed:.4g} m/s after a tap at a striker speed of {striker:.4g} "
            "m/s; is one of them in mm/s?",
        )
    radius = body.support_radius
    fastest = speed * body.bounding_radius / body.radius_of_gyration**2
    if abs(spin) > 1.5 * fastest:
        return Rejection(
            "units",
            f"initial_spin is {spin:.4g} rad/s at {speed:.4g} m/s, more than the {fastest:.4g} "
            "rad/s that an impulse at the rim gives; is it in degrees/s, or the speed in other "
            "units?",
        )
    spin_std = _or(trial.initial_spin_std, max(_SPIN_SHARE * abs(spin), 0.03 * speed / radius))
    noise = _OTHER_NOISE * spin_std
    if abs(trial.rotation) > _OTHER_NOISE * turn_spread + 0.005 and abs(spin) > 2 * noise:
        gain = 2 * distance * spin / (speed * trial.rotation)
        if gain < 0:
            return Rejection("disturbed", "initial_spin and rotation have different signs")
        if not _SPIN_GAIN[0] < gain < _SPIN_GAIN[1]:
            return Rejection(
                "units",
                f"initial_spin {spin:.4g} rad/s does not fit a rotation of {trial.rotation:.4g} "
                "rad; is one of them in degrees?",
            )
    return Motion(
        displacement=distance,
        rotation=trial.rotation,
        displacement_std=spread,
        rotation_std=turn_spread,
        heading=trial.direction - trial.start_theta - trial.rotation / 2,
        speed=speed,
        spin=spin,
        speed_std=_or(trial.initial_speed_std, _SPEED_SHARE * speed),
        spin_std=spin_std,
    )


def _remedy(speed: float, distance: float, gravity: float) -> str:
    """Suggest the columns for which another unit would give a plausible friction."""
    for text, v, x in (
        ("is initial_speed_m_s in mm/s?", 1e-3, 1.0),
        ("is displacement_m in mm?", 1.0, 1e-3),
        ("are initial_speed_m_s and displacement_m in mm/s and mm?", 1e-3, 1e-3),
        ("is initial_speed_mm_s in m/s?", 1e3, 1.0),
        ("is displacement_mm in m?", 1.0, 1e3),
        ("are initial_speed_mm_s and displacement_mm in m/s and m?", 1e3, 1e3),
    ):
        friction = (v * speed) ** 2 / (2 * gravity * x * distance)
        if 0.02 < friction < 2.0:
            return text
    return "check the units of both columns"


def _from_track(
    trial: Trial, header: ExperimentFile, spread: float, turn_spread: float, gravity: float
) -> Motion | Rejection:
    assert trial.track is not None
    time = trial.track.time
    own_rate = 1.0 / float(np.median(np.diff(time))) if time.size > 1 else math.nan
    rate = _or(trial.camera_rate_hz, header.camera_rate_hz or own_rate)
    if not _RATE[0] < _or(own_rate / rate, 1.0) < _RATE[1]:
        return Rejection(
            "units",
            f"the track has {own_rate:.4g} samples per second, but the camera has a rate of "
            f"{rate:.4g} Hz; is t_s in ms?",
        )
    slide = slide_of(
        trial, header.track_position_std, header.track_rotation_std, rate, header.exposure
    )
    if isinstance(slide, Rejection):
        return slide
    # If displacement or rotation is not recorded, the value between the two ends of the track is
    # used.
    displacement, rotation = (
        _or(trial.displacement, slide.displacement),
        _or(trial.rotation, slide.turned),
    )
    off = abs(slide.displacement - displacement)
    if off > max(_MIN_MOTION, 0.03 * displacement, _OTHER_NOISE * spread):
        units = off > 100 * min(slide.displacement, displacement)
        return Rejection(
            "units" if units else "disturbed",
            f"the track ends {1e3 * slide.displacement:.4g} mm from its start, but the poses at "
            f"rest are {1e3 * displacement:.4g} mm apart"
            + ("; is one of them in mm?" if units else "; was the object moved by hand?"),
        )
    if slide.moving < _TRACK_POINTS:
        return Rejection(
            "short slide",
            f"only {slide.moving} samples of the track show the object sliding; tap harder, or use "
            "a faster camera",
        )
    friction = slide.deceleration / gravity
    if slide.moving > _TRACK_POINTS and not _FRICTION[0] < friction < _FRICTION[1]:
        return Rejection(
            "units",
            f"the object decelerates by {slide.deceleration:.3g} m/s^2 in the track, which implies "
            f"a friction of {friction:.3g}; are x_m and y_m in mm, or t_s in ms?",
        )
    return Motion(
        displacement=displacement,
        rotation=rotation,
        displacement_std=spread,
        rotation_std=turn_spread,
        slide=slide,
        heading=slide.heading,
    )


def _or(value: float, other: float) -> float:
    return other if math.isnan(value) else value
