"""Find objects on which the edge of a shadow lies, by searching for evenly lit patches.

If a hard shadow falls across an object, no threshold separates the object from the table. However,
its lit part and its shaded part are patches without inner edges, and together they have the
object's shape.
"""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Image

Points = NDArray[np.int32]

_EDGE = 0.05
"""Change of the grey level from one pixel to the next, as a fraction of the grey level, at which a
patch ends."""
_LEAST, _MOST = 0.08, 1.3
"""Minimum and maximum area of a patch, relative to the object's area."""
_MAX_PATCHES = 60


def patches(small: Image, area: float, reach: float) -> Iterator[Points]:
    """Yield the convex hull (N, 1, 2), in pixels, of each evenly lit patch and of each pair of
    patches that lie close together.

    ``area`` is the object's area and ``reach`` its maximum distance from its centre, in pixels.
    """
    soft = cv2.GaussianBlur(small, (3, 3), 0).astype(np.float32)
    slope = np.hypot(
        cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125),
    )
    even = (slope < _EDGE * np.maximum(soft, 8.0)).astype(np.uint8)
    count, found, boxes, middles = cv2.connectedComponentsWithStats(even, connectivity=4)
    labels, stats = np.asarray(found, dtype=np.int32), np.asarray(boxes, dtype=np.int32)
    sizes = stats[:, cv2.CC_STAT_AREA]
    kept = [k for k in range(1, count) if _LEAST * area < sizes[k] < _MOST * area][:_MAX_PATCHES]
    rims = {k: _rim(labels, stats[k], k) for k in kept}
    for number, first in enumerate(kept):
        yield _hull(rims[first])
        for second in kept[:number]:
            if np.hypot(*(middles[first] - middles[second])) < 1.5 * reach:
                yield _hull(np.concatenate([rims[first], rims[second]]))


def _hull(points: Points) -> Points:
    return np.asarray(cv2.convexHull(points), dtype=np.int32)


def _rim(labels: Points, box: Points, label: int) -> Points:
    """Points (N, 1, 2) of a patch's rim. The patch is dilated by the one pixel that its edge
    occupies."""
    x, y = int(box[cv2.CC_STAT_LEFT]), int(box[cv2.CC_STAT_TOP])
    width, height = int(box[cv2.CC_STAT_WIDTH]), int(box[cv2.CC_STAT_HEIGHT])
    mask = np.pad((labels[y : y + height, x : x + width] == label).astype(np.uint8), 2)
    mask = np.asarray(cv2.dilate(mask, np.ones((3, 3), dtype=np.uint8)), dtype=np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate([np.asarray(contour, dtype=np.int32) for contour in contours])
    return points + np.array([x - 2, y - 2], dtype=np.int32)
