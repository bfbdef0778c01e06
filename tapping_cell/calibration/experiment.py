"""Header of an experiment, valid for all its trials: ``experiment.yaml`` in its folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.calibration.trials import LeftOut, Trial, read_trials
from tapping_cell.configuration.objects import ObjectFile
from tapping_cell.configuration.schema import choice, load, quantity, section, text
from tapping_cell.configuration.yaml_document import format_yaml
from tapping_cell.mechanics import Striker

HEADER_FILE = "experiment.yaml"


@dataclass(frozen=True, slots=True)
class StrikerSection:
    """The striker that made the taps."""

    mass: float = quantity("mass of the striker", "kg", 0.001, 10.0)
    tip_radius: float = quantity("radius of the ball at the tip", "m", 0.0, 0.1)
    constraint: Literal["linear_bearings", "free"] = choice(
        "guidance of the striker", "linear_bearings", "free"
    )

    def striker(self) -> Striker:
        """Return the striker of the mechanical model."""
        return Striker(self.mass, self.tip_radius, self.constraint)


@dataclass(frozen=True, slots=True)
class ExperimentFile:
    """Header of the records. Its standard deviations apply to rows and track samples without
    standard deviations of their own."""

    format: int = quantity("version of the format", "", 1, 1)
    made: str = text("date and time, ISO 8601")
    source: str = choice("origin of the records", "simulated", "hardware", "other")
    description: str = text("free text", default="")
    striker: StrikerSection | None = section(
        "the striker; without it, the impact is not fitted", default=None
    )
    object: ObjectFile | None = section(
        "object file that the planner used; without it, `object fit` needs --object", default=None
    )
    camera_rate_hz: float | None = quantity(
        "frame rate of trials without camera_rate_hz in their row; default: computed from the "
        "times of each track",
        "Hz",
        1.0,
        1e5,
        default=None,
    )
    exposure: float = quantity("exposure time of a frame", "s", 0.0, 0.1, default=0.0)
    rest_position_std: float = quantity(
        "standard deviation of the position at rest along one axis", "m", 0.0, 0.1, default=0.00005
    )
    rest_rotation_std: float = quantity(
        "standard deviation of the angle at rest", "rad", 0.0, 1.0, default=0.0009
    )
    track_position_std: float = quantity(
        "standard deviation of the position of a track sample along one axis",
        "m",
        0.0,
        0.1,
        default=0.0001,
    )
    track_rotation_std: float = quantity(
        "standard deviation of the angle of a track sample", "rad", 0.0, 1.0, default=0.002
    )
    striker_speed_std: float = quantity(
        "relative standard deviation of a measured striker speed", "", 0.0, 0.5, default=0.01
    )


class Experiment(NamedTuple):
    """Records of one folder: header, trials and unreadable rows."""

    folder: Path
    header: ExperimentFile
    trials: tuple[Trial, ...]
    left_out: tuple[LeftOut, ...]


def read_experiment(place: Path | str) -> Experiment:
    """Read the experiment in a folder, or one CSV file with the header in the same folder.

    Without a header file, object and striker are None, and the standard deviations have default
    values.

    Raises:
        RecordError: the records cannot be used (see ``read_trials``).
        ConfigurationError: the header has an unknown key or a value out of range.
    """
    place = Path(place)
    folder = place if place.is_dir() else place.parent
    records = read_trials(place)
    header = ExperimentFile(format=1, made="", source="other")
    if (folder / HEADER_FILE).is_file():
        header = load(ExperimentFile, folder / HEADER_FILE)
    return Experiment(folder, header, *records)


def write_header(folder: Path, header: ExperimentFile) -> None:
    """Write ``experiment.yaml`` into a folder, and create the folder if missing.

    Raises:
        RecordError: the file already exists.
        OSError: the folder cannot be written.
    """
    file = folder / HEADER_FILE
    try:
        write_new(file, asdict(header))
    except FileExistsError as error:
        raise RecordError(f"{file} exists already; resume it or choose another folder") from error


def write_new(file: Path, content: dict[str, Any]) -> None:
    """Write a section to a YAML file, and create its folder if missing.

    Raises:
        FileExistsError: the file already exists.
        OSError: the folder cannot be written.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    text = format_yaml(plain(content), default_flow_style=None)
    with file.open("x", encoding="utf-8") as stream:
        stream.write(text)


def plain(value: Any) -> Any:
    """Convert a section for YAML: tuples become lists, and keys without a value are omitted."""
    if isinstance(value, dict):
        return {name: plain(entry) for name, entry in value.items() if entry is not None}
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    return value
