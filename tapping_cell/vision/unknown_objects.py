"""Outlines of objects on the table that no object file describes.

The image is rectified to the plane of the table at a coarse resolution. Areas that differ in
brightness from the table are such objects, unless they are

- reference markers or objects that have been measured (with the shadow beside them),
- connected to the edge of the table's area (such as the arm, a cable or a hand),
- covered by the arm, according to its joint angles, or
- narrower than ``_MIN_WIDTH`` (such as printed lines).

A flat print wider than ``_MIN_WIDTH`` is taken for an object, and an object of the table's
brightness is not found. The silhouette projected to the table's plane contains the object's
footprint, because a camera above the table sees the side walls of an object outside its footprint.
The outlines are therefore conservative.

An outline is kept unchanged while the area changes by less than ``_SAME``, so that a planner can
compare outlines. The outline is removed when its place has been seen several times without the
object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.free_view import shadows
from tapping_cell.vision.markers.detection import ReferenceMap

Mask = NDArray[np.uint8]

CELL = 0.002
"""Size of a cell of the rectified image in m."""
_EVERY = 8
"""Spacing, in cells, of the grid nodes that are projected into the camera image. Between nodes, the
position in the camera image is interpolated."""
_MIN_WIDTH = 0.010
"""An area that differs from the table counts as a printed line or dirt if it is narrower than this
width in m. In the rectified image, areas appear wider by up to a cell on both sides."""
_MIN_RADIUS = 0.0075
"""The minimum area of an object is that of a disk with this radius in m."""
_MIN_CONTRAST = 5.0
_RELATIVE_CONTRAST = 0.1
_NOISE_DEVIATIONS = 6.0
"""The difference of a cell's brightness from the table's must exceed three limits: in grey levels,
relative to the table's brightness, and in standard deviations of the table's texture."""
_FREE_RIM = 1.45
"""Side of the square that a reference marker and its white border cover, relative to the side of
the marker."""
_BESIDE_KNOWN = 0.005
"""Distance in m from a measured object within which an area belongs to it."""
_BESIDE_ARM = 0.012
"""Distance in m from the arm's modelled shadow within which an area belongs to the arm."""
_OF_ARM = 0.3
"""If more than this fraction of an area lies within the arm's shadow, the whole area counts as part
of the arm."""
_SHADOW_EXTRA = 0.004
"""An area beside a measured object counts as a shadow if its width is at most the height of the
highest measured object plus this distance in m."""
_SAME = 0.004
"""An outline is kept if neither the old nor the new area extends beyond the other by more than this
distance in m."""
_MARGIN = 0.004
"""Distance in m by which an outline encloses its area."""
_MISSES = 2
"""Number of searches in which the place of an object is visible without it, after which the object
counts as removed."""
_MIN_CELLS = 1000
"""Number of visible cells of the table below which an image is not searched."""
_FIT_POINTS = 3000
_FIT_STEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """A measured object: outline (N, 2) in ``table``, and the height of its top, in m."""

    outline: Array
    height: float


@dataclass(frozen=True, slots=True, eq=False)
class ArmBars:
    """Round bars that model the arm: ``start`` and ``end`` (K, 3) in ``table``, ``radius`` (K,), in
    m."""

    start: Array
    end: Array
    radius: Array


@dataclass(slots=True, eq=False)
class _Tracked:
    """An unknown object: its outline (N, 2), the cells that it covers, and the number of searches
    in which its place was visible without the object."""

    outline: Array
    cells: Mask
    missed: int = 0


