"""The parameters of the recorder."""

from __future__ import annotations

from dataclasses import dataclass

from tapping_cell.configuration.schema import quantity, text


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of run_recorder."""

    autostart: bool = text("configure and activate without being asked", default=True)
    cell_file: str = text("path of the cell file; empty for the package's own", default="")
    object_file: str = text("path of the object file; empty for the cell file's", default="")
    folder: str = text("folder in which every run gets one of its own", default="runs")
    name: str = text("name of the run's folder; empty for time and goal", default="")
    picture_rate: float = quantity(
        "pictures kept of camera/image_annotated; 0 for none", "Hz", 0.0, 10.0, default=1.0
    )
    picture_width: int = quantity("width of a kept picture", "pixels", 160, 4096, default=960)
    pictures: bool = text("draw cell.png and report.html at the end of a run", default=True)
    least_free: float = quantity(
        "room on the disk below which nothing is recorded", "MB", 0.0, 1e7, default=500.0
    )
    most_runs: int = quantity(
        "folders beside each other after which nothing is recorded; nothing is ever deleted",
        "",
        1,
        1_000_000,
        default=10_000,
    )
    seed: int = quantity(
        "seed of the simulated world, to be written down; negative for none",
        "",
        -1,
        2**31 - 1,
        default=-1,
    )
