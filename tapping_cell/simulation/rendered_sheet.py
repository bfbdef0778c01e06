"""Photographs of a printed sheet with exact ground truth, for tests of the calibration.

Every pixel is the mean of ``SAMPLES`` x ``SAMPLES`` samples of the print through the lens. Then
point spread, uneven light, noise and rounding are applied.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from tapping_cell.vision.camera import CameraModel, CameraPose, Image, View

SAMPLES = 3
_PAPER, _INK, _TABLE = 215.0, 35.0, 120.0
"""Grey levels of white paper, black ink and the table around the sheet, in full light."""
_NODE = 8


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A printed sheet: ``pattern`` (rows, columns), 255 for white, with a pixel size of ``pixel``
    m.

    The sheet's frame has its origin in the middle, x to the right and y up.
    """

    pattern: Image
    pixel: float

    @property
    def size(self) -> tuple[float, float]:
        """Width and height in m."""
        return self.pattern.shape[1] * self.pixel, self.pattern.shape[0] * self.pixel


class SheetCamera:
    """A camera that takes photographs of sheets. The lens distortion is computed only once per
    camera."""

    def __init__(self, camera: CameraModel, seed: int = 0) -> None:
        self.camera = camera
        self._random = np.random.default_rng(seed)
        x = np.arange(-2 * _NODE, camera.width + 3 * _NODE, _NODE)
        y = np.arange(-2 * _NODE, camera.height + 3 * _NODE, _NODE)
        nodes = camera.rays(np.stack(np.meshgrid(x, y), axis=-1).astype(float))
        self._rays = [RectBivariateSpline(y, x, nodes[..., i]) for i in (0, 1)]

    def photograph(
        self,
        sheet: Sheet,
        pose: CameraPose,
        noise: float = 2.0,
        blur: float = 0.6,
        falloff: float = 0.3,
    ) -> Image:
        """Return an image, uint8 (height, width), of the sheet; ``pose``: pose of the sheet in the
        camera's frame.

        ``noise`` in grey levels; ``blur``: sigma of the point spread function in pixels, without
        the averaging over a pixel; ``falloff``: fraction of the light that is lost from left to
        right.
        """
        camera = self.camera
        image = np.full((camera.height, camera.width), _TABLE)
        window = self._window(sheet, pose)
        rows = np.arange(window[0].start, window[0].stop)
        columns = np.arange(window[1].start, window[1].stop)
        inside = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
        fine_y = (rows[:, None] + inside).ravel()
        fine_x = (columns[:, None] + inside).ravel()
        if len(fine_x) and len(fine_y):
            rays = np.stack([spline(fine_y, fine_x) for spline in self._rays], axis=-1)
            ground = View(camera, pose).rays_on_plane(rays)
            seen = _reflectance(sheet, ground).reshape(len(rows), SAMPLES, len(columns), SAMPLES)
            image[window] = seen.mean(axis=(1, 3))
        if blur > 0:
            image = cv2.GaussianBlur(image, (0, 0), blur)
        light = 1.0 - falloff * np.linspace(0.0, 1.0, camera.width)
        noisy = image * light + noise * self._random.standard_normal(image.shape)
        return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)

    def _window(self, sheet: Sheet, pose: CameraPose) -> tuple[slice, slice]:
        """Return the region of the image that contains the sheet."""
        width, height = sheet.size
        x = np.linspace(-0.5, 0.5, 21)
        rim = np.concatenate([[(a, b), (b, a)] for a in x for b in (-0.5, 0.5)])
        pixels = View(self.camera, pose).project(rim * [width, height])
        low = np.floor(pixels.min(axis=0)).astype(int) - 3
        high = np.ceil(pixels.max(axis=0)).astype(int) + 4
        limit = (self.camera.width, self.camera.height)
        low, high = np.clip(low, 0, limit), np.clip(high, 0, limit)
        return slice(low[1], high[1]), slice(low[0], high[0])


def _reflectance(sheet: Sheet, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the grey levels of points (..., 2) in the plane of the sheet."""
    rows, columns = sheet.pattern.shape
    column = np.floor(points[..., 0] / sheet.pixel + columns / 2).astype(np.intp)
    row = np.floor(rows / 2 - points[..., 1] / sheet.pixel).astype(np.intp)
    on = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    white = sheet.pattern[np.where(on, row, 0), np.where(on, column, 0)] / 255.0
    return np.where(on, _INK + (_PAPER - _INK) * white, _TABLE)
