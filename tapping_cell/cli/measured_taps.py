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
    if run.object_name and run.object_name != object_name:
        raise RecordError(
            f"{folder} is a run with '{run.object_name}', but the object file is of "
            f"'{object_name}'; give the file of the object that was tapped (--object)"
        )
    # An unmeasured pose is NaN.
    return [tap for tap in run.taps if tap.outcome == "fired" and tap.seen]
