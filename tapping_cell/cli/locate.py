"""Find objects in image files: their poses on the table, the uncertainty and the computing time.

Every image is processed independently, by the same pipeline as the live camera's frames. With
--sequence, the images are consecutive frames of one fixed camera: the table's pose is averaged over
the frames, and frames in which the object is at rest are fused. Several objects (--object given
more than once) are distinguished by their marker ids or by their outlines. Lengths are in mm,
angles in degrees, in the frame `table`. The exit code is 1 if no object was found in any image.

  python -m tapping_cell locate shot1.png shot2.png --camera config/camera_info.yaml \\
      --table config/table.yaml --object config/objects/aluminium_disk.yaml --annotate pictures
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.cli.errors import print_error
from tapping_cell.cli.image_output import (
    distinct_names,
    picture_files,
    refuse_replacing,
    write_image,
)
from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.objects import (
    MarkerSection,
    OutlineSection,
    ShapeSection,
    height_tolerance_key,
    seen_as,
)
from tapping_cell.configuration.schema import (
    ConfigurationError,
    build,
    quantity,
    read_yaml,
    section,
    text,
)
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.vision import (
    CameraModel,
    ObjectMarker,
    ObjectOutline,
    Observation,
    PoseTracker,
    Problem,
    ReferenceMap,
    TrackerSettings,
    marker_ids,
)
from tapping_cell.vision.annotate import annotate
from tapping_cell.vision.camera import Image
from tapping_cell.vision.images import ImageRefused, read_photograph
from tapping_cell.vision.markers.detection import dictionary_name, find_markers, visible_instead

FRAME_PERIOD = 1.0 / 30.0
"""Assumed time in s between the images of a --sequence, for estimating speeds."""


@dataclass(frozen=True, slots=True)
class SeenObject:
    """Part of an object file that is needed to detect the object. Other keys are not read."""

    shape: ShapeSection = section("outline of the object")
    height: float = quantity("height of the top above the table", "m", 0.0, 0.5)
    marker: MarkerSection | None = section("marker on the top", default=None)
    outline: OutlineSection | None = section(
        "appearance of an object without a marker", default=None
    )
    height_tolerance: float = height_tolerance_key()
    name: str = text("display name of the object", default="")

    def seen(self) -> ObjectMarker | ObjectOutline:
        """Return the marker or outline for the tracker."""
        return seen_as(self.shape, self.height, self.marker, self.outline, self.height_tolerance)

    def rim(self) -> NDArray[np.float64]:
        """Return points (N, 2) of the outline in the object's frame, in m."""
        if self.shape.vertices is not None:
            return np.array(self.shape.vertices)
        angle = np.linspace(0.0, 2.0 * np.pi, 120, endpoint=False)
        return self.shape.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's arguments."""
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE", help="image file")
    parser.add_argument(
        "--camera", type=Path, help="ROS camera_info file (default: the package's camera_info.yaml)"
    )
    parser.add_argument(
        "--table",
        type=Path,
        help="table file with the reference markers (default: the package's table.yaml)",
    )
    parser.add_argument(
        "--object",
        type=Path,
        action="append",
        help="object file with shape, height and marker or outline; may be given several times "
        "(default: the package's aluminium_disk.yaml)",
    )
    parser.add_argument(
        "--sequence",
        action="store_true",
        help="treat the images as consecutive frames of one stationary camera",
    )
    parser.add_argument(
        "--annotate",
        type=Path,
        metavar="DIR",
        help="folder for copies of the images with the results drawn in; not a folder of the "
        "images",
    )
    parser.add_argument(
        "--json", action="store_true", help="print a JSON list with one result per image"
    )


def run(arguments: argparse.Namespace) -> int:
    """Locate the object in every image. Return 0 if an object was found in at least one image, 1 if
    no object was found in any image, 2 for invalid files."""
    try:
        camera = load_camera_model(arguments.camera or shared_folder() / "camera_info.yaml")
        table = load_reference_map(arguments.table or shared_folder() / "table.yaml")
        paths = arguments.object or [shared_folder() / "objects" / "aluminium_disk.yaml"]
        objects = [load_seen_object(path) for path in paths]
        for path, seen in zip(paths, objects, strict=True):
            refuse_reference(path, seen, table)
        search = Search(camera, table, [seen.seen() for seen in objects])
        pictures = annotated_files(arguments.annotate, arguments.images, objects)
    except ValueError as error:
        print_error(str(error))
        return 2
    cv2.setNumThreads(1)
    results: list[dict[str, Any]] = []
    for number, path in enumerate(arguments.images):
        try:
            image = read_photograph(path, (camera.width, camera.height))
        except ImageRefused as error:
            results.extend(unread(path, seen.name, f"{path} {error}") for seen in objects)
            continue
        if not arguments.sequence:
            search.reset()
        for index, (seen, tracker) in enumerate(zip(objects, search.trackers, strict=True)):
            begin = time.perf_counter()
            observation = tracker.update(image.pixels, number * FRAME_PERIOD)
            milliseconds = (time.perf_counter() - begin) * 1e3
            sentence = image.explain(observation.sentence, observation.visible)
            if observation.problem is Problem.TABLE_UNKNOWN:
                sentence += search.seen_instead(image.pixels)
            observation = replace(observation, sentence=sentence)
            results.append(result(path, seen.name, observation, milliseconds))
            if arguments.annotate is None:
                continue
            view, rim = tracker.view, seen.rim()
            picture = annotate(image.pixels, view, observation, rim, seen.height, references=table)
            try:
                arguments.annotate.mkdir(parents=True, exist_ok=True)
                write_image(pictures[number * len(objects) + index], picture)
            except OSError as error:
                print_error(str(error))
                return 2
    if arguments.json:
        print(json.dumps(results, indent=1))
    else:
        print(table_of(results))
    return 0 if any(entry["visible"] for entry in results) else 1


