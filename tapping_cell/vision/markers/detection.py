"""Square markers: dictionaries, printed patterns, and detection in an image.

The frame of a marker has its origin at the centre of the black square, x along its top edge to the
right and y up, as OpenCV draws the pattern (``generateImageMarker``). The size of a marker is the
side of its black square. Corners are clockwise in the image, starting at the top left.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import transform_points
from tapping_cell.vision.camera import Array, Image
from tapping_cell.vision.markers import aruco

# The corners of a marker of side 1 in its own frame, in the order of detection.
UNIT_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])


_ENLARGED = 2_200_000
"""Number of pixels above which an image is not enlarged, because markers appear larger in such an
image."""


class Effort(enum.IntEnum):
    """Level of a search.

    A thorough search takes 1.5 times as long as a quick search and finds smaller markers. An
    enlarged search doubles the width and height of images of up to 2.2 million pixels. An enlarged
    search takes five times as long and finds markers whose modules are little more than a pixel
    wide.
    """

    QUICK = 0
    THOROUGH = 1
    ENLARGED = 2


class MarkerError(ValueError):
    """A marker or marker map that cannot exist, e.g. with an unknown dictionary or id; the message
    gives the reason."""


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A detected marker: its id and its corners (4, 2) in pixels, accurate to about half a
    pixel."""

    id: int
    corners: Array


def _dictionaries() -> dict[str, str]:
    """Return the names (``DICT_...``) of OpenCV's dictionaries, by their names in upper case
    without this prefix."""
    return {n.upper().removeprefix("DICT_"): n for n in dir(cv2.aruco) if n.startswith("DICT_")}


def dictionary_name(name: str) -> str:
    """Return OpenCV's name (``DICT_...``) of a dictionary, e.g. apriltag_36h11, tag36h11 or 4X4_50.

    Raises MarkerError for a name that OpenCV does not have.
    """
    known = _dictionaries()
    word = name.strip().upper().removeprefix("DICT_").replace("-", "_")
    for candidate in (word, word.removeprefix("ARUCO_"), word.replace("TAG", "APRILTAG_", 1)):
        if candidate in known:
            return known[candidate]
    raise MarkerError(
        f"marker dictionary {name!r} is unknown; use apriltag_36h11, apriltag_25h9, "
        "aruco_4x4_50 or another of OpenCV's (DICT_...)"
    )


@lru_cache(maxsize=32)
def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Return a dictionary by name, e.g. apriltag_36h11. Raises MarkerError for an unknown name."""
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary_name(name)))


@lru_cache(maxsize=64)
def marker_pattern(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return the modules of a marker, including its black border, as an array (n, n): True if
    white, row 0 on top.

    Raises MarkerError for an unknown dictionary or an id out of its range.
    """
    book = marker_dictionary(dictionary)
    count = len(book.bytesList)
    if not 0 <= marker_id < count:
        raise MarkerError(
            f"marker id {marker_id} is out of range for {dictionary} (0 to {count - 1}); correct "
            "the id or the dictionary"
        )
    modules = book.markerSize + 2
    return np.asarray(aruco.draw_marker(book, marker_id, modules) > 127)


@lru_cache(maxsize=32)
def _parameters(effort: Effort) -> Any:
    parameters = aruco.detector_parameters()
    # The corners are refined later by edges.py, which uses every pixel row.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    # Detect both copies of a repeated marker, so that the duplicate is reported instead of dropped.
    parameters.minMarkerDistanceRate = 0.05
    # Two sizes of the threshold window detect as many markers as OpenCV's three
    # (benchmarks/vision.py) in less time. Three smaller sizes detect more of the small and oblique
    # markers of real photographs.
    low, high, step, perimeter = {
        Effort.QUICK: (5, 21, 16, 0.04),
        Effort.THOROUGH: (3, 19, 8, 0.02),
        Effort.ENLARGED: (5, 21, 16, 0.02),
    }[effort]
    parameters.adaptiveThreshWinSizeMin = low
    parameters.adaptiveThreshWinSizeMax = high
    parameters.adaptiveThreshWinSizeStep = step
    parameters.minMarkerPerimeterRate = perimeter
    if effort is Effort.ENLARGED:
        # Blurred modules have less contrast.
        parameters.adaptiveThreshConstant = 5
    return parameters


