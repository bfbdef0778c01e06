"""Detection of calibration targets (chessboards and ChArUco boards) in photographs.

Corners are accurate to hundredths of a pixel. If the detection fails, the reason is returned. The
origin of a board's frame is its top left inner corner, with x along a row to the right and y down
the board. Corner ``k`` of a board of C x R squares is in row ``k // (C - 1)`` and column ``k % (C -
1)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import Array
from tapping_cell.vision.camera import Image
from tapping_cell.vision.markers import aruco
from tapping_cell.vision.markers.detection import marker_dictionary

_SEARCH_WIDTH = 1600
"""Width in pixels of the downscaled image for detection; corners are refined at full resolution."""
_MIN_SHARE = 0.2
_MIN_CORNERS = 8
"""Minimum share (``_MIN_SHARE``) and minimum number of the board's corners that a view must
show."""
_NEWER = "; a board drawn by OpenCV before 4.6 can only be detected with OpenCV 4.7 or newer"
_STEPS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)


class TargetError(ValueError):
    """Raised for an impossible target; the message names the wrong number."""


@dataclass(frozen=True)
class Target:
    """A board of ``columns`` x ``rows`` squares of side ``square`` in m.

    ``kind`` is ``"chessboard"`` or ``"charuco"``. A ChArUco board has markers of side ``marker`` in
    m of an OpenCV ``dictionary`` in its white squares.

    Raises:
        TargetError: the counts or sizes are impossible.
    """

    kind: str
    columns: int
    rows: int
    square: float
    marker: float = 0.0
    dictionary: str = ""

    def __post_init__(self) -> None:
        if self.kind not in ("chessboard", "charuco"):
            raise TargetError(f"target {self.kind!r} is unknown; use chessboard or charuco")
        if min(self.columns, self.rows) < 3 or max(self.columns, self.rows) > 200:
            raise TargetError(
                f"a board of {self.columns} x {self.rows} squares is not supported; give 3 to "
                "200 per side"
            )
        if not 0.0005 <= self.square <= 1.0:
            raise TargetError(
                f"squares of {self.square * 1e3:g} mm are outside 0.5 to 1000 mm; sizes are in mm"
            )
        if self.kind == "charuco":
            if not 0.2 * self.square <= self.marker < self.square:
                raise TargetError(
                    f"markers of {self.marker * 1e3:g} mm in squares of {self.square * 1e3:g} mm:"
                    " give the markers' side in mm, smaller than the side of the squares"
                )
            held = len(marker_dictionary(self.dictionary).bytesList)
            needed = self.columns * self.rows // 2
            if needed > held:
                raise TargetError(
                    f"{self.dictionary} has {held} markers; a board of {self.columns} x"
                    f" {self.rows} squares needs {needed}"
                )

    @property
    def inner(self) -> tuple[int, int]:
        """Number of inner corners in a row and in a column."""
        return self.columns - 1, self.rows - 1

    @cached_property
    def points(self) -> Array:
        """All corners in the board's frame, shape (corners, 2), in m."""
        across, down = self.inner
        grid = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2)
        return np.asarray(grid * self.square, dtype=float)

    @property
    def clear(self) -> float:
        """Radius about a corner within which only the corner's four squares are visible, as a
        fraction of a square's side."""
        if self.kind == "chessboard":
            return 0.35
        return 0.5 * (1.0 - self.marker / self.square)

    @cached_property
    def least_corners(self) -> int:
        """Minimum number of corners in a view."""
        return max(_MIN_CORNERS, int(np.ceil(_MIN_SHARE * len(self.points))))

    def describe(self) -> str:
        """Describe the target for the user, with sizes in mm."""
        text = f"{self.kind} of {self.columns} x {self.rows} squares of {self.square * 1e3:g} mm"
        if self.kind == "charuco":
            text += f", markers {self.dictionary} of {self.marker * 1e3:g} mm"
        return text


@dataclass(frozen=True, slots=True, eq=False)
class TargetView:
    """The corners of one photograph: their numbers ``ids`` (N,) on the board and ``pixels`` (N, 2).

    ``blur`` is the standard deviation of the point spread function in pixels. ``side`` is the
    median side length of the squares in pixels, in the more foreshortened direction.
    """

    name: str
    ids: NDArray[np.intp]
    pixels: Array
    blur: float
    side: float


