"""Detect cheaply whether a frame differs from the last measured frame.

Windows around the reference markers and the object are compared pixel by pixel. Between two frames
of a static scene, the mean squared difference is twice the variance of the noise. The scatter of
this mean decreases with the number of pixels in the window, so even an edge that moves by a
twentieth of a pixel is detected.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Image

Window = tuple[int, int, int, int]
"""x0, y0, x1, y1 in pixels; x1 and y1 are exclusive."""

_LEARNT = 8
"""Minimum number of frame pairs needed to estimate the noise of a window."""
_CONFIDENCE = 6.0
"""Number of standard deviations by which a difference must exceed the usual difference due to noise
to count as a change."""
_NOISY = 100.0
"""Mean squared difference above which a window is too noisy to detect a change."""
_MARGIN = 0.25
"""Margin added on each side, relative to a window's size."""


class SceneChange:
    """Compares frames with the last measured frame inside fixed windows."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Discard the windows and their noise, because the scene changed."""
        self._windows: tuple[Window, ...] = ()
        self._kept: list[Image] = []
        self._noise: list[deque[float]] = []
        self._limits: list[float] = []

    def watch(self, image: Image, regions: list[NDArray[np.float64]]) -> None:
        """Start from a measured frame. Each region, given as points (N, 2) in pixels, gets a
        window."""
        self._windows = tuple(_window(points, image) for points in regions)
        self._noise = [deque(maxlen=4 * _LEARNT) for _ in self._windows]
        self._limits = []
        self._keep(image)

    def learn(self, image: Image) -> None:
        """Add a measured frame of the same scene. Its difference from the last frame is used to
        estimate the noise."""
        for values, difference in zip(self._noise, self._differences(image), strict=True):
            values.append(difference)
        self._limits = [
            _limit(window, values)
            for window, values in zip(self._windows, self._noise, strict=True)
            if len(values) >= _LEARNT
        ]
        self._keep(image)

    def unchanged(self, image: Image) -> bool:
        """Return True if no window differs from the last measured frame by more than the noise."""
        return bool(self._limits) and all(
            difference <= limit
            for difference, limit in zip(self._differences(image), self._limits, strict=True)
        )

    def _keep(self, image: Image) -> None:
        self._kept = [image[y0:y1, x0:x1].copy() for x0, y0, x1, y1 in self._windows]

    def _differences(self, image: Image) -> list[float]:
        return [
            cv2.norm(image[y0:y1, x0:x1], kept, cv2.NORM_L2SQR) / max(1, kept.size)
            for (x0, y0, x1, y1), kept in zip(self._windows, self._kept, strict=True)
        ]


def _limit(window: Window, noise: Sequence[float]) -> float:
    """Return the largest mean squared difference that can be due to noise; negative if the window
    is too noisy to detect a change."""
    level = float(np.median(noise))
    if level > _NOISY:
        return -1.0
    scatter = 1.4826 * float(np.median(np.abs(np.asarray(noise) - level)))
    pixels = max(1, (window[2] - window[0]) * (window[3] - window[1]))
    expected = level * math.sqrt(2.0 / pixels)
    return level + _CONFIDENCE * max(scatter, expected)


def _window(points: NDArray[np.float64], image: Image) -> Window:
    low, high = points.min(axis=0), points.max(axis=0)
    margin = _MARGIN * (high - low) + 2.0
    x0, y0 = np.floor(low - margin).astype(int)
    x1, y1 = np.ceil(high + margin).astype(int)
    height, width = image.shape
    return (
        min(max(0, int(x0)), width - 1),
        min(max(0, int(y0)), height - 1),
        max(1, min(width, int(x1))),
        max(1, min(height, int(y1))),
    )
