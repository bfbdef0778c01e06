"""Render photographs of the calibration target or of the reference markers, to test the
calibration.

The images show the sheets of `calibrate print` as seen by a camera with the given calibration,
including lens distortion, point spread, uneven light and noise.

    python -m tapping_cell calibrate photographs --output pictures
    python -m tapping_cell calibrate camera pictures --squares 10x7 --square-size 25 \\
        --marker-size 18.75
"""

from __future__ import annotations

import argparse
import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.target import Target
from tapping_cell.cli import argument_types
from tapping_cell.cli.image_output import write_image
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.simulation.rendered_sheet import Sheet, SheetCamera
from tapping_cell.vision import CameraModel, CameraPose, ReferenceMap, ReferenceMarker
from tapping_cell.vision.markers.detection import marker_pattern

TARGET = Target("charuco", 10, 7, 0.025, 0.01875, "4X4_250")
"""Default target of `calibrate print`."""
MODULES_A_SQUARE = 24
PIXEL = 0.00025
"""Pixel size of the drawn sheet of reference markers, m."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--output",
        type=Path,
        required=True,
        metavar="FOLDER",
        help="folder for the images; it must be empty or new",
    )
    parser.add_argument(
        "--what",
        choices=("target", "table"),
        default="target",
        help="subject of the images: the calibration target or the table's reference markers "
        "(default: target)",
    )
    parser.add_argument(
        "--count",
        type=argument_types.whole(1, 200),
        default=20,
        help="number of images (default: 20)",
    )
    argument_types.add_seed(parser, 1, "random seed of the views and the noise (default: 1)")
    parser.add_argument(
        "--camera", type=Path, help="ROS camera_info file (default: the package's camera_info.yaml)"
    )
    parser.add_argument(
        "--table",
        type=Path,
        help="table file with the reference markers (only with --what table; default: the "
        "package's table.yaml)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Render the photographs. Return 0.

    Raises:
        CalibrationRefused: the folder is not empty, or is a file.
        OSError: the images cannot be written.
    """
    folder: Path = arguments.output
    if folder.exists() and not folder.is_dir():
        raise CalibrationRefused(f"{folder} is a file: choose another name for the folder")
    if folder.exists() and any(folder.iterdir()):
        raise CalibrationRefused(f"{folder} is not empty: choose another folder")
    camera = load_camera_model(arguments.camera or shared_folder() / "camera_info.yaml")
    eye = SheetCamera(camera, arguments.seed)
    random = np.random.default_rng(arguments.seed)
    if arguments.what == "target":
        sheet = target_sheet(TARGET)
        poses = [view_of_target(random, camera, sheet.size) for _ in range(arguments.count)]
    else:
        sheet = table_sheet(load_reference_map(arguments.table or shared_folder() / "table.yaml"))
        poses = [view_of_table(random, camera, number) for number in range(arguments.count)]
    with _complete(folder) as draft:
        for number, pose in enumerate(poses, start=1):
            picture = eye.photograph(sheet, pose, noise=float(random.uniform(1.0, 3.0)), blur=0.7)
            write_image(draft / f"{arguments.what}_{number:02d}.png", picture)
    print(f"{len(poses)} images in {folder}")
    return 0


