"""The one reader of camera images: messages with raw pixels, compressed messages, and files.

All of them become grey images of 8 bits whose pixels are arranged as on the sensor, because the
lens model refers to these pixels. Therefore an Exif orientation is applied only if the image would
otherwise not have the size of the calibration.
"""

from __future__ import annotations

import array
import io
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Union

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from tapping_cell.vision.camera import Image

Data = Union[bytes, "array.array[int]"]
"""Content of a file, or the field ``data`` of a message."""


class ImageRefused(ValueError):
    """Image that cannot be read, or whose content contradicts what is declared about it."""


@dataclass(frozen=True, slots=True, eq=False)
class GreyImage:
    """Grey image (height, width), 8 bits.

    ``bits`` of each sample of the source hold the image; ``depth`` describes them. ``warnings`` are
    sentences about the source that do not invalidate the image.
    """

    pixels: Image
    bits: int = 8
    depth: str = "8 bits"
    warnings: tuple[str, ...] = ()

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.pixels.shape[1], self.pixels.shape[0]

    def explain(self, sentence: str, visible: bool) -> str:
        """Return the sentence about a measurement in this image, with the warnings added. If
        nothing was found, also add a depth that is unusual, which may be the cause."""
        cause = [] if visible or self.depth == "8 bits" else [f"the image has {self.depth}"]
        return "; ".join(filter(None, (sentence, *self.warnings, *cause)))


@dataclass(frozen=True, slots=True)
class Encoding:
    """Channels of a pixel, bytes of a sample, and OpenCV's conversion to grey if one is needed."""

    channels: int
    conversion: int | None = None
    sample: int = 1