class Search:
    """One tracker for each object. Each tracker is given the marker ids of all objects."""

    def __init__(
        self,
        camera: CameraModel,
        table: ReferenceMap,
        seen: Sequence[ObjectMarker | ObjectOutline],
    ) -> None:
        """Raises ValueError if two objects have the same marker."""
        self._camera, self._table, self._seen = camera, table, tuple(seen)
        self._settings = TrackerSettings(other_ids=marker_ids(self._seen))
        self.reset()

    def reset(self) -> None:
        """Discard the tracks."""
        self.trackers = [
            PoseTracker(self._camera, self._table, seen, self._settings) for seen in self._seen
        ]

    def seen_instead(self, image: Image) -> str:
        """Return a sentence about the markers of an image that shows no reference marker; empty if
        it shows one, or no markers."""
        wanted = {marker.id for marker in self._table.markers}
        found = {each.id for each in find_markers(image, self._table.dictionary)}
        if found & wanted:
            return ""
        others = sorted(found - self._settings.other_ids)
        instead = visible_instead(image, self._table.dictionary, others)
        return f"; {instead}" if instead else ""


def load_seen_object(path: Path) -> SeenObject:
    """Read shape, height and marker or outline from an object file.

    Raises:
        ConfigurationError: the file is invalid. The message names file, key, value and range.
    """
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise ConfigurationError(f"{path}: must be a mapping with shape, height and marker")
    keys = ("shape", "height", "marker", "outline", "name")
    wanted = {key: document[key] for key in keys if key in document}
    wanted.setdefault("name", path.stem)
    content = build(SeenObject, wanted, str(path))
    try:
        content.seen()
    except ValueError as error:
        raise ConfigurationError(f"{path}: {error}") from error
    return content


def refuse_reference(path: Path, seen: SeenObject, table: ReferenceMap) -> None:
    """Raise ConfigurationError if the object's marker is a reference marker of the table."""
    marker = seen.marker
    if marker is None or dictionary_name(marker.dictionary) != dictionary_name(table.dictionary):
        return
    if marker.id in {reference.id for reference in table.markers}:
        raise ConfigurationError(
            f"{path}: key 'marker.id' is {marker.id}, which is also a reference marker of the "
            "table; give the object another marker"
        )


def result(path: Path, name: str, observation: Observation, milliseconds: float) -> dict[str, Any]:
    """Return the result for one object in one image, in mm and degrees."""
    entry = unread(path, name, observation.sentence)
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


def unread(path: Path, name: str, sentence: str) -> dict[str, Any]:
    """Return the result for an image in which nothing was found."""
    return {
        "image": str(path),
        "object": name,
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


def annotated_files(
    folder: Path | None, images: Sequence[Path], objects: Sequence[SeenObject]
) -> list[Path]:
    """Return the file of each annotated copy: for every image, one per object. Without a folder,
    return an empty list.

    Raises:
        KeptFile: an annotated copy would replace an input image.
    """
    if folder is None:
        return []
    names = distinct_names(images)
    stems = [os.path.splitext(names[image])[0] for image in images]
    if len(objects) > 1:
        stems = [f"{stem}_{seen.name}" for stem in stems for seen in objects]
    files = picture_files(folder, stems)
    refuse_replacing(folder, files, images)
    return files


def table_of(results: list[dict[str, Any]]) -> str:
    """Format the results as text lines."""
    several = len({entry["object"] for entry in results}) > 1
    shown_as = distinct_names(Path(entry["image"]) for entry in results)
    names = [
        shown_as[Path(entry["image"])] + (f" {entry['object']}" if several else "")
        for entry in results
    ]
    width = max(5, *(len(name) for name in names))
    lines = [
        f"{'image':<{width}}  {'x mm':>10} {'y mm':>10} {'theta deg':>10}"
        f"  {'sd mm':>7} {'sd deg':>7}  {'ms':>6}  references"
    ]
    for entry, shown in zip(results, names, strict=True):
        name = f"{shown:<{width}}"
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
