"""Records of single-tap experiments: plain CSV files that can also be written by other tools.

A folder is one experiment::

    experiment.yaml               header for all trials (see ``experiment.py``)
    run_01.csv, run_02.csv, ...   one row per trial; or one trials.csv with a column ``run``
    tracks/run_01_trial_03.csv    poses of the object over time, one file per trial (optional)

The first line names the columns with their units: ``displacement_m`` or ``displacement_mm``. An
empty cell means that the value was not measured. ``docs/objects.md`` describes the columns. In
memory, all values are in SI units, and NaN means that the value was not measured.
"""

from __future__ import annotations

import csv
import math
import os
import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tapping_cell.calibration.csv_table import Column, RecordError, read_csv
from tapping_cell.se2 import Array

TRACK_FOLDER = "tracks"
OUTCOMES = ("ok", "missed", "disturbed", "lost")
"""Outcomes of a trial. ``ok``: the tap hit, and the object was measured before and after it.
``missed``: the striker missed. ``disturbed``: something else moved the object. ``lost``: the camera
lost the object. Fits use only the trials with the outcome ``ok``."""

# rad; most angles that are given in degrees by mistake exceed this limit or contradict other
# columns
_TURNS = 100.0


def measured(unit: str, low: float, high: float) -> Any:
    """Declare a field of a trial as an optional column with its SI unit and range."""
    return field(default=math.nan, metadata={"unit": unit, "minimum": low, "maximum": high})