# ROS names a Bayer pattern by its top left 2x2 pixels. OpenCV names the pattern by the second and
# third pixels of the second row.
_BAYER = {
    "bayer_rggb8": Encoding(1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": Encoding(1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": Encoding(1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": Encoding(1, cv2.COLOR_BayerGB2GRAY),
}
_EIGHT_BITS = {
    "mono8": Encoding(1),
    "8UC1": Encoding(1),
    "bgr8": Encoding(3, cv2.COLOR_BGR2GRAY),
    "8UC3": Encoding(3, cv2.COLOR_BGR2GRAY),
    "rgb8": Encoding(3, cv2.COLOR_RGB2GRAY),
    "bgra8": Encoding(4, cv2.COLOR_BGRA2GRAY),
    "8UC4": Encoding(4, cv2.COLOR_BGRA2GRAY),
    "rgba8": Encoding(4, cv2.COLOR_RGBA2GRAY),
    **_BAYER,
}
ENCODINGS = {
    **_EIGHT_BITS,
    **{name.replace("8", "16"): replace(e, sample=2) for name, e in _EIGHT_BITS.items()},
    "yuv422": Encoding(2, cv2.COLOR_YUV2GRAY_UYVY),
    "uyvy": Encoding(2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": Encoding(2, cv2.COLOR_YUV2GRAY_YUY2),
    "yuyv": Encoding(2, cv2.COLOR_YUV2GRAY_YUY2),
    # The rows of the luminance come first; the colours after them are not needed.
    "nv12": Encoding(1),
    "nv21": Encoding(1),
    "nv24": Encoding(1),
}
"""Accepted image encodings (sensor_msgs/image_encodings.h)."""

DEPTHS = (8, 10, 12, 14, 16)
"""Numbers of bits that a sample of 16 bits may hold in its lower bits."""
OUTLIERS = 3e-5
"""Fraction of the samples that may exceed the number of bits: hot pixels, and the data that some
cameras write into the first pixels."""
FILE_FORMATS = ("PNG", "JPEG", "MPO", "TIFF", "BMP", "PPM", "WEBP")
"""Accepted formats of compressed images and files, in Pillow's terms; MPO is a JPEG followed by
previews."""
ORIENTATIONS = {
    2: "mirrored",
    3: "rotated by 180 degrees",
    4: "mirrored and rotated by 180 degrees",
    5: "mirrored and rotated by 90 degrees",
    6: "rotated by 90 degrees",
    7: "mirrored and rotated by 270 degrees",
    8: "rotated by 270 degrees",
}
"""Exif orientations that change the image."""
LOW_QUALITY = 50
"""JPEG quality below which a warning is given. In rendered images, the error of the pose is 3 times
that of an uncompressed image at this quality, and 5 to 13 times below 40."""
_ORIENTATION_TAG = 0x112
_PHOTOMETRIC_TAG = 0x106
"""Tag of a TIFF file; 0 means that white is stored as 0."""
_STANDARD_TABLE = 3688
"""Sum of the luminance quantisation table in annex K of the JPEG standard (ITU-T T.81)."""


def rows(
    data: Data, width: int, height: int, step: int, encoding: str, big_endian: bool = False
) -> NDArray[Any]:
    """Return the samples of raw image data, shape (height, width, channels), uint8 or uint16. 8-bit
    samples are copied only if the rows are padded (``step`` is the number of bytes in a row).

    Raises:
        ImageRefused: the encoding is unknown, the image is empty, or there are fewer bytes than the
            size requires.
    """
    known = ENCODINGS.get(encoding)
    if known is None:
        raise ImageRefused(
            f"the image's encoding is '{encoding}'; set the camera to one of "
            f"{', '.join(ENCODINGS)}, preferably mono8"
        )
    count = memoryview(data).nbytes
    used, needed = width * known.channels * known.sample, step * height
    if step < used or count < needed or 0 in (used, needed):
        raise ImageRefused(
            f"the image's header states {width} x {height} {encoding} with {step} bytes per row, "
            f"but its data has {count} bytes"
        )
    lines = np.frombuffer(data, dtype=np.uint8, count=needed).reshape(height, step)[:, :used]
    samples = np.ascontiguousarray(lines).reshape(height, width, -1)
    return samples.view(">u2" if big_endian else "<u2") if known.sample == 2 else samples


def read_raw(
    data: Data,
    width: int,
    height: int,
    step: int,
    encoding: str,
    big_endian: bool = False,
    bits: int = 8,
) -> GreyImage:
    """Read an image with raw pixels. ``bits``: least number of bits in samples of 16, for example
    that of an earlier image of the same camera.

    Raises:
        ImageRefused: see :func:`rows`; or the encoding does not suit the size.
    """
    samples = rows(data, width, height, step, encoding, big_endian)
    warnings = []
    if step >= 2 * samples[0].nbytes:
        warnings.append(
            f"each row of the image has {step} bytes, but {width} pixels of the encoding "
            f"'{encoding}' need only {samples[0].nbytes}; check the encoding"
        )
    image = _eight_bits(samples, bits)
    pixels = _converted(image.pixels, ENCODINGS[encoding].conversion, encoding)
    return replace(image, pixels=pixels, warnings=(*image.warnings, *warnings))


def read_compressed(
    data: Data, form: str = "", size: tuple[int, int] | None = None, bits: int = 8
) -> GreyImage:
    """Read a compressed image. ``form`` describes it as in image_transport: the encoding before
    compression, a semicolon, the codec, and the encoding that was compressed. ``size``: width and
    height of the calibration. ``bits``: as in :func:`read_raw`.

    Raises:
        ImageRefused: the data cannot be decoded, or contradict ``form``.
    """
    coded = np.frombuffer(data, dtype=np.uint8)
    header = _header(coded)
    if header is None or header.format not in FILE_FORMATS:
        raise ImageRefused(_undecodable(coded, form))
    encoding, _, codec = (part.strip() for part in form.partition(";"))
    known = ENCODINGS.get(encoding)
    alpha = header.mode in ("RGBA", "LA", "PA") or "transparency" in header.info
    mosaic = encoding.removesuffix("16").removesuffix("8") + "8" in _BAYER
    flags = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    colour = mosaic or codec.endswith(("rgb8", "rgb16"))
    flags |= cv2.IMREAD_ANYCOLOR if colour else cv2.IMREAD_GRAYSCALE
    samples = _decode(coded, cv2.IMREAD_UNCHANGED if alpha else flags)
    if samples is None:
        raise ImageRefused(_undecodable(coded, form))
    if samples.dtype not in (np.uint8, np.uint16):
        raise ImageRefused(f"its pixels are of type {samples.dtype}; give 8 or 16 bits per sample")
    if samples.dtype == np.uint16 and getattr(header, "tag_v2", {}).get(_PHOTOMETRIC_TAG) == 0:
        samples = 65535 - samples  # OpenCV inverts 8 bits only
    warnings = []
    if header.format != "MPO" and (count := getattr(header, "n_frames", 1)) > 1:
        warnings.append(f"the file contains {count} images, of which the first is used")
    if alpha:
        warnings += _transparency(samples, header.format)
    if known is not None and known.sample == 2 and samples.dtype == np.uint8:
        warnings.append(
            f"the format '{form}' has 16 bits, but the data has 8, which may have cut off the "
            "image's values; set the compressed transport to png"
        )
    image = _eight_bits(samples, bits)
    conversion = None
    if image.pixels.ndim == 3:
        swapped = codec.endswith(("rgb8", "rgb16"))
        conversion = cv2.COLOR_RGB2GRAY if swapped else cv2.COLOR_BGR2GRAY
        if image.pixels.shape[2] == 4:
            conversion = cv2.COLOR_BGRA2GRAY
    elif mosaic and known is not None and not codec.endswith(("mono8", "mono16")):
        conversion = known.conversion
    pixels = _converted(image.pixels, conversion, encoding)
    pixels, turned = _as_on_sensor(pixels, header, size)
    warnings += [*turned, *_quality_warning(header)]
    return replace(image, pixels=pixels, warnings=(*image.warnings, *warnings))


def read_photograph(path: Path, size: tuple[int, int] | None = None, bits: int = 8) -> GreyImage:
    """Read an image file for a camera whose calibration has this ``size`` (width, height).
    ``bits``: as in :func:`read_raw`.

    Raises:
        ImageRefused: the file cannot be read. The message does not contain the path.
    """
    if path.is_dir():
        raise ImageRefused("is a folder; give the image files in it")
    if not path.exists():
        raise ImageRefused("does not exist; check the name")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImageRefused(f"cannot be read ({error.strerror})") from error
    _refuse_damaged(np.frombuffer(data, dtype=np.uint8))
    return read_compressed(data, size=size, bits=bits)


def bits_used(samples: NDArray[np.uint16]) -> int:
    """Return how many of the lower bits of the samples hold the image, one of ``DEPTHS``."""
    allowed = OUTLIERS * samples.size
    return next(b for b in DEPTHS if b == 16 or np.count_nonzero(samples >> b) <= allowed)


def estimated_quality(table: list[int]) -> float:
    """Return the quality, 1 to 100, with which the IJG encoder makes a luminance quantisation table
    of this mean; it is an estimate for the tables of other encoders."""
    scale = 100.0 * sum(table) / _STANDARD_TABLE
    return 100.0 - scale / 2.0 if scale <= 100.0 else 5000.0 / scale


def _eight_bits(samples: NDArray[Any], least: int) -> GreyImage:
    """Reduce samples to 8 bits; one channel loses its axis."""
    if samples.ndim == 3 and samples.shape[2] == 1:
        samples = samples[..., 0]
    if samples.dtype == np.uint8:
        return GreyImage(np.asarray(samples))
    samples = np.ascontiguousarray(samples, dtype=np.uint16)
    bits = max(least, bits_used(samples))
    zeros = _unused_lower_bits(samples)
    depth = f"{bits} bits in the lower part of 16" if bits < 16 else "16 bits"
    if bits == 16 and zeros >= 2:
        depth = f"{16 - zeros} bits in the upper part of 16"
    pixels = np.minimum(samples >> (bits - 8), 255).astype(np.uint8)
    warnings = (_SWAPPED,) if _bytes_swapped(samples) else ()
    return GreyImage(pixels, bits, depth, warnings)


_SWAPPED = (
    "the two bytes of each sample seem to be exchanged; check is_bigendian and the driver of the "
    "camera"
)


def _unused_lower_bits(samples: NDArray[np.uint16]) -> int:
    """Return the number of lower bits, at most 8, that are zero in all samples."""
    used = int(np.bitwise_or.reduce(samples, axis=None)) | 0x100
    return (used & -used).bit_length() - 1


def _bytes_swapped(samples: NDArray[np.uint16]) -> bool:
    """Return whether the lower byte changes less from pixel to pixel than the upper byte, which
    contains noise only if the bytes are exchanged."""
    lines = samples[::16].astype(np.int32)
    upper, lower = (np.abs(np.diff(part, axis=1)).sum() for part in (lines >> 8, lines & 255))
    return bool(0.0 < 2.0 * lower < upper)


def _converted(pixels: NDArray[Any], conversion: int | None, encoding: str) -> Image:
    if conversion is None:
        return np.asarray(pixels, dtype=np.uint8)
    try:
        return np.asarray(cv2.cvtColor(pixels, conversion), dtype=np.uint8)
    except cv2.error as error:
        raise ImageRefused(
            f"an image of {pixels.shape[1]} x {pixels.shape[0]} pixels cannot have the encoding "
            f"'{encoding}'; set the camera to another image size or to mono8"
        ) from error


def _header(coded: Image) -> PIL.Image.Image | None:
    """Return the opened image without decoding its pixels; None if its header cannot be read."""
    try:
        return PIL.Image.open(io.BytesIO(coded.data))
    except (OSError, ValueError, SyntaxError, struct.error, PIL.Image.DecompressionBombError):
        return None


def _refuse_damaged(coded: Image) -> None:
    """Raise ImageRefused if Pillow finds damage in the pixels. The libraries of OpenCV would print
    lines of their own, and some read a damaged image in part."""
    header = _header(coded)
    try:
        if header is not None:
            header.load()
    except (OSError, ValueError, SyntaxError, struct.error) as error:
        raise ImageRefused(
            f"is a damaged or incomplete {header.format if header else ''} file ({error}); copy "
            "or save it again"
        ) from error


def _decode(coded: Image, flags: int) -> NDArray[Any] | None:
    try:
        # imdecode, because imread returns the upper part of a file that is cut off
        decoded = cv2.imdecode(coded, flags)
    except cv2.error:  # a damaged header can state more pixels than OpenCV accepts
        return None
    return None if decoded is None else np.asarray(decoded)


def _undecodable(coded: Image, form: str) -> str:
    if not form:
        if coded.tobytes().startswith(b"version https://git-lfs"):
            return "is a pointer of git LFS; get the image with `git lfs pull`"
        return "cannot be read as an image; give a complete PNG, JPEG, TIFF, BMP or PGM file"
    return (
        f"the compressed image of {coded.size} bytes, format '{form}', cannot be decoded; set the "
        "camera's compressed transport to jpeg or png"
    )


def _transparency(samples: NDArray[Any], form: str) -> list[str]:
    """Return a warning if pixels are transparent.

    Raises:
        ImageRefused: the colours of the transparent pixels are lost.
    """
    if samples.ndim != 3 or samples.shape[2] != 4 or np.ptp(samples[..., 3]) == 0:
        return []
    if form == "TIFF":  # OpenCV multiplies the colours by the transparency
        raise ImageRefused("contains transparent pixels; save it without transparency")
    return ["the image contains transparent pixels, whose stored colours are used"]


def _as_on_sensor(
    pixels: Image, header: PIL.Image.Image, size: tuple[int, int] | None
) -> tuple[Image, list[str]]:
    """Return the pixels as on the sensor, and a warning if the image has an Exif orientation."""
    try:
        orientation = int(header.getexif().get(_ORIENTATION_TAG, 1))
    except (OSError, ValueError, TypeError, SyntaxError, struct.error):
        return pixels, []
    if orientation not in ORIENTATIONS:
        return pixels, []
    if header.format == "TIFF":  # OpenCV has applied it
        inverse = {6: 8, 8: 6}.get(orientation, orientation)
        pixels = _oriented(pixels, inverse)
    turned = f"Exif orientation {orientation} ({ORIENTATIONS[orientation]})"
    if size is not None and size == pixels.shape != size[::-1] and orientation >= 5:
        return _oriented(pixels, orientation), [
            f"the {turned} of the image is applied, because only then it has the size of the "
            "calibration"
        ]
    return pixels, [
        f"the {turned} of the image is not applied, as in `calibrate camera`; a calibration from "
        "rotated images does not suit it"
    ]


def _oriented(pixels: Image, orientation: int) -> Image:
    """Apply an Exif orientation, 2 to 8."""
    if orientation >= 5:
        pixels = pixels.T
    flips = {2: (1, -1), 3: (-1, -1), 4: (-1, 1), 6: (1, -1), 7: (-1, -1), 8: (-1, 1)}
    down, right = flips.get(orientation, (1, 1))
    return np.ascontiguousarray(pixels[::down, ::right])


def _quality_warning(header: PIL.Image.Image) -> list[str]:
    tables = getattr(header, "quantization", None)
    if not tables:
        return []
    quality = estimated_quality(list(tables[min(tables)]))
    if quality >= LOW_QUALITY:
        return []
    return [
        f"the JPEG quality of the image is about {quality:.0f} (limit {LOW_QUALITY}), which makes "
        "the pose several times less accurate; set it to 90 or more"
    ]
