"""Calibrate the intrinsics of a camera from photographs of a flat target; write ROS camera_info
YAML.

Print a target (calibrate print --what charuco), attach it to a flat surface and take about 20
photographs at the image size that the cell will use, with focus and zoom locked. Show the target in
every part of the image, tilted by 20 to 40 degrees in all directions. If a folder is given, all
images in it are used. The exit code is 1 if the photographs do not determine the calibration.

  python -m tapping_cell calibrate camera photos/*.png --target charuco --squares 8x6 \\
      --square-size 25 --marker-size 18.75 --dictionary 4X4_250 --output camera_info.yaml
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from tapping_cell.calibration.camera import (
    CalibrationRefused,
    CameraCalibration,
    UsedView,
    calibrate_camera,
)
from tapping_cell.calibration.camera_file import camera_info_yaml, camera_record
from tapping_cell.calibration.camera_views import Rejected
from tapping_cell.calibration.keep import write_kept
from tapping_cell.calibration.target import Target, TargetError, TargetView, find_target
from tapping_cell.calibration.target_hint import hint
from tapping_cell.cli.calibration_arguments import add_output_arguments, output_of
from tapping_cell.cli.image_output import (
    distinct_names,
    picture_files,
    refuse_replacing,
    write_image,
)
from tapping_cell.cli.progress import progress
from tapping_cell.configuration.table import load_camera_model
from tapping_cell.vision.images import ImageRefused, read_photograph

IMAGE_ENDINGS = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm"}
COVERAGE = "coverage.png"
"""File in the folder of ``--annotate`` that shows the coverage of the image."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "images", nargs="+", type=Path, metavar="IMAGE", help="image file, or folder of images"
    )
    parser.add_argument(
        "--target",
        choices=("charuco", "chessboard"),
        default="charuco",
        help="kind of calibration target in the images (default: charuco)",
    )
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument(
        "--squares",
        type=counts,
        metavar="CxR",
        help="number of squares per row and per column, for example 8x6",
    )
    group.add_argument(
        "--corners",
        type=counts,
        metavar="CxR",
        help="number of inner corners per row and per column, as OpenCV and ROS count "
        "chessboards, for example 7x5",
    )
    parser.add_argument(
        "--square-size",
        type=float,
        required=True,
        metavar="MM",
        help="side length of a square in mm",
    )
    parser.add_argument(
        "--marker-size",
        type=float,
        metavar="MM",
        help="side length of a ChArUco marker in mm (required with --target charuco)",
    )
    parser.add_argument(
        "--dictionary",
        default="4X4_250",
        help="marker dictionary of the board (only with --target charuco; default: 4X4_250)",
    )
    parser.add_argument(
        "--model",
        choices=("auto", "plumb_bob", "rational_polynomial"),
        default="auto",
        help="lens model; auto selects the model with the least predicted projection error over "
        "the whole image (default: auto)",
    )
    parser.add_argument(
        "--name",
        default="overhead_camera",
        help="value of camera_name in the written file (default: overhead_camera)",
    )
    parser.add_argument(
        "--annotate",
        type=Path,
        metavar="DIR",
        help="folder for plots of the errors and the image coverage; not a folder of the images",
    )
    add_output_arguments(parser, "camera_info.yaml")


def counts(word: str) -> tuple[int, int]:
    """Parse two counts from a word such as 8x6."""
    found = re.fullmatch(r"(\d+)[xX](\d+)", word)
    if not found:
        raise argparse.ArgumentTypeError(f"{word!r} is not a pair of counts such as 8x6")
    return int(found[1]), int(found[2])


def run(arguments: argparse.Namespace) -> int:
    """Run the calibration. Return 0 if the file was written."""
    output = output_of(arguments)
    target = _target(arguments)
    paths = image_files(arguments.images)
    pictures = None if arguments.annotate is None else annotated_files(arguments.annotate, paths)
    views, size, unseen, notes = _find(paths, target, quiet=arguments.json)
    model = None if arguments.model == "auto" else arguments.model
    result = calibrate_camera(views, target, size, model, unseen)
    result = replace(result, warnings=(*result.warnings, *notes))
    record = camera_record(result, target.describe(), paths)
    if pictures is not None:
        write_pictures(pictures, result, arguments.annotate / COVERAGE)
    text = camera_info_yaml(result.model, arguments.name, record)
    write_kept(output, text, record, load_camera_model)
    if arguments.json:
        print(json.dumps(report(result, output.path), indent=1))
    else:
        print("\n".join(lines(result)))
        print(f"written: {output.path}")
    return 0


