"""Calibrate the line and speed of each fixed tapper from single taps measured by the camera.

The taps are read from run folders, or from a CSV file with one row per tap. The columns are tapper
(the name in the cell file), speed (m/s; or speed_mm_s) and the object's poses at rest before and
after the tap: x_before, y_before, theta_before, x_after, y_after, theta_after (m and rad; or with
the suffixes _mm and _deg). Place the object at several positions along each tapper's line. Twelve
taps per tapper are usually enough. Writes a copy of the cell file with the measured positions and
directions. A tapper without taps keeps its values.

  python -m tapping_cell calibrate mounts runs/* --cell config/positioning_cell/cell.yaml \\
      --output cell.yaml
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.cell_file import calibrated_cell, load_cell_with_objects
from tapping_cell.calibration.csv_table import RecordError, read_csv
from tapping_cell.calibration.keep import fingerprints, now, write_kept
from tapping_cell.calibration.mounts import (
    MAX_DEVIATION,
    RECORD_COLUMNS,
    MountFit,
    TapScatter,
    fit_mount,
)
from tapping_cell.calibration.yaml_edit import numbers_text, with_entry
from tapping_cell.cli.calibration_arguments import add_output_arguments, output_of
from tapping_cell.cli.measured_taps import measured_taps
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.report.run import TapRow
from tapping_cell.report.run_folder import SUMMARY, TAPS
from tapping_cell.se2 import Array, Pose


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "record",
        type=Path,
        nargs="+",
        metavar="RECORD",
        help="one CSV file with taps, or run folders",
    )
    parser.add_argument(
        "--cell", type=Path, metavar="FILE", required=True, help="cell file to copy and update"
    )
    parser.add_argument(
        "--object",
        type=Path,
        metavar="FILE",
        help="file of the object that was tapped (default: the cell's)",
    )
    add_output_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the calibration. Return 0 if the file was written."""
    output = output_of(arguments, ("fixed_tappers", "calibration"))
    cell = load_cell_with_objects(arguments.cell, arguments.object)
    taps = read_taps(arguments.record, cell)
    fits, too_few = fit_all(cell, taps)
    record = _provenance(fits, taps, cell)
    text = calibrated_cell(cell, "fixed_tappers", {}, record, output.path)
    entries = [entry.name for entry in cell.fixed_tappers.tappers]
    for fit in fits:
        values = {
            "position": numbers_text([fit.mount.x, fit.mount.y]),
            "direction": numbers_text(fit.mount.theta),
        }
        text = with_entry(text, ("fixed_tappers", "tappers"), entries.index(fit.name), values)
    write_kept(output, text, record, load_cell_with_objects)
    found = report(fits, taps, output.path, entries) | {"too_few_taps": too_few}
    print(json.dumps(found, indent=1) if arguments.json else "\n".join(lines(found)))
    return 0


@dataclass(frozen=True, slots=True)
class Taps:
    """Single taps and the files that they were read from.

    ``tapper``: names (n,). ``speed``: commanded, (n,), m/s. ``before``, ``after``: poses of the
    object at rest (n, 3), m and rad. ``faults``: rows and folders that were left out, with
    the reason.
    """

    files: tuple[Path, ...]
    tapper: NDArray[np.str_]
    speed: Array
    before: Array
    after: Array
    faults: tuple[str, ...] = ()


def read_taps(paths: Sequence[Path], cell: Cell) -> Taps:
    """Read the taps of one CSV file, or of the goals in run folders. Among several paths, a file
    that is not a CSV file is left out: a pattern such as runs/* also gives runs/comparison.html.

    Raises:
        RecordError: a path does not exist, a CSV file and other paths are mixed, a run was made
            with another object, or there are no taps.
        tapping_cell.report.run_folder.RunError: a run folder is damaged.
    """
    missing = next((path for path in paths if not path.exists()), None)
    if missing is not None:
        raise RecordError(f"{missing} does not exist; give one CSV file, or run folders")
    folders = [path for path in paths if path.is_dir()]
    tables = [path for path in paths if path.suffix.lower() == ".csv"]
    if folders and not tables:
        taps = _taps_of_runs(folders, cell)
        others = [f"{path} is not a run folder" for path in paths if path not in folders]
        return replace(taps, faults=(*taps.faults, *others))
    if len(paths) > 1:
        raise RecordError(f"{len(paths)} records were given; give one CSV file, or run folders")
    table = read_csv(paths[0], RECORD_COLUMNS, texts=("tapper",))
    return Taps(
        (table.path,),
        np.array(table.texts["tapper"]),
        table.values["speed"],
        table.columns("x_before", "y_before", "theta_before"),
        table.columns("x_after", "y_after", "theta_after"),
        tuple(str(fault) for fault in table.faults),
    )


def _taps_of_runs(folders: Sequence[Path], cell: Cell) -> Taps:
    taps: list[TapRow] = []
    runs = [folder for folder in folders if (folder / SUMMARY).exists()]
    for folder in runs:
        taps += [tap for tap in measured_taps(folder, cell.object.name) if tap.tapper]
    if not taps:
        raise RecordError(
            f"the {len(folders)} run folders contain no measured tap by a fixed tapper; give "
            "runs of a cell with fixed tappers"
        )
    return Taps(
        tuple(folder / TAPS for folder in runs),
        np.array([tap.tapper for tap in taps]),
        np.array([tap.striker_speed for tap in taps]),
        np.array([tap.before for tap in taps]),
        np.array([tap.measured for tap in taps]),
        tuple(
            f"{folder} has no {SUMMARY}: it is not the folder of a finished run"
            for folder in folders
            if folder not in runs
        ),
    )


