"""Calibrate the pose of the arm's base and the zero offset of its elbow from a CSV record of poses.

Each row is one pose. Columns shoulder, elbow and tool are the joint positions reported by the
controller, in rad (or in degrees, as shoulder_deg, elbow_deg and tool_deg). Columns x, y and theta
are the pose of a marker held by the arm, measured by the camera in the frame table, in m and rad
(or as x_mm, y_mm and theta_deg). Without theta, each row is a point on the table that the tip
touched. Record 20 poses over the whole table, with the elbow bent to both sides by different
angles, and with different tool angles. Writes a copy of the cell file with the new values in its
section arm.

With --record, the verb first records the poses with the running cell. The arm must hold a marker,
and the cell must have been started with an object file that describes this marker. The height in
that file is the height at which the arm holds the marker above the table. The arm moves above the
table at its current height, and the camera's measurements are recorded pose by pose. Ctrl-C stops
the recording; --resume continues it.

  python -m tapping_cell calibrate arm poses.csv --cell config/cell.yaml --output cell.yaml
  python -m tapping_cell up --hardware --object held_marker.yaml    # in another terminal, and then
  python -m tapping_cell calibrate arm poses.csv --record --output cell.yaml
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tapping_cell.calibration.arm import (
    MIN_POSES,
    RECORD_COLUMNS,
    ArmCalibration,
    ArmRecord,
    calibrate_arm,
)
from tapping_cell.calibration.cell_file import calibrated_cell, load_cell_with_objects
from tapping_cell.calibration.csv_table import CsvTable, read_csv
from tapping_cell.calibration.keep import fingerprints, now, write_kept
from tapping_cell.cli.calibration_arguments import (
    add_output_arguments,
    add_recording_arguments,
    check_count,
    output_of,
)
from tapping_cell.configuration.cell import Cell
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.se2 import Pose


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "record", type=Path, metavar="RECORD.csv", help="CSV file with the recorded poses"
    )
    parser.add_argument(
        "--cell",
        type=Path,
        metavar="FILE",
        help="cell file to copy and update (default: the package's cell.yaml)",
    )
    parser.add_argument("--links", action="store_true", help="also fit the lengths of the links")
    parser.add_argument(
        "--marker-on-tip",
        nargs=3,
        type=float,
        metavar=("X", "Y", "THETA"),
        help="pose of the held marker in the frame striker, if known, in mm, mm and degrees; the "
        "position of the tip on the tool is then also calibrated",
    )
    add_recording_arguments(parser, "--poses", 20, "number of poses to record")
    add_output_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the calibration. Return 0 if the file was written, 130 if the recording was
    interrupted."""
    output = output_of(arguments, ("arm", "calibration"))
    cell = load_cell_with_objects(arguments.cell)
    if arguments.record_first:
        check_count("--poses", arguments.poses, MIN_POSES)
        from tapping_cell.cli.calibration.arm_recording import record as make_record

        if not make_record(arguments, cell, Console(stderr=arguments.json)):
            return 130
    table = read_csv(arguments.record, RECORD_COLUMNS)
    result = calibrate_arm(record_of(table), cell.arm.geometry(), arguments.links)
    values = file_values(result, cell, arguments.marker_on_tip)
    record = _provenance(result, table, arguments)
    text = calibrated_cell(cell, "arm", values, record, output.path)
    write_kept(output, text, record, load_cell_with_objects)
    found = report(result, values, table, output.path)
    print(json.dumps(found, indent=1) if arguments.json else "\n".join(lines(found)))
    return 0


def record_of(table: CsvTable) -> ArmRecord:
    """Return the poses in the valid rows. If a row has no angle, the angles of all rows are
    ignored."""
    angles = table.values.get("theta")
    if angles is not None and not np.isfinite(angles).all():
        angles = None
    return ArmRecord(
        joints=table.columns("shoulder", "elbow", "tool"),
        points=table.columns("x", "y"),
        angles=angles,
        rows=table.rows,
    )


