"""Overhead camera of the simulated world: images with exact ground truth, fast enough for 30 Hz.

The images include perspective from a tilted pose, lens distortion, area sampling of markers, uneven
light, sensor noise, motion blur, the object's side wall, and silhouettes above the table (the arm,
a hand). The table is drawn once. The objects at rest are redrawn only when one of them has moved.
In each frame, only the regions around moving objects are redrawn.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapping_cell import se2
from tapping_cell.simulation.camera_layers import (
    Array32,
    Layer,
    convex_coverage,
    marker_layer,
    outline_layer,
)
from tapping_cell.vision.camera import CameraModel, CameraPose, Image, View
from tapping_cell.vision.markers.detection import ObjectMarker, ReferenceMap
from tapping_cell.vision.outline.shape import ObjectOutline

TABLE_REFLECTANCE = 0.50
TOP_REFLECTANCE = 0.30
WALL_REFLECTANCE = 0.16
BRIGHT_TOP_REFLECTANCE = 0.78
BRIGHT_WALL_REFLECTANCE = 0.42
"""Reflectances of the top and the side wall of an object that is brighter than the table."""
DARK_DOT_REFLECTANCE = 0.08
BRIGHT_DOT_REFLECTANCE = 0.95
WHITE_LEVEL = 230.0
"""Grey level of a surface with reflectance 1 in the brightest light."""
LAMP = (0.09, -0.07)
"""Displacement of a drawing's shadow (x, y in ``table``) per height above the table."""
_COARSE = 8
"""Pixels per cell of the grid in which shadows are drawn."""
_STRIP = 8
"""Height of a strip of that grid."""
_STRIP_MARGIN = 4
"""Rows around a strip of an image with a rolling shutter that are rendered because of the blur."""
_FRACTION = 16
"""Fixed-point units per grey level in the noise-free image, so that values are rounded only after
the noise was added."""


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """Light and sensor.

    ``light_falloff``: fraction of the light lost from the brightest side to the darkest, in the
    direction ``light_direction`` (rad, in table); ``noise``: standard deviation in grey levels;
    ``blur``: sigma of the point spread function in pixels, including the averaging over a pixel;
    ``shadow``: displacement of the object's shadow (m, in table); ``shadow_depth``: fraction of the
    light that the shadow removes; ``rolling``: fraction of the time of an image by which the
    exposure of its last row is later than that of its first (0: global shutter).
    """

    noise: float = 2.0
    light_falloff: float = 0.3
    light_direction: float = 0.6
    vignetting: float = 0.1
    blur: float = 0.65
    shadow: tuple[float, float] = (0.0, 0.0)
    shadow_depth: float = 0.0
    rolling: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Occluder:
    """A silhouette above the table: its corners (N, 3) in ``table``, m, and its grey level.

    ``convex``: True if the silhouette is the convex hull of the projected corners, as for a convex
    solid; otherwise the corners form a polygon in their order.
    """

    points: NDArray[np.float64]
    level: float = 45.0
    convex: bool = False