@contextmanager
def _complete(folder: Path) -> Iterator[Path]:
    """Provide a new folder for files. At the end, the files become the content of ``folder``; after
    an error or an interruption they are deleted. So ``folder`` never has only a part of them.

    Raises:
        OSError: a folder or file cannot be written.
    """
    place = folder.resolve()
    place.parent.mkdir(parents=True, exist_ok=True)
    draft = place.with_name(f".{place.name}.{os.getpid()}")
    draft.mkdir()
    try:
        yield draft
        if place.exists():
            # Do not replace the folder itself: it may be a shell's current folder.
            for file in sorted(draft.iterdir()):
                shutil.move(file, place / file.name)
        else:
            draft.rename(place)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def target_sheet(target: Target) -> Sheet:
    """Return a printed ChArUco target with a white margin."""
    n = MODULES_A_SQUARE
    cells = np.indices((target.rows, target.columns)).sum(axis=0) % 2 * 255
    pattern = np.kron(cells, np.ones((n, n))).astype(np.uint8)
    for number, (row, column) in enumerate(np.argwhere(cells > 0).tolist()):
        modules = marker_pattern(target.dictionary, number)
        each = round(n * target.marker / target.square) // modules.shape[0]
        marker = np.kron(modules * 255, np.ones((each, each))).astype(np.uint8)
        inset = (n - marker.shape[0]) // 2
        top, left = row * n + inset, column * n + inset
        pattern[top : top + marker.shape[0], left : left + marker.shape[1]] = marker
    return Sheet(np.pad(pattern, n // 2, constant_values=255), target.square / n)


def table_sheet(references: ReferenceMap) -> Sheet:
    """Return the reference markers on one white sheet, in the frame of the table."""
    # _draw paints a square of 1.5 times the marker's side, which extends beyond the corners.
    margin = max(0.02, 0.3 * max(marker.size for marker in references.markers))
    corners = np.abs(references.corners().reshape(-1, 2)).max(axis=0) + margin
    rows, columns = (2 * round(float(half) / PIXEL) for half in corners[::-1])
    pattern = np.full((rows, columns), 255, dtype=np.uint8)
    for marker in references.markers:
        _draw(pattern, references.dictionary, marker)
    return Sheet(pattern, PIXEL)


def _draw(pattern: NDArray[np.uint8], dictionary: str, marker: ReferenceMarker) -> None:
    modules = marker_pattern(dictionary, marker.id)
    x0, y0, turn, size = marker.x, marker.y, marker.theta, marker.size
    rows, columns = pattern.shape
    reach = 0.75 * size
    column = np.arange(round((x0 - reach) / PIXEL), round((x0 + reach) / PIXEL)) + columns // 2
    row = np.arange(round((-y0 - reach) / PIXEL), round((-y0 + reach) / PIXEL)) + rows // 2
    x, y = np.meshgrid(
        (column + 0.5 - columns / 2) * PIXEL - x0, (rows / 2 - row - 0.5) * PIXEL - y0
    )
    across = np.floor(((x * math.cos(turn) + y * math.sin(turn)) / size + 0.5) * len(modules))
    down = np.floor((0.5 - (y * math.cos(turn) - x * math.sin(turn)) / size) * len(modules))
    inside = (across >= 0) & (across < len(modules)) & (down >= 0) & (down < len(modules))
    i, j = np.where(inside, down, 0).astype(int), np.where(inside, across, 0).astype(int)
    pattern[np.ix_(row, column)] = np.where(inside & ~modules[i, j].astype(bool), 0, 255)


def view_of_target(
    random: np.random.Generator, camera: CameraModel, size: tuple[float, float]
) -> CameraPose:
    """Return a random camera pose above a target of ``size`` in m, tilted by 5 to 40 degrees in any
    direction. The target is anywhere in the image and fills a third to two thirds of it."""
    distance = size[0] / (random.uniform(0.35, 0.65) * camera.width / camera.fx)
    tilt, side = np.radians(random.uniform(5.0, 40.0)), random.uniform(0.0, 2.0 * math.pi)
    x, y = np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side)
    away = (float(distance * x), float(distance * y), float(distance * np.cos(tilt)))
    aim = random.uniform(-0.25, 0.25, 2) * distance * camera.width / camera.fx
    return CameraPose.above(away, (float(aim[0]), float(aim[1])), float(random.uniform(-0.6, 0.6)))


def view_of_table(random: np.random.Generator, camera: CameraModel, number: int) -> CameraPose:
    """Return a camera pose from which the whole table is visible."""
    side = number * math.pi / 3 + random.uniform(-0.3, 0.3)
    height = 0.80 * camera.fx / camera.width + random.uniform(0.0, 0.1)
    place = (0.35 * math.cos(side), 0.35 * math.sin(side), float(height))
    return CameraPose.above(place, spin=float(random.uniform(-3, 3)))
