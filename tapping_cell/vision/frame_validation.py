"""Reject frames that have the wrong format or are late, repeated, dark or overexposed."""

from __future__ import annotations

import math
import zlib
from collections import deque

import numpy as np

from tapping_cell.vision.camera import CameraModel, Image
from tapping_cell.vision.observation import Problem

_REPEATED = 4
"""Number of recent frames from which an image must differ. A camera that repeats old frames usually
has this many frame buffers."""
_GLOW = 12.0
"""Maximum brightness, in grey levels above ``dark``, that noise and the camera's own lamps cause
in the dark."""


class FrameValidator:
    """Rejects unusable frames; remembers the last valid stamp and signatures of recent images.

    An image is dark below the grey level ``dark`` and overexposed above ``bright``.
    """

    def __init__(self, camera: CameraModel, dark: float, bright: float) -> None:
        self._camera = camera
        self._dark, self._bright = dark, bright
        self._stamp = -math.inf
        self._seen: deque[int] = deque(maxlen=_REPEATED)

    def refuse(self, image: Image, stamp: float) -> tuple[Problem, str] | None:
        """Return the problem of the frame captured at ``stamp`` (s) and a sentence that explains
        it; None if the frame is valid."""
        sentence = self._camera.check_image(image)
        if sentence is not None:
            return Problem.WRONG_IMAGE, sentence
        if not math.isfinite(stamp):
            return Problem.LATE_FRAME, "the frame has no time stamp and is ignored"
        if stamp <= self._stamp:
            late = (self._stamp - stamp) * 1e3
            when = f"is {late:.0f} ms older than" if late >= 1.0 else "has the time stamp of"
            return (
                Problem.LATE_FRAME,
                f"the frame is ignored: it {when} a frame already used",
            )
        self._stamp = stamp
        rows = np.ascontiguousarray(image[:: max(1, self._camera.height // 64)])
        signature = zlib.crc32(rows.data)
        if signature in self._seen:
            return (
                Problem.FROZEN_FRAME,
                "the frame is identical to a recent frame, even in its noise: the camera repeats "
                "frames; check the camera's driver",
            )
        self._seen.append(signature)
        sample = image[::16, ::16]
        shade = np.count_nonzero(sample < self._dark)
        if shade > 0.5 * sample.size and (
            np.count_nonzero(sample < self._dark + _GLOW) > 0.98 * sample.size
        ):
            return (
                Problem.DARK,
                f"the image is dark (half of it below grey level {self._dark:.0f}, 98 % below "
                f"{self._dark + _GLOW:.0f}); turn on the light or lengthen the exposure",
            )
        if np.count_nonzero(sample > self._bright) > 0.70 * sample.size:
            return (
                Problem.OVEREXPOSED,
                f"the image is overexposed (70 % of it above grey level {self._bright:.0f}); "
                "shorten the exposure",
            )
        return None