class UnknownObjects:
    """Finds the objects without an object file within a table of ``length`` and ``width`` m."""

    def __init__(self, length: float, width: float, references: ReferenceMap) -> None:
        columns, rows = round(length / CELL), round(width / CELL)
        self._shape = rows, columns
        self._origin = np.array([-(columns - 1) / 2, -(rows - 1) / 2]) * CELL
        corners = references.corners()
        middles = corners.mean(axis=1, keepdims=True)
        v, u = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
        powers = [(i, j) for i in range(4) for j in range(4 - i)]
        self._terms = np.stack([u**i * v**j for i, j in powers], axis=-1).astype(np.float32)
        self._markers = self._filled(middles + _FREE_RIM * (corners - middles))
        self._tracked: list[_Tracked] = []

    @property
    def outlines(self) -> list[Array]:
        """Convex outlines, points (N, 2) in ``table``, in m, of the objects found so far."""
        return [each.outline for each in self._tracked]

    def search(
        self,
        image: Image,
        view: View,
        standing: Sequence[Standing],
        arm: ArmBars | None = None,
    ) -> None:
        """Search an image for unknown objects. ``standing`` are the measured objects, which must be
        at rest."""
        seen = self._rectified(image, view)
        visible = np.isfinite(seen)
        known = self._known(view, standing)
        free = visible & (known == 0) & (self._markers == 0)
        if int(free.sum()) < _MIN_CELLS:
            return
        other = self._differs(seen, free)
        hidden = np.where(visible, 0, 1).astype(np.uint8)
        of_arm = self._arm_mask(view, arm)
        hidden |= of_arm
        found = self._areas(other, visible, of_arm, hidden, known, standing)
        self._update(found, hidden, known)

    # -- the image

    def _rectified(self, image: Image, view: View) -> NDArray[np.float32]:
        """Rectify an image to the plane of the table; NaN outside the image."""
        rows, columns = self._shape
        v, u = (np.arange(-_EVERY, n + 2 * _EVERY, _EVERY) for n in (rows, columns))
        nodes = view.project(self._origin + CELL * np.stack(np.meshgrid(u, v), axis=-1))
        step = np.linalg.norm(nodes[0, 1] - nodes[0, 0]) / _EVERY
        factor = max(1, round(float(step)))
        small = cv2.resize(
            image,
            (image.shape[1] // factor, image.shape[0] // factor),
            interpolation=cv2.INTER_AREA,
        )
        nodes = (nodes + 0.5) / factor - 0.5
        spread = [
            cv2.warpAffine(
                np.ascontiguousarray(nodes[..., axis], dtype=np.float32),
                np.array([[1.0 / _EVERY, 0.0, 1.0], [0.0, 1.0 / _EVERY, 1.0]]),
                (columns, rows),
                flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            )
            for axis in (0, 1)
        ]
        seen = cv2.remap(
            small.astype(np.float32),
            spread[0],
            spread[1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(np.nan,),
        )
        return np.asarray(seen, dtype=np.float32)

    def _differs(self, seen: NDArray[np.float32], free: NDArray[np.bool_]) -> Mask:
        """Return the cells whose brightness differs from the table's.

        The table's brightness is modelled by a cubic surface. This surface is fitted by least
        absolute deviations (iteratively reweighted least squares), because objects cover a part of
        the table.
        """
        rows = np.flatnonzero(free)
        rows = rows[:: max(1, len(rows) // _FIT_POINTS)]
        terms = self._terms.reshape(-1, self._terms.shape[-1])
        a, b = terms[rows].astype(float), seen.reshape(-1)[rows].astype(float)
        weight = np.ones(len(rows))
        for _ in range(_FIT_STEPS):
            weighted = a * weight[:, None]
            light = np.linalg.lstsq(weighted.T @ a, weighted.T @ b, rcond=None)[0]
            off = np.abs(b - a @ light)
            weight = 1.0 / np.maximum(off, 1.0)
        noise = 1.4826 * float(np.median(off))
        table = (terms @ light.astype(np.float32)).reshape(self._shape)
        least = np.maximum(
            _RELATIVE_CONTRAST * table, max(_MIN_CONTRAST, _NOISE_DEVIATIONS * noise)
        )
        other = (free & (np.abs(np.nan_to_num(seen) - table) > least)).astype(np.uint8)
        # Between a dark and a bright part of an object, there is a thin line with the table's
        # brightness. Closing fills this line.
        return np.asarray(cv2.morphologyEx(other, cv2.MORPH_CLOSE, _kernel(CELL)), dtype=np.uint8)

    # -- masks

    def _known(self, view: View, standing: Sequence[Standing]) -> Mask:
        """Return a mask of the silhouettes of the measured objects, with a margin."""
        silhouettes = [
            np.concatenate([one.outline, view.on_plane(view.project(one.outline, one.height))])
            for one in standing
        ]
        return _grown(self._filled(silhouettes, hull=True), _BESIDE_KNOWN)

    def _arm_mask(self, view: View, arm: ArmBars | None) -> Mask:
        mask = np.zeros(self._shape, dtype=np.uint8)
        if arm is None:
            return mask
        start, end, radius = shadows(view.pose.position, arm.start, arm.end, arm.radius)
        for first, last, half in zip(start, end, radius + _BESIDE_ARM, strict=True):
            ends = np.clip(np.rint(self._cells(np.stack([first, last]))), -5000, 5000).astype(int)
            width = min(2000, max(1, round(2.0 * half / CELL)))
            cv2.line(mask, ends[0].tolist(), ends[1].tolist(), (1,), width)
        return mask

    def _filled(self, outlines: Sequence[Array] | Array, hull: bool = False) -> Mask:
        """Return a mask of convex outlines (N, 2) in m."""
        mask = np.zeros(self._shape, dtype=np.uint8)
        for outline in outlines:
            corners = np.rint(self._cells(outline)).astype(np.int32)
            if hull:
                corners = np.asarray(cv2.convexHull(corners)[:, 0], dtype=np.int32)
            cv2.fillConvexPoly(mask, corners, (1,))
        return mask

    def _cells(self, places: Array) -> Array:
        """Convert points (N, 2) in m to columns and rows (N, 2)."""
        return np.asarray((places - self._origin) / CELL)

    # -- areas

    def _areas(
        self,
        other: Mask,
        visible: NDArray[np.bool_],
        of_arm: Mask,
        hidden: Mask,
        known: Mask,
        standing: Sequence[Standing],
    ) -> list[Mask]:
        """Return a mask of the cells of each object. The cells of arms and hands are added to
        ``hidden`` instead."""
        wide = cv2.morphologyEx(other, cv2.MORPH_OPEN, _kernel(0.5 * _MIN_WIDTH))
        # Opening removes thin lines but also the corners of wide areas. Only the corners are added
        # again.
        other = np.asarray(_grown(np.asarray(wide), 0.5 * _MIN_WIDTH) & other)
        outer, _ = cv2.findContours(other, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        other = np.asarray(cv2.drawContours(other, outer, -1, (1,), cv2.FILLED))
        count, labels = cv2.connectedComponents(other, connectivity=8)
        edge = np.zeros(self._shape, dtype=bool)
        edge[0] = edge[-1] = edge[:, 0] = edge[:, -1] = True
        edge |= cv2.erode(visible.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
        reaching = set(np.unique(labels[edge]).tolist())
        least = np.pi * (_MIN_RADIUS / CELL) ** 2
        highest = max((one.height for one in standing), default=0.0)
        beside = _grown(known, 2.0 * CELL)
        found: list[Mask] = []
        for number in range(1, count):
            cells = (labels == number).astype(np.uint8)
            area = int(cells.sum())
            covered = int((cells & of_arm).sum())
            if number in reaching or covered > _OF_ARM * area:
                hidden |= _grown(cells, _BESIDE_ARM)
                continue
            cells = np.asarray(cells & ~of_arm & 1, dtype=np.uint8)
            if int((cells & wide).sum()) < least:
                continue
            width = 2.0 * CELL * float(cv2.distanceTransform(cells, cv2.DIST_L2, 3).max())
            if np.any(cells & beside) and width <= highest + _SHADOW_EXTRA:
                continue
            found.append(cells)
        return found

    def _update(self, found: list[Mask], hidden: Mask, known: Mask) -> None:
        """Compare the areas found with the objects tracked so far."""
        kept: list[_Tracked] = []
        for each in self._tracked:
            size = int(each.cells.sum())
            overlaps = [int((cells & each.cells).sum()) for cells in found]
            best = int(np.argmax(overlaps)) if overlaps else -1
            if best >= 0 and overlaps[best] > 0:
                cells = found.pop(best)
                partly = bool(np.any(each.cells & (hidden | known)))
                within = not np.any(cells & ~_grown(each.cells, _SAME) & 1)
                whole = partly or not np.any(each.cells & ~_grown(cells, _SAME) & 1)
                kept.append(
                    _Tracked(each.outline, each.cells)
                    if within and whole
                    else _Tracked(self._outline(cells), cells)
                )
                continue
            if int((each.cells & known).sum()) > size // 2:
                continue
            if not np.any(each.cells & hidden):
                each.missed += 1
            if each.missed < _MISSES:
                kept.append(each)
        self._tracked = kept + [_Tracked(self._outline(cells), cells) for cells in found]

    def _outline(self, cells: Mask) -> Array:
        """Return the convex outline (N, 2) in m, with a margin, around cells."""
        rows, columns = np.nonzero(_grown(cells, _MARGIN))
        hull = cv2.convexHull(np.stack([columns, rows], axis=-1).astype(np.int32))
        few = cv2.approxPolyDP(hull, 0.5, True)[:, 0]
        return np.asarray(self._origin + CELL * few.astype(float))


def _grown(mask: Mask, distance: float) -> Mask:
    """Return the mask enlarged by a distance in m."""
    return np.asarray(cv2.dilate(mask, _kernel(distance)), dtype=np.uint8)


def _kernel(radius: float) -> Mask:
    """Return a disk with this radius in m as a structuring element for morphological operations."""
    size = 2 * max(1, int(radius / CELL)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), dtype=np.uint8)
