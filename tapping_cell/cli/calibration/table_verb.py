"""Calibrate the map of the reference markers from images, or from a printed sheet and its ruler.

Take at least six images with the calibrated camera, from above and from all sides, each showing
several markers (move the camera, not the markers). All markers must lie flat on the table.

With --origin and --x-axis, two markers define the frame: the origin is the first marker, and the x
axis passes through the second. Otherwise the frame of --table OLD is kept. Without any of these
options, the origin is the centre of all markers, and the x axis is along their mean direction. The
scale is determined by the markers' printed size or, more accurately, by a measured --distance
between the centres of two markers.

  python -m tapping_cell calibrate table views/*.png --camera camera_info.yaml --size 40 \\
      --distance 101 103 660.2 --output table.yaml
  python -m tapping_cell calibrate table --sheet sheet.table.yaml --ruler 99.8 --output table.yaml
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.keep import fingerprints, now, write_kept
from tapping_cell.calibration.print_sheet import RULER
from tapping_cell.calibration.table import (
    MarkerView,
    TableCalibration,
    calibrate_table,
    observe_markers,
)
from tapping_cell.calibration.table_file import table_yaml
from tapping_cell.calibration.table_frame import (
    frame_of_map,
    frame_of_markers,
    in_frame,
    scaled,
)
from tapping_cell.cli.calibration.camera_verb import image_files, one_size
from tapping_cell.cli.calibration_arguments import add_output_arguments, output_of
from tapping_cell.cli.image_output import distinct_names
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.hints import unit_hint
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.vision import CameraModel, MarkerError, ReferenceMap
from tapping_cell.vision.images import GreyImage, ImageRefused, read_photograph


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "images", nargs="*", type=Path, metavar="IMAGE", help="image file, or folder of images"
    )
    parser.add_argument(
        "--camera",
        type=Path,
        metavar="FILE",
        help="ROS camera_info file of the camera (default: the package's camera_info.yaml)",
    )
    parser.add_argument(
        "--table",
        type=Path,
        metavar="OLD",
        help="table file with the marker ids, the marker sizes and the frame to keep",
    )
    parser.add_argument(
        "--dictionary",
        default="APRILTAG_36h11",
        help="marker dictionary (only without --table; default: APRILTAG_36h11)",
    )
    parser.add_argument(
        "--size",
        type=float,
        metavar="MM",
        help="side length of every marker in mm (required without --table)",
    )
    parser.add_argument(
        "--ids",
        type=int,
        nargs="+",
        help="ids of the reference markers (only without --table; default: all detected markers)",
    )
    parser.add_argument(
        "--origin",
        type=int,
        metavar="ID",
        help="id of the marker at the origin of the frame (only with --x-axis)",
    )
    parser.add_argument(
        "--x-axis",
        type=int,
        metavar="ID",
        help="id of a marker on the positive x axis (only with --origin)",
    )
    parser.add_argument(
        "--distance",
        nargs=3,
        metavar=("ID", "ID", "MM"),
        help="ids of two markers and the measured distance between their centres in mm, which "
        "sets the scale",
    )
    parser.add_argument(
        "--sheet", type=Path, help="table file of a printed sheet, used instead of images"
    )
    parser.add_argument(
        "--ruler",
        type=float,
        metavar="MM",
        help="measured length of the sheet's 100 mm ruler in mm (required with --sheet)",
    )
    add_output_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write the table file. Return 0 on success."""
    output = output_of(arguments)
    if arguments.sheet is not None:
        references, record, result = *_from_sheet(arguments), None
    else:
        references, record, result = _from_images(arguments)
    text = table_yaml(references, record, "Reference markers, measured (calibrate table): m, rad.")
    write_kept(output, text, record, load_reference_map)
    found = report(references, record, result, output.path)
    print(json.dumps(found, indent=1) if arguments.json else "\n".join(lines(found)))
    return 0


