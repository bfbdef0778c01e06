"""Select the pixels that determine an outline's position, and project them to the object's
planes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray

from tapping_cell.se2 import inverse, transform_points
from tapping_cell.vision.camera import Array, CameraModel, Image, View
from tapping_cell.vision.outline.shape import Dot, ObjectOutline

SOFTENED = 2.5
"""Sigma, in pixels, of the blur that is applied to the image before a coarse fit. This blur extends
the range of convergence."""
MAX_PIXELS, ROUGH_PIXELS = 3000, 1000
"""Maximum number of pixels in a fine fit, and in a coarse or motion-blurred fit."""
_SECTORS = 24


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Pixels: their projections (N, 2) to the plane of the top and to the table, in m, and their
    flat indices (N,) in the image."""

    top: Array
    floor: Array
    pixels: NDArray[np.intp]

    def grey(self, image: Image) -> Array:
        """Grey values of these pixels in an image, (N,)."""
        return image.reshape(-1)[self.pixels].astype(float)


def softened(image: Image, view: View, outline: ObjectOutline, pose: Array, width: float) -> Image:
    """Return the image, blurred at the object and in its surroundings."""
    seen = view.project(transform_points(pose, outline.points()), outline.height)
    clearance = math.ceil(3.0 * width)
    x0, y0 = np.maximum(np.floor(seen.min(axis=0)).astype(int) - clearance, 0)
    x1, y1 = np.maximum(np.ceil(seen.max(axis=0)).astype(int) + clearance, 1)
    soft = image.copy()
    part = image[y0:y1, x0:x1]
    if part.size:
        soft[y0:y1, x0:x1] = cv2.GaussianBlur(part, (0, 0), SOFTENED)
    return soft


def rim_pixels(
    view: View,
    outline: ObjectOutline,
    pose: Array,
    width: float,
    most: int = MAX_PIXELS,
) -> Pixels | None:
    """Select at most ``most`` pixels of the band along the rim of the top."""
    top = view.project(transform_points(pose, outline.points()), outline.height)
    reach = math.ceil(width) + 1
    camera = view.camera
    x0, y0 = np.maximum(np.floor(top.min(axis=0)).astype(int) - reach, 0)
    x1, y1 = np.minimum(
        np.ceil(top.max(axis=0)).astype(int) + reach + 1, [camera.width, camera.height]
    )
    if x1 - x0 < 8 or y1 - y0 < 8:
        return None
    mask = np.zeros((y1 - y0, x1 - x0), dtype=np.uint8)
    corner = np.array([x0, y0])
    face = np.round((top - corner) * 16.0).astype(np.int32)
    cv2.polylines(mask, [face], True, (1,), round(2.0 * width) + 1, shift=4)
    if outline.vertices is not None:
        # Blurred corners are round, unlike the model, so their pixels are not used.
        for x, y in face:
            cv2.circle(mask, (int(x), int(y)), round(16.0 * width), (0,), -1, shift=4)
    return _seen_through(view, outline.height, mask, (int(x0), int(y0)), most)


def dot_pixels(view: View, outline: ObjectOutline, dot: Dot, pose: Array) -> Pixels | None:
    """Select the pixels of the dot and of the top around it, without the rim of the top."""
    clearance = -float(outline.distance(np.array([dot.offset]))[0][0])
    pixel = (float(view.pose.position[2]) - outline.height) / view.camera.fx
    reach = min(clearance - pixel, dot.radius + 5.0 * pixel)
    angle = np.linspace(0.0, 2.0 * math.pi, 32, endpoint=False)
    circle = np.array(dot.offset) + reach * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = view.project(transform_points(pose, circle), outline.height)
    x0, y0 = np.floor(seen.min(axis=0)).astype(int)
    x1, y1 = np.ceil(seen.max(axis=0)).astype(int) + 1
    if x0 < 0 or y0 < 0 or x1 > view.camera.width or y1 > view.camera.height:
        return None
    mask = np.zeros((y1 - y0, x1 - x0), dtype=np.uint8)
    cv2.fillPoly(mask, [np.round((seen - [x0, y0]) * 16.0).astype(np.int32)], (1,), shift=4)
    return _seen_through(view, outline.height, mask, (int(x0), int(y0)))


def _seen_through(
    view: View,
    height: float,
    mask: NDArray[np.uint8],
    corner: tuple[int, int],
    most: int = MAX_PIXELS,
) -> Pixels | None:
    """Project the pixels of a mask. The first pixel of the mask is the pixel ``corner`` (x, y) of
    the image."""
    rows, columns = mask.shape
    x0, y0 = corner
    chosen = np.flatnonzero(mask)
    if len(chosen) < 40:
        return None
    chosen = chosen[:: math.ceil(len(chosen) / most)]
    rays = window_rays(view.camera, x0, y0, x0 + columns, y0 + rows).reshape(-1, 2)[chosen]
    row, column = np.divmod(chosen, columns)
    pixels = (row + y0) * view.camera.width + column + x0
    return Pixels(view.rays_on_plane(rays, height), view.rays_on_plane(rays, 0.0), pixels)


def sectors_of(outline: ObjectOutline, rim: Pixels, pose: Array) -> NDArray[np.intp]:
    """Index of the rim's sector to which each pixel belongs."""
    place = transform_points(inverse(pose), rim.top)
    if outline.vertices is None:
        angle = np.arctan2(place[:, 1], place[:, 0])
        return np.floor((angle / (2.0 * math.pi) + 0.5) * _SECTORS).astype(np.intp) % _SECTORS
    corners = np.array(outline.vertices)
    along = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(along, axis=1)
    parts = sectors_a_side(outline)
    first = np.cumsum(parts) - parts
    normals, offsets = outline.sides()
    side = (place @ normals.T - offsets).argmax(axis=1)
    share = ((place - corners[side]) * along[side]).sum(axis=1) / length[side] ** 2
    part = np.clip((share * parts[side]).astype(np.intp), 0, parts[side] - 1)
    return np.asarray(first[side] + part)


def sectors_a_side(outline: ObjectOutline) -> NDArray[np.intp]:
    """Number of sectors of each side of a polygon, in the order of :func:`sectors_of`."""
    corners = np.array(outline.vertices)
    length = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return np.asarray(np.maximum(1, np.round(_SECTORS * length / length.sum())), dtype=np.intp)


def window_rays(camera: CameraModel, x0: int, y0: int, x1: int, y1: int) -> Array:
    """Directions (y1 - y0, x1 - x0, 2) of the pixels of an image window.

    The directions are exact at 8 x 8 Chebyshev nodes and are interpolated by a polynomial between
    them. The error is below 1e-6 pixel for windows of a few hundred pixels, because the distortion
    of a lens varies smoothly.
    """
    degree = 7
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    half_x, half_y = 0.5 * (x1 - 1 - x0) + 0.5, 0.5 * (y1 - 1 - y0) + 0.5
    mid_x, mid_y = 0.5 * (x0 + x1 - 1), 0.5 * (y0 + y1 - 1)
    grid = np.stack(np.meshgrid(mid_x + half_x * nodes, mid_y + half_y * nodes), axis=-1)
    known = camera.rays(grid)
    inverse = np.linalg.inv(chebvander(nodes, degree))
    at_x = chebvander((np.arange(x0, x1) - mid_x) / half_x, degree) @ inverse
    at_y = chebvander((np.arange(y0, y1) - mid_y) / half_y, degree) @ inverse
    return np.stack([at_y @ known[..., i] @ at_x.T for i in (0, 1)], axis=-1)
