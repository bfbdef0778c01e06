"""The table file (reference markers) and the camera file (ROS ``camera_info`` YAML)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from tapping_cell.configuration.hints import character_hint, number_hint
from tapping_cell.configuration.provenance import Provenance
from tapping_cell.configuration.schema import (
    ConfigurationError,
    load,
    quantity,
    read_yaml,
    section,
    text,
)
from tapping_cell.vision import CameraModel, ReferenceMap, ReferenceMarker


@dataclass(frozen=True, slots=True)
class ReferenceSection:
    """One reference marker, printed on the table."""

    id: int = quantity("number of the marker in its dictionary", "", 0, 1_000_000)
    size: float = quantity("side of the marker's black square", "m", 0.005, 1.0)
    x: float = quantity("x of the marker's centre in the frame table", "m", -10.0, 10.0)
    y: float = quantity("y of the marker's centre in the frame table", "m", -10.0, 10.0)
    theta: float = quantity("angle of the marker in the frame table", "rad", -7.0, 7.0, default=0.0)


@dataclass(frozen=True, slots=True)
class TableFile:
    """The reference markers that define the frame ``table``."""

    dictionary: str = text(
        "OpenCV name of the marker dictionary, with or without the prefix DICT_, such as "
        "APRILTAG_36h11"
    )
    markers: tuple[ReferenceSection, ...] = section("reference markers on the table")
    calibration: Provenance | None = section(
        "record of the calibration of the marker poses", default=None
    )


def load_reference_map(path: Path | str) -> ReferenceMap:
    """Load the reference markers of a table file.

    Raises:
        ConfigurationError: the file is invalid; the message names file, key, value and range.
    """
    content = load(TableFile, path)
    markers = tuple(
        ReferenceMarker(id=entry.id, size=entry.size, x=entry.x, y=entry.y, theta=entry.theta)
        for entry in content.markers
    )
    try:
        references = ReferenceMap(content.dictionary, markers, _measured(content))
    except ValueError as error:
        raise ConfigurationError(f"{path}: key 'markers': {error}") from error
    _refuse_unplaced(content, path)
    _refuse_odd_size(content, path)
    return references


def _measured(content: TableFile) -> float:
    """Return the root mean square, in m, of the standard deviations of the marker positions that a
    calibration has recorded; 0 if there is no record.
    """
    stated = content.calibration.deviations if content.calibration else {}
    places = [value for name, value in stated.items() if name[:1] in ("x", "y")]
    return math.sqrt(math.fsum(v * v for v in places) / len(places)) if places else 0.0


def _refuse_unplaced(content: TableFile, path: Path | str) -> None:
    """Raise ConfigurationError for fewer than two markers or for overlapping markers."""
    if len(content.markers) < 2:
        raise ConfigurationError(
            f"{path}: key 'markers' lists {len(content.markers)} marker(s), but at least "
            "two are needed, preferably six or more around the working area"
        )
    for first, second in combinations(content.markers, 2):
        apart = math.hypot(first.x - second.x, first.y - second.y)
        least = 0.5 * (first.size + second.size)
        if apart < least:
            raise ConfigurationError(
                f"{path}: the markers {first.id} and {second.id} lie {apart * 1e3:.1f} mm "
                f"apart; below {least * 1e3:.1f} mm, their squares overlap; correct x and y "
                "in the key 'markers'"
            )


MOST_DIFFERENT = 5.0
"""Maximum ratio of a marker's size to the median size."""


def _refuse_odd_size(content: TableFile, path: Path | str) -> None:
    """Raise ConfigurationError for a marker whose size is probably in another unit."""
    usual = median(entry.size for entry in content.markers)
    for entry in content.markers:
        if not 1.0 / MOST_DIFFERENT < entry.size / usual < MOST_DIFFERENT:
            raise ConfigurationError(
                f"{path}: the marker {entry.id} has a size of {1e3 * entry.size:.1f} mm, but most "
                f"have {1e3 * usual:.1f} mm (limit: a factor of {MOST_DIFFERENT:g}); correct "
                "'size', the side of the black square in m"
            )


