"""The designed single-tap experiment: which taps, which way each, and what became of one.

A run is one striker speed with one incidence, tapped again and again (section 3.1 of the paper has
four runs of ten trials). Small incidences stick and tell the impact's constants, large ones slide
through and tell the contact friction; two speeds tell what depends on speed from what does not.
Where the object starts and how it lies is varied on purpose: near the middle of the table it is
sent out along a fan of directions, from anywhere else back towards the middle. So each pair of
trials goes there and back, what the table's tilt adds to one it takes from the other, and the
object needs no bringing back between trials.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import yaml

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.experiment import ExperimentFile
from tapping_cell.calibration.track import TrackProblem, slide_of
from tapping_cell.calibration.trials import Trial
from tapping_cell.configuration.schema import ConfigurationError, load, quantity
from tapping_cell.mechanics import Tap
from tapping_cell.se2 import Pose

DESIGN_FILE = "design.yaml"

SPEEDS = (0.75, 1.1)
"""Striker speeds in m/s: the paper's disk travels 30 to 100 mm, 6 to 12 pictures at 30 Hz."""
INCIDENCES = (math.radians(20.0), math.radians(-45.0))
"""One that sticks and one that slides through, for contact frictions about 0.2; one to each side,
so that the object does not wind up and a steady error of the arm's angle averages out."""
TRIALS = 10

NEAR_MIDDLE = 0.030
"""Distance from the table's middle, m, within which a trial goes outward."""
FAN = math.radians(137.507764)
"""Golden angle: any number of directions stepped by it are spread evenly."""
ATTEMPTS = 2
"""Trials made for each that is wanted, before a run is given up."""
MISSED = 0.1
"""A tap that moved the object by less than this share of the expected has missed it."""

USUAL_RATE_HZ = 30.0

_ONE_TAP = {"missed": "missed", "disturbed": "disturbed"}


@dataclass(frozen=True, slots=True)
class Run:
    """One run: ``striker_speed`` in m/s, ``incidence`` in rad, numbered from 1."""

    number: int
    striker_speed: float
    incidence: float


@dataclass(frozen=True, slots=True)
class Design:
    """Every speed with every incidence, ``trials`` times; kept as ``design.yaml``."""

    speeds: tuple[float, ...] = quantity(
        "striker speeds of the runs", "m/s", 0.01, 20.0, default=SPEEDS
    )
    incidences: tuple[float, ...] = quantity(
        "incidences of the runs", "rad", -math.pi / 2, math.pi / 2, default=INCIDENCES
    )
    trials: int = quantity("trials of each run", "", 1, 1000, default=TRIALS)
    seed: int = quantity("of a simulated world", "", 0, 2**31 - 1, default=1)

    def __post_init__(self) -> None:
        for name in ("speeds", "incidences"):
            values = getattr(self, name)
            if not values:
                raise ValueError(f"'{name}' is empty; give at least one")
            if len(set(values)) != len(values):
                raise ValueError(f"'{name}' holds a value twice; raise 'trials' instead")

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs in the order in which they are made."""
        every = itertools.product(self.speeds, self.incidences)
        return tuple(Run(number, *both) for number, both in enumerate(every, start=1))


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is: trials that can be used, and all that were made."""

    used: int
    made: int


def progress(design: Design, trials: Iterable[Trial]) -> dict[int, Progress]:
    """How far each run of a design is, by number."""
    made: Counter[int] = Counter()
    used: Counter[int] = Counter()
    for trial in trials:
        made[trial.run] = max(made[trial.run], trial.trial)
        used[trial.run] += trial.outcome == "ok"
    return {run.number: Progress(used[run.number], made[run.number]) for run in design.runs}


def given_up(design: Design, far: Progress) -> bool:
    """Whether a run has had its attempts."""
    return far.made >= ATTEMPTS * design.trials and far.used < design.trials


def travel_direction(place: Pose, number: int) -> float:
    """Direction, rad in ``table``, in which a trial should send the object from ``place``.

    ``number`` counts the trials of the whole experiment.
    """
    if math.hypot(place.x, place.y) > NEAR_MIDDLE:
        return math.atan2(-place.y, -place.x)
    return math.remainder(number * FAN, math.tau)


def contact_of(tap: Tap, start: Pose, tip: Pose, striker_speed: float) -> tuple[float, float]:
    """Incidence and contact angle (rad) of a tip at rest at ``tip``; NaN where it would miss."""
    hit = tap.strike(start, tip, striker_speed)
    if bool(hit.missed):
        return math.nan, math.nan
    x, y = (hit.point - [start.x, start.y]).tolist()
    return float(hit.incidence), math.remainder(math.atan2(y, x) - start.theta, math.tau)


def judged(trial: Trial, header: ExperimentFile, expected: float) -> Trial:
    """The trial with its outcome: whether one tap, seen from rest to rest, did all that was done.

    ``expected``: distance in m that the tap should have made. A trial that was lost already (no
    pose after it) stays so.
    """
    if trial.outcome == "lost":
        return trial
    moved = math.hypot(trial.end_x - trial.start_x, trial.end_y - trial.start_y)
    if moved < MISSED * expected:
        return replace(
            trial,
            outcome="missed",
            note=f"moved {1000 * moved:.2f} mm where {1000 * expected:.1f} mm were expected",
        )
    rate = trial.camera_rate_hz
    if not math.isfinite(rate):
        rate = header.camera_rate_hz or USUAL_RATE_HZ
    found = slide_of(
        trial, header.track_position_std, header.track_rotation_std, rate, header.exposure
    )
    if isinstance(found, TrackProblem):
        return replace(
            trial,
            outcome=_ONE_TAP.get(found.reason, "lost"),
            note=f"{found.reason}: {found.sentence}",
        )
    return trial


def write_design(folder: Path, design: Design) -> None:
    """Keep the design in an experiment's folder, made if missing.

    Raises:
        RecordError: there is one already.
        OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    content = {key: _plain(value) for key, value in asdict(design).items()}
    try:
        with (folder / DESIGN_FILE).open("x", encoding="utf-8") as stream:
            yaml.safe_dump(content, stream, sort_keys=False, default_flow_style=None)
    except FileExistsError as error:
        raise RecordError(
            f"{folder} holds an experiment already; go on with it (--resume), or take another "
            "folder"
        ) from error


def read_design(folder: Path) -> Design:
    """The design of an experiment's folder.

    Raises:
        RecordError: there is none, or it cannot be read.
    """
    file = folder / DESIGN_FILE
    if not file.is_file():
        raise RecordError(
            f"{folder} holds no {DESIGN_FILE}: no experiment of single-tap began there"
        )
    try:
        return load(Design, file)
    except ConfigurationError as error:
        raise RecordError(str(error)) from error


def _plain(value: object) -> object:
    return list(value) if isinstance(value, Sequence) else value
