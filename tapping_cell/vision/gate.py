"""Frames that must not be looked at: of another kind, late, repeated, dark or overexposed."""

from __future__ import annotations

import math

import numpy as np

from tapping_cell.vision.camera import CameraModel, Image
from tapping_cell.vision.observation import Problem


class FrameGate:
    """Remembers the last good frame's stamp and looks, and refuses what cannot be one.

    ``dark`` and ``bright`` are grey levels: below the one, or above the other, there is no picture.
    """

    def __init__(self, camera: CameraModel, dark: float, bright: float) -> None:
        self._camera = camera
        self._dark, self._bright = dark, bright
        self._stamp = -math.inf
        self._signature: Image | None = None

    def refuse(self, image: Image, stamp: float) -> tuple[Problem, str] | None:
        """Why the frame taken at ``stamp`` (s) cannot be used, with a sentence; None if it can."""
        sentence = self._camera.check_image(image)
        if sentence is not None:
            return Problem.WRONG_IMAGE, sentence
        if not math.isfinite(stamp):
            return Problem.LATE_FRAME, "the frame has no time stamp; it is left out"
        if stamp <= self._stamp:
            late = (self._stamp - stamp) * 1e3
            return (
                Problem.LATE_FRAME,
                f"the frame is {late:.0f} ms older than one already used; it is left out",
            )
        self._stamp = stamp
        signature = image[:: max(1, self._camera.height // 64)]
        if self._signature is not None and np.array_equal(signature, self._signature):
            return (
                Problem.FROZEN_FRAME,
                "the frame equals the one before, down to the noise: the camera repeats itself",
            )
        self._signature = signature.copy()
        sample = image[::16, ::16]
        if np.count_nonzero(sample < self._dark) > 0.98 * sample.size:
            return (
                Problem.DARK,
                f"the image is dark (98 % of it below grey level {self._dark:.0f}); "
                "turn on the light or lengthen the exposure",
            )
        if np.count_nonzero(sample > self._bright) > 0.70 * sample.size:
            return (
                Problem.OVEREXPOSED,
                f"the image is overexposed (70 % of it above grey level {self._bright:.0f}); "
                "shorten the exposure",
            )
        return None