def _from_sheet(arguments: argparse.Namespace) -> tuple[ReferenceMap, Provenance]:
    """Return the map of a printed sheet at the scale given by its ruler."""
    if arguments.images:
        raise CalibrationRefused("give images or --sheet, not both")
    if arguments.ruler is None:
        raise CalibrationRefused(
            "--sheet needs --ruler, the measured length of its 100 mm ruler in mm"
        )
    factor = arguments.ruler / (RULER * 1e3)
    if not 0.9 <= factor <= 1.1:
        raise CalibrationRefused(
            f"a ruler of {arguments.ruler:g} mm is outside 90 to 110 mm: print the sheet at 100 %"
        )
    references = scaled(load_reference_map(arguments.sheet), factor)
    farthest = max(math.hypot(m.x, m.y) for m in references.markers)
    return references, Provenance(
        by="calibrate table",
        made=now(),
        inputs=fingerprints([arguments.sheet]),
        observations=1,
        left_out=0,
        residual=0.0,
        residual_of="none (a single reading of a ruler)",
        uncertainty=0.0002 / RULER * farthest,
        uncertainty_of="position of the farthest marker if the ruler is read to 0.2 mm, m",
        deviations={},
        notes=(f"the sheet's 100 mm ruler measures {arguments.ruler:g} mm",),
    )


def _from_images(
    arguments: argparse.Namespace,
) -> tuple[ReferenceMap, Provenance, TableCalibration]:
    """Return the map from images, in the requested frame."""
    if not arguments.images:
        raise CalibrationRefused("give images of the markers, or --sheet with --ruler")
    camera_path = arguments.camera or shared_folder() / "camera_info.yaml"
    camera = load_camera_model(camera_path)
    old = load_reference_map(arguments.table) if arguments.table else None
    if old is None and arguments.size is None:
        raise CalibrationRefused("the marker size is unknown: give --size in mm, or --table")
    dictionary = old.dictionary if old else arguments.dictionary
    known = [m.id for m in old.markers] if old else arguments.ids
    paths = image_files(arguments.images)
    views, unseen = _views(paths, camera, dictionary, known)
    seen = sorted({int(i) for view in views for i in view.ids})
    sizes = {m.id: m.size for m in old.markers} if old else _sizes(seen, arguments.size)
    try:
        result = calibrate_table(views, sizes, dictionary, camera.fx)
    except CalibrationRefused as error:
        raise CalibrationRefused("; ".join([str(error), *unseen])) from error
    references, notes = _placed(result.references, arguments, old)
    largest = float(np.hypot(result.deviations[:, 0], result.deviations[:, 1]).max())
    record = Provenance(
        by="calibrate table",
        made=now(),
        inputs=fingerprints([*paths, camera_path]),
        observations=int(result.seen.sum()),
        left_out=len(result.outliers),
        residual=result.rms,
        residual_of="root mean square reprojection error of the corners, pixels",
        uncertainty=largest,
        uncertainty_of="position of the least certain marker relative to all markers, m",
        deviations={
            f"{name}{m.id}": value
            for m, row in zip(references.markers, result.deviations.tolist(), strict=True)
            for name, value in zip(("x", "y", "theta"), row, strict=True)
        },
        notes=(*notes, *unseen, *outlier_lines(result), *result.warnings),
    )
    return references, record, result


def _views(
    paths: list[Path], camera: CameraModel, dictionary: str, known: list[int] | None
) -> tuple[list[MarkerView], list[str]]:
    """Return the marker detections, and messages about the images."""
    images: dict[str, GreyImage] = {}
    unseen = []
    for path, name in distinct_names(paths).items():
        try:
            images[name] = read_photograph(path, (camera.width, camera.height))
            unseen += [f"{name}: {warning}" for warning in images[name].warnings]
        except ImageRefused as error:
            unseen.append(f"{name}: {error}")
    one_size({name: image.size for name, image in images.items()})
    views = []
    for name, image in images.items():
        try:
            found = observe_markers(image.pixels, name, camera, dictionary, known)
        except MarkerError as error:
            raise CalibrationRefused(str(error)) from error
        if isinstance(found, str):
            unseen.append(f"{name}: {image.explain(found, visible=False)}")
        else:
            views.append(found)
    return views, unseen


def _sizes(ids: list[int], size: float) -> Mapping[int, float]:
    if not 3.0 <= size <= 1000.0:
        raise CalibrationRefused(
            f"marker size {size:g} mm is outside 3 to 1000 mm; --size is in mm"
        )
    return {number: size / 1e3 for number in ids}


