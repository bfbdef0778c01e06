"""Calibrate the striker's speed at each energy, from the travel of the object after each tap.

Each row is one tap: energy (J; or energy_mJ) and the distance travelled by the object (m; or
distance_mm). Three columns are optional: rotation of the object (rad; or rotation_deg), incidence,
which is the angle between the striker's line of travel and the contact normal (rad; or
incidence_deg; default 0), and distance_std, the standard deviation of the measured distance
(default 0.1 mm). Record about 30 taps through the object's centre, at six or more energies from the
smallest tap to the largest. Friction and restitution come from the object file. Writes a copy of
the cell file with the new curve in its section tapper.

With --record, the verb first makes and records the taps with the running cell. The taps are made
near the middle of the table. They range from the smallest tap in the object file to the largest tap
after which the object certainly stays on the table and in view. Most taps are at the two ends of
this range. Ctrl-C stops the recording; --resume continues it.

  python -m tapping_cell calibrate tapper taps.csv --cell config/cell.yaml --output cell.yaml
  python -m tapping_cell up --hardware                              # in another terminal, and then
  python -m tapping_cell calibrate tapper taps.csv --record --output cell.yaml
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.cell_file import calibrated_cell, load_cell_with_objects
from tapping_cell.calibration.csv_table import CsvTable, read_csv
from tapping_cell.calibration.keep import fingerprints, now, write_kept
from tapping_cell.calibration.tapper import (
    MIN_TAPS,
    RECORD_COLUMNS,
    USUAL_DEVIATION,
    TapperCalibration,
    TapRecord,
    calibrate_tapper,
)
from tapping_cell.cli.calibration_arguments import (
    add_output_arguments,
    add_recording_arguments,
    check_count,
    output_of,
)
from tapping_cell.configuration.cell import TapperSection
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.hardware.energy import EnergyCurve

MUCH_CHANGED = 1.3
"""Ratio of new to old speed, or its inverse, from which a note is given."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "record", type=Path, metavar="RECORD.csv", help="CSV file with the recorded taps"
    )
    parser.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="cell file to copy and update (default: the package's cell.yaml)",
    )
    parser.add_argument(
        "--object",
        type=Path,
        metavar="FILE",
        help="file of the object that was tapped (default: the cell's)",
    )
    add_recording_arguments(parser, "--taps", 30, "approximate number of taps to record")
    add_output_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the calibration. Return 0 if the file was written, 130 if the recording was
    interrupted."""
    output = output_of(arguments, ("tapper", "calibration"))
    cell = load_cell_with_objects(arguments.cell, arguments.object)
    if arguments.record_first:
        check_count("--taps", arguments.taps, MIN_TAPS)
        from tapping_cell.cli.calibration.tapper_recording import record as make_record

        if not make_record(arguments, cell, Console(stderr=arguments.json)):
            return 130
    table = read_csv(arguments.record, RECORD_COLUMNS)
    tap = cell.object.tap(cell.file.tapper.striker())
    result = calibrate_tapper(record_of(table), tap)
    _check_energy(cell.file.tapper, result)
    record = _provenance(result, table, cell.object_path)
    values = {"energies": list(result.energies), "speeds": list(result.speeds)}
    text = calibrated_cell(cell, "tapper", values, record, output.path)
    write_kept(output, text, record, load_cell_with_objects)
    found = report(result, table, output.path)
    old = cell.file.tapper.curve()
    if old.slowest < 0.99 * result.speeds[0] or old.fastest > 1.01 * result.speeds[-1]:
        found["notes"].append(
            f"the old curve covered {old.slowest * 1e3:.0f} to {old.fastest * 1e3:.0f} mm/s; the"
            f" planner now uses {result.speeds[0] * 1e3:.0f} to {result.speeds[-1] * 1e3:.0f} mm/s,"
            " the range of the recorded taps"
        )
    found["notes"] += _changed(old, result)
    print(json.dumps(found, indent=1) if arguments.json else "\n".join(lines(found)))
    return 0


def _changed(old: EnergyCurve, result: TapperCalibration) -> list[str]:
    """Return a note if the speed at an energy differs much from that of the old curve."""
    ratios = [
        (speed / old.speed_for(energy), energy)
        for energy, speed in zip(result.energies, result.speeds, strict=True)
        if old.table[0][0] <= energy <= old.table[-1][0]
    ]
    ratio, energy = max(ratios, key=lambda each: abs(math.log(each[0])), default=(1.0, 0.0))
    if 1.0 / MUCH_CHANGED < ratio < MUCH_CHANGED:
        return []
    return [
        f"at {1e3 * energy:.4g} mJ, the new speed is {ratio:.2f} times that of the old curve; if "
        "that was measured with this tapper, check names and units of the columns, and mass and "
        "friction in the object file"
    ]


def _check_energy(tapper: TapperSection, result: TapperCalibration) -> None:
    """Raise CalibrationRefused if the curve contradicts the striker's kinetic energy."""
    try:
        replace(tapper, energies=result.energies, speeds=result.speeds).curve()
    except ValueError as error:
        raise CalibrationRefused(
            f"the calibrated curve is impossible: {error}. In the record, check the unit in the "
            "name of its column (energy in J, energy_mJ in mJ)"
        ) from error