def load_camera_model(path: Path | str) -> CameraModel:
    """Load a camera model from a ROS ``camera_info`` YAML file, as camera_calibration writes it.

    The projection and rectification matrices and the camera's name are ignored because pose
    estimation does not need them. The standard deviations that ``calibrate camera`` recorded are
    read.

    Raises:
        ConfigurationError: the file is invalid; the message names file, key and error.
    """
    document = read_yaml(Path(path))
    if not isinstance(document, dict):
        raise ConfigurationError(
            f"{path}: must be a mapping of keys to values, as ROS's camera_calibration writes it"
        )
    if "markers" in document:
        raise ConfigurationError(
            f"{path}: is a table file, but a camera_info file is needed here; correct the path"
        )
    try:
        camera = CameraModel.from_camera_info(
            width=_pixels(document, "image_width"),
            height=_pixels(document, "image_height"),
            distortion_model=str(_entry(document, "distortion_model")),
            d=_numbers(document, "distortion_coefficients"),
            k=_numbers(document, "camera_matrix"),
        )
        check_camera(camera)
        return replace(camera, deviations=_deviations(document))
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"{path}: {error}") from error


CAMERA_KEYS = (
    *("image_width", "image_height", "camera_matrix"),
    *("distortion_model", "distortion_coefficients"),
)
"""Keys of a camera_info file that must be there."""
IGNORED_KEYS = ("camera_name", "rectification_matrix", "projection_matrix", "calibration")
MOST_OFF_CENTRE = 0.12
"""Maximum distance of the principal point from the image's centre, as a fraction of the image's
width or height."""
OFF_CENTRE = 0.05
"""The same limit if both coordinates are off by the same factor, as those of another resolution."""


LARGE_TANGENTIAL = 0.01
"""Tangential coefficients p1 and p2 above which a warning is given. Those of lenses that are
mounted straight are a few thousandths."""


def camera_warning(camera: CameraModel) -> str:
    """Return a warning about an unusual lens model; empty if there is none."""
    tangential = camera.distortion[2:4]
    if all(abs(value) <= LARGE_TANGENTIAL for value in tangential):
        return ""
    return (
        "key 'distortion_coefficients': the tangential coefficients p1 and p2 are "
        f"{tangential[0]:g} and {tangential[1]:g} (usual: up to {LARGE_TANGENTIAL:g}); check the "
        "order, which is k1, k2, p1, p2, k3 (some programs write k3 before p1)"
    )


def check_camera(camera: CameraModel) -> None:
    """Raise ValueError if the camera matrix belongs to an image of another size, the focal length
    is implausible, or the image radius does not grow with the angle of the ray."""
    column, row = camera.cx / (camera.width - 1), camera.cy / (camera.height - 1)
    off = max(abs(column - 0.5), abs(row - 0.5))
    same = abs(column - row) < 0.03
    if off > (OFF_CENTRE if same else MOST_OFF_CENTRE):
        # Pixel coordinates count from the centre of the first pixel.
        fits = 2.0 * camera.cx + 1.0, 2.0 * camera.cy + 1.0
        remedy = "correct image_width and image_height, or calibrate the camera at this resolution"
        if max(abs(fits[0] / camera.height - 1.0), abs(fits[1] / camera.width - 1.0)) < 0.1:
            remedy = "image_width and image_height, or cx and cy, seem to be exchanged"
        if 0.0 < camera.cx < 1.0 and 0.0 < camera.cy < 1.0:
            remedy = "multiply shares of the image's size by its width (fx, cx) or height (fy, cy)"
        raise ValueError(
            f"key 'camera_matrix': the principal point ({camera.cx:.1f}, {camera.cy:.1f}) lies at "
            f"{100 * column:.0f} % of the image's width and {100 * row:.0f} % of its height, but "
            f"should be near its centre; the matrix fits an image of about {fits[0]:.0f} x "
            f"{fits[1]:.0f} pixels, not {camera.width} x {camera.height}: {remedy}"
        )
    ratio = camera.fx / camera.fy
    if not 0.9 < ratio < 1.1:
        raise ValueError(
            f"key 'camera_matrix': the focal lengths {camera.fx:.1f} and {camera.fy:.1f} pixels "
            f"differ by a factor of {ratio:.2f}; square pixels give nearly 1; calibrate the camera"
        )
    angle = math.degrees(2.0 * math.atan(0.5 * camera.width / camera.fx))
    if not 2.0 <= angle <= 150.0:
        raise ValueError(
            f"key 'camera_matrix': the focal length of {camera.fx:g} pixels gives {camera.width} "
            f"pixels an angle of view of {angle:.3g} degrees (limits 2 and 150); it must be in "
            "pixels, at the resolution of the images"
        )
    edge = np.array([(s, t) for s in np.linspace(0.0, 1.0, 9) for t in (0.0, 1.0)])
    rim = np.concatenate([edge, edge[:, ::-1]]) * [camera.width - 1, camera.height - 1]
    along = np.linspace(0.0, 1.0, 65)[:, None, None] * camera.rays(rim)
    points = camera.project(np.concatenate([along, np.ones_like(along[..., :1])], axis=-1))
    radius = np.linalg.norm(points - [camera.cx, camera.cy], axis=-1)
    if not np.all(np.diff(radius, axis=0) > 0.0):
        raise ValueError(
            "key 'distortion_coefficients': the distance of a point from the principal point does "
            f"not grow with its angle inside the image (coefficients {list(camera.distortion)}); "
            "calibrate the camera again, with views of the target in the corners of the image"
        )


