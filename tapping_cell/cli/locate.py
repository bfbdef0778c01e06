"""Find the object in image files: where it is on the table, how well that is known, how long it
took.

Every image is judged by itself, by the same pipeline as the live camera's frames; with --sequence
they are frames of one steady camera in the order given, so that the table's pose is averaged and
frames at rest are fused. Lengths are in mm, angles in degrees, in the frame `table`. Exit status 1
if the object was found in none.

  python -m tapping_cell locate shot1.png shot2.png --camera config/camera_info.yaml \\
      --table config/table.yaml --object config/objects/aluminium_disk.yaml --annotate pictures
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import MarkerSection, ShapeSection
from tapping_cell.configuration.schema import (
    ConfigurationError,
    build,
    quantity,
    read_yaml,
    section,
)
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.vision import ObjectMarker, Observation, PoseTracker, annotate

FRAME_PERIOD = 1.0 / 30.0
"""Seconds between the images of a --sequence, as far as speeds are concerned."""


@dataclass(frozen=True, slots=True)
class SeenObject:
    """What of an object file matters to the camera; its other keys are not read."""

    shape: ShapeSection = section("outline of the object")
    height: float = quantity("height of the top above the table", "m", 0.0, 0.5)
    marker: MarkerSection = section("marker on the top")

    def object_marker(self) -> ObjectMarker:
        """The marker as the tracker looks for it."""
        m = self.marker
        return ObjectMarker(m.dictionary, m.id, m.size, self.height, tuple(m.offset))

    def outline(self) -> np.ndarray:
        """Points (N, 2) of the outline in the object's frame, in m."""
        if self.shape.vertices is not None:
            return np.array(self.shape.vertices)
        angle = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
        return self.shape.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's arguments."""
    folder = shared_folder()
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE", help="image files")
    parser.add_argument(
        "--camera", type=Path, default=folder / "camera_info.yaml", help="ROS camera_info file"
    )
    parser.add_argument(
        "--table", type=Path, default=folder / "table.yaml", help="reference markers"
    )
    parser.add_argument(
        "--object",
        type=Path,
        default=folder / "objects" / "aluminium_disk.yaml",
        help="shape, height and marker of the object",
    )
    parser.add_argument(
        "--sequence", action="store_true", help="the images are frames of one steady camera"
    )
    parser.add_argument(
        "--annotate", type=Path, metavar="DIR", help="write pictures with the result drawn in"
    )
    parser.add_argument("--json", action="store_true", help="a list of results, one per image")


def run(arguments: argparse.Namespace) -> int:
    """Locate the object in every image; 0 if it was found in one, 1 if in none, 2 for bad files."""
    try:
        camera = load_camera_model(arguments.camera)
        table = load_reference_map(arguments.table)
        seen_object = load_seen_object(arguments.object)
        marker = seen_object.object_marker()
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    cv2.setNumThreads(1)
    results = []
    tracker = PoseTracker(camera, table, marker)
    for number, path in enumerate(arguments.images):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            sentence = f"{path} cannot be read as an image; give a PNG, JPEG, TIFF or PGM file"
            results.append(unread(path, sentence))
            continue
        if not arguments.sequence:
            tracker = PoseTracker(camera, table, marker)
        begin = time.perf_counter()
        observation = tracker.update(image, number * FRAME_PERIOD)
        milliseconds = (time.perf_counter() - begin) * 1e3
        results.append(result(path, observation, milliseconds))
        if arguments.annotate is not None:
            picture = annotate(
                image, tracker.view, observation, seen_object.outline(), seen_object.height
            )
            try:
                write_picture(arguments.annotate, path, picture)
            except OSError as error:
                print(f"{arguments.annotate}: cannot be written: {error}", file=sys.stderr)
                return 2
    if arguments.json:
        print(json.dumps(results, indent=1))
    else:
        print(table_of(results))
    return 0 if any(entry["visible"] for entry in results) else 1


def load_seen_object(path: Path) -> SeenObject:
    """Shape, height and marker out of an object file.

    Raises:
        ConfigurationError: names file, key, value and range.
    """
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise ConfigurationError(f"{path}: must be a mapping with shape, height and marker")
    wanted = {key: document[key] for key in ("shape", "height", "marker") if key in document}
    return build(SeenObject, wanted, str(path))


def result(path: Path, observation: Observation, milliseconds: float) -> dict[str, Any]:
    """One image's answer: mm and degrees."""
    entry = unread(path, observation.sentence)
    entry["milliseconds"] = round(milliseconds, 2)
    entry["references"] = list(observation.references_used)
    entry["problem"] = None if observation.visible else observation.problem.name.lower()
    if observation.pose is not None and observation.covariance is not None:
        sigma = np.sqrt(np.diag(observation.covariance))
        entry.update(
            visible=True,
            x=observation.pose.x * 1e3,
            y=observation.pose.y * 1e3,
            theta=math.degrees(observation.pose.theta),
            sd_x=float(sigma[0]) * 1e3,
            sd_y=float(sigma[1]) * 1e3,
            sd_theta=math.degrees(sigma[2]),
            at_rest=observation.at_rest,
            frames_fused=observation.frames_fused,
        )
    return entry


def unread(path: Path, sentence: str) -> dict[str, Any]:
    """The answer for an image in which nothing was found."""
    return {
        "image": str(path),
        "visible": False,
        "x": None,
        "y": None,
        "theta": None,
        "sd_x": None,
        "sd_y": None,
        "sd_theta": None,
        "at_rest": False,
        "frames_fused": 0,
        "references": [],
        "milliseconds": None,
        "problem": "unreadable",
        "sentence": sentence,
    }


def write_picture(folder: Path, path: Path, picture: np.ndarray) -> None:
    """Write an annotated picture under the image's name, as PNG.

    Raises:
        OSError: the folder or the file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{path.stem}.png"
    if not cv2.imwrite(str(target), picture):
        raise OSError(f"{target} was not written")


def table_of(results: list[dict[str, Any]]) -> str:
    """The answers as lines for people."""
    width = max(5, *(len(Path(entry["image"]).name) for entry in results))
    lines = [
        f"{'image':<{width}}  {'x mm':>10} {'y mm':>10} {'theta deg':>10}"
        f"  {'sd mm':>7} {'sd deg':>7}  {'ms':>6}  references"
    ]
    for entry in results:
        name = f"{Path(entry['image']).name:<{width}}"
        if not entry["visible"]:
            lines.append(f"{name}  not found: {entry['sentence']}")
            continue
        spread = max(entry["sd_x"], entry["sd_y"])
        lines.append(
            f"{name}  {entry['x']:>10.4f} {entry['y']:>10.4f} {entry['theta']:>10.4f}"
            f"  {spread:>7.4f} {entry['sd_theta']:>7.4f}  {entry['milliseconds']:>6.1f}"
            f"  {' '.join(map(str, entry['references']))}"
        )
        if entry["sentence"]:
            lines.append(f"{'':<{width}}  {entry['sentence']}")
    return "\n".join(lines)
