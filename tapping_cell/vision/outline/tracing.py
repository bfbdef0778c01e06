"""Trace shape and marker of an unknown flat object in one image.

The image is rectified to the plane of the object's top, which removes lens distortion and
perspective, so that all pixels have the same size in m. The regions that differ from the table's
brightness are objects, and one of them is chosen. Its rim is then located with sub-pixel accuracy,
and a circle or a convex polygon is fitted to it. Near the edge of the image, a side wall is visible
beside the top, so the object should lie below the camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from tapping_cell.se2 import inverse, transform_points
from tapping_cell.vision.camera import Array, CameraModel, Image, View
from tapping_cell.vision.markers.detection import (
    Detection,
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
_TEXTURE = 4.0
"""Minimum difference between an object and the table, relative to the standard deviation of the
table's own brightness."""
_SHADOW = 0.4
"""Minimum contrast of a pixel, as a fraction of the object's contrast, for the pixel to belong to
the object and not to a soft shadow."""
_LEVEL = 1.4
"""Ratio of two successive thresholds of the contrast at which regions are searched."""
_SOFT = 2.0
"""Ratio of the sharpness of two rims above which the softer one belongs to a shadow."""
_EVERY = 8
"""Spacing, in pixels of the rectified image, of the grid nodes that are projected into the camera
image. Between nodes, the position in the camera image is interpolated."""
_APART = 0.05
"""Area of another region, relative to the object's area, above which that region is a second
object."""
_MIN_REACH = 0.006
"""Minimum radius (m) of an object; smaller regions are dirt."""
_BESIDE = 0.002
"""Distance (m) from an object within which a region that differs from the table in the other
direction is its shadow, its print or a reflection."""
_ONLY_MARKER = 1.7
"""Minimum area of an object relative to that of its marker. A smaller region is the marker with its
white border."""
_MOST_PLACES = 6
"""Largest number of objects whose places are listed."""
_BLUR = 1.5
"""Standard deviation, in pixels, of the smoothing before regions are searched."""
_DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
"""Neighbourhood of a pixel that removes thin connections between regions."""
_ACROSS = np.arange(-6.0, 6.01, 0.25)
"""Sample positions across the rim, in pixels of the rectified image."""
_NEIGHBOURS = 9
"""Number of adjacent points of the rim with whose median a point is compared."""
_ASTRAY = 1.0
"""Distance, in pixels, from this median above which a point is not used."""
_HOLLOW = 1.04
"""Ratio of the areas of convex hull and outline above which an object is not convex."""
_ROUND = 0.012
"""Maximum deviation (rms) of the rim from a circle, relative to the radius, for a round object."""
_PIXELS = 1.6
"""Maximum deviation in pixels of the rectified image, for objects with a small image."""
_FAR, _STRAY = 3.0, 0.15
"""Distance of a stray point from a circle, relative to the median distance, and the maximum share
of such points."""
_CORNERS = (0.025, 0.04, 0.06)
"""Maximum distances of the rim from the polygon's sides in the search for corners, relative to the
outline's mean radius. The coarser ones serve rounded corners."""
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
    at: tuple[float, float] | None = None,
) -> TracedObject:
    """Trace an object in an image; its top is ``height`` (m) above the table.

    The object's marker may be any marker of ``dictionary`` (None: the table's dictionary) except
    the reference markers. ``at``: a point (m) in ``table`` on the object; None if the object is
    alone on the table or the only one with a marker.

    Raises:
        NotTraced: the image shows no table, no object or no simple shape, or it does not show which
            of several objects is meant.
    """
    view = _view(image, camera, table)
    plane = _Plane.over(view, table, height)
    seen = plane.rectified(image)
    known = (plane.free(table) > 0) & np.isfinite(seen)
    excess, least = _excess(seen, known)
    found = _markers(image, table, dictionary or table.dictionary)
    middles = [view.on_plane(one.corners, height).mean(axis=0) for one in found]
    region = _chosen(_regions(excess, known, least, plane), plane, least, middles, at)
    on_it = [
        one
        for one, middle in zip(found, middles, strict=True)
        if region.encloses(plane.pixels(middle))
    ]
    marker, marker_pose = None, None
    if on_it:
        marker, marker_pose = _marker(image, view, height, on_it, dictionary or table.dictionary)
        if region.area * plane.step**2 < _ONLY_MARKER * marker.size**2:
            raise NotTraced(
                f"only marker {marker.id} and its border differ from the table: put a plain sheet "
                "of contrasting brightness under the object; if the marker covers the whole "
                "object, write its shape by hand"
            )
    brighter = region.brighter
    rim = plane.places(_rim(excess if brighter else -excess, region.outline))
    radius, corners, middle, deviation = _shape(rim, plane.step)
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