def _entry(mapping: dict[str, Any], key: str, within: str = "") -> Any:
    if key not in mapping:
        others = [name for name in mapping if name not in (*CAMERA_KEYS, *IGNORED_KEYS)]
        if not within and len(others) == 1:
            odd = character_hint(str(others[0]))
            raise ValueError(f"key '{key}' is missing; if '{others[0]}' is meant, rename it{odd}")
        raise ValueError(
            f"key '{within}{key}' of a camera_info file is missing; write the file with `calibrate "
            "camera` or ROS's camera_calibration, or name the values as in the package's "
            f"camera_info.yaml (the keys here are {', '.join(map(str, mapping))})"
        )
    return mapping[key]


def _pixels(document: dict[str, Any], key: str) -> int:
    value = _entry(document, key)
    number = _number(value, key)
    if not number.is_integer():
        raise ValueError(f"key '{key}' is {value!r}, but must be a whole number of pixels")
    return int(number)


def _numbers(document: dict[str, Any], key: str) -> list[float]:
    """Return the list ``data`` of a matrix."""
    matrix = _entry(document, key)
    if not isinstance(matrix, dict):
        raise ValueError(f"key '{key}' must be a mapping with rows, cols and data")
    data = _entry(matrix, "data", f"{key}.")
    if not isinstance(data, list):
        raise ValueError(f"key '{key}.data' is {data!r}, but must be a list of numbers")
    if any(isinstance(value, list) for value in data):
        raise ValueError(f"key '{key}.data' contains lists; write all its numbers in one list")
    numbers = [_number(value, f"{key}.data[{index}]") for index, value in enumerate(data)]
    rows, columns = (matrix.get(name, 0) for name in ("rows", "cols"))
    if isinstance(rows, int) and isinstance(columns, int) and rows * columns not in (0, len(data)):
        raise ValueError(
            f"key '{key}' has {rows} rows and {columns} cols, but {len(data)} numbers in 'data'; "
            "correct one of them"
        )
    return numbers


def _number(value: Any, key: str) -> float:
    """Return the value of a key as a finite number."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        hint = number_hint(value) if isinstance(value, str) else ""
        raise ValueError(f"key '{key}' is {value!r}, but must be a number{hint}")
    try:
        number = float(value)
    except OverflowError as error:
        raise ValueError(
            f"key '{key}' is an integer beyond +-1.8e308, the limit of numbers; correct it"
        ) from error
    if not math.isfinite(number):
        raise ValueError(
            f"key '{key}' is {value}, but must be a finite number; calibrate the camera again"
        )
    return number


def _deviations(document: dict[str, Any]) -> tuple[float, ...]:
    """Return the recorded standard deviations of fx, fy, cx, cy, k1, k2, p1 and p2.

    The result is empty if the file has no such record, as in files of other programs.
    """
    record = document.get("calibration")
    stated = record.get("deviations") if isinstance(record, dict) else None
    if not isinstance(stated, dict):
        return ()
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    if "fx" not in stated:
        return ()
    return tuple(_number(stated.get(name, 0.0), f"calibration.deviations.{name}") for name in names)