@dataclass(frozen=True, slots=True)
class Part:
    """One polygon of a drawing: its grey level, whether it is the convex hull of its points, the
    fraction of the light that its shadow on the table removes, and its number of points."""

    level: float
    convex: bool = False
    shade: float = 0.0
    count: int = 0

    def with_count(self, count: int) -> Part:
        """Return the part with its number of points."""
        return replace(self, count=count)


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """Polygons above the table, drawn in their order: the points of all parts (N, 3) in ``table``,
    m, and the parts."""

    points: NDArray[np.float64]
    parts: tuple[Part, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """An object in the image: its convex outline, points (N, 2) in m in its frame, and its top.

    ``marker`` describes the top: its height, and whether it has a marker or is plain.
    """

    outline: NDArray[np.float64]
    marker: ObjectMarker | ObjectOutline


class _Drawable:
    """Pre-computed appearance of one object in the camera image."""

    def __init__(
        self,
        shown: SceneObject,
        plane: Array32,
        pixel: float,
        blur: float,
    ) -> None:
        """``plane``: x and y of the intersections of the pixel rays with the plane of the object's
        top, (2, rows, columns)."""
        marker = shown.marker
        self.outline, self.height = shown.outline, marker.height
        self.x, self.y = plane
        bright = isinstance(marker, ObjectOutline) and marker.brighter
        top = BRIGHT_TOP_REFLECTANCE if bright else TOP_REFLECTANCE
        self.wall = BRIGHT_WALL_REFLECTANCE if bright else WALL_REFLECTANCE
        self.body = outline_layer(self.outline, top, pixel, blur)
        self.label, self.label_pose = _label(marker, pixel, blur)


class SceneRenderer:
    """Renders the table with its reference markers and the objects on it.

    ``camera`` and ``pose``: true parameters and true pose of the camera. ``outline`` and ``marker``
    describe the first object as in ``SceneObject``; ``others`` are further objects. ``seed`` sets
    the random noise.
    """

    def __init__(
        self,
        camera: CameraModel,
        pose: CameraPose,
        references: ReferenceMap,
        outline: ArrayLike,
        marker: ObjectMarker | ObjectOutline,
        settings: SceneSettings | None = None,
        seed: int = 0,
        others: Sequence[SceneObject] = (),
    ) -> None:
        self.view = View(camera, pose)
        self.settings = settings or SceneSettings()
        grain, self._noise, state = _random_fields(
            seed, camera.height, camera.width, self.settings.noise
        )
        self._random = np.random.default_rng()
        self._random.bit_generator.state = state
        # `blur` includes the averaging over a pixel, which is a blur with a variance of 1/12
        # (pixel^2). The pixel coverage already contains this averaging, so its variance is
        # subtracted.
        self._point_spread = max(0.1, np.sqrt(max(0.0, self.settings.blur**2 - 1.0 / 12.0)))
        distance = float(pose.position[2])
        pixel = distance / camera.fx
        blur = self.settings.blur * pixel
        rays = _ray_map(camera)
        ground = self.view.rays_on_plane(rays, 0.0)
        self._light = self._light_map(ground).astype(np.float32)
        background = self._background(ground, references, pixel, blur, grain)
        self._background16 = _fixed_point(background)
        self._background_image = background
        objects = (SceneObject(np.asarray(outline, dtype=float), marker), *others)
        planes: dict[float, Array32] = {}
        for shown in objects:
            height = shown.marker.height
            if height not in planes:
                plane = np.moveaxis(self.view.rays_on_plane(rays, height), -1, 0)
                planes[height] = np.ascontiguousarray(plane, dtype=np.float32)
        self._drawables = tuple(
            _Drawable(shown, planes[shown.marker.height], pixel, blur) for shown in objects
        )
        if self.settings.shadow_depth > 0.0:
            self._ground = ground.astype(np.float32)
        # Objects at rest are drawn into one image, moving objects into a copy of it.
        self._still, self._still16 = background.copy(), self._background16.copy()
        self._still_key: tuple[tuple[float, ...], ...] = ()
        self._still_windows: list[tuple[slice, slice]] = []
        self._clean = self._background16.copy()
        self._noisy = np.empty_like(self._background16)
        self._moving_windows: list[tuple[slice, slice]] = []
        # The image with the drawings, which is kept while nothing in it moves.
        self._drawings: Sequence[Drawing] = ()
        self._drawn = np.empty_like(self._background16)

    def render(
        self,
        object_pose: ArrayLike,
        later_poses: Sequence[ArrayLike] = (),
        occluders: Sequence[Occluder] = (),
        light: float = 1.0,
        drawings: Sequence[Drawing] = (),
    ) -> Image:
        """Render one frame, uint8 (height, width).

        ``object_pose``: (x, y, theta) in ``table`` at the start of the exposure, or one row per
        object. ``later_poses``: the same at equal intervals up to the end of the exposure (none:
        at rest). ``light`` scales the light of the whole scene (0 is dark). ``drawings`` are drawn
        over the objects, with their shadows; the same sequence again means that nothing in them
        moved.
        """
        poses = [np.atleast_2d(np.asarray(p, dtype=float)) for p in (object_pose, *later_poses)]
        changed = self._draw_objects(np.stack(poses, axis=1))
        clean = self._clean
        if drawings:
            if changed or drawings != self._drawings:
                self._draw_drawings(drawings)
            clean = self._drawn
        self._drawings = drawings
        if occluders:
            clean = clean.copy()
            for occluder in occluders:
                corners = _corners(self.view.project(occluder.points))
                _fill(clean, corners, occluder.level * _FRACTION, occluder.convex)
        if light != 1.0:
            clean = np.asarray(clean * light, dtype=np.int16)
        # The sum is written to an existing array, because the allocation of a new one would take as
        # long as the sum itself.
        noisy = cv2.add(clean, self._noise_field(), dst=self._noisy)
        cv2.threshold(noisy, 0.0, 0.0, cv2.THRESH_TOZERO, dst=noisy)
        return np.asarray(cv2.convertScaleAbs(noisy, alpha=1.0 / _FRACTION), dtype=np.uint8)

    def _light_map(self, ground: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the light at every pixel as a fraction of the brightest light."""
        s = self.settings
        along = ground[..., 0] * np.cos(s.light_direction) + ground[..., 1] * np.sin(
            s.light_direction
        )
        low, high = along.min(), along.max()
        slope = 1.0 - s.light_falloff * (along - low) / (high - low)
        rows, columns = along.shape
        y = (np.arange(rows) - rows / 2)[:, None] / (rows / 2)
        x = (np.arange(columns) - columns / 2)[None, :] / (columns / 2)
        return np.asarray(slope * (1.0 - s.vignetting * 0.5 * (x * x + y * y)))

    def _background(
        self,
        ground: NDArray[np.float64],
        references: ReferenceMap,
        pixel: float,
        blur: float,
        grain: Array32,
    ) -> Array32:
        reflectance = np.full(ground.shape[:2], TABLE_REFLECTANCE, dtype=np.float32)
        # The table has a faint grain with a width of about a centimetre.
        size = (ground.shape[1], ground.shape[0])
        smooth = cv2.resize(grain * np.float32(0.006), size, interpolation=cv2.INTER_CUBIC)
        reflectance += np.asarray(smooth, dtype=np.float32)
        for marker in references.markers:
            layer = marker_layer(references.dictionary, marker.id, marker.size, pixel, blur)
            pose = (marker.x, marker.y, marker.theta)
            square = layer.half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
            window = self._window(self.view.project(se2.transform_points(pose, square)))
            if window is None:
                continue
            local = se2.transform_points(se2.inverse(pose), ground[window]).astype(np.float32)
            reflected, coverage = layer.sample(local[..., 0], local[..., 1])
            reflectance[window] = reflectance[window] * (1 - coverage) + reflected
        return np.asarray(reflectance * self._light * np.float32(WHITE_LEVEL))

    def _window(self, pixels: NDArray[np.float64], margin: int = 5) -> tuple[slice, slice] | None:
        """Return the region of the image around these pixels; None if it is outside the image."""
        low = np.floor(pixels.min(axis=0)).astype(int) - margin
        high = np.ceil(pixels.max(axis=0)).astype(int) + margin + 1
        camera = self.view.camera
        low = np.maximum(low, 0)
        high = np.minimum(high, [camera.width, camera.height])
        if np.any(high <= low):
            return None
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _draw_drawings(self, drawings: Sequence[Drawing]) -> None:
        """Draw the objects with the drawings and their shadows over them."""
        np.copyto(self._drawn, self._clean)
        points = np.concatenate([drawing.points for drawing in drawings])
        parts = [part for drawing in drawings for part in drawing.parts]
        ends = np.cumsum([part.count for part in parts])
        begins = ends - [part.count for part in parts]
        ranges = [slice(*both) for both in zip(begins.tolist(), ends.tolist(), strict=True)]
        self._draw_shadows(points, parts, ranges)
        corners = _corners(self.view.project(points))
        camera = self.view.camera
        limit = 16 * np.array([camera.width, camera.height])
        inside = np.all(np.maximum.reduceat(corners, begins) >= 0, axis=1)
        inside &= np.all(np.minimum.reduceat(corners, begins) < limit, axis=1)
        for number in np.flatnonzero(inside).tolist():
            part = parts[number]
            _fill(self._drawn, corners[ranges[number]], part.level * _FRACTION, part.convex)

    def _draw_shadows(
        self, points: NDArray[np.float64], parts: Sequence[Part], ranges: Sequence[slice]
    ) -> None:
        """Darken the image in the soft shadows of the parts. ``ranges``: their points in
        ``points``."""
        casting = [(part, each) for part, each in zip(parts, ranges, strict=True) if part.shade]
        if not casting:
            return
        above = np.concatenate([points[each] for _, each in casting])
        pixels = self.view.project(above[:, :2] + above[:, 2:] * LAMP)
        window = self._window(pixels, 4 * _COARSE)
        if window is None:
            return
        top, left = (part.start for part in window)
        grid = np.full([-(-(each.stop - each.start) // _COARSE) for each in window], 255, np.uint8)
        cells = _corners((pixels - [left, top] - (_COARSE - 1) / 2.0) / _COARSE)
        begin = 0
        for part, _ in casting:
            outline = cells[begin : begin + part.count]
            _fill(grid, outline, round(255 * (1.0 - part.shade)), part.convex)
            begin += part.count
        grid = np.asarray(cv2.blur(cv2.blur(grid, (3, 3)), (3, 3)), dtype=np.uint8)
        # Most of the window has no shadow, so only strips of rows with a shadow are darkened.
        for row in range(0, grid.shape[0], _STRIP):
            shaded = np.flatnonzero(grid[row : row + _STRIP].min(axis=0) < 255)
            if not len(shaded):
                continue
            first, above_it = max(int(shaded[0]) - 1, 0), min(row, 1)
            near = grid[row - above_it : row + _STRIP + 1, first : int(shaded[-1]) + 2]
            light = cv2.resize(near, (0, 0), fx=_COARSE, fy=_COARSE)[above_it * _COARSE :]
            y, x = top + row * _COARSE, left + first * _COARSE
            darkened = self._drawn[
                y : min(y + _STRIP * _COARSE, window[0].stop),
                x : min(x + light.shape[1], window[1].stop),
            ]
            light = light[: darkened.shape[0], : darkened.shape[1]]
            cv2.multiply(darkened, light, dst=darkened, scale=1.0 / 255.0, dtype=cv2.CV_16S)

    def _draw_objects(self, paths: NDArray[np.float64]) -> bool:
        """Redraw all objects at rest if one of them has moved, then draw the moving objects. Return
        whether the image changed. ``paths``: poses during the exposure, (objects, times, 3)."""
        moved = bool(self._moving_windows)
        start = paths[:, 0]
        still = np.all(paths == paths[:, :1], axis=(1, 2))
        key = tuple((number, *start[number].tolist()) for number in np.flatnonzero(still).tolist())
        if key != self._still_key:
            moved = True
            for window in (*self._still_windows, *self._moving_windows):
                self._still[window] = self._background_image[window]
                self._still16[window] = self._clean[window] = self._background16[window]
            self._still_windows = []
            for number in np.flatnonzero(still).tolist():
                drawn = self._draw(self._drawables[number], paths[number, :1], self._still)
                if drawn is not None:
                    window, patch = drawn
                    self._still[window] = patch
                    self._still16[window] = self._clean[window] = _fixed_point(patch)
                    self._still_windows.append(window)
            self._still_key = key
        else:
            for window in self._moving_windows:
                self._clean[window] = self._still16[window]
        self._moving_windows = []
        moving = np.flatnonzero(~still).tolist()
        floor = self._still.copy() if len(moving) > 1 else self._still
        for number in moving:
            drawn = self._draw(self._drawables[number], paths[number], floor)
            if drawn is not None:
                window, patch = drawn
                if len(moving) > 1:
                    floor[window] = patch
                self._clean[window] = _fixed_point(patch)
                self._moving_windows.append(window)
        return moved or bool(moving)

    def _draw(
        self, drawn: _Drawable, path: NDArray[np.float64], floor: Array32
    ) -> tuple[tuple[slice, slice], Array32] | None:
        """Render an object that moves along a path, poses (times, 3). Return the image region and
        its content, or None if the object is out of view. ``floor``: image without the object."""
        base = se2.transform_points(path[:, None, :], drawn.outline)
        rims = np.stack([self.view.project(base), self.view.project(base, drawn.height)])
        fallen = self.view.project(base + np.array(self.settings.shadow))
        window = self._window(np.concatenate([rims.reshape(-1, 2), fallen.reshape(-1, 2)]))
        if window is None:
            return None
        travel = float(np.max(np.ptp(rims, axis=1)))
        rolling = self.settings.rolling
        # Each row is exposed during its own part of the image's time. Strips of rows in which the
        # object moves by less than a quarter of a pixel are rendered together.
        strips = int(np.clip(np.ceil(4.0 * travel * rolling), 1, 64))
        blurs = int(np.clip(np.ceil(travel * (1.0 - rolling)), 1, 12))
        during = (np.arange(blurs) + 0.5) / blurs
        times = np.linspace(0.0, 1.0, len(path))
        rows, columns = window
        result = np.empty(self._light[window].shape, dtype=np.float32)
        edges = np.linspace(rows.start, rows.stop, strips + 1).astype(int)
        for top, bottom in itertools.pairwise(edges.tolist()):
            begin = rolling * (top + bottom - 1) / 2.0 / (self.view.camera.height - 1)
            first, last = (
                max(top - _STRIP_MARGIN, rows.start),
                min(bottom + _STRIP_MARGIN, rows.stop),
            )
            strip = slice(first, last), columns
            total = np.zeros(self._light[strip].shape, dtype=np.float32)
            for at in begin + (1.0 - rolling) * during:
                pose = np.array([np.interp(at, times, values) for values in path.T])
                total += self._patch(drawn, strip, pose, floor[strip])
            kept = total[top - first : bottom - first]
            result[top - rows.start : bottom - rows.start] = kept / np.float32(blurs)
        return window, result

    def _patch(
        self,
        drawn: _Drawable,
        window: tuple[slice, slice],
        pose: NDArray[np.float64],
        floor: Array32,
    ) -> Array32:
        """Render a region of the image with the object at one pose."""
        light = self._light[window] * np.float32(WHITE_LEVEL)
        body = self._body_coverage(drawn, window, pose)
        if self.settings.shadow_depth > 0.0:
            ground = self._ground[window]
            fallen = pose + np.array([*self.settings.shadow, 0.0])
            _, shaded = drawn.body.sample(*_local(fallen, ground[..., 0], ground[..., 1]))
            floor = floor * (1 - np.float32(self.settings.shadow_depth) * shaded)
        x, y = drawn.x[window], drawn.y[window]
        top, covered = drawn.body.sample(*_local(pose, x, y))
        # The coverages of top, wall and floor add up to 1, so the wall does not appear at edges
        # where it is hidden.
        behind = np.maximum(body - covered, 0.0) * light * np.float32(drawn.wall)
        patch = floor * (1 - np.maximum(body, covered)) + behind + top * light
        if drawn.label is not None:
            label_pose = se2.compose(pose, drawn.label_pose)
            reflected, covered = drawn.label.sample(*_local(label_pose, x, y))
            patch = patch * (1 - covered) + reflected * light
        return np.asarray(patch, dtype=np.float32)

    def _body_coverage(
        self, drawn: _Drawable, window: tuple[slice, slice], pose: NDArray[np.float64]
    ) -> Array32:
        """Return the coverage of each pixel by the object's whole body, from its outline on the
        table to its top."""
        base = se2.transform_points(pose, drawn.outline)
        rims = np.concatenate([self.view.project(base), self.view.project(base, drawn.height)])
        hull = cv2.convexHull(rims.astype(np.float32))[:, 0]
        corner = np.array([window[1].start, window[0].start]) - 0.5
        rows, columns = (part.stop - part.start for part in window)
        sharp = convex_coverage(hull - corner, rows, columns).astype(np.float32)
        soft = cv2.GaussianBlur(sharp, (0, 0), self._point_spread)
        return np.asarray(soft, dtype=np.float32)

    def _noise_field(self) -> NDArray[np.int16]:
        """Return a random window of the noise pool, which has about 200 000 possible windows."""
        camera = self.view.camera
        _, rows, columns = self._noise.shape
        which = self._random.integers(self._noise.shape[0])
        row = self._random.integers(rows - camera.height)
        column = self._random.integers(columns - camera.width)
        return self._noise[which, row : row + camera.height, column : column + camera.width]


def _label(
    shown: ObjectMarker | ObjectOutline, pixel: float, blur: float
) -> tuple[Layer | None, NDArray[np.float64]]:
    """Return the layer on the object's top (None for a plain top), and the layer's pose in the
    object's frame."""
    if isinstance(shown, ObjectMarker):
        layer = marker_layer(shown.dictionary, shown.id, shown.size, pixel, blur)
        return layer, np.array(shown.offset)
    if shown.dot is None:
        return None, np.zeros(3)
    angle = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
    circle = shown.dot.radius * se2.unit_vectors(angle)
    reflectance = BRIGHT_DOT_REFLECTANCE if shown.dot.brighter else DARK_DOT_REFLECTANCE
    return outline_layer(circle, reflectance, pixel, blur), np.array([*shown.dot.offset, 0.0])


def _local(pose: NDArray[np.float64], x: Array32, y: Array32) -> tuple[Array32, Array32]:
    cos, sin = np.float32(np.cos(pose[2])), np.float32(np.sin(pose[2]))
    dx, dy = x - np.float32(pose[0]), y - np.float32(pose[1])
    return cos * dx + sin * dy, cos * dy - sin * dx


@lru_cache(maxsize=2)
def _random_fields(
    seed: int, height: int, width: int, noise: float
) -> tuple[Array32, NDArray[np.int16], dict[str, Any]]:
    """Return the random fields of a scene: the table's grain with standard deviation 1, the noise
    pool (fixed point), and the state of the random generator afterwards. Scenes with the same seed
    share them."""
    random = np.random.default_rng(seed)
    grain = random.standard_normal((64, 80)).astype(np.float32)
    scale = np.float32(noise * _FRACTION)
    pool = np.empty((4, height + 192, width + 256), dtype=np.int16)
    for layer in pool:
        np.rint(
            random.standard_normal(layer.shape, dtype=np.float32) * scale,
            out=layer,
            casting="unsafe",
        )
    return grain, pool, dict(random.bit_generator.state)


def _corners(pixels: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return pixels as the fixed-point coordinates of ``_fill``."""
    return np.round(pixels * 16.0).astype(np.int32)


def _fill(image: NDArray[Any], corners: NDArray[np.int32], level: float, convex: bool) -> None:
    """Fill a polygon with corners (N, 2), or their convex hull."""
    if convex:
        corners = np.asarray(cv2.convexHull(corners), dtype=np.int32)
    cv2.fillPoly(image, [corners], (level,), shift=4)


def _fixed_point(image: Array32) -> NDArray[np.int16]:
    return np.round(image * np.float32(_FRACTION)).astype(np.int16)


def forget_shared() -> None:
    """Free what renderers of one process share: useful after the last renderer was made."""
    for shared in (_ray_map, _random_fields, marker_layer):
        shared.cache_clear()


@lru_cache(maxsize=2)
def _ray_map(camera: CameraModel) -> NDArray[np.float64]:
    """Return the ray directions (height, width, 2) of all pixels. They are exact on a grid of 8
    pixels and interpolated by cubic polynomials between the grid points."""
    step = 8
    x = np.arange(-step, camera.width + 2 * step, step)
    y = np.arange(-step, camera.height + 2 * step, step)
    nodes = camera.rays(np.stack(np.meshgrid(x, y), axis=-1).astype(float))
    rows, columns = (_cubic_weights(grid, step) for grid in (y, x))
    return np.stack(
        [(rows @ nodes[..., i] @ columns.T)[: camera.height, : camera.width] for i in (0, 1)],
        axis=-1,
    )


def _cubic_weights(nodes: NDArray[np.int_], step: int) -> NDArray[np.float64]:
    """Return the matrix (pixels, nodes) that interpolates values at the nodes, of which the first
    is at -``step``. The pixels go from 0 to the last node but two. SciPy's splines would take 40 MB
    and 0.3 s."""
    pixels = np.arange(step * (len(nodes) - 3))
    cell, t = pixels // step, pixels % step / step
    matrix = np.zeros((len(pixels), len(nodes)))
    matrix[pixels, cell + np.arange(4)[:, None]] = (
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    )
    return matrix
