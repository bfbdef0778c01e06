"""Trace shape and marker of an unknown flat object in one image.

The image is rectified to the plane of the object's top, which removes lens distortion and
perspective, so that all pixels have the same size in m. The area that differs from the table's
brightness is the object. Its rim is then located with sub-pixel accuracy, and a circle or a convex
polygon is fitted to it. Near the edge of the image, a side wall is visible beside the top, so the
object should lie below the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import inverse, transform_points
from tapping_cell.vision.camera import Array, CameraModel, Image, View
from tapping_cell.vision.markers.detection import (
    Effort,
    MarkerError,
    ObjectMarker,
    ReferenceMap,
    find_markers,
    marker_pattern,
)
from tapping_cell.vision.markers.measurement import measure
from tapping_cell.vision.outline.shape import centroid, signed_area, turns_left
from tapping_cell.vision.tracker import PoseTracker

Mask = NDArray[np.uint8]

_AROUND = 0.04
"""Width (m) of a margin around the area that the centres of the reference markers enclose. The
object may lie anywhere in this area or in the margin."""
_FREE_RIM = 1.4
"""Side of the square that a reference marker and its white border cover, relative to the side of
the marker."""
_MIN_CONTRAST = 8.0
"""Minimum difference in grey levels between an object and the table."""
_SHADOW = 0.4
"""Minimum contrast of a pixel, as a fraction of the object's contrast, for the pixel to belong to
the object and not to a soft shadow."""
_EVERY = 8
"""Spacing, in pixels of the rectified image, of the grid nodes that are projected into the camera
image. Between nodes, the position in the camera image is interpolated."""
_APART = 0.05
"""Area of another region, relative to the object's area, above which that region is a second
object."""
_MIN_REACH = 0.006
"""Minimum radius (m) of an object; smaller regions are dirt."""
_ACROSS = np.arange(-6.0, 6.01, 0.25)
"""Sample positions across the rim, in pixels of the rectified image."""
_HOLLOW = 1.04
"""Ratio of the areas of convex hull and outline above which an object is not convex."""
_ROUND = 0.012
"""Maximum deviation (rms) of the rim from a circle, relative to the radius, for a round object."""
_CORNER = 0.025
"""Maximum distance of the rim from the polygon's sides in the search for corners, relative to the
outline's mean radius."""
_BESIDE_CORNER = 0.12
"""Fraction at each end of a side that is not used in its line fit, because corners appear
rounded."""
_MAX_CORNERS = 12


class NotTraced(ValueError):
    """The image shows no traceable object; the message gives the reason and a remedy."""


@dataclass(frozen=True, slots=True)
class TracedObject:
    """An object traced in one image, in m and rad.

    The shape is a disk of ``radius`` or a convex polygon of ``vertices`` (counter-clockwise). The
    object's frame has its origin at the centre of the area and is aligned with the marker or,
    without a marker, with the longest side. ``pose`` is the pose in ``table``, and ``brighter`` is
    True if the object is brighter than the table. ``deviation`` is the root mean square distance of
    the rim from the shape.
    """

    radius: float | None
    vertices: tuple[tuple[float, float], ...] | None
    pose: tuple[float, float, float]
    brighter: bool
    deviation: float
    marker: ObjectMarker | None


def trace_object(
    image: Image,
    camera: CameraModel,
    table: ReferenceMap,
    height: float,
    dictionary: str | None = None,
) -> TracedObject:
    """Trace the single object in an image; its top is ``height`` (m) above the table.

    The object's marker may be any marker of ``dictionary`` (None: the table's dictionary) except
    the reference markers.

    Raises:
        NotTraced: the image shows no table, no object, several objects, or no simple shape.
    """
    view = _view(image, camera, table)
    marker, marker_pose = _marker(image, view, table, height, dictionary or table.dictionary)
    plane = _Plane.over(view, table, height)
    seen = plane.rectified(image)
    excess = _excess(seen, plane.free(table))
    mask, brighter = _object(excess, plane, marker_pose)
    rim = plane.places(_rim(excess if brighter else -excess, mask))
    radius, corners, middle, deviation = _shape(rim)
    angle = marker_pose[2] if marker_pose is not None else _direction(corners)
    pose = (float(middle[0]), float(middle[1]), angle)
    vertices = None
    if corners is not None:
        own = transform_points(inverse(pose), corners)
        vertices = tuple((float(x), float(y)) for x, y in own)
    if marker is not None and marker_pose is not None:
        x, y = transform_points(inverse(pose), np.array([marker_pose[:2]]))[0]
        marker = ObjectMarker(
            marker.dictionary, marker.id, marker.size, height, (float(x), float(y), 0.0)
        )
    return TracedObject(radius, vertices, pose, brighter, deviation, marker)