def _placed(
    references: ReferenceMap, arguments: argparse.Namespace, old: ReferenceMap | None
) -> tuple[ReferenceMap, list[str]]:
    """Return the marker map, scaled and transformed as requested, and messages that describe it."""
    notes = []
    if arguments.distance:
        references, factor = _at_distance(references, arguments.distance)
        notes.append(
            "scale from a measured distance, which is "
            f"{factor:.5f} times the distance according to the printed sizes"
        )
    if arguments.origin is not None or arguments.x_axis is not None:
        if arguments.origin is None or arguments.x_axis is None:
            raise CalibrationRefused("--origin needs --x-axis, and vice versa: give both markers")
        frame = frame_of_markers(references, arguments.origin, arguments.x_axis)
        notes.append(f"origin: marker {arguments.origin}; x axis through {arguments.x_axis}")
        return in_frame(references, frame), notes
    if old is not None:
        frame, moved = frame_of_map(references, old)
        notes.append(
            f"frame kept from {arguments.table.name}; the markers moved by {moved * 1e3:.3f} mm rms"
        )
        return in_frame(references, frame), notes
    return references, [*notes, "origin: centre of the markers; x axis: their mean direction"]


def _at_distance(references: ReferenceMap, words: list[str]) -> tuple[ReferenceMap, float]:
    """Scale the map to a measured distance between two markers. Return the map and the factor."""
    try:
        first, second, wanted = int(words[0]), int(words[1]), float(words[2]) / 1e3
    except ValueError as error:
        raise CalibrationRefused(
            f"--distance {' '.join(words)}: give two ids and the distance in mm"
        ) from error
    places = {m.id: (m.x, m.y) for m in references.markers}
    for number in (first, second):
        if number not in places:
            raise CalibrationRefused(f"--distance: marker {number} was not detected")
    apart = math.dist(places[first], places[second])
    least, most = 0.8 * apart, 1.25 * apart
    if first == second or not least <= wanted <= most:
        raise CalibrationRefused(
            f"--distance: markers {first} and {second} are about {apart * 1e3:.1f} mm apart "
            f"according to their printed size; {wanted * 1e3:g} mm is not plausible"
            + (unit_hint(1e3 * wanted, "mm", 1e3 * least, 1e3 * most) if first != second else "")
        )
    return scaled(references, wanted / apart), wanted / apart


def outlier_lines(result: TableCalibration) -> list[str]:
    """Return a message for every marker that was excluded from an image."""
    return [
        f"left out: marker {s.marker} in {s.image}, because its residual is {s.error:.1f} pixels"
        for s in result.outliers
    ]


def report(
    references: ReferenceMap, record: Provenance, result: TableCalibration | None, path: Path
) -> dict[str, Any]:
    """Return the result for JSON output."""
    rows = []
    for number, m in enumerate(references.markers):
        row: dict[str, Any] = {"id": m.id, "x": m.x, "y": m.y, "theta": m.theta, "size": m.size}
        if result is not None:
            row["deviations"] = result.deviations[number].tolist()
            row["images"] = int(result.seen[number])
        rows.append(row)
    return {
        "output": str(path),
        "markers": rows,
        "rms_px": None if result is None else result.rms,
        "notes": list(record.notes),
    }


def lines(found: dict[str, Any]) -> list[str]:
    """Format the report in mm and degrees."""
    rows = [f"{'marker':>6} {'x mm':>10} {'y mm':>10} {'theta deg':>10} {'sd mm':>7} images"]
    for m in found["markers"]:
        sd = f"{1e3 * math.hypot(*m['deviations'][:2]):>7.3f}" if "deviations" in m else f"{'':>7}"
        rows.append(
            f"{m['id']:>6} {1e3 * m['x']:>10.3f} {1e3 * m['y']:>10.3f}"
            f" {math.degrees(m['theta']):>10.3f} {sd} {m.get('images', ''):>6}"
        )
    rows += [f"note: {text}" for text in found["notes"]]
    if found["rms_px"] is not None:
        rows.append(f"residual of the corners: {found['rms_px']:.3f} px rms")
    return [*rows, f"written: {found['output']}"]
