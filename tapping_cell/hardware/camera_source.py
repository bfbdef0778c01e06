"""Where pictures come from: a camera of the system, a video file, a folder of images."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
MANUAL_EXPOSURE = 1
"""V4L2_EXPOSURE_MANUAL of the control V4L2_CID_EXPOSURE_AUTO."""
EXPOSURE_UNIT_S = 1e-4
"""Unit of the control V4L2_CID_EXPOSURE_ABSOLUTE."""


class CameraSourceError(RuntimeError):
    """A source that cannot be opened or has ended; the sentence says what to do."""


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """What a device is asked for. ``exposure`` in s, 0 leaves it to the device; ``rate`` in Hz."""

    width: int
    height: int
    rate: float
    exposure: float = 0.0
    loop: bool = False


class Device:
    """A V4L2 device through OpenCV.

    Raises:
        CameraSourceError: it cannot be opened, or stopped to deliver.
    """

    def __init__(self, name: str, settings: CameraSettings) -> None:
        self._name = name
        self._capture = cv2.VideoCapture(int(name) if name.isdigit() else name, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraSourceError(
                f"the camera {name} cannot be opened; check its cable, that nobody else uses it, "
                "and that you may read it (group video)"
            )
        wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: settings.width,
            cv2.CAP_PROP_FRAME_HEIGHT: settings.height,
            cv2.CAP_PROP_FPS: settings.rate,
            # One buffered picture: an older one would be stamped as new.
            cv2.CAP_PROP_BUFFERSIZE: 1,
        }
        if settings.exposure > 0:
            wanted[cv2.CAP_PROP_AUTO_EXPOSURE] = MANUAL_EXPOSURE
            wanted[cv2.CAP_PROP_EXPOSURE] = settings.exposure / EXPOSURE_UNIT_S
        for prop, value in wanted.items():
            self._capture.set(prop, value)

    def read(self) -> Picture:
        """The next picture, as soon as the device has it."""
        good, picture = self._capture.read()
        if not good:
            raise CameraSourceError(
                f"the camera {self._name} delivers no pictures any more; check its cable"
            )
        return np.asarray(picture, dtype=np.uint8)

    def close(self) -> None:
        """Give the device back."""
        self._capture.release()


class Playback:
    """Pictures from a file or a folder, at a steady rate.

    Raises:
        CameraSourceError: at the end, where it does not begin again.
    """

    def __init__(self, name: str, settings: CameraSettings) -> None:
        self._name = name
        self._settings = settings
        self._pictures = self._all()
        self._due = time.monotonic()

    def read(self) -> Picture:
        """The next picture, when it is due."""
        picture = next(self._pictures, None)
        if picture is None and self._settings.loop:
            self._pictures = self._all()
            picture = next(self._pictures, None)
        if picture is None:
            raise CameraSourceError(
                f"{self._name} has no more pictures; set the parameter loop to begin again"
            )
        wait = self._due - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        self._due = max(self._due, time.monotonic() - 1.0) + 1.0 / self._settings.rate
        return picture

    def close(self) -> None:
        """Close the file; of a folder nothing is held open between two pictures."""
        self._pictures = iter(())

    def _all(self) -> Iterator[Picture]:
        path = Path(self._name)
        return _folder_pictures(path) if path.is_dir() else _video_pictures(path)


def _folder_pictures(folder: Path) -> Iterator[Picture]:
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise CameraSourceError(
            f"the folder {folder} holds no pictures ({', '.join(IMAGE_SUFFIXES)})"
        )
    for file in files:
        picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if picture is None:
            raise CameraSourceError(f"the picture {file} cannot be decoded; remove or replace it")
        yield np.asarray(picture, dtype=np.uint8)


def _video_pictures(file: Path) -> Iterator[Picture]:
    capture = cv2.VideoCapture(str(file))
    try:
        if not capture.isOpened():
            raise CameraSourceError(f"the video {file} cannot be opened or decoded")
        while True:
            good, picture = capture.read()
            if not good:
                return
            yield np.asarray(picture, dtype=np.uint8)
    finally:
        capture.release()


def open_source(name: str, settings: CameraSettings) -> Device | Playback:
    """A camera by device path or number, a video file, or a folder of pictures.

    Raises:
        CameraSourceError: there is nothing of that name, or it cannot be opened.
    """
    path = Path(name)
    if name.isdigit() or str(path).startswith("/dev/"):
        return Device(name, settings)
    if not path.exists():
        raise CameraSourceError(
            f"there is no camera, video file or folder '{name}'; give a device such as "
            "/dev/video0, a file or a folder"
        )
    return Playback(name, settings)


def to_grey(picture: Picture) -> Picture:
    """A picture of one channel, from one of one, three (BGR) or four."""
    if picture.ndim == 2:
        return picture
    code = cv2.COLOR_BGR2GRAY if picture.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
    return np.asarray(cv2.cvtColor(picture, code), dtype=np.uint8)
