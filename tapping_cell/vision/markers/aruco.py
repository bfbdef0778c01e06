"""OpenCV's ArUco module in both versions: functions (4.6, Ubuntu 24.04) and classes (from 4.7).

This module contains all code that depends on the version.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Quad = NDArray[Any]

_aruco: Any = cv2.aruco
_CLASSES = hasattr(_aruco, "ArucoDetector")

LEGACY_BOARDS = _CLASSES
"""True if legacy ChArUco boards can be detected. These boards have an even number of rows, were
drawn before OpenCV 4.6 and begin with a marker."""


def draw_marker(book: cv2.aruco.Dictionary, marker_id: int, side: int) -> Image:
    """Draw a marker with a border of one module, ``side`` pixels wide and high."""
    draw = _aruco.generateImageMarker if _CLASSES else _aruco.drawMarker
    return np.asarray(draw(book, marker_id, side, borderBits=1), dtype=np.uint8)


def draw_board(
    book: cv2.aruco.Dictionary, grid: tuple[int, int], square: float, marker: float, side: int
) -> Image:
    """Draw a ChArUco board of ``grid`` (columns, rows) with squares of ``side`` pixels."""
    board = _board(book, grid, square, marker, legacy=False)
    size = (grid[0] * side, grid[1] * side)
    drawn = board.generateImage(size) if _CLASSES else board.draw(size)
    return np.asarray(drawn, dtype=np.uint8)


def detector_parameters() -> Any:
    """Return the detector's parameters with the defaults of this OpenCV version."""
    return _aruco.DetectorParameters() if _CLASSES else _aruco.DetectorParameters_create()


def detect_markers(
    image: Image, book: cv2.aruco.Dictionary, parameters: Any
) -> list[tuple[int, Quad]]:
    """Return id and corners, shape (4, 2) in pixels, of every detected marker."""
    if _CLASSES:
        corners, ids, _ = _aruco.ArucoDetector(book, parameters).detectMarkers(image)
    else:
        corners, ids = _detect_with_functions(image, book, parameters)
    if ids is None:
        return []
    found: list[tuple[int, Quad]] = [
        (int(number), np.asarray(four, dtype=float).reshape(4, 2))
        for number, four in zip(np.ravel(ids), corners, strict=True)
    ]
    return found if _CLASSES else _without_repeats(found, parameters.minMarkerDistanceRate)


def _detect_with_functions(image: Image, book: cv2.aruco.Dictionary, parameters: Any) -> Any:
    """Detect corners and ids with OpenCV 4.6.

    This version keeps only the larger of two close quads before decoding, and so may discard a
    marker in favour of the rim around it. The minimum distance of quads is therefore lowered, so
    that every quad is decoded.
    """
    rate = parameters.minMarkerDistanceRate
    parameters.minMarkerDistanceRate = 1e-3
    try:
        corners, ids, _ = _aruco.detectMarkers(image, book, parameters=parameters)
    finally:
        parameters.minMarkerDistanceRate = rate
    return corners, ids


def _without_repeats(found: list[tuple[int, Quad]], rate: float) -> list[tuple[int, Quad]]:
    """Of several quads that decode to the same marker at about the same position, keep only the
    largest. ``rate`` is the maximum distance of such quads, as a fraction of the perimeter."""
    kept: list[tuple[int, Quad]] = []
    # The largest quad is the rim of the marker itself; a smaller quad lies within the rim.
    for number, corners in sorted(found, key=lambda each: -_perimeter(each[1])):
        limit = rate * _perimeter(corners)
        middle = corners.mean(axis=0)
        if not any(
            number == other and np.abs(middle - quad.mean(axis=0)).max() < limit
            for other, quad in kept
        ):
            kept.append((number, corners))
    return kept


def _perimeter(corners: Quad) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).sum())


def detect_board(
    image: Image,
    book: cv2.aruco.Dictionary,
    grid: tuple[int, int],
    square: float,
    marker: float,
    legacy: bool = False,
) -> tuple[NDArray[np.intp], NDArray[np.float64], int]:
    """Detect a ChArUco board.

    Returns indices and pixels (N, 2) of its inner corners, and the number of markers detected.
    ``legacy``: the board begins with a marker; supported only if ``LEGACY_BOARDS`` is True.
    """
    board = _board(book, grid, square, marker, legacy)
    if _CLASSES:
        corners, ids, _, seen = _aruco.CharucoDetector(board).detectBoard(image)
    else:
        parameters = detector_parameters()
        markers_seen = detect_markers(image, book, parameters)
        seen = np.array([number for number, _ in markers_seen], dtype=np.int32).reshape(-1, 1)
        quads = [corners.astype(np.float32).reshape(1, 4, 2) for _, corners in markers_seen]
        corners = ids = None
        if len(seen):
            _, corners, ids = _aruco.interpolateCornersCharuco(quads, seen, image, board)
    markers = 0 if seen is None else len(seen)
    if ids is None or corners is None:
        return np.zeros(0, dtype=np.intp), np.zeros((0, 2)), markers
    return np.ravel(ids).astype(np.intp), np.asarray(corners, float).reshape(-1, 2), markers


def _board(
    book: cv2.aruco.Dictionary, grid: tuple[int, int], square: float, marker: float, legacy: bool
) -> Any:
    if not _CLASSES:
        return _aruco.CharucoBoard_create(*grid, square, marker, book)
    board = _aruco.CharucoBoard(grid, square, marker, book)
    board.setLegacyPattern(legacy)
    return board