def _markers(image: Image, table: ReferenceMap, dictionary: str) -> list[Detection]:
    """Return the markers of ``dictionary`` that are not reference markers."""
    references = {marker.id for marker in table.markers}
    if dictionary != table.dictionary:
        references = set()
    return [
        one
        for one in find_markers(image, dictionary, effort=Effort.THOROUGH)
        if one.id not in references
    ]


def _marker(
    image: Image, view: View, height: float, found: list[Detection], dictionary: str
) -> tuple[ObjectMarker, tuple[float, float, float]]:
    """The marker on the object and its pose in ``table``."""
    if len(found) > 1:
        raise NotTraced(
            f"{len(found)} markers are seen on the object (ids "
            f"{', '.join(str(one.id) for one in found)}): leave one marker on it"
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


def _excess(
    seen: NDArray[np.float32], known: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], float]:
    """Return the difference of every pixel's brightness from the table's (0 for pixels that are not
    ``known``), and the minimum difference of an object.

    The table's brightness is modelled by a quadratic surface. The surface is fitted iteratively to
    the pixels whose brightness is close to it.
    """
    rows, columns = seen.shape
    v, u = (2.0 * np.arange(n, dtype=np.float32) / max(n - 1, 1) - 1.0 for n in (rows, columns))
    one = np.ones_like(seen)
    x, y = one * u[None, :], one * v[:, None]
    terms = np.stack([one, x, y, x * x, x * y, y * y], axis=-1)
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
    excess = np.where(known, seen - (terms @ light.astype(np.float32)), 0.0)
    excess = np.asarray(excess, dtype=np.float32)
    texture = float(np.std(_blurred(excess)[known][::every][near]))
    return excess, max(_MIN_CONTRAST, _TEXTURE * texture)


def _blurred(image: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _BLUR), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """A region that differs from the table, in pixels of the rectified image."""

    outline: NDArray[np.int32]
    brighter: bool
    cut: bool = False
    """Whether it reaches a reference marker or the edge of the visible area."""
    contrast: float = 0.0
    """Median difference from the table, grey levels."""

    @property
    def area(self) -> float:
        """Area without holes."""
        return float(cv2.contourArea(self.outline))

    def encloses(self, pixel: Array) -> bool:
        """Return whether a pixel (x, y) is inside."""
        return cv2.pointPolygonTest(self.outline, (float(pixel[0]), float(pixel[1])), False) >= 0

    def filled(self, shape: tuple[int, ...]) -> Mask:
        """Return a mask (255) of the region without holes."""
        mask = np.zeros(shape, dtype=np.uint8)
        cv2.drawContours(mask, [self.outline], 0, (255,), cv2.FILLED)
        return mask


def _regions(
    excess: NDArray[np.float32], known: NDArray[np.bool_], least: float, plane: _Plane
) -> list[_Region]:
    """Return the regions that differ from the table by at least ``least`` grey levels, by area,
    without the shadows and the print of larger ones."""
    found = sorted(
        (
            one
            for brighter in (False, True)
            for one in _things(excess, brighter, known, least, plane)
        ),
        key=lambda one: -one.area,
    )
    beside = 2 * round(_BESIDE / plane.step) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (beside, beside))
    kept: list[_Region] = []
    around: dict[bool, Mask] = {side: np.zeros(excess.shape, np.uint8) for side in (False, True)}
    for one in found:
        mask = one.filled(excess.shape)
        if (mask & around[not one.brighter]).any():
            continue
        kept.append(one)
        around[one.brighter] |= np.asarray(cv2.dilate(mask, kernel), dtype=np.uint8)
    return kept