def fit_all(cell: Cell, taps: Taps) -> tuple[list[MountFit], list[str]]:
    """Fit every tapper. Return the fits, in the order of the cell file, and a sentence about each
    tapper whose taps are too few or contradict the cell file.

    Raises:
        RecordError: a tap was made by a tapper that the cell does not have.
        CalibrationRefused: no tapper could be fitted.
    """
    entries = cell.fixed_tappers.tappers
    unknown = sorted(set(taps.tapper.tolist()) - {entry.name for entry in entries})
    if unknown:
        raise RecordError(
            f"some taps were made by {', '.join(map(repr, unknown))}, but {cell.path} has only the "
            f"tappers {', '.join(entry.name for entry in entries)}; give the cell file of these "
            "taps with --cell"
        )
    scatter, camera = cell.object.scatter, cell.file.camera
    noise = TapScatter(
        scatter.distance,
        scatter.rotation,
        scatter.direction,
        camera.position_noise,
        camera.angle_noise,
        scatter.position_floor,
        scatter.angle_floor,
    )
    fits: list[MountFit] = []
    too_few: list[str] = []
    for entry in entries:
        rows = taps.tapper == entry.name
        if not np.any(rows):
            continue
        tap = cell.object.tap(cell.tapper_of(entry).striker())
        tap = replace(tap, sliding=tap.sliding.approximated(), smallest_distance=0.0)
        nominal = Pose(*entry.position, entry.direction)
        measured = taps.speed[rows], taps.before[rows], taps.after[rows]
        try:
            fits.append(fit_mount(entry.name, nominal, tap, *measured, noise))
        except CalibrationRefused as refusal:
            too_few.append(str(refusal))
    if not fits:
        others = f" (and {len(too_few) - 1} more tappers)" if len(too_few) > 1 else ""
        raise CalibrationRefused(too_few[0] + others)
    return fits, too_few


def _provenance(fits: list[MountFit], taps: Taps, cell: Cell) -> Provenance:
    return Provenance(
        by="calibrate mounts",
        made=now(),
        inputs=fingerprints([*taps.files, cell.object_path]),
        observations=sum(fit.taps for fit in fits),
        left_out=sum(fit.left_out for fit in fits) + len(taps.faults),
        residual=math.sqrt(sum(fit.residual**2 for fit in fits) / len(fits)),
        residual_of="root mean square residual relative to the scatter in the object file",
        uncertainty=max(fit.line_deviation for fit in fits),
        uncertainty_of="lateral position of the least certain tapper's line at the object, m",
        deviations={f"{fit.name}_direction": fit.angle_deviation for fit in fits},
        notes=tuple(
            f"{fit.name}: the speed differs from the calibration curve by "
            f"{100 * (fit.speed_factor - 1):+.1f} %, if the friction in the object file is correct"
            for fit in fits
        ),
    )


def report(fits: list[MountFit], taps: Taps, path: Path, entries: list[str]) -> dict[str, Any]:
    """Return the result for JSON output, in SI units."""
    return {
        "output": str(path),
        "tappers": [
            {
                **{name: value for name, value in asdict(fit).items() if name != "mount"},
                "position": [fit.mount.x, fit.mount.y],
                "direction": fit.mount.theta,
                "taps_wanted": fit.taps_wanted,
            }
            for fit in fits
        ],
        "without_taps": [name for name in entries if name not in taps.tapper],
        "faults": list(taps.faults),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """Format the report as text."""
    rows = [
        "offset of each tapper's line (at the object and at the mount), angle and speed, relative "
        "to the cell file:",
        f"{'tapper':<12} {'taps':>5} {'at object, mm':>16} {'at mount, mm':>13} "
        f"{'angle, deg':>11} {'speed, %':>9}",
    ]
    for fit in found["tappers"]:
        rows.append(
            f"{fit['name']:<12} {fit['taps']:>5} {1e3 * fit['line_offset']:>8.2f} +- "
            f"{1e3 * fit['line_deviation']:>4.2f} {1e3 * fit['offset']:>13.2f} "
            f"{math.degrees(fit['angle']):>11.2f} {100 * (fit['speed_factor'] - 1):>+9.1f}"
        )
    for fit in found["tappers"]:
        if fit["line_deviation"] > MAX_DEVIATION:
            rows.append(
                f"note: the line of '{fit['name']}' has a standard deviation of "
                f"{1e3 * fit['line_deviation']:.2f} mm at the object (limit "
                f"{1e3 * MAX_DEVIATION:.1f} mm); make about {fit['taps_wanted']} taps in total"
            )
    rows += [f"note: unchanged: {sentence}" for sentence in found["too_few_taps"]]
    if found["without_taps"]:
        rows.append(f"note: without taps, unchanged: {', '.join(found['without_taps'])}")
    rows += [f"left out: {fault}" for fault in found["faults"]]
    return [*rows, f"written: {found['output']}"]