def file_values(
    result: ArmCalibration, cell: Cell, marker: list[float] | None
) -> dict[str, float | list[float]]:
    """Return the calibrated values by key, for the section arm of the cell file."""
    v, arm = result.values, cell.arm
    offset = list(arm.joint_offset)
    # The fitted yaw is the sum of the base's yaw and the zero offset of the shoulder. The cell file
    # keeps its shoulder offset, so this offset is subtracted from the fitted yaw.
    base = [v["base_x"], v["base_y"], math.remainder(v["base_yaw"] - offset[0], 2 * math.pi)]
    offset[1] = v["elbow_zero"]
    values: dict[str, float | list[float]] = {"base": base, "joint_offset": offset}
    if "upper_arm" in result.deviations:
        values |= {"upper_arm": v["upper_arm"], "forearm": v["forearm"]}
    # The fit uses the tool angle that the controller reports, but in the cell the zero offset of
    # the tool is added to this angle. The mount is therefore rotated back by the offset.
    mount = Pose(v["mount_x"], v["mount_y"], v["mount_angle"])
    into_tool = Pose(0.0, 0.0, -offset[3])
    if marker is not None and result.turns is not None:
        on_tip = Pose(marker[0] / 1e3, marker[1] / 1e3, math.radians(marker[2]))
        tip = into_tool @ mount @ on_tip.inverse()
        yaw = math.remainder(tip.theta, 2 * math.pi)
        values |= {"tip_forward": tip.x, "tip_side": tip.y, "tip_yaw": yaw}
    elif result.turns is None and not {"mount_x", "mount_y"} & set(result.held):
        tip = into_tool @ mount
        values |= {"tip_forward": tip.x, "tip_side": tip.y}
    return values


def _provenance(
    result: ArmCalibration, table: CsvTable, arguments: argparse.Namespace
) -> Provenance:
    tip = []
    if result.turns is None:
        tip.append(
            "tip_yaw is kept as in the cell file, because a record without angles does not "
            "determine the direction of the striker's line of travel"
        )
    elif arguments.marker_on_tip is None:
        tip.append(
            "the position of the tip on the tool is kept, because it can be fitted only if "
            "--marker-on-tip gives the position of the marker on the tip"
        )
    turned = result.angle_rms
    angle = (
        [] if turned is None else [f"residual of the angles: {math.degrees(turned):.4f} deg rms"]
    )
    return Provenance(
        by="calibrate arm",
        made=now(),
        inputs=fingerprints([arguments.record]),
        observations=len(result.residuals),
        left_out=len(result.outliers) + len(table.faults),
        residual=result.position_rms,
        residual_of="root mean square error of the points, m",
        uncertainty=result.wrist_deviation,
        uncertainty_of="position of the wrist, root mean square over the poses, m",
        deviations=dict(result.deviations),
        notes=(
            *angle,
            *(str(fault) for fault in table.faults),
            *(f"{table.path}, {outlier}" for outlier in result.outliers),
            *tip,
            *result.notes,
        ),
    )


def report(
    result: ArmCalibration,
    values: dict[str, float | list[float]],
    table: CsvTable,
    path: Path,
) -> dict[str, Any]:
    """Return the result for JSON output, in SI units."""
    return {
        "output": str(path),
        "values": values,
        "fitted": {name: result.values[name] for name in result.deviations},
        "deviations": result.deviations,
        "held": list(result.held),
        "position_rms": result.position_rms,
        "angle_rms": result.angle_rms,
        "wrist_deviation": result.wrist_deviation,
        "heading_deviation": result.heading_deviation,
        "used": len(result.residuals),
        "left_out": [str(fault) for fault in table.faults]
        + [f"{table.path}, {outlier}" for outlier in result.outliers],
        "notes": list(result.notes),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """Format the report in mm and degrees."""
    rows = []
    for name, value in found["fitted"].items():
        turn = name.endswith(("yaw", "zero", "angle"))
        scale, unit = (math.degrees(1.0), "deg") if turn else (1e3, "mm")
        spread = found["deviations"][name]
        rows.append(f"{name:<12} {scale * value:>11.4f} +- {scale * spread:.4f} {unit}")
    rows += [f"left out: {text}" for text in found["left_out"]]
    turned = found["angle_rms"]
    rows.append(
        f"{found['used']} poses; residual of the points {1e3 * found['position_rms']:.3f} mm rms"
        + ("" if turned is None else f", of the angles {math.degrees(turned):.3f} deg rms")
    )
    rows.append(
        f"the wrist is known to {1e3 * found['wrist_deviation']:.3f} mm, the forearm's heading to"
        f" {math.degrees(found['heading_deviation']):.4f} deg (one standard deviation)"
    )
    return [*rows, *(f"note: {text}" for text in found["notes"]), f"written: {found['output']}"]
