"""Image sources: a camera of the system, a video file, or a folder of images.

Every image has its capture time on the steady clock (``time.monotonic``). For a camera, the capture
time is the driver's timestamp of the buffer, if there is one. An image that had to wait in a queue
or on a busy machine therefore does not appear newer than it is.
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

from tapping_cell.vision.images import GreyImage, ImageRefused, read_photograph

Picture = NDArray[np.uint8]

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
MANUAL_EXPOSURE = 1
"""Value V4L2_EXPOSURE_MANUAL of the control V4L2_CID_EXPOSURE_AUTO."""
EXPOSURE_UNIT_S = 1e-4
"""Unit of the control V4L2_CID_EXPOSURE_ABSOLUTE, s."""


OLDEST_STAMP_S = 2.0
"""Maximum age of a driver timestamp, s; an older timestamp is from another clock and is ignored."""


class CameraSourceError(RuntimeError):
    """A source cannot be opened, or has stopped delivering images; opening it again may succeed."""


class SourceEnded(CameraSourceError):
    """A file or folder has no more images; opening it again would start from the beginning."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A grey 8-bit image (height, width), its capture time (s, steady clock), and a message about
    the source."""

    picture: Picture
    captured: float
    sentence: str = ""


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings requested from a device; ``exposure`` in s (0: automatic), ``rate`` in Hz."""

    width: int
    height: int
    rate: float
    exposure: float = 0.0
    loop: bool = False


class Device:
    """A V4L2 device through OpenCV.

    Raises:
        CameraSourceError: the device cannot be opened, or has stopped delivering images.
    """

    def __init__(self, name: str, settings: CameraSettings) -> None:
        self._name = name
        self._capture = cv2.VideoCapture(int(name) if name.isdigit() else name, cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraSourceError(
                f"the camera {name} cannot be opened; check its cable, that no other program "
                "uses it, and that you may read it (group video)"
            )
        wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: settings.width,
            cv2.CAP_PROP_FRAME_HEIGHT: settings.height,
            cv2.CAP_PROP_FPS: settings.rate,
            # With a longer buffer, an old image would be stamped as new.
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
                f"calibration's {settings.width} x {settings.height}; calibrate the camera "
                "at the size that it delivers"
            )

    def read(self) -> Frame:
        """Wait for the next image and return it."""
        good, picture = self._capture.read()
        if not good:
            raise CameraSourceError(
                f"the camera {self._name} no longer delivers images; check its cable"
            )
        now = time.monotonic()
        stamp = 1e-3 * self._capture.get(cv2.CAP_PROP_POS_MSEC)
        return Frame(_grey(picture), captured_at(stamp, now))

    def close(self) -> None:
        """Release the device."""
        self._capture.release()


class Playback:
    """Images from a file or a folder, at a constant rate.

    Raises:
        CameraSourceError: the source cannot be opened, or contains no image that can be decoded.
        SourceEnded: the last image was read and ``loop`` is not set.
    """

    def __init__(self, name: str, settings: CameraSettings) -> None:
        self._name = name
        self._settings = settings
        self._pictures = self._all()
        self._due = time.monotonic()
        self._delivered = 0

    def read(self) -> Frame:
        """Return the next image when it is due; images that cannot be decoded are skipped."""
        left_out: list[str] = []
        picture = self._next(left_out)
        if picture is None and self._settings.loop:
            self._pictures = self._all()
            picture = self._next(left_out)
        # Either the source has never delivered an image, or it loops and delivered no image after
        # it had started over.
        if picture is None and (self._delivered == 0 or self._settings.loop):
            raise CameraSourceError(
                f"{self._name} contains no image that can be decoded; replace it"
            )
        if picture is None:
            raise SourceEnded(
                f"{self._name} has no more images; set the parameter loop to start over"
            )
        self._delivered += 1
        wait = self._due - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        self._due = max(self._due, time.monotonic() - 1.0) + 1.0 / self._settings.rate
        sentences = [*picture.warnings]
        if left_out:
            sentences.insert(0, f"skipped files that cannot be decoded: {', '.join(left_out)}")
        return Frame(picture.pixels, time.monotonic(), "; ".join(sentences))

    def _next(self, left_out: list[str]) -> GreyImage | None:
        for picture in self._pictures:
            if not isinstance(picture, str):
                return picture
            left_out.append(picture)
        return None

    def close(self) -> None:
        """Close the file; a folder is not kept open between images."""
        self._pictures = iter(())

    def _all(self) -> Iterator[GreyImage | str]:
        path = Path(self._name)
        size = (self._settings.width, self._settings.height)
        return _folder_pictures(path, size) if path.is_dir() else _video_pictures(path)


def _folder_pictures(folder: Path, size: tuple[int, int]) -> Iterator[GreyImage | str]:
    """Return an iterator over the images in order of name. In place of an image that cannot be
    decoded, it yields the path of the file. ``size``: width and height of the calibration."""
    try:
        files = sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    except OSError as error:
        raise CameraSourceError(
            f"the folder {folder} cannot be read ({error.strerror}); check that it exists"
        ) from error
    if not files:
        raise CameraSourceError(
            f"the folder {folder} contains no images; give a folder with files of the types "
            f"{', '.join(IMAGE_SUFFIXES)}"
        )
    return _decoded(files, size)


def _decoded(files: list[Path], size: tuple[int, int]) -> Iterator[GreyImage | str]:
    bits = 8
    for file in files:
        try:
            image = read_photograph(file, size, bits)
        except ImageRefused:
            yield str(file)
            continue
        bits = image.bits
        yield image


def _video_pictures(file: Path) -> Iterator[GreyImage]:
    capture = cv2.VideoCapture(str(file))
    # The lens model refers to the pixels as on the sensor.
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        if not capture.isOpened():
            raise CameraSourceError(
                f"the video {file} cannot be opened or decoded; give a video file that OpenCV can "
                "read"
            )
        while True:
            good, picture = capture.read()
            if not good:
                return
            yield GreyImage(_grey(picture))
    finally:
        capture.release()


def _grey(picture: NDArray[Any]) -> Picture:
    """Convert a frame that OpenCV has captured: 8 bits, grey or BGR."""
    if picture.ndim == 2:
        return np.asarray(picture, dtype=np.uint8)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def captured_at(stamp: float, now: float) -> float:
    """Return the capture time (s, steady clock) of an image read at ``now``.

    V4L2 drivers set ``stamp`` on the steady clock. A stamp with an impossible age is from another
    clock, so ``now`` is returned instead.
    """
    return stamp if 0.0 <= now - stamp < OLDEST_STAMP_S else now


def open_source(name: str, settings: CameraSettings) -> Device | Playback:
    """Open a camera by device path or number, a video file, or a folder of images.

    Raises:
        CameraSourceError: no source has that name, or the source cannot be opened.
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
