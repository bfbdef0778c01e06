"""Find an outline in a whole image, knowing only its shape.

Several candidate positions are found, and the outline is fitted at each of them. Candidates are
blobs of about the right area that are darker or brighter than their surroundings. They are
extracted by morphological closing or opening of a downscaled image, with several thresholds,
because the object's brightness is unknown. If the outline fits none of these blobs, evenly lit
patches are tried (``patches``). A polygon's angle is found from the distances of its rim from its
centre. The dot resolves the angle of a disk and the ambiguity of a symmetric polygon.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.se2 import transform_points, wrap_angle
from tapping_cell.vision.camera import Array, Image, View
from tapping_cell.vision.observation import Problem
from tapping_cell.vision.outline.fit import (
    COARSE,
    MIN_CONTRAST,
    SIZE_SPREAD,
    USUAL_BLUR,
    OutlineFit,
    fit_outline,
)
from tapping_cell.vision.outline.patches import patches
from tapping_cell.vision.outline.shape import (
    ANGLES,
    Dot,
    ObjectOutline,
    centroid,
    turn_differences,
)

_MIN_SEEN = {"disk": 0.55, "polygon": 0.7}
"""Minimum visible fraction of the rim. The limit is higher for a polygon than for a disk: an arc of
a circle fits in only one place, but a polygon displaced along some of its sides still agrees with
these sides."""
_MIN_SIDE = 0.25
"""Minimum visible fraction of each long side of a polygon. Without this limit, a triangle displaced
by some millimetres can fit well: two of its sides agree, and its third side agrees with a wall as
bright as the top."""
LARGEST_STRETCH = 0.03
"""Maximum relative difference between an object's apparent size and the size in its file."""
_CERTAIN = 1e-5
_SMALL = 32
"""Size of the object, in pixels, in the downscaled image that is searched."""
_SHADES = (0.06, 0.1, 0.16, 0.25, 0.4, 0.7)
"""Thresholds for the relative difference of a blob's brightness from the surroundings."""
_AREAS = (0.65, 1.45)
_LARGEST_HULL_RATIO = 1.18
"""``_AREAS`` are the minimum and maximum area of a blob, relative to the area of the object's top.
A blob may include walls and shadows. ``_LARGEST_HULL_RATIO`` is the maximum area of a blob's convex
hull, relative to the area of the blob."""
_FORM = 0.12
"""Maximum relative deviation (rms) of a blob's shape from the outline. Walls and occlusion cause
such deviations."""
_CANDIDATES = 6
_NEAR = 30
"""Maximum error of the angle found without considering the wall, in steps of
:func:`turn_differences`. The limit corresponds to 15 degrees."""
_INSIDE, _BESIDE, _THICK = 8.0, 14.0, np.array([-1.0, 0.0, 1.0])
"""Distances, in pixels, inside and outside the rim at which the brightness of the top is compared
with that of the surroundings (beyond the wall). At each of these positions, pixels with the offsets
``_THICK`` are averaged."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A region of about the right size that is not the object: the problem, and a sentence that
    explains it."""

    problem: Problem
    sentence: str


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A candidate pose.

    ``difference`` is the relative deviation (rms) of the blob's shape from the outline, ``middle``
    (2,) the blob's centre, ``pose`` (3,) the best fit of the outline, and ``size`` the blob's size
    relative to the outline.
    """

    difference: float
    middle: Array
    pose: Array
    size: float


def least_seen(outline: ObjectOutline) -> float:
    """Minimum fraction of the rim that must be visible for the outline to be accepted."""
    return _MIN_SEEN["disk" if outline.vertices is None else "polygon"]


def find_outlines(
    image: Image, view: View, outline: ObjectOutline, known: Array, blur: float = USUAL_BLUR
) -> tuple[list[OutlineFit], list[Refused]]:
    """Find all outlines in the image; return also the rejected candidates.

    ``known`` (M, 4, 2) are the corners, in ``table``, of the reference markers' black squares.
    """
    found: list[OutlineFit] = []
    refused: list[Refused] = []
    for start, size in rough_places(image, view, outline, known):
        answer = fit_closely(image, view, outline, start, blur, size)
        if isinstance(answer, OutlineFit):
            apart = [math.hypot(*(answer.pose - other.pose)[:2]) for other in found]
            if not apart or min(apart) > 0.5 * outline.reach:
                found.append(answer)
        else:
            refused.append(answer)
    return found, refused


def fit_closely(
    image: Image,
    view: View,
    outline: ObjectOutline,
    start: Array,
    blur: float = USUAL_BLUR,
    size: float = 1.0,
) -> OutlineFit | Refused:
    """Fit the outline at a candidate pose (3,), or return why the candidate is rejected.

    ``size`` is the size of the candidate relative to the outline, including walls and shadows.
    """
    rough = rim = None
    # A shadow makes a dark object appear larger, so the size is fixed at first.
    for seems, size_spread in ((1.0, _CERTAIN), (1.0, 5.0 * SIZE_SPREAD), (size, 0.1)):
        rough = fit_outline(
            image,
            view,
            outline,
            start,
            width=COARSE,
            blur=blur,
            with_dot=False,
            size=seems,
            size_spread=size_spread,
        )
        if rough is None or rough.seen < 0.5 * least_seen(outline):
            continue
        if abs(rough.size - 1.0) > LARGEST_STRETCH:
            continue
        rim = fit_outline(image, view, outline, rough.pose, blur=blur, with_dot=False)
        if rim is not None and rim.seen >= least_seen(outline):
            break
    else:
        return _unlike(outline, rough, rim)
    if outline.dot is None:
        return accept(rim, outline)
    turned = turn_by_dot(image, view, outline, outline.dot, rim.pose)
    if isinstance(turned, Refused):
        return turned
    whole = fit_outline(image, view, outline, turned, blur=blur)
    if whole is None:
        return Refused(Problem.DOT_HIDDEN, "its dot is not seen at the expected position")
    return accept(whole, outline)


def _unlike(outline: ObjectOutline, rough: OutlineFit | None, rim: OutlineFit | None) -> Refused:
    """Return why neither the coarse nor the fine fit found the rim."""
    least = least_seen(outline)
    if rough is not None and rough.seen >= least and abs(rough.size - 1.0) > LARGEST_STRETCH:
        return wrong_size(rough)
    seen = 0.0 if rim is None else rim.seen
    return Refused(
        Problem.WRONG_OBJECT,
        f"only {seen * 100:.0f} % of its rim is seen where its outline predicts it (at least "
        f"{least * 100:.0f} % is needed)",
    )


def accept(fit: OutlineFit, outline: ObjectOutline) -> OutlineFit | Refused:
    """Return the fit if it is a fit of the object, otherwise the reason for rejecting it."""
    if abs(fit.size - 1.0) > LARGEST_STRETCH:
        return wrong_size(fit)
    least = least_seen(outline)
    if fit.seen < least or fit.contrast < MIN_CONTRAST:
        return Refused(
            Problem.WRONG_OBJECT,
            f"{fit.seen * 100:.0f} % of its rim is seen with a contrast of {fit.contrast:.0f} "
            f"grey levels (at least {least * 100:.0f} % and {MIN_CONTRAST:.0f} are needed)",
        )
    if fit.least_side < _MIN_SIDE:
        return Refused(
            Problem.WRONG_OBJECT,
            f"only {fit.least_side * 100:.0f} % of one of its sides is seen (at least "
            f"{_MIN_SIDE * 100:.0f} % of each side is needed)",
        )
    if outline.dot is not None and fit.dot_contrast < MIN_CONTRAST:
        return Refused(Problem.DOT_HIDDEN, "its dot is not seen at the expected position")
    return fit


def wrong_size(fit: OutlineFit) -> Refused:
    """Reject a region that is too large or too small."""
    return Refused(
        Problem.MISSHAPEN_OBJECT,
        f"its apparent size differs by {(fit.size - 1.0) * 100:+.1f} % from the size in its file "
        f"(limit {LARGEST_STRETCH * 100:.0f} %): it may be lifted or tilted, or be a different "
        "object, or its height in the file may be wrong",
    )


def rough_places(
    image: Image, view: View, outline: ObjectOutline, known: Array
) -> Iterator[tuple[Array, float]]:
    """Yield poses (3,) of blobs with about the object's area and shape, and their relative sizes,
    the most likely first."""
    pixel = (float(view.pose.position[2]) - outline.height) / view.camera.fx
    across = 2.0 * math.sqrt(outline.area / math.pi) / pixel
    shrink = int(np.clip(round(across / _SMALL), 1, 12))
    size = (image.shape[1] // shrink, image.shape[0] // shrink)
    scale = np.array([image.shape[1] / size[0], image.shape[0] / size[1]])
    shrunk = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    small: Image = np.array(shrunk, dtype=np.uint8)
    _paint_over(small, view, scale, known)
    if shrink < 3:
        small = np.asarray(cv2.blur(small, (3, 3)), dtype=np.uint8)
    area = outline.area / (float(scale.prod()) * pixel**2)
    wide = int(2.6 * outline.reach / pixel / shrink) | 1
    blobs = _blobs(small, outline.brighter, area, wide)
    places = [place for hull in blobs for place in _places(view, outline, hull, scale)]
    if not places:
        for hull in patches(small, area, outline.reach / pixel / shrink):
            share = (cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True)) / area
            if _AREAS[0] < share < _AREAS[1]:
                places.extend(_places(view, outline, hull, scale))
    places.sort(key=lambda place: place.difference)
    taken: list[Array] = []
    for place in places:
        if len(taken) >= _CANDIDATES:
            return
        if all(np.hypot(*(place.middle - other)) > 0.4 * outline.reach for other in taken):
            taken.append(place.middle)
            yield place.pose, place.size


def _blobs(small: Image, brighter: bool, area: float, wide: int) -> Iterator[NDArray[np.int32]]:
    """Yield the convex hulls (N, 1, 2) of nearly convex blobs that are brighter or darker than
    their surroundings. Their area is about ``area``, and they are less than ``wide`` pixels wide.
    """
    operation = cv2.MORPH_OPEN if brighter else cv2.MORPH_CLOSE
    kernel = np.ones((wide, wide), dtype=np.uint8)
    around = np.asarray(cv2.morphologyEx(small, operation, kernel), dtype=np.float32)
    shade = np.abs(small.astype(np.float32) - around) / np.maximum(around, 8.0)
    # The minimum number of points of a contour. Of all shapes with the same area, a disk has the
    # shortest rim. The number of points can be smaller than the length in pixels by a factor of up
    # to sqrt(2), because a diagonal step adds only one point.
    shortest = math.sqrt(2.0 * math.pi * _AREAS[0] * area)
    for threshold in _SHADES:
        mask = (shade > threshold).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            if len(contour) < shortest:
                continue
            # Contours pass through the centres of the outermost pixels, so half a pixel is missing
            # along the whole contour.
            inner = cv2.contourArea(contour)
            if not inner or not _AREAS[0] < (inner + 0.5 * len(contour)) / area < _AREAS[1]:
                continue
            hull = np.asarray(cv2.convexHull(contour), dtype=np.int32)
            if cv2.contourArea(hull) <= _LARGEST_HULL_RATIO * max(inner, 1.0):
                yield hull


def _places(
    view: View, outline: ObjectOutline, hull: NDArray[np.int32], scale: Array
) -> Iterator[_Place]:
    """Candidate poses for a convex hull (N, 1, 2) in the downscaled image; none if the shape
    differs."""
    seen = (hull.reshape(-1, 2) + 0.5) * scale - 0.5
    rim = view.on_plane(_walked(seen), outline.height)
    return (place for place in _matched(view, outline, rim) if place.difference < _FORM)


def _paint_over(small: Image, view: View, scale: Array, known: Array) -> None:
    """Paint the reference markers and their white borders with the grey of the table beside
    them."""
    middle = known.mean(axis=1, keepdims=True)
    rows, columns = small.shape
    for whole, beside in (
        (middle + 1.35 * (quad - middle), middle + 1.7 * (quad - middle))
        for quad, middle in zip(known, middle, strict=True)
    ):
        inner, outer = ((view.project(p) + 0.5) / scale - 0.5 for p in (whole, beside))
        at = np.rint(_walked(outer)).astype(np.intp)
        inside = ((at >= 0) & (at < [columns, rows])).all(axis=1)
        if inside.any():
            level = float(np.median(small[at[inside, 1], at[inside, 0]]))
            cv2.fillPoly(small, [np.round(inner).astype(np.int32)], (level,))


def _matched(view: View, outline: ObjectOutline, rim: Array) -> Iterator[_Place]:
    """Match a rim (N, 2), projected to the plane of the top, with the outline of the top alone, and
    with the outline of top and wall together. Yield a candidate for each of the two."""
    middle, radii = centroid(rim), _radii(rim)
    model = outline.radii()
    size = float(radii.mean() / model.mean())
    # The visible side wall of the object and the choice of the threshold change the size of the
    # rim. The rim is therefore scaled to the outline's size, and only the shapes are compared.
    differences = turn_differences(radii / size, model)
    best = int(differences.argmin())
    turn = 0.0 if outline.vertices is None else 2.0 * math.pi * best / len(model)
    at = middle - transform_points([0.0, 0.0, turn], outline.middle)
    pose = np.array([*at, turn])
    yield _Place(float(differences[best] / model.mean()), middle, pose, size)
    for _ in range(2):
        whole = _silhouette(view, outline, pose)
        model = _radii(whole)
        size = float(radii.mean() / model.mean())
        differences = turn_differences(radii / size, model)
        if outline.vertices is not None:
            near = np.arange(-_NEAR, _NEAR + 1)
            step = float(near[differences[near].argmin()])
            pose = _turned(outline, pose, np.array([2.0 * math.pi * step / len(model)]))[0]
        pose[:2] += middle - centroid(whole)
    yield _Place(float(differences.min() / model.mean()), middle, pose, size)


def _radii(rim: Array) -> Array:
    """Distances of a rim (N, 2) from its centre, at the angles of :meth:`ObjectOutline.radii`."""
    arm = rim - centroid(rim)
    angle = np.arctan2(arm[:, 1], arm[:, 0])
    order = np.argsort(angle)
    length = np.hypot(*arm.T)[order]
    grid = np.linspace(0.0, 2.0 * math.pi, ANGLES, endpoint=False)
    return np.asarray(np.interp(grid, angle[order], length, period=2.0 * math.pi))


def _silhouette(view: View, outline: ObjectOutline, pose: Array) -> Array:
    """Rim (N, 2) of top and wall together, projected to the plane of the top."""
    points = transform_points(pose, outline.points(36))
    both = np.concatenate([view.project(points, outline.height), view.project(points, 0.0)])
    hull = cv2.convexHull(both.astype(np.float32)).reshape(-1, 2).astype(float)
    return _walked(view.on_plane(hull, outline.height))


def stands_out(image: Image, view: View, outline: ObjectOutline, pose: Array) -> bool:
    """Return False if the rim cannot be within some pixels of a pose (3,).

    The test compares the grey levels on both sides of the rim at that pose. The test takes a
    hundredth of the time of a failed fit.
    """
    pixel = (float(view.pose.position[2]) - outline.height) / view.camera.fx
    points = _walked(outline.points(24))
    arm = points - outline.middle
    outward = arm / np.hypot(*arm.T)[:, None] * pixel
    inside, beside = (
        _greys(
            image,
            view,
            outline,
            transform_points(pose, points[:, None] + (far + _THICK)[:, None] * outward[:, None]),
        )
        for far in (-_INSIDE, _BESIDE)
    )
    # Each mean is taken over a dozen pixels, so that noise alone cannot appear as contrast.
    difference = (inside - beside).mean(axis=1).reshape(-1, 4).mean(axis=1)
    contrast = difference * (1.0 if outline.brighter else -1.0)
    seen = float((contrast > 0.5 * MIN_CONTRAST).mean())
    return seen >= 0.5 * least_seen(outline)


def turn_by_dot(
    image: Image, view: View, outline: ObjectOutline, dot: Dot, pose: Array
) -> Array | Refused:
    """Rotate the pose (3,) so that the predicted dot agrees with the visible one."""
    turns = np.array(outline.turns() or np.linspace(0.0, 2.0 * math.pi, 360, endpoint=False))
    angle = np.linspace(0.0, 2.0 * math.pi, 12, endpoint=False)
    circle = dot.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    poses = _turned(outline, pose, turns)
    places = transform_points(poses[:, None, :], np.array([dot.offset]))
    inner = _greys(image, view, outline, places + np.concatenate([0.0 * circle[:1], 0.55 * circle]))
    outer = _greys(image, view, outline, places + 1.6 * circle)
    difference = inner.mean(axis=1) - np.median(outer, axis=1)
    contrast = difference if dot.brighter else -difference
    best = int(contrast.argmax())
    if contrast[best] < MIN_CONTRAST:
        return Refused(
            Problem.DOT_HIDDEN,
            f"its dot is not seen (the strongest contrast is {contrast[best]:.0f} grey levels; at "
            f"least {MIN_CONTRAST:.0f} are needed)",
        )
    away = np.hypot(*(places[:, 0] - places[best, 0]).T) > 2.0 * dot.radius
    if away.any() and contrast[away].max() > 0.6 * contrast[best]:
        return Refused(
            Problem.DOT_HIDDEN, "two dots are seen instead of one, so the object's angle is unknown"
        )
    return np.asarray(poses[best])


def _turned(outline: ObjectOutline, pose: Array, turns: Array) -> Array:
    """The pose after rotations (N,) about the outline's centre, (N, 3)."""
    angles = wrap_angle(pose[2] + turns)
    aside = np.column_stack([np.zeros((len(turns), 2)), angles])
    at = transform_points(pose, outline.middle) - transform_points(aside, outline.middle)
    return np.column_stack([at, angles])


def _greys(image: Image, view: View, outline: ObjectOutline, points: Array) -> Array:
    """Grey values of the pixels at points (N, K, 2) of the top."""
    pixels = np.rint(view.project(points, outline.height)).astype(np.intp)
    rows, columns = image.shape
    x = np.clip(pixels[..., 0], 0, columns - 1)
    y = np.clip(pixels[..., 1], 0, rows - 1)
    return image[y, x].astype(float)


def _walked(polygon: Array, each: int = 8) -> Array:
    """Return points along the sides of a polygon (N, 2)."""
    after = np.roll(polygon, -1, axis=0)
    share = np.arange(each) / each
    return (polygon[:, None] + share[:, None] * (after - polygon)[:, None]).reshape(-1, 2)
