"""Create the object file of a new object from one image of it.

Put the object on the table, below the camera, and take an image that shows the table's reference
markers. The object's outline, and its marker if it has one, are read from the image; only the
height has to be measured. If several objects lie on the table, a message gives their places, and
--at chooses one. Friction and torque factor are set to typical values: `object learn` measures them
with the cell.

  python -m tapping_cell object new shot.png --name bracket --height 12 --output bracket.yaml
  python -m tapping_cell object new shot.png --at 80 -35 --name nut --height 6 --output nut.yaml

Without a marker, the orientation of an object with a rotationally symmetric outline (a disk, a
square) is ambiguous: stick a marker on it.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from tapping_cell.cli import argument_types
from tapping_cell.cli.errors import print_error
from tapping_cell.durable_file import replace_text

if TYPE_CHECKING:
    from tapping_cell.configuration.objects import ObjectFile
    from tapping_cell.vision.outline.tracing import TracedObject


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument(
        "image", type=Path, metavar="IMAGE", help="image file that shows the object"
    )
    parser.add_argument("--name", required=True, help="display name of the object")
    parser.add_argument(
        "--height",
        type=argument_types.within(0.5, 500.0, "mm"),
        required=True,
        metavar="MM",
        help="height of the object's top above the table in mm",
    )
    parser.add_argument(
        "--at",
        nargs=2,
        type=float,
        metavar=("X", "Y"),
        help="point on the object in the frame table in mm, if several objects lie on the table",
    )
    parser.add_argument(
        "--mass",
        type=argument_types.within(1.0, 100_000.0, "g"),
        metavar="G",
        help="mass in g (default: estimated from the volume, assuming plastic)",
    )
    parser.add_argument(
        "--ring", action="store_true", help="treat the object as a ring, not a disk"
    )
    parser.add_argument(
        "--dictionary",
        help="dictionary of the object's marker (default: that of the table's markers)",
    )
    parser.add_argument(
        "--camera", type=Path, help="ROS camera_info file (default: the package's camera_info.yaml)"
    )
    parser.add_argument(
        "--table",
        type=Path,
        help="table file with the reference markers (default: the package's table.yaml)",
    )
    parser.add_argument(
        "--output", type=Path, required=True, metavar="FILE", help="object file to write"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")


def run(arguments: argparse.Namespace) -> int:
    """Trace the object and write the file. Return 0 on success, 2 for an unusable image or
    values."""
    from tapping_cell.calibration.object_file import object_yaml
    from tapping_cell.configuration.files import shared_folder
    from tapping_cell.configuration.table import load_camera_model, load_reference_map
    from tapping_cell.vision.images import ImageRefused, read_photograph
    from tapping_cell.vision.outline.tracing import trace_object

    output: Path = arguments.output.expanduser()
    if output.exists() and not arguments.force:
        print_error(f"{output} exists already; choose another name, or give --force")
        return 2
    try:
        camera = load_camera_model(arguments.camera or shared_folder() / "camera_info.yaml")
        table = load_reference_map(arguments.table or shared_folder() / "table.yaml")
        image = read_photograph(arguments.image, (camera.width, camera.height))
        height = arguments.height / 1000
        try:
            at = None if arguments.at is None else (arguments.at[0] / 1e3, arguments.at[1] / 1e3)
            traced = trace_object(image.pixels, camera, table, height, arguments.dictionary, at)
        except ValueError as error:
            raise ValueError(image.explain(str(error), visible=False)) from error
        made = _object(arguments, traced)
        output.parent.mkdir(parents=True, exist_ok=True)
        replace_text(output, object_yaml(made, None, HEADING))
    except ImageRefused as error:
        print_error(f"{arguments.image} {error}")
        return 2
    except (ValueError, OSError) as error:
        print_error(str(error))
        return 2
    notes = [f"note: {warning}" for warning in image.warnings]
    print("\n".join([*summary_lines(made, traced), *notes]))
    files = [
        f" --{name} {shlex.quote(str(file))}"
        for name, file in (("camera", arguments.camera), ("table", arguments.table))
        if file is not None
    ]
    written, shot = shlex.quote(str(output)), shlex.quote(str(arguments.image))
    print(
        f"wrote {output}\n"
        "draw the outline into the image:  python -m tapping_cell locate "
        f"{shot} --object {written}{''.join(files)} --annotate drawn\n"
        "measure friction and torque factor:  python -m tapping_cell object learn --object "
        f"{written} --output FILE"
    )
    return 0


HEADING = (
    "Shape and appearance from an image (tapping_cell object new); friction and impact assumed."
)


def _object(arguments: argparse.Namespace, traced: TracedObject) -> ObjectFile:
    """Return the file's content.

    Raises:
        ValueError: the object is invalid, or cannot be detected.
    """
    from dataclasses import replace

    from tapping_cell.calibration.new_object import (
        new_object,
        traced_marker,
        traced_outline,
        traced_shape,
    )

    shape = traced_shape(traced)
    if arguments.ring:
        if shape.radius is None:
            raise ValueError("--ring is given, but the image shows a polygon")
        shape = replace(shape, kind="ring")
    return new_object(
        arguments.name,
        shape,
        arguments.height / 1000,
        traced_marker(traced),
        traced_outline(traced),
        None if arguments.mass is None else arguments.mass / 1000,
    )


def summary_lines(made: ObjectFile, traced: TracedObject) -> list[str]:
    """Format the traced object, in mm."""
    shape = made.shape
    if shape.radius is not None:
        text = f"{shape.kind} of {2e3 * shape.radius:.2f} mm in diameter"
    else:
        assert shape.vertices is not None
        corners = ", ".join(f"({1e3 * x:.2f}, {1e3 * y:.2f})" for x, y in shape.vertices)
        text = f"polygon with the corners {corners} mm"
    lines = [f"{text}; the traced rim deviates from it by {1e3 * traced.deviation:.2f} mm rms"]
    if made.marker is not None:
        marker = made.marker
        x, y, _ = marker.offset
        lines.append(
            f"marker {marker.id} of {marker.dictionary}, side {1e3 * marker.size:.2f} mm, "
            f"centre at ({1e3 * x:.2f}, {1e3 * y:.2f}) mm from the middle of the object"
        )
    else:
        assert made.outline is not None
        lines.append(f"no marker; the top is {made.outline.shade} than the table")
    lines.append(f"mass {1e3 * made.mass:.0f} g")
    return lines
