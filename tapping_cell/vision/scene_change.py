"""Detect cheaply whether a frame differs from the last measured frame.

Windows around the reference markers and the object are compared pixel by pixel. Between two frames
of a static scene, the mean squared difference is twice the variance of the noise. The scatter of
this mean decreases with the number of pixels in the window, so even an edge that moves by a
twentieth of a pixel is detected.
"""

from __future__ import annotations

import math
from collections import deque

import cv2
import numpy as np
from numpy.typing import NDArray

from tapping_cell.vision.camera import Image

_LEARNT = 8
"""Minimum number of frame pairs needed to estimate the noise of a window."""
_CONFIDENCE = 6.0
"""Number of standard deviations by which a difference must exceed the usual difference due to noise
to count as a change."""
_NOISY = 100.0
"""Mean squared difference above which a window is too noisy to detect a change."""
_MARGIN = 0.25
"""Margin added on each side, relative to a window's size."""


class _Window:
    """A window around a region of the image, given as points (N, 2) in pixels."""

    def __init__(self, points: NDArray[np.float64], image: Image) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        margin = _MARGIN * (high - low) + 2.0
        size = np.array(image.shape[::-1])
        x0, y0 = np.clip(np.floor(low - margin).astype(int), 0, size - 1)
        x1, y1 = np.clip(np.ceil(high + margin).astype(int), 1, size)
        self._place = slice(y0, y1), slice(x0, x1)
        self._kept = image[self._place].copy()
        self._noise: deque[float] = deque(maxlen=4 * _LEARNT)
        self._limit = -1.0

    def difference(self, image: Image) -> float:
        """Mean squared difference between the image and the last measured frame."""
        return cv2.norm(image[self._place], self._kept, cv2.NORM_L2SQR) / max(1, self._kept.size)

    def learn(self, image: Image) -> None:
        """Keep the image, and estimate the largest difference that can be due to noise."""
        self._noise.append(self.difference(image))
        self._kept = image[self._place].copy()
        level = float(np.median(self._noise))
        if len(self._noise) < _LEARNT or level > _NOISY:
            self._limit = -1.0
            return
        scatter = 1.4826 * float(np.median(np.abs(np.asarray(self._noise) - level)))
        expected = level * math.sqrt(2.0 / max(1, self._kept.size))
        self._limit = level + _CONFIDENCE * max(scatter, expected)

    def unchanged(self, image: Image) -> bool:
        """Return whether the difference can be due to noise. False if this cannot be known yet, or
        if the window is too noisy to detect a change."""
        return self.difference(image) <= self._limit


class SceneChange:
    """Compares each frame, inside fixed windows, with the last measured frame."""

    def __init__(self) -> None:
        self._windows: list[_Window] = []

    def watch(self, image: Image, regions: list[NDArray[np.float64]]) -> None:
        """Start from a measured frame. Each region, given as points (N, 2) in pixels, gets a
        window."""
        self._windows = [_Window(points, image) for points in regions]

    def learn(self, image: Image) -> None:
        """Add a measured frame of the same scene. Its difference from the last frame is used to
        estimate the noise."""
        for window in self._windows:
            window.learn(image)

    def unchanged(self, image: Image) -> bool:
        """Return True if no window differs from the last measured frame by more than the noise."""
        return bool(self._windows) and all(window.unchanged(image) for window in self._windows)