def find_target(image: Image, target: Target, name: str) -> TargetView | str:
    """Detect the target's corners in a grey image. If this fails, return the reason as a string."""
    found = _chessboard(image, target) if target.kind == "chessboard" else _charuco(image, target)
    if isinstance(found, str):
        return found
    ids, pixels = found
    if len(ids) < target.least_corners:
        return (
            f"too few corners: {len(ids)} of {len(target.points)} are seen, but at least "
            f"{target.least_corners} are needed"
        )
    grid = np.stack([ids % target.inner[0], ids // target.inner[0]], axis=-1)
    if np.linalg.matrix_rank(grid - grid[0]) < 2:
        return (
            "the visible corners lie on one line; at least two rows and two columns must be visible"
        )
    side = _side(grid, pixels)
    half = int(np.clip(0.9 * target.clear * side - 1.0, 2, 15))
    start = np.array(pixels, dtype=np.float32, order="C").reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(image, start, (half, half), (-1, -1), _STEPS).reshape(-1, 2)
    moved = np.linalg.norm(refined - pixels, axis=1)
    kept = moved < max(2.0, 0.25 * side)
    if kept.sum() < target.least_corners:
        return (
            f"too few corners: only {kept.sum()} of {len(ids)} detected corners are confirmed as "
            f"corners of squares, but at least {target.least_corners} are needed"
        )
    ids, pixels = ids[kept], refined[kept].astype(float)
    return TargetView(name, ids, pixels, _blur(image, target, ids, pixels), side)


def _chessboard(image: Image, target: Target) -> tuple[NDArray[np.intp], Array] | str:
    """Detect all corners of a chessboard.

    The sector-based detector (Duda and Frese 2018) is tried first. If it fails, the classic
    detector is tried, which tolerates more perspective.
    """
    scale = max(1.0, image.shape[1] / _SEARCH_WIDTH)
    size = (round(image.shape[1] / scale), round(image.shape[0] / scale))
    small = image if scale == 1.0 else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    good, corners = cv2.findChessboardCornersSB(small, target.inner)
    if not good:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        good, corners = cv2.findChessboardCorners(small, target.inner, flags=flags)
    if not good:
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
        good, corners = cv2.findChessboardCornersSB(small, target.inner, flags=flags)
    if not good or corners is None or len(corners) != len(target.points):
        return (
            f"no target: a chessboard with {target.inner[0]} x {target.inner[1]} inner "
            "corners is not completely visible"
        )
    ratio = np.array([image.shape[1] / size[0], image.shape[0] / size[1]])
    pixels = (np.asarray(corners, dtype=float).reshape(-1, 2) + 0.5) * ratio - 0.5
    return np.arange(len(target.points)), pixels


def _charuco(image: Image, target: Target) -> tuple[NDArray[np.intp], Array] | str:
    """Detect the corners of a ChArUco board; each is identified by its adjacent markers."""
    best: tuple[NDArray[np.intp], Array] = (np.zeros(0, dtype=np.intp), np.zeros((0, 2)))
    markers = 0
    # Boards with an even number of rows that were drawn by OpenCV before 4.6 begin with a marker.
    even = target.rows % 2 == 0
    for legacy in (False, True) if even and aruco.LEGACY_BOARDS else (False,):
        ids, corners, seen = aruco.detect_board(
            image,
            marker_dictionary(target.dictionary),
            (target.columns, target.rows),
            target.square,
            target.marker,
            legacy,
        )
        markers = max(markers, seen)
        if len(ids) > len(best[0]):
            best = (ids, corners)
    if markers == 0:
        return f"no target: no marker of {target.dictionary} is seen"
    if not len(best[0]):
        return (
            f"no target: {markers} markers of {target.dictionary} are seen, but between them no "
            f"corner of a board of {target.columns} x {target.rows} squares is found"
            + ("" if aruco.LEGACY_BOARDS or not even else _NEWER)
        )
    return best


def _neighbours(grid: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return pairs (P, 2) of indices of corners that are connected by a side of a square."""
    place = {(x, y): index for index, (x, y) in enumerate(grid.tolist())}
    pairs = [
        (index, place[beside])
        for (x, y), index in place.items()
        for beside in ((x + 1, y), (x, y + 1))
        if beside in place
    ]
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)


def _side(grid: NDArray[np.intp], pixels: Array) -> float:
    """Compute the median side of the squares in pixels, in the more foreshortened direction."""
    pairs = _neighbours(grid)
    if not len(pairs):
        return 8.0
    lengths = np.linalg.norm(pixels[pairs[:, 1]] - pixels[pairs[:, 0]], axis=1)
    across = grid[pairs[:, 1], 0] != grid[pairs[:, 0], 0]
    return float(min(np.median(lengths[part]) for part in (across, ~across) if part.any()))


def _blur(image: Image, target: Target, ids: NDArray[np.intp], pixels: Array) -> float:
    """Estimate the standard deviation of the point spread function in pixels.

    A step of height c, blurred by a Gaussian, has the maximum slope c / (sigma sqrt(2 pi)). The
    result is the median over grey profiles across all sides of squares.
    """
    grid = np.stack([ids % target.inner[0], ids // target.inner[0]], axis=-1)
    pairs = _neighbours(grid)
    if not len(pairs):
        return 0.0
    start, end = pixels[pairs[:, 0]], pixels[pairs[:, 1]]
    along = end - start
    length = np.linalg.norm(along, axis=1)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / length[:, None]
    # Profiles must not reach the markers inside the white squares of a ChArUco board.
    reach = np.clip(target.clear * float(np.median(length)), 2.0, 12.0)
    step = 0.5
    offsets = np.arange(-reach, reach + step, step)
    points = (start + 0.5 * along)[:, None] + offsets[:, None] * normal[:, None]
    grey = cv2.remap(
        image.astype(np.float32),
        points[..., 0].astype(np.float32),
        points[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(float)
    contrast = grey.max(axis=1) - grey.min(axis=1)
    slope = np.abs(grey[:, 2:] - grey[:, :-2]).max(axis=1) / (2 * step)
    usable = contrast > 15.0
    if not usable.any():
        return float(reach)
    ratio = float(np.median(contrast[usable] / np.maximum(slope[usable], 1e-6)))
    return ratio / math.sqrt(2 * math.pi)
