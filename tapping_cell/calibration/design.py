"""The designed single-tap experiment: its taps, their directions and their outcomes.

A run repeats taps with one striker speed and one incidence (section 3.1 of the paper has four runs
of ten trials). Taps with a small incidence, whose contact sticks, determine the impact constants.
Taps with a large incidence, whose contact slides during the whole impact, determine the contact
friction. Two speeds show which effects depend on the speed. The start pose is varied on purpose: if
the object is in the middle of the table, it is tapped outwards, in a different direction each time;
if it is elsewhere, it is tapped back to the middle. The effect of the table's tilt therefore
cancels in each pair of trials, and an operator does not have to return the object.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import ExperimentFile, write_new
from tapping_cell.calibration.track import Rejection, slide_of
from tapping_cell.calibration.trials import Trial
from tapping_cell.configuration.schema import ConfigurationError, load, quantity
from tapping_cell.mechanics import Tap
from tapping_cell.se2 import Pose

DESIGN_FILE = "design.yaml"

SPEEDS = (0.75, 1.1)
"""Striker speeds in m/s. At these speeds the paper's disk travels 30 to 100 mm, in 6 to 12 frames
of a camera at 30 Hz."""
INCIDENCES = (math.radians(20.0), math.radians(-45.0))
"""One incidence at which the contact sticks and one at which it slides, for contact frictions near
0.2. The signs of the two incidences differ, so that the object's rotations and the effects of a
constant error of the arm's angle cancel over the trials.
"""
TRIALS = 10

NEAR_MIDDLE = 0.030
"""Distance from the table's middle, in m, within which an object is tapped outwards."""
FAN = math.radians(137.507764)
"""Golden angle: steps of this angle give evenly spread directions for any number of trials."""
ATTEMPTS = 2
"""Maximum number of taps per requested trial; a run that needs more taps is abandoned."""
MISSED = 0.1
"""Fraction of the expected displacement below which a tap counts as missed."""

USUAL_RATE_HZ = 30.0

_ONE_TAP = {"missed": "missed", "disturbed": "disturbed"}


@dataclass(frozen=True, slots=True)
class Run:
    """One run, numbered from 1; ``striker_speed`` in m/s, ``incidence`` in rad."""

    number: int
    striker_speed: float
    incidence: float


@dataclass(frozen=True, slots=True)
class Design:
    """Design of ``trials`` taps at every speed with every incidence; stored as ``design.yaml``."""

    speeds: tuple[float, ...] = quantity(
        "striker speeds of the runs", "m/s", 0.01, 20.0, default=SPEEDS
    )
    incidences: tuple[float, ...] = quantity(
        "incidences of the runs", "rad", -math.pi / 2, math.pi / 2, default=INCIDENCES
    )
    trials: int = quantity("trials of each run", "", 1, 1000, default=TRIALS)
    seed: int = quantity("random seed of the simulated world", "", 0, 2**31 - 1, default=1)

    def __post_init__(self) -> None:
        for name in ("speeds", "incidences"):
            values = getattr(self, name)
            if not values:
                raise ValueError(f"'{name}' is empty; give at least one value")
            if len(set(values)) != len(values):
                raise ValueError(f"'{name}' contains a value twice; increase 'trials' instead")

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs in the order of execution."""
        every = itertools.product(self.speeds, self.incidences)
        return tuple(Run(number, *both) for number, both in enumerate(every, start=1))


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run: number of usable trials and of all trials made."""

    used: int
    made: int


def progress(design: Design, trials: Iterable[Trial]) -> dict[int, Progress]:
    """Return the progress of each run of a design, by number."""
    made: Counter[int] = Counter()
    used: Counter[int] = Counter()
    for trial in trials:
        made[trial.run] = max(made[trial.run], trial.trial)
        used[trial.run] += trial.outcome == "ok"
    return {run.number: Progress(used[run.number], made[run.number]) for run in design.runs}


def given_up(design: Design, far: Progress) -> bool:
    """Return whether a run has used all its attempts without reaching the requested number of
    usable trials."""
    return far.made >= ATTEMPTS * design.trials and far.used < design.trials


def travel_direction(place: Pose, number: int) -> float:
    """Return the direction, rad in ``table``, in which a trial should move the object.

    ``place`` is the object's pose, and ``number`` counts the trials of the whole experiment.
    """
    if math.hypot(place.x, place.y) > NEAR_MIDDLE:
        return math.atan2(-place.y, -place.x)
    return math.remainder(number * FAN, math.tau)


def contact_of(tap: Tap, start: Pose, tip: Pose, striker_speed: float) -> tuple[float, float]:
    """Compute the incidence and the contact angle (rad) of a strike on an object at ``start``. The
    tip is at ``tip`` when the strike begins. Both angles are NaN if the strike misses."""
    hit = tap.strike(start, tip, striker_speed)
    if bool(hit.missed):
        return math.nan, math.nan
    x, y = (hit.point - [start.x, start.y]).tolist()
    return float(hit.incidence), math.remainder(math.atan2(y, x) - start.theta, math.tau)


def judged(trial: Trial, header: ExperimentFile, expected: float) -> Trial:
    """Return the trial with the outcome that follows from its motion (see ``trials.OUTCOMES``).

    ``expected`` is the expected displacement in m. The outcome of a lost trial (no pose after the
    tap) is unchanged.
    """
    if trial.outcome == "lost":
        return trial
    moved = math.hypot(trial.end_x - trial.start_x, trial.end_y - trial.start_y)
    if moved < MISSED * expected:
        return replace(
            trial,
            outcome="missed",
            note=f"moved {1000 * moved:.2f} mm; {1000 * expected:.1f} mm was expected",
        )
    rate = trial.camera_rate_hz
    if not math.isfinite(rate):
        rate = header.camera_rate_hz or USUAL_RATE_HZ
    found = slide_of(
        trial, header.track_position_std, header.track_rotation_std, rate, header.exposure
    )
    if isinstance(found, Rejection):
        return replace(
            trial,
            outcome=_ONE_TAP.get(found.reason, "lost"),
            note=f"{found.reason}: {found.sentence}",
        )
    return trial


def write_design(folder: Path, design: Design) -> None:
    """Write the design to an experiment's folder, and create the folder if missing.

    Raises:
        RecordError: the folder already contains a design.
        OSError: the folder cannot be written.
    """
    try:
        write_new(folder / DESIGN_FILE, asdict(design))
    except FileExistsError as error:
        raise RecordError(
            f"{folder} already contains an experiment; continue it (--resume) or choose "
            "another folder"
        ) from error


def read_design(folder: Path) -> Design:
    """Read the design of an experiment's folder.

    Raises:
        RecordError: the folder contains no design, or the design cannot be read.
    """
    file = folder / DESIGN_FILE
    if not file.is_file():
        raise RecordError(
            f"{folder} contains no {DESIGN_FILE}; give the folder of a single-tap experiment"
        )
    try:
        return load(Design, file)
    except ConfigurationError as error:
        raise RecordError(str(error)) from error