def _things(
    excess: NDArray[np.float32],
    brighter: bool,
    known: NDArray[np.bool_],
    least: float,
    plane: _Plane,
) -> list[_Region]:
    """Return the regions that are brighter or darker than the table."""
    soft = _blurred(excess if brighter else -excess)
    slope = np.hypot(cv2.Sobel(soft, -1, 1, 0, scale=0.125), cv2.Sobel(soft, -1, 0, 1, scale=0.125))
    unknown = np.asarray(cv2.dilate(np.asarray(~known, dtype=np.uint8), _DISC), dtype=np.uint8)
    unknown[[0, -1], :] = unknown[:, [0, -1]] = 1
    smallest = math.pi * (_MIN_REACH / plane.step) ** 2

    def inside(outer: Mask, level: float) -> list[tuple[_Region, float]]:
        """Return the regions above a level, or the parts of them with a much sharper rim, each with
        the sharpness of its rim, 1/pixel."""
        found = []
        for outline in _outlines((soft > level) & (outer > 0), smallest):
            region = _Region(outline, brighter)
            mask = region.filled(soft.shape)
            at = outline[:, 0]
            contrast = float(np.median(soft[(mask > 0) & (soft > level)]))
            sharpness = float(np.median(slope[at[:, 1], at[:, 0]])) / contrast
            region = replace(region, contrast=contrast)
            parts = inside(mask, _LEVEL * level)
            sharper = [one for one in parts if one[1] > _SOFT * sharpness]
            found += sharper or [(region, sharpness)]
        return found

    found = []
    for rough, _ in inside(np.ones(soft.shape, dtype=np.uint8), least):
        own = (soft > _SHADOW * rough.contrast) & (rough.filled(soft.shape) > 0)
        for outline in _outlines(own, smallest):
            region = replace(rough, outline=outline)
            cut = bool((region.filled(soft.shape) & unknown).any())
            found.append(replace(region, cut=cut))
    return found


def _outlines(mask: NDArray[np.bool_], smallest: float) -> list[NDArray[np.int32]]:
    """Return the outlines of the connected regions of at least ``smallest`` pixels."""
    clean = cv2.morphologyEx(np.asarray(mask, dtype=np.uint8), cv2.MORPH_OPEN, _DISC)
    outlines, _ = cv2.findContours(clean, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(one, np.int32) for one in outlines if cv2.contourArea(one) >= smallest]


def _chosen(
    regions: list[_Region],
    plane: _Plane,
    least: float,
    markers: list[Array],
    at: tuple[float, float] | None,
) -> _Region:
    """Return the region at the point ``at``, at the only marker, or the only one."""
    points = [np.array(at)] if at is not None else markers
    if len(points) == 1:
        here = [one for one in regions if one.encloses(plane.pixels(points[0]))]
        if at is None and not here:
            raise NotTraced(
                "the object with the marker does not differ from the table: put a plain sheet of "
                "contrasting brightness under it"
            )
        if not here:
            x, y = points[0]
            raise NotTraced(
                f"no object lies at x {1e3 * x:.0f}, y {1e3 * y:.0f} mm of the table; there are"
                f" {_places(regions, plane)}"
            )
        # A part of a larger object may have been chosen, such as its print.
        regions = [min(here, key=lambda one: (one.cut, -one.area))]
    whole = [one for one in regions if not one.cut] or regions
    if not whole:
        raise NotTraced(
            f"no area at least {2e3 * _MIN_REACH:.0f} mm wide differs from the table by "
            f"{least:.0f} grey levels: put the object on the table; if it is there, put a plain "
            "sheet of contrasting brightness under it"
        )
    objects = [one for one in whole if one.area > _APART * whole[0].area]
    if len(objects) > 1:
        raise NotTraced(
            f"{len(objects)} objects lie on the table, {_places(objects, plane)}: leave one object "
            "on it, or choose one by a point on it (--at X Y)"
        )
    if objects[0].cut:
        raise NotTraced(
            "the object reaches a reference marker or the edge of the visible area: put it between "
            "the reference markers, below the camera"
        )
    return objects[0]