def find_markers(
    image: Image,
    dictionary: str,
    region: tuple[int, int, int, int] | None = None,
    effort: Effort = Effort.QUICK,
) -> list[Detection]:
    """Find all markers of a dictionary in the image or in a region (x0, y0, x1, y1), in pixels."""
    x0, y0 = 0, 0
    if region is not None:
        x0, y0 = max(0, region[0]), max(0, region[1])
        image = image[y0 : max(0, region[3]), x0 : max(0, region[2])]
        if min(image.shape) < 16:
            return []
    if image.size > _ENLARGED:
        effort = min(effort, Effort.THOROUGH)
    scale = 2.0 if effort is Effort.ENLARGED else 1.0
    if scale > 1.0:
        larger = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        image = np.asarray(larger, dtype=np.uint8)
    found = aruco.detect_markers(
        np.ascontiguousarray(image), marker_dictionary(dictionary), _parameters(effort)
    )
    # Coordinates are measured from the centre of an image's first pixel. In the enlarged image, the
    # centre of the original image's first pixel is at (scale - 1) / 2.
    offset = np.array([x0, y0]) - 0.5 * (1.0 - 1.0 / scale)
    return [Detection(number, corners / scale + offset) for number, corners in found]


def markers_instead(image: Image, wanted: str) -> tuple[str, list[int]]:
    """Return the dictionary of OpenCV other than ``wanted`` with the most markers in an image, and
    the ids of these markers; an empty name if no dictionary has two, which can be by chance."""
    others = _dictionaries()
    others.pop(dictionary_name(wanted).upper().removeprefix("DICT_"))
    # A short dictionary has the same first markers as the longer ones of its kind.
    by_length = sorted(others, key=lambda name: (len(marker_dictionary(name).bytesList), name))
    seen = {name: sorted({found.id for found in find_markers(image, name)}) for name in by_length}
    best = max(by_length, key=lambda name: len(seen[name]))
    return (best, seen[best]) if len(seen[best]) > 1 else ("", [])


def visible_instead(image: Image, dictionary: str, others: list[int]) -> str:
    """Return a sentence about the markers that an image shows in place of the wanted ones, of which
    it shows none; empty if it shows no markers. ``others`` are visible ids of the dictionary."""
    wrong = "ids"
    if not others:
        if len(inverted := find_markers(255 - image, dictionary)) > 1:
            listed = ", ".join(str(number) for number in sorted({each.id for each in inverted}))
            return (
                f"the markers {listed} are visible inverted; print black markers on white, and "
                "turn off a negative image"
            )
        dictionary, others = markers_instead(image, dictionary)
        wrong = "dictionary"
    listed = ", ".join(map(str, others))
    return (
        f"the markers {listed} of {dictionary} are visible; correct the {wrong}" if listed else ""
    )


@dataclass(frozen=True, slots=True)
class ObjectMarker:
    """The marker on an object's top: its pose on the object and its height above the table.

    ``size`` is the side of the black square in m, ``offset`` the marker's pose in the object's
    frame (m, m, rad), and ``height`` the height of the printed face above the table in m, with the
    standard deviation ``height_tolerance``.
    """

    dictionary: str
    id: int
    size: float
    height: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    height_tolerance: float = 0.0

    def __post_init__(self) -> None:
        """Raise MarkerError, with the value, if the marker cannot exist."""
        if not 0.0 < self.size < 10.0:
            raise MarkerError(f"the marker's size is {self.size} m; it must be above 0")
        marker_pattern(self.dictionary, self.id)


@dataclass(frozen=True, slots=True)
class ReferenceMarker:
    """A marker printed on the table: its centre and angle in ``table`` (m, rad), and its side
    (m)."""

    id: int
    size: float
    x: float
    y: float
    theta: float = 0.0


@dataclass(frozen=True, slots=True)
class ReferenceMap:
    """The reference markers of a table, all of one dictionary.

    ``deviation`` (m) is the root mean square error of their measured relative positions; it is 0 if
    the map is exact by definition.
    """

    dictionary: str
    markers: tuple[ReferenceMarker, ...]
    deviation: float = field(default=0.0, compare=False)

    def __post_init__(self) -> None:
        """Raise MarkerError if the map is empty, contains an id twice or has an invalid marker."""
        if not self.markers:
            raise MarkerError("the table has no reference markers; list at least two")
        ids = [marker.id for marker in self.markers]
        if len(set(ids)) != len(ids):
            raise MarkerError(f"the reference markers' ids {ids} contain an id twice")
        for marker in self.markers:
            if not 0.0 < marker.size < 10.0:
                raise MarkerError(
                    f"reference marker {marker.id} has the size {marker.size} m; it must be "
                    "above 0 and below 10 m"
                )
            marker_pattern(self.dictionary, marker.id)

    def corners(self) -> Array:
        """Corners of every marker in the table's plane, shape (M, 4, 2), in m."""
        poses = np.array([[m.x, m.y, m.theta] for m in self.markers])
        sizes = np.array([m.size for m in self.markers])
        return transform_points(poses[:, None, :], UNIT_CORNERS * sizes[:, None, None])
