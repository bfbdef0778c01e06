"""Select the taps of a run folder that are suitable for estimating properties of the object or the
tappers."""

from __future__ import annotations

from pathlib import Path

from tapping_cell.calibration.csv_table import RecordError
from tapping_cell.report.run import TapRow
from tapping_cell.report.run_folder import read_run


def measured_taps(folder: Path, object_name: str) -> list[TapRow]:
    """Return every tap of a run that was fired and has a measured result.

    Raises:
        RecordError: the run was made with another object.
        tapping_cell.report.run_folder.RunError: the folder is damaged.
    """
    run = read_run(folder)
    names = [one.name for one in run.objects if one.name]
    if names and object_name not in names:
        raise RecordError(
            f"{folder} is a run with '{', '.join(names)}', but the object file is of "
            f"'{object_name}'; give the file of the object that was tapped (--object)"
        )
    # An unmeasured pose is NaN.
    return [
        tap
        for tap in run.taps
        if tap.outcome == "fired" and tap.seen and tap.object_name in ("", object_name)
    ]