def _places(regions: list[_Region], plane: _Plane) -> str:
    """Return where the largest of these regions are."""
    told = []
    for one in regions[:_MOST_PLACES]:
        x, y = 1e3 * plane.places(one.outline[:, 0].mean(axis=0))
        wide = 1e3 * plane.step * math.sqrt(one.area)
        told.append(f"x {x:.0f}, y {y:.0f} mm (about {wide:.0f} mm wide)")
    more = len(regions) - len(told)
    return "; ".join([*told, *([f"and {more} smaller ones"] if more else [])]) or "none"


def _rim(excess: NDArray[np.float32], outline: NDArray[np.int32]) -> Array:
    """Points (N, 2) of the rim in pixels, with sub-pixel accuracy.

    The brightness is sampled across the coarse rim at each of its points. The rim is where the
    brightness is halfway between that inside and that outside.
    """
    rough = outline[:, 0].astype(float)
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
    # Dirt beside the rim displaces a few points.
    near = np.abs(place - scipy.ndimage.median_filter(place, _NEIGHBOURS, mode="wrap")) < _ASTRAY
    return np.asarray((rough[good] + place[:, None] * outward[good])[near])


def _sampled(image: NDArray[np.float32], at: NDArray[np.float32]) -> NDArray[np.float32]:
    """Interpolate the image linearly at pixels (..., 2); NaN outside."""
    x, y = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    border = cv2.BORDER_CONSTANT
    read = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border, borderValue=(math.nan,))
    return np.asarray(read, dtype=np.float32)


def _shape(rim: Array, step: float) -> tuple[float | None, Array | None, Array, float]:
    """Fit a circle or a polygon to a rim (N, 2). Return the radius (None for a polygon), the
    corners (n, 2; None for a circle), the centre (2,), and the root mean square distance of the rim
    from the shape, all in m. ``step``: side of a pixel, m."""
    if signed_area(rim) < 0.0:
        rim = rim[::-1]
    hull = cv2.convexHull(rim.astype(np.float32))[:, 0].astype(float)
    hollow = abs(signed_area(hull)) / abs(signed_area(rim))
    if hollow > _HOLLOW:
        raise NotTraced(
            f"the object's outline is not convex (its hull is {100 * (hollow - 1):.0f} % larger): "
            "the cell taps disks, rings and convex polygons; give the corners of its hull by hand"
        )
    middle, radius, round_by = _circle(rim)
    limit = max(_ROUND * radius, _PIXELS * step)
    if round_by > 0.3 * limit:
        for tolerance in _CORNERS:
            corners = _corners(rim, tolerance * radius)
            if corners is None:
                continue
            polygon_by = float(np.sqrt(np.mean(_distances(rim, corners) ** 2)))
            if polygon_by < min(round_by, limit):
                return None, corners, centroid(corners), polygon_by
    if round_by > limit:
        raise NotTraced(
            f"the outline is neither a disk (off by {1e3 * round_by:.1f} mm) nor a convex polygon "
            f"of at most {_MAX_CORNERS} corners; give its corners by hand"
        )
    return radius, None, middle, round_by


def _circle(points: Array) -> tuple[Array, float, float]:
    """Centre and radius of the least-squares circle through points (N, 2), and the root mean square
    distance of the points from it. A few points that are far off, such as those at a shadow, are
    not used."""
    used = np.ones(len(points), dtype=bool)
    for _ in range(4):
        centre = points[used].mean(axis=0)
        p = points[used] - centre
        a = np.column_stack([2.0 * p, np.ones(len(p))])
        found, *_ = np.linalg.lstsq(a, (p * p).sum(axis=1), rcond=None)
        middle, radius = centre + found[:2], math.sqrt(float(found[2] + found[:2] @ found[:2]))
        off = np.abs(np.hypot(*(points - middle).T) - radius)
        limit = max(_FAR * float(np.median(off)), float(np.quantile(off, 1.0 - _STRAY)))
        used = off <= limit
    return middle, radius, float(np.sqrt(np.mean(off[used] ** 2)))


def _corners(rim: Array, tolerance: float) -> Array | None:
    """Corners of the convex polygon along the rim, each the intersection of two fitted sides; None
    if there is none within ``tolerance`` (m)."""
    line = rim.astype(np.float32)[:, None, :]
    rough = cv2.approxPolyDP(line, tolerance, True)[:, 0].astype(float)
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
