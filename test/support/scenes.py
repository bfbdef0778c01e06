"""Scenes for the tests of vision: a camera above a table, a disk, and an independent area
sampler."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import make_interp_spline

from tapping_cell.se2 import inverse, transform_points
from tapping_cell.simulation.rendered_camera import SceneRenderer, SceneSettings
from tapping_cell.vision import (
    CameraModel,
    CameraPose,
    ObjectMarker,
    ReferenceMap,
    ReferenceMarker,
    View,
)
from tapping_cell.vision.markers.detection import marker_pattern

CAMERA = CameraModel(1280, 1024, 1150.0, 1150.0, 639.5, 511.5, (-0.12, 0.08, 0.0004, -0.0003, 0.0))
POSE = CameraPose.above((0.03, -0.02, 0.7), spin=0.02)
MARKER = ObjectMarker("apriltag_36h11", 3, 0.05, 0.012)
REFERENCES = ReferenceMap(
    "apriltag_36h11",
    tuple(
        ReferenceMarker(101 + i, 0.04, x, y)
        for i, (x, y) in enumerate(
            [
                (-0.33, 0.25),
                (0.0, 0.25),
                (0.33, 0.25),
                (-0.33, 0.0),
                (0.33, 0.0),
                (-0.33, -0.25),
                (0.0, -0.25),
                (0.33, -0.25),
            ]
        )
    ),
)
ANGLES = np.linspace(0.0, 2.0 * np.pi, 180, endpoint=False)
DISK = 0.048 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)


def renderer(
    pose: CameraPose = POSE,
    references: ReferenceMap = REFERENCES,
    marker: ObjectMarker = MARKER,
    seed: int = 0,
    **settings: float,
) -> SceneRenderer:
    """Return the renderer of the standard scene with the given changes."""
    return SceneRenderer(
        CAMERA, pose, references, DISK, marker, SceneSettings(**settings), seed=seed
    )


def between(grid_y: np.ndarray, grid_x: np.ndarray, nodes: np.ndarray, ys, xs) -> np.ndarray:
    """Interpolate ``nodes`` (len(grid_y), len(grid_x), N) by cubic splines at all ``ys`` and
    ``xs``; return (N, len(ys), len(xs)). The result equals that of RectBivariateSpline, but is
    computed by matrix products."""
    down, across = (
        make_interp_spline(grid, np.eye(len(grid)), k=3)(at)
        for grid, at in ((grid_y, ys), (grid_x, xs))
    )
    return down @ np.moveaxis(nodes, -1, 0) @ across.T


def area_sampled_marker(
    view: View,
    marker: ObjectMarker,
    pose: np.ndarray,
    noise: np.ndarray | float = 0.0,
    samples: int = 10,
    black: float = 30.0,
    white: float = 200.0,
    around: float = 110.0,
) -> np.ndarray:
    """Return an image with one marker, computed by brute force: a pixel is the mean of samples x
    samples points.

    The marker has a white margin of one module; the grey level elsewhere is ``around``. Independent
    of the renderer.
    """
    camera = view.camera
    image = np.full((camera.height, camera.width), around)
    pattern = np.pad(marker_pattern(marker.dictionary, marker.id), 1, constant_values=True)
    module = marker.size / (pattern.shape[0] - 2)
    half = 0.5 * module * pattern.shape[0]
    square = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    seen = view.project(transform_points(pose, square), marker.height)
    x0, y0 = np.floor(seen.min(axis=0)).astype(int) - 2
    x1, y1 = np.ceil(seen.max(axis=0)).astype(int) + 3
    inside = (np.arange(samples) + 0.5) / samples - 0.5
    xs = (np.arange(x0, x1)[:, None] + inside).ravel()
    ys = (np.arange(y0, y1)[:, None] + inside).ravel()
    # Positions on the plane are computed at every sixth pixel and interpolated by splines. The
    # interpolation is exact enough, because the positions vary smoothly over the image.
    grid_x, grid_y = np.arange(x0 - 6, x1 + 12, 6.0), np.arange(y0 - 6, y1 + 12, 6.0)
    nodes = view.on_plane(np.stack(np.meshgrid(grid_x, grid_y), axis=-1), marker.height)
    # The nodes are transformed before interpolation. The result is the same as if all pixels were
    # transformed.
    local = between(grid_y, grid_x, transform_points(inverse(pose), nodes), ys, xs)
    column, row = ((half + sign * part) / module for sign, part in zip((1, -1), local, strict=True))
    # The grey levels of the modules, extended by one row and column of the surroundings on each
    # side.
    levels = np.pad(np.where(pattern, white, black), 1, constant_values=around)
    last = levels.shape[0] - 1
    column, row = ((np.clip(part + 1.0, 0.0, last)).astype(np.int32) for part in (column, row))
    value = levels.ravel().take(row * (last + 1) + column)
    mean = value.reshape(y1 - y0, samples, x1 - x0, samples).mean(axis=(1, 3))
    image[y0:y1, x0:x1] = mean
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