def record_of(table: CsvTable) -> TapRecord:
    """Return the taps of the valid rows. Missing values are 0."""
    zero = np.zeros(len(table.rows))
    return TapRecord(
        energies=table.values["energy"],
        distances=table.values["distance"],
        rotations=np.nan_to_num(table.values.get("rotation", zero)),
        incidences=np.nan_to_num(table.values.get("incidence", zero)),
        deviations=np.nan_to_num(
            table.values.get("distance_std", zero + USUAL_DEVIATION), nan=USUAL_DEVIATION
        ),
        rows=table.rows,
    )


def _left_out(result: TapperCalibration, table: CsvTable) -> list[str]:
    return [
        *(str(fault) for fault in table.faults),
        *(f"{table.path}, {entry}" for entry in result.left_out),
    ]


def _provenance(result: TapperCalibration, table: CsvTable, object_path: Path) -> Provenance:
    names = [f"speed_at_{energy * 1e3:.4g}_mJ" for energy in result.energies]
    spread = np.array(result.deviations) * np.array(result.speeds)
    return Provenance(
        by="calibrate tapper",
        made=now(),
        inputs=fingerprints([table.path, object_path]),
        observations=result.used,
        left_out=len(result.left_out) + len(table.faults),
        residual=result.scatter,
        residual_of="relative scatter of a tap's speed",
        uncertainty=result.uncertainty,
        uncertainty_of="relative error of the curve's speeds, excluding errors of the object file",
        deviations=dict(zip(names, spread.tolist(), strict=True)),
        notes=(
            f"smallest reliable tap: {result.least_energy * 1e3:.4g} mJ,"
            f" {result.least_travel * 1e3:.2f} mm",
            *_left_out(result, table),
            *result.notes,
        ),
    )


def report(result: TapperCalibration, table: CsvTable, path: Path) -> dict[str, Any]:
    """Return the result for JSON output: energies, speeds and distances in SI units, deviations and
    scatter as fractions."""
    figures = asdict(result) | {"left_out": _left_out(result, table), "notes": list(result.notes)}
    return {"output": str(path), **figures}


def lines(found: dict[str, Any]) -> list[str]:
    """Format the report as text."""
    rows = [f"{'energy mJ':>10} {'taps':>5} {'moved':>5} {'mm/s':>8} {'scatter %':>9}"]
    for d in found["draws"]:
        scatter = "" if d["scatter"] is None else f"{100 * d['scatter']:.1f}"
        rows.append(
            f"{1e3 * d['energy']:>10.4g} {d['taps']:>5} {d['moved']:>5} {1e3 * d['speed']:>8.1f}"
            f" {scatter:>9}"
        )
    rows.append("the curve:")
    rows += [
        f"{1e3 * energy:>10.4g} mJ  {1e3 * speed:>8.1f} mm/s +- {100 * spread:.1f} %"
        for energy, speed, spread in zip(
            found["energies"], found["speeds"], found["deviations"], strict=True
        )
    ]
    rows += [f"left out: {text}" for text in found["left_out"]]
    rows.append(
        f"{found['used']} taps; a tap's speed scatters by {100 * found['scatter']:.1f} %; smallest"
        f" reliable tap {1e3 * found['least_energy']:.4g} mJ,"
        f" {1e3 * found['least_travel']:.1f} mm"
    )
    if not math.isclose(found["by_friction"], 0.5, abs_tol=0.02):
        rows.append(
            "a different friction in the object file would change all speeds: they are "
            f"proportional to friction ** {found['by_friction']:.2f}"
        )
    return [*rows, *(f"note: {text}" for text in found["notes"]), f"written: {found['output']}"]