def _target(arguments: argparse.Namespace) -> Target:
    columns, rows = arguments.squares or tuple(count + 1 for count in arguments.corners)
    marker = 0.0
    if arguments.target == "charuco":
        if arguments.marker_size is None:
            raise CalibrationRefused("a ChArUco target needs --marker-size, in mm")
        marker = arguments.marker_size / 1e3
    try:
        return Target(
            arguments.target,
            columns,
            rows,
            arguments.square_size / 1e3,
            marker,
            arguments.dictionary if arguments.target == "charuco" else "",
        )
    except (TargetError, ValueError) as error:
        raise CalibrationRefused(str(error)) from error


def image_files(paths: list[Path]) -> list[Path]:
    """Return the image files, each of them once; each folder is replaced by the images in it,
    sorted by name.

    Raises:
        CalibrationRefused: a file does not exist, or a folder contains no image.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_ENDINGS)
            if not inside:
                raise CalibrationRefused(f"{path}: the folder contains no images")
            found.extend(inside)
        elif path.is_file():
            found.append(path)
        else:
            raise CalibrationRefused(f"{path}: there is no such file")
    different: dict[Path, Path] = {}
    for path in found:
        different.setdefault(path.resolve(), path)
    return list(different.values())


def one_size(sizes: dict[str, tuple[int, int]]) -> tuple[int, int]:
    """Return the common size (width, height) of all images. The keys of ``sizes`` are the names of
    the images.

    Raises:
        CalibrationRefused: the sizes differ, or there is no image.
    """
    if not sizes:
        raise CalibrationRefused("none of the files is a readable image")
    counted = Counter(sizes.values()).most_common()
    size, number = counted[0]
    if len(counted) > 1:
        odd = [f"{name} ({w} x {h})" for name, (w, h) in sizes.items() if (w, h) != size]
        raise CalibrationRefused(
            f"the images differ in size: {number} are {size[0]} x {size[1]} pixels, but "
            f"{name_some(odd)}."
            " A calibration is valid for one image size; leave out the images of other sizes"
        )
    return size


def name_some(names: list[str]) -> str:
    """Return the first six names and the number of further names."""
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def _find(
    paths: list[Path], target: Target, quiet: bool
) -> tuple[list[TargetView], tuple[int, int], list[Rejected], list[str]]:
    """Return the detected views of the target, the image size (width, height), the rejected files
    with the reasons, and the warnings about the files."""
    images = {}
    warned: dict[str, list[str]] = {}
    names = distinct_names(paths)
    unseen: list[Rejected] = []
    for path in paths:
        try:
            image = read_photograph(path)
            images[path] = image.size
            for warning in image.warnings:
                warned.setdefault(warning, []).append(names[path])
        except ImageRefused as error:
            unseen.append(Rejected(names[path], str(error)))
    size = one_size({names[path]: shape for path, shape in images.items()})
    views = []
    console = Console(stderr=True, quiet=quiet)
    with progress("photographs", len(images), console=console) as advance:
        for path in images:
            advance()
            try:
                image = read_photograph(path)
            except ImageRefused:
                continue  # the file was deleted after it had been listed
            found = find_target(image.pixels, target, names[path])
            if isinstance(found, str):
                unseen.append(Rejected(names[path], image.explain(found, visible=False)))
            else:
                views.append(found)
    if not views:
        for path in list(images)[:5]:
            try:
                idea = hint(read_photograph(path).pixels, target)
            except ImageRefused:
                continue  # deleted, as above
            if idea:
                raise CalibrationRefused(
                    f"no photograph shows the {target.describe()}; in {names[path]} {idea}"
                )
    notes = [f"{warning} ({name_some(files)})" for warning, files in warned.items()]
    return views, size, unseen, notes


def report(result: CameraCalibration, path: Path) -> dict[str, Any]:
    """Return the result for JSON output."""
    model = result.model
    return {
        "output": str(path),
        "image_width": model.width,
        "image_height": model.height,
        "fx": model.fx,
        "fy": model.fy,
        "cx": model.cx,
        "cy": model.cy,
        "distortion_model": model.distortion_model,
        "distortion": list(model.distortion),
        "deviations": result.deviations,
        "rms_px": result.rms,
        "lens": result.lens,
        "predicted_px": result.predicted,
        "projection_px": result.projection.tolist(),
        "views": [
            {
                "image": entry.view.name,
                "corners": len(entry.view.ids),
                "rms_px": entry.rms,
                "tilt_deg": math.degrees(entry.tilt),
                "blur_px": entry.view.blur,
            }
            for entry in result.views
        ],
        "rejected": [{"image": r.name, "reason": r.reason} for r in result.rejected],
        "coverage": result.coverage.tolist(),
        "warnings": list(result.warnings),
    }


def lines(result: CameraCalibration) -> list[str]:
    """Format the result as text."""
    m, d = result.model, result.deviations
    rows = [f"{'view':<28} {'corners':>7} {'rms px':>7} {'tilt deg':>8} {'blur px':>7}"]
    rows += [
        f"{entry.view.name:<28} {len(entry.view.ids):>7} {entry.rms:>7.3f}"
        f" {math.degrees(entry.tilt):>8.1f} {entry.view.blur:>7.2f}"
        for entry in result.views
    ]
    rows += [f"left out: {entry.name}: {entry.reason}" for entry in result.rejected]
    rows.append("number of views with corners in each part of the image:")
    rows += ["  " + " ".join(f"{count:>3}" for count in row) for row in result.coverage]
    rows.append("predicted projection error in px, from border to border of the image:")
    rows += ["  " + " ".join(f"{error:>5.2f}" for error in row) for row in result.projection]
    tried = ", ".join(f"{label} {error:.2f}" for label, error in result.predicted.items())
    rows += [
        f"lens: {result.lens} (predicted projection error over the image, px: {tried})",
        f"fx {m.fx:.2f} +- {d['fx']:.2f}, fy {m.fy:.2f} +- {d['fy']:.2f}, cx {m.cx:.2f} +-"
        f" {d['cx']:.2f}, cy {m.cy:.2f} +- {d['cy']:.2f} px",
        "distortion " + " ".join(f"{value:.5g}" for value in m.distortion),
        f"reprojection rms {result.rms:.4f} px over {len(result.views)} views",
    ]
    return rows + [f"note: {text}" for text in result.warnings]


def annotated_files(folder: Path, paths: list[Path]) -> dict[Path, Path]:
    """Return the file of the annotated copy of each image.

    Raises:
        KeptFile: an annotated copy would replace an input image.
    """
    stems = [os.path.splitext(name)[0] for name in distinct_names(paths).values()]
    files = picture_files(folder, stems, [Path(COVERAGE).stem])
    refuse_replacing(folder, [*files, folder / COVERAGE], paths)
    return dict(zip(paths, files, strict=True))


def write_pictures(pictures: dict[Path, Path], result: CameraCalibration, coverage: Path) -> None:
    """Write one image per view, with the corners and their errors (magnified 50 times), to the file
    that ``pictures`` gives for the photograph. Also write the image ``coverage``, which shows which
    parts of the camera's image the views cover and, in red, the predicted projection error: full
    red is 1 pixel or more.

    Raises:
        OSError: a folder or file cannot be written, or a photograph can no longer be read.
    """
    coverage.parent.mkdir(parents=True, exist_ok=True)
    paths = {name: path for path, name in distinct_names(pictures).items()}
    scale = max(1, round(result.model.width / 900))
    size = (result.model.height, result.model.width, 3)
    share = np.clip(result.projection, 0.0, 1.0).astype(np.float32)
    pale = 255 - 160 * cv2.resize(share, (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    whole = np.stack([pale, pale, np.full_like(pale, 255)], axis=-1).astype(np.uint8)
    for entry in result.views:
        path = paths[entry.view.name]
        try:
            image = read_photograph(path)
        except ImageRefused as error:
            raise OSError(
                f"{path} can no longer be read; keep the photographs, and repeat the command"
            ) from error
        picture = np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        _draw(picture, entry, scale)
        _draw(whole, entry, scale)
        write_image(pictures[path], picture)
    write_image(coverage, whole)


def _draw(picture: NDArray[np.uint8], entry: UsedView, scale: int) -> None:
    for (x, y), (dx, dy) in zip(entry.view.pixels.tolist(), entry.residuals.tolist(), strict=True):
        at = (round(x), round(y))
        cv2.circle(picture, at, 3 * scale, (40, 140, 0), scale, cv2.LINE_AA)
        end = (round(x + 50 * dx), round(y + 50 * dy))
        cv2.line(picture, at, end, (0, 0, 220), scale, cv2.LINE_AA)