TRACK_COLUMNS: tuple[Column, ...] = (
    Column("t", "s"),
    Column("x", "m", -5.0, 5.0),
    Column("y", "m", -5.0, 5.0),
    Column("theta", "rad", -_TURNS, _TURNS),
    Column("position_std", "m", 0.0, 0.1, required=False),
    Column("rotation_std", "rad", 0.0, 1.0, required=False),
)
_POSES = ("start_x", "start_y", "start_theta", "end_x", "end_y", "end_theta")
_COUNT = 100_000


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Poses of the object over time: arrays (n,), SI units, angles unwrapped.

    ``time`` is the middle of the exposure, with an arbitrary origin. The standard deviations are
    those of the position along one axis (m) and of the angle (rad), NaN if unknown.
    """

    time: Array
    x: Array
    y: Array
    theta: Array
    position_std: Array
    rotation_std: Array


@dataclass(frozen=True, slots=True)
class Trial:
    """One tap. SI; NaN if not measured. ``docs/objects.md`` describes the fields.

    ``striker_speed`` is the commanded speed. ``incidence`` is the angle from the contact normal
    (into the object) to the striker's axis. ``contact_angle`` is the direction from the centre of
    mass to the contact point in the object frame, and ``direction`` is the direction of travel in
    table axes. ``file`` and ``row`` are the source of the record.

    The ranges cover any conceivable tapping cell. ``screening`` detects values that are within
    these ranges but contradict the rest of their row.
    """

    run: int
    trial: int
    outcome: str = "ok"
    striker_speed: float = measured("m/s", 0.001, 20.0)
    striker_speed_measured: float = measured("m/s", 0.001, 20.0)
    striker_speed_std: float = measured("m/s", 0.0, 5.0)
    draw: float = measured("m", 0.0, 0.5)
    incidence: float = measured("rad", -math.pi / 2, math.pi / 2)
    contact_angle: float = measured("rad", -7.0, 7.0)
    start_x: float = measured("m", -5.0, 5.0)
    start_y: float = measured("m", -5.0, 5.0)
    start_theta: float = measured("rad", -_TURNS, _TURNS)
    end_x: float = measured("m", -5.0, 5.0)
    end_y: float = measured("m", -5.0, 5.0)
    end_theta: float = measured("rad", -_TURNS, _TURNS)
    displacement: float = measured("m", 0.0, 3.0)
    rotation: float = measured("rad", -_TURNS, _TURNS)
    direction: float = measured("rad", -7.0, 7.0)
    displacement_std: float = measured("m", 0.0, 0.1)
    rotation_std: float = measured("rad", 0.0, 1.0)
    initial_speed: float = measured("m/s", 0.0, 20.0)
    initial_speed_std: float = measured("m/s", 0.0, 5.0)
    initial_spin: float = measured("rad/s", -1000.0, 1000.0)
    initial_spin_std: float = measured("rad/s", 0.0, 100.0)
    camera_rate_hz: float = measured("", 1.0, 100000.0)
    note: str = ""
    track: Track | None = field(default=None, compare=False)
    file: str = field(default="", compare=False)
    row: int = field(default=0, compare=False)

    def left_out(self, reason: str, sentence: str) -> LeftOut:
        """Return the rejection of this trial. The reason is given as a keyword (``reason``) and a
        sentence."""
        return LeftOut(self.file, self.row, reason, sentence)


TRIAL_COLUMNS = tuple(
    Column(entry.name, **entry.metadata, required=False)
    for entry in fields(Trial)
    if entry.metadata
)


class LeftOut(NamedTuple):
    """A rejected row: its file and number, and the reason as a keyword and a sentence."""

    file: str
    row: int
    reason: str
    sentence: str

    def __str__(self) -> str:
        return f"{self.file}, row {self.row} ({self.reason}): {self.sentence}"


class Trials(NamedTuple):
    """The trials of one or more files, and the unreadable rows."""

    trials: tuple[Trial, ...]
    left_out: tuple[LeftOut, ...]


def trial_files(place: Path) -> list[Path]:
    """Return the CSV files with trials in a folder, or the file itself.

    Raises:
        RecordError: there are no such files.
    """
    if place.is_file():
        return [place]
    if not place.is_dir():
        raise RecordError(f"{place}: does not exist; give a folder of records or a CSV file")
    found = sorted([*place.glob("run*.csv"), *place.glob("trials*.csv")])
    if not found:
        raise RecordError(f"{place}: contains no run_NN.csv or trials.csv")
    return found


def read_trials(place: Path | str) -> Trials:
    """Read all trials of a folder, or of one CSV file, with their tracks if there are any.

    Missing displacements, rotations and directions are computed from the poses.

    Raises:
        RecordError: a file or a column is missing, many rows are out of range (wrong units), or a
        trial occurs twice.
    """
    trials: list[Trial] = []
    left_out: list[LeftOut] = []
    for file in trial_files(Path(place)):
        found = _read_file(file)
        trials.extend(found.trials)
        left_out.extend(found.left_out)
    seen: dict[tuple[int, int], Trial] = {}
    for trial in trials:
        first = seen.setdefault((trial.run, trial.trial), trial)
        if first is not trial:
            raise RecordError(
                f"{trial.file}, row {trial.row}: run {trial.run}, trial {trial.trial} is also "
                f"in {first.file}, row {first.row}; give each trial a number of its own"
            )
    return Trials(tuple(trials), tuple(left_out))


def _read_file(file: Path) -> Trials:
    number = re.search(r"(\d+)", file.stem)
    numbering = (
        Column("run", "", 0, _COUNT, required=number is None),
        Column("trial", "", 0, _COUNT),
    )
    table = read_csv(file, (*numbering, *TRIAL_COLUMNS), optional_texts=("outcome", "note"))
    _check_columns(file, set(table.values))
    left_out = [LeftOut(str(f.path), f.row, "unreadable", f.reason) for f in table.faults]
    trials = []
    for k, row in enumerate(table.rows.tolist()):
        values = {name: float(column[k]) for name, column in table.values.items()}
        run, trial = values.pop("run", math.nan), values.pop("trial")
        if math.isnan(run):
            run = float(number.group(1)) if number else 0.0
        labels = {name: column[k] for name, column in table.texts.items() if column[k]}
        try:
            record = completed(
                Trial(int(run), int(trial), **labels, **values, file=str(file), row=row)  # type: ignore[arg-type]
            )
            samples = file.parent / TRACK_FOLDER / track_name(record.run, record.trial)
            if samples.is_file():
                record = replace(record, track=read_track(samples))
        except RecordError as problem:
            left_out.append(LeftOut(str(file), row, "unreadable", str(problem)))
            continue
        trials.append(record)
    return Trials(tuple(trials), tuple(left_out))


def _check_columns(file: Path, have: set[str]) -> None:
    if have.issuperset(("displacement", "rotation")) or have.issuperset(_POSES):
        return
    missing = [name for name in ("displacement", "rotation") if name not in have]
    raise RecordError(
        f"{file}, row 1: no column {' and '.join(missing)}; add displacement_m and rotation_rad "
        "(or _mm, _deg), or the poses start_x_m, start_y_m, start_theta_rad, end_x_m, end_y_m and "
        "end_theta_rad"
    )


def completed(trial: Trial) -> Trial:
    """Return the trial with missing displacement, rotation and direction computed from its poses.

    Raises:
        RecordError: the outcome is not in ``OUTCOMES``.
    """
    if trial.outcome not in OUTCOMES:
        raise RecordError(f"outcome is {trial.outcome!r}; it must be one of {', '.join(OUTCOMES)}")
    across, up = trial.end_x - trial.start_x, trial.end_y - trial.start_y
    turned = trial.end_theta - trial.start_theta
    values = {
        "displacement": math.hypot(across, up),
        "rotation": turned if math.isnan(turned) else math.remainder(turned, math.tau),
        "direction": math.atan2(up, across),
    }
    missing = {name: new for name, new in values.items() if math.isnan(getattr(trial, name))}
    return replace(trial, **missing)  # type: ignore[arg-type]


def read_track(file: Path) -> Track:
    """Read the samples of one trial.

    Raises:
        RecordError: a column is missing, a cell is not a number or is out of range, or time does
            not increase.
    """
    table = read_csv(file, TRACK_COLUMNS)
    if table.faults:
        raise RecordError(str(table.faults[0]))
    time = table.values["t"]
    falls = np.flatnonzero(np.diff(time) <= 0)
    if falls.size:
        raise RecordError(f"{file}, row {table.rows[falls[0] + 1]}: the time does not increase")
    unknown = np.full(time.shape, math.nan)
    return Track(
        time=time,
        x=table.values["x"],
        y=table.values["y"],
        theta=np.asarray(np.unwrap(table.values["theta"]), dtype=float),
        position_std=table.values.get("position_std", unknown),
        rotation_std=table.values.get("rotation_std", unknown),
    )


def run_name(run: int) -> str:
    """Return the name of the file with the trials of a run."""
    return f"run_{run:02d}.csv"


def track_name(run: int, trial: int) -> str:
    """Return the name, in ``TRACK_FOLDER``, of the file with the samples of a trial."""
    return f"run_{run:02d}_trial_{trial:02d}.csv"


def append_trial(folder: Path, trial: Trial) -> None:
    """Write a trial's track, then append the trial to its run's file.

    A crash between these two steps leaves a track without a row. Such a track is ignored, and it is
    overwritten when the trial is repeated. The run's file is replaced atomically, so that a crash
    leaves no empty or incomplete file. ``file`` and ``row`` of the trial are ignored.

    Raises:
        RecordError: the run's file already contains the trial.
        OSError: the folder cannot be written.
    """
    file = folder / run_name(trial.run)
    fresh = not file.exists()
    if not fresh:
        for other in _read_file(file).trials:
            if other.trial == trial.trial:
                raise RecordError(
                    f"{file}, row {other.row}: trial {trial.trial} is already recorded here; "
                    "use a trial number that is not in this file"
                )
    if trial.track is not None:
        (folder / TRACK_FOLDER).mkdir(parents=True, exist_ok=True)
        _write_track(folder / TRACK_FOLDER / track_name(trial.run, trial.trial), trial.track)
    part = file.with_suffix(".part")
    with part.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if fresh:
            writer.writerow(TRIAL_TITLES)
        else:
            kept = file.read_bytes().decode()
            stream.write(kept if kept.endswith("\n") else kept + "\r\n")
        numbers = [_cell(getattr(trial, column.name)) for column in TRIAL_COLUMNS]
        writer.writerow([trial.run, trial.trial, trial.outcome, *numbers, trial.note])
    os.replace(part, file)


def _write_track(file: Path, track: Track) -> None:
    columns = [getattr(track, entry.name).tolist() for entry in fields(Track)]
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow([_title(column) for column in TRACK_COLUMNS])
        writer.writerows([_cell(value) for value in row] for row in zip(*columns, strict=True))


def _title(column: Column) -> str:
    """Return the column's name with its SI unit, for the header."""
    return column.name + ("_" + column.unit.replace("/", "_") if column.unit else "")


def _cell(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))


TRIAL_TITLES = ("run", "trial", "outcome", *map(_title, TRIAL_COLUMNS), "note")
"""Header of a run's file."""