def _view(image: Image, camera: CameraModel, table: ReferenceMap) -> View:
    """Locate the camera relative to the table by the reference markers."""
    size = table.markers[0].size
    others = {marker.id for marker in table.markers}
    free = next(number for number in range(len(others) + 1) if number not in others)
    # The tracker needs an object, but only the table is used.
    tracker = PoseTracker(camera, table, ObjectMarker(table.dictionary, free, size, 0.001))
    observation = tracker.update(image, 0.0)
    if tracker.view is None:
        raise NotTraced(f"the table is not seen: {observation.sentence}")
    return tracker.view


def _marker(
    image: Image, view: View, table: ReferenceMap, height: float, dictionary: str
) -> tuple[ObjectMarker | None, tuple[float, float, float] | None]:
    """The marker on the object and its pose in ``table``; None if there is no marker."""
    references = {marker.id for marker in table.markers}
    if dictionary != table.dictionary:
        references = set()
    found = [
        one
        for one in find_markers(image, dictionary, effort=Effort.THOROUGH)
        if one.id not in references
    ]
    if not found:
        return None, None
    if len(found) > 1:
        raise NotTraced(
            f"{len(found)} markers besides those of the table are seen (ids "
            f"{', '.join(str(one.id) for one in found)}): leave one object on the table"
        )
    number = found[0].id
    edges, sure = measure(
        image, found[0].corners[None], [marker_pattern(dictionary, number)], searched=True
    )
    if not (edges.good[0] and sure[0]):
        raise NotTraced(f"marker {number} on the object is not sharp: improve focus and light")
    corners = view.on_plane(edges.corners[0], height)
    sides = np.roll(corners, -1, axis=0) - corners
    size = float(np.hypot(sides[:, 0], sides[:, 1]).mean())
    # Corners are clockwise from the upper left, so the first and third sides are parallel to x.
    along = sides[0] - sides[2]
    x, y = corners.mean(axis=0)
    try:
        marker = ObjectMarker(dictionary, number, size, height)
    except MarkerError as error:
        raise NotTraced(str(error)) from error
    return marker, (float(x), float(y), math.atan2(along[1], along[0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """The plane of the top as an image with ``step`` m per pixel and ``origin`` (m) at pixel 0,
    0."""

    view: View
    height: float
    origin: Array
    step: float
    size: tuple[int, int]

    @classmethod
    def over(cls, view: View, table: ReferenceMap, height: float) -> _Plane:
        """Create the plane over the area that the reference markers enclose."""
        middles = np.array([[marker.x, marker.y] for marker in table.markers])
        low, high = middles.min(axis=0) - _AROUND, middles.max(axis=0) + _AROUND
        camera = view.camera
        corners = np.array([[0, 0], [camera.width - 1, 0], [0, camera.height - 1]], dtype=float)
        seen = view.on_plane(corners, height)
        # The step is 0.7 times the size of a camera pixel on this plane, so that no resolution is
        # lost.
        step = 0.7 * float(np.linalg.norm(seen[1] - seen[0])) / (camera.width - 1)
        columns, rows = (int(n) for n in np.ceil((high - low) / step))
        return cls(view, height, low, step, (columns, rows))

    def places(self, pixels: Array) -> Array:
        """Convert pixels (N, 2) of this image to points (N, 2) in m."""
        return self.origin + self.step * pixels

    def pixels(self, places: Array) -> Array:
        """Convert points (N, 2) in m to pixels (N, 2)."""
        return np.asarray((places - self.origin) / self.step)

    def rectified(self, image: Image) -> NDArray[np.float32]:
        """Rectify a camera image to the plane; NaN outside the camera image."""
        columns, rows = self.size
        # The projection is a smooth function, so it is interpolated between nodes. On both axes one
        # extra node is added before and after, so that the border is interpolated too.
        u, v = ((np.arange(-1, n // _EVERY + 2) + 0.5) * _EVERY - 0.5 for n in (columns, rows))
        nodes = self.view.project(self.places(np.stack(np.meshgrid(u, v), axis=-1)), self.height)
        size = (_EVERY * len(u), _EVERY * len(v))
        at = cv2.resize(nodes.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        own = at[_EVERY : _EVERY + rows, _EVERY : _EVERY + columns]
        return _sampled(image.astype(np.float32), np.asarray(own, dtype=np.float32))

    def free(self, table: ReferenceMap) -> Mask:
        """Return a mask that is 255 outside the reference markers."""
        columns, rows = self.size
        mask = np.full((rows, columns), 255, dtype=np.uint8)
        corners = table.corners()
        middles = corners.mean(axis=1, keepdims=True)
        # The markers are on the table below the plane, so project their apparent positions to the
        # plane.
        places = self.view.on_plane(
            self.view.project(middles + _FREE_RIM * (corners - middles)), self.height
        )
        for place in places:
            cv2.fillConvexPoly(mask, np.rint(self.pixels(place)).astype(np.int32), (0,))
        return mask


def _excess(seen: NDArray[np.float32], free: Mask) -> NDArray[np.float32]:
    """Return the difference of every pixel's brightness from the table's; 0 for pixels on reference
    markers or outside the image.

    The table's brightness is modelled by a quadratic surface. The surface is fitted iteratively to
    the pixels whose brightness is close to it.
    """
    rows, columns = seen.shape
    v, u = (2.0 * np.arange(n, dtype=np.float32) / max(n - 1, 1) - 1.0 for n in (rows, columns))
    one = np.ones_like(seen)
    x, y = one * u[None, :], one * v[:, None]
    terms = np.stack([one, x, y, x * x, x * y, y * y], axis=-1)
    known = (free > 0) & np.isfinite(seen)
    if not known.any():
        raise NotTraced("no part of the table is in the image")
    every = max(1, int(known.sum()) // 40_000)
    a, b = terms[known][::every].astype(float), seen[known][::every].astype(float)
    # Most pixels show the table, so start from the most frequent grey level.
    counts, edges = np.histogram(b, bins=64)
    near = np.abs(b - edges[int(counts.argmax())]) < 0.3 * np.ptp(edges)
    for _ in range(8):
        light, *_ = np.linalg.lstsq(a[near], b[near], rcond=None)
        off = np.abs(b - a @ light)
        near = off < max(3.0 * float(np.median(off[near])), 3.0)
    excess = seen - (terms @ light.astype(np.float32))
    return np.asarray(np.where(known, excess, 0.0), dtype=np.float32)


def _object(
    excess: NDArray[np.float32], plane: _Plane, marker: tuple[float, float, float] | None
) -> tuple[Mask, bool]:
    """Return a mask (255) of the object without holes, and whether it is brighter than the table.

    Regions darker than the table and regions brighter than the table are searched. The largest
    region is the object. Regions that differ from the table in the other direction are ignored,
    because they are the object's shadow or its print.
    """
    least = math.pi * (_MIN_REACH / plane.step) ** 2
    found = [
        (cv2.contourArea(outline), outline, brighter)
        for brighter in (False, True)
        for outline in _things(excess if brighter else -excess, least)
        if marker is None or _encloses(outline, plane.pixels(np.array([marker[:2]]))[0])
    ]
    if not found:
        raise NotTraced(
            f"no area at least {2e3 * _MIN_REACH:.0f} mm wide differs from the table by "
            f"{_MIN_CONTRAST:.0f} grey levels: put the object on the table; if it is there, put "
            "a plain sheet of contrasting brightness under it"
        )
    area, outline, brighter = max(found, key=lambda one: one[0])
    apart = [
        one
        for _, one, other in found
        if other == brighter and one is not outline and cv2.contourArea(one) > _APART * area
    ]
    if apart:
        raise NotTraced(f"{len(apart) + 1} objects lie on the table: leave one object on it")
    x, y, width, height = cv2.boundingRect(outline)
    if x <= 0 or y <= 0 or x + width >= plane.size[0] or y + height >= plane.size[1]:
        raise NotTraced("the object reaches the edge of the visible area: put it below the camera")
    filled = np.zeros(excess.shape, dtype=np.uint8)
    cv2.drawContours(filled, [outline], 0, (255,), cv2.FILLED)
    return filled, brighter


def _things(excess: NDArray[np.float32], least: float) -> list[NDArray[np.int32]]:
    """Outlines of regions brighter than the table and larger than ``least`` pixels."""
    strong = excess[excess > _MIN_CONTRAST]
    if strong.size < least:
        return []
    threshold = max(_MIN_CONTRAST, _SHADOW * float(np.median(strong)))
    mask = np.asarray(255 * (cv2.GaussianBlur(excess, (0, 0), 1.5) > threshold), dtype=np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    mask = np.asarray(cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel), dtype=np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(one, dtype=np.int32) for one in contours if cv2.contourArea(one) >= least]


def _encloses(outline: NDArray[np.int32], pixel: Array) -> bool:
    return cv2.pointPolygonTest(outline, (float(pixel[0]), float(pixel[1])), False) > 0


def _rim(excess: NDArray[np.float32], mask: Mask) -> Array:
    """Points (N, 2) of the rim in pixels, with sub-pixel accuracy.

    The brightness is sampled across the coarse rim at each of its points. The rim is where the
    brightness is halfway between that inside and that outside.
    """
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    rough = max(contours, key=cv2.contourArea)[:, 0].astype(float)
    count = len(rough)
    wide = 4
    ahead = np.roll(rough, -wide, axis=0) - np.roll(rough, wide, axis=0)
    length = np.maximum(np.hypot(ahead[:, 0], ahead[:, 1]), 1e-9)
    outward = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1) / length[:, None]
    if signed_area(rough) < 0.0:
        outward = -outward
    at = (rough[:, None, :] + _ACROSS[:, None] * outward[:, None, :]).astype(np.float32)
    read = _sampled(excess, at).astype(float)
    inside = np.median(read[:, _ACROSS <= -4.0], axis=1, keepdims=True)
    beside = np.median(read[:, _ACROSS >= 4.0], axis=1, keepdims=True)
    share = (read - beside) / np.where(np.abs(inside - beside) < 1.0, np.nan, inside - beside)
    # Use the outermost position at which the share falls below one half.
    above = share > 0.5
    last = above.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
    good = above.any(axis=1) & (last > 0) & (last < above.shape[1] - 1)
    rows = np.arange(count)[good]
    last = last[good]
    one, two = share[rows, last], share[rows, last + 1]
    place = _ACROSS[last] + (one - 0.5) / np.maximum(one - two, 1e-9) * (_ACROSS[1] - _ACROSS[0])
    if len(place) < 0.5 * count:
        raise NotTraced(
            "the object's rim is not sharp: improve the focus, or use softer light so that the "
            "object casts no hard shadow"
        )
    return np.asarray(rough[good] + place[:, None] * outward[good])


def _sampled(image: NDArray[np.float32], at: NDArray[np.float32]) -> NDArray[np.float32]:
    """Interpolate the image linearly at pixels (..., 2); NaN outside."""
    x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    border = cv2.BORDER_CONSTANT
    read = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border, borderValue=(math.nan,))
    return np.asarray(read, dtype=np.float32)


def _shape(rim: Array) -> tuple[float | None, Array | None, Array, float]:
    """Fit a circle or a polygon to a rim (N, 2). Return the radius (None for a polygon), the
    corners (n, 2; None for a circle), the centre (2,), and the root mean square distance of the rim
    from the shape, all in m."""
    if signed_area(rim) < 0.0:
        rim = rim[::-1]
    hull = cv2.convexHull(rim.astype(np.float32))[:, 0].astype(float)
    hollow = abs(signed_area(hull)) / abs(signed_area(rim))
    if hollow > _HOLLOW:
        raise NotTraced(
            f"the object's outline is not convex (its hull is {100 * (hollow - 1):.0f} % larger): "
            "the cell taps disks, rings and convex polygons; give the corners of its hull by hand"
        )
    middle, radius = _circle(rim)
    off = np.hypot(*(rim - middle).T) - radius
    round_by = float(np.sqrt(np.mean(off**2)))
    corners = _corners(rim, radius) if round_by > 0.3 * _ROUND * radius else None
    if corners is not None:
        polygon_by = float(np.sqrt(np.mean(_distances(rim, corners) ** 2)))
        if polygon_by < round_by:
            return None, corners, centroid(corners), polygon_by
    if round_by > _ROUND * radius:
        raise NotTraced(
            f"the outline is neither a disk (off by {1e3 * round_by:.1f} mm) nor a convex polygon "
            f"of at most {_MAX_CORNERS} corners; give its corners by hand"
        )
    return radius, None, middle, round_by


def _circle(points: Array) -> tuple[Array, float]:
    """Centre and radius of the least-squares circle through points (N, 2)."""
    centre = points.mean(axis=0)
    p = points - centre
    a = np.column_stack([2.0 * p, np.ones(len(p))])
    found, *_ = np.linalg.lstsq(a, (p * p).sum(axis=1), rcond=None)
    middle = found[:2]
    return centre + middle, math.sqrt(float(found[2] + middle @ middle))


def _corners(rim: Array, radius: float) -> Array | None:
    """Corners of the convex polygon along the rim, each the intersection of two fitted sides."""
    line = rim.astype(np.float32)[:, None, :]
    rough = cv2.approxPolyDP(line, _CORNER * radius, True)[:, 0].astype(float)
    if not 3 <= len(rough) <= _MAX_CORNERS:
        return None
    start = [int(np.argmin(np.hypot(*(rim - corner).T))) for corner in rough]
    middles, normals = [], []
    for first, last in zip(start, [*start[1:], start[0]], strict=True):
        indices = np.arange(first, last if last > first else last + len(rim)) % len(rim)
        cut = int(_BESIDE_CORNER * len(indices))
        side = rim[indices[cut : len(indices) - cut]]
        if len(side) < 5:
            return None
        middle = side.mean(axis=0)
        # The normal of a side is the direction in which its points scatter least.
        _, _, directions = np.linalg.svd(side - middle, full_matrices=False)
        middles.append(middle)
        normals.append(directions[1])
    corners = []
    for number in range(len(start)):
        n = np.stack([normals[number - 1], normals[number]])
        if abs(np.linalg.det(n)) < 0.05:
            return None
        right = [normals[k] @ middles[k] for k in (number - 1, number)]
        corners.append(np.linalg.solve(n, right))
    made = np.array(corners)
    return made if turns_left(made) else None


def _distances(points: Array, corners: Array) -> Array:
    """Distance of each point (N, 2) from the nearest side of a polygon (n, 2)."""
    begin, end = corners, np.roll(corners, -1, axis=0)
    along = end - begin
    share = ((points[:, None] - begin) * along).sum(axis=-1) / (along * along).sum(axis=-1)
    nearest = begin + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.asarray(np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1))


def _direction(corners: Array | None) -> float:
    """Angle of a polygon's longest side; 0 for a disk."""
    if corners is None:
        return 0.0
    sides = np.roll(corners, -1, axis=0) - corners
    longest = sides[int(np.hypot(sides[:, 0], sides[:, 1]).argmax())]
    return math.atan2(longest[1], longest[0])
