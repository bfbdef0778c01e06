"""Where pictures come from: a camera of the system, a video file, a folder of images.

Every picture comes with the time of its capture on the steady clock (``time.monotonic``): of a
device the driver's own stamp of the buffer, where it has one, so that neither the queue nor a busy
machine makes a picture look younger than it is.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
MANUAL_EXPOSURE = 1
"""V4L2_EXPOSURE_MANUAL of the control V4L2_CID_EXPOSURE_AUTO."""
EXPOSURE_UNIT_S = 1e-4
"""Unit of the control V4L2_CID_EXPOSURE_ABSOLUTE."""


OLDEST_STAMP_S = 2.0
"""A driver's stamp older than this is on another clock, and is not used."""


class CameraSourceError(RuntimeError):
    """A source that cannot be opened or stopped to deliver; it may be opened again later."""


class SourceEnded(CameraSourceError):
    """A file or folder has no more pictures: opening it again would begin it again."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A picture (height, width) or (height, width, channels), 8 bit; when it was captured (s,
    steady clock); and a sentence on pictures before it that were left out."""

    picture: Picture
    captured: float
    sentence: str = ""


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
        width = round(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = round(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) != (settings.width, settings.height):
            self._capture.release()
            raise CameraSourceError(
                f"the camera {name} delivers {width} x {height} pixels and cannot be set to the "
                f"calibration's {settings.width} x {settings.height}; calibrate it at its own size"
            )

    def read(self) -> Frame:
        """The next picture, as soon as the device has it."""
        good, picture = self._capture.read()
        if not good:
            raise CameraSourceError(
                f"the camera {self._name} delivers no pictures any more; check its cable"
            )
        now = time.monotonic()
        stamp = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
        return Frame(eight_bit(picture), captured_at(stamp, now))

    def close(self) -> None:
        """Give the device back."""
        self._capture.release()


class Playback:
    """Pictures from a file or a folder, at a steady rate.

    Raises:
        CameraSourceError: it cannot be opened, or holds no picture that can be decoded.
        SourceEnded: at the end, where it does not begin again.
    """

    def __init__(self, name: str, settings: CameraSettings) -> None:
        self._name = name
        self._settings = settings
        self._pictures = self._all()
        self._due = time.monotonic()
        self._delivered = 0

    def read(self) -> Frame:
        """The next picture, when it is due; those that cannot be decoded are left out."""
        left_out: list[str] = []
        picture = self._next(left_out)
        if picture is None and self._settings.loop:
            self._pictures = self._all()
            picture = self._next(left_out)
        # A source that is to begin again does not end: it went away, or its pictures did.
        if picture is None and (self._delivered == 0 or self._settings.loop):
            raise CameraSourceError(
                f"{self._name} holds no picture that can be decoded; replace it"
            )
        if picture is None:
            raise SourceEnded(
                f"{self._name} has no more pictures; set the parameter loop to begin again"
            )
        self._delivered += 1
        wait = self._due - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        self._due = max(self._due, time.monotonic() - 1.0) + 1.0 / self._settings.rate
        sentence = ""
        if left_out:
            sentence = f"left out what cannot be decoded: {', '.join(left_out)}"
        return Frame(picture, time.monotonic(), sentence)

    def _next(self, left_out: list[str]) -> Picture | None:
        for picture in self._pictures:
            if not isinstance(picture, str):
                return picture
            left_out.append(picture)
        return None

    def close(self) -> None:
        """Close the file; of a folder nothing is held open between two pictures."""
        self._pictures = iter(())

    def _all(self) -> Iterator[Picture | str]:
        path = Path(self._name)
        return _folder_pictures(path) if path.is_dir() else _video_pictures(path)


def _folder_pictures(folder: Path) -> Iterator[Picture | str]:
    """The pictures by name; the path of one that cannot be decoded."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    except OSError as error:
        raise CameraSourceError(
            f"the folder {folder} cannot be read ({error.strerror}); check that it is there"
        ) from error
    if not files:
        raise CameraSourceError(
            f"the folder {folder} holds no pictures ({', '.join(IMAGE_SUFFIXES)})"
        )
    return (_decoded(file) for file in files)


def _decoded(file: Path) -> Picture | str:
    try:
        picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return str(file)
    return str(file) if picture is None else eight_bit(picture)


def _video_pictures(file: Path) -> Iterator[Picture]:
    capture = cv2.VideoCapture(str(file))
    try:
        if not capture.isOpened():
            raise CameraSourceError(f"the video {file} cannot be opened or decoded")
        while True:
            good, picture = capture.read()
            if not good:
                return
            yield eight_bit(picture)
    finally:
        capture.release()


def eight_bit(picture: NDArray[Any]) -> Picture:
    """A picture with 8 bits a channel; of 16 bits the upper ones (cameras align them so)."""
    if picture.dtype == np.uint16:
        return np.asarray(picture >> 8, dtype=np.uint8)
    if picture.dtype != np.uint8:
        # Floating point images run from 0 to 1.
        return np.asarray(np.clip(np.rint(picture * 255.0), 0, 255), dtype=np.uint8)
    return np.asarray(picture, dtype=np.uint8)


def captured_at(stamp: float, now: float) -> float:
    """When a picture read at ``now`` was captured (s, steady clock), from the driver's ``stamp``.

    V4L2 drivers stamp on the steady clock; one that does not is told by an age that cannot be.
    """
    return stamp if 0.0 <= now - stamp < OLDEST_STAMP_S else now


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
