"""Conversion between image messages and grey images, for all accepted encodings."""

from __future__ import annotations

import array
import struct
import subprocess
import sys
import zlib

import cv2
import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage, Image

from tapping_cell.nodes.camera import images
from tapping_cell.vision.images import ImageRefused

HEIGHT, WIDTH = 24, 32
RANDOM = np.random.default_rng(5)
# The colours vary smoothly, so that they can be reconstructed from a Bayer pattern.
COLOUR = np.clip(
    np.stack(np.meshgrid(np.linspace(20, 200, WIDTH), np.linspace(30, 220, HEIGHT)), -1).sum(-1)[
        ..., None
    ]
    * np.array([0.3, 0.5, 0.45]),
    0,
    255,
).astype(np.uint8)
"""Channels in the order blue, green, red."""
LUMA = COLOUR @ np.array([0.114, 0.587, 0.299])


def message(pixels: np.ndarray, encoding: str, padding: int = 0) -> Image:
    """Build an image message without library functions: the rows in order, each followed by
    ``padding`` bytes."""
    rows = pixels.reshape(HEIGHT, -1).view(np.uint8)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    made = Image(height=HEIGHT, width=WIDTH, encoding=encoding, step=padded.shape[1])
    made.data = array.array("B", padded.tobytes())
    return made


def bayer(first: str, second: str) -> np.ndarray:
    """Return a Bayer image. The arguments are the colours of the first two pixels in the first row
    and in the second row, such as "rg"."""
    index = {"b": 0, "g": 1, "r": 2}
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    for row, letters in enumerate((first, second)):
        for column, letter in enumerate(letters):
            mosaic[row::2, column::2] = COLOUR[row::2, column::2, index[letter]]
    return mosaic


def yuv(luma_first: bool) -> np.ndarray:
    luma = np.rint(LUMA).astype(np.uint8)
    chroma = np.full_like(luma, 128)
    return np.stack([luma, chroma] if luma_first else [chroma, luma], axis=-1)


CASES = {
    "mono8": np.rint(LUMA).astype(np.uint8),
    "8UC1": np.rint(LUMA).astype(np.uint8),
    "mono16": (LUMA * 256).astype("<u2"),
    "bgr8": COLOUR,
    "rgb8": np.ascontiguousarray(COLOUR[..., ::-1]),
    "bgra8": np.dstack([COLOUR, np.full((HEIGHT, WIDTH), 9, np.uint8)]),
    "rgba8": np.dstack([COLOUR[..., ::-1], np.full((HEIGHT, WIDTH), 9, np.uint8)]),
    "bayer_rggb8": bayer("rg", "gb"),
    "bayer_bggr8": bayer("bg", "gr"),
    "bayer_gbrg8": bayer("gb", "rg"),
    "bayer_grbg8": bayer("gr", "bg"),
    "yuv422": yuv(luma_first=False),
    "yuv422_yuy2": yuv(luma_first=True),
}


@pytest.mark.parametrize("encoding", CASES)
@pytest.mark.parametrize("padding", [0, 6])
def test_every_encoding_gives_the_same_grey_image(encoding, padding):
    grey = images.to_grey(message(CASES[encoding], encoding, padding))
    assert grey.shape == (HEIGHT, WIDTH) and grey.dtype == np.uint8
    inner = np.s_[2:-2, 2:-2]  # values at the border of a Bayer pattern are extrapolated
    assert np.abs(grey.astype(float) - LUMA)[inner].max() <= 3.0


def test_the_upper_byte_is_used_for_either_endianness():
    big = message((LUMA * 256).astype(">u2"), "mono16")
    big.is_bigendian = 1
    assert np.abs(images.to_grey(big).astype(float) - LUMA).max() <= 1.0


def test_a_grey_image_is_not_copied():
    made = message(CASES["mono8"], "mono8")
    assert np.shares_memory(images.to_grey(made), np.frombuffer(made.data, np.uint8))


@pytest.mark.parametrize("encoding", ["", "jpeg", "32FC1", "bayer_rggb32"])
def test_an_unknown_encoding_is_named(encoding):
    with pytest.raises(ImageRefused, match="set the camera to one of mono8"):
        images.to_grey(message(CASES["mono8"], encoding))


@pytest.mark.parametrize("encoding", ["bgr8", "mono16", "yuv422"])
def test_too_few_bytes_for_the_encoding_are_refused(encoding):
    with pytest.raises(ImageRefused, match="32 x 24"):
        images.to_grey(message(CASES["mono8"], encoding))


def test_a_message_is_made_from_any_image():
    picture = RANDOM.integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
    for one in (picture, picture[:, ::-1]):
        assert np.array_equal(images.to_grey(images.to_message(one, "mono8")), one)
    colour = images.to_message(COLOUR, "bgr8")
    assert colour.step == 3 * WIDTH
    assert np.array_equal(images.to_grey(colour), cv2.cvtColor(COLOUR, cv2.COLOR_BGR2GRAY))


def test_image_memory_is_kept_instead_of_being_freed_and_cleared_again() -> None:
    """Count the page faults while a process repeatedly allocates and frees images. A separate
    process is used because the memory setting applies to a whole process."""
    script = """
import ctypes, resource
from tapping_cell.nodes.memory import keep_memory
keep_memory()
def faults(rounds):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(rounds):
        pictures = [bytes(b'x') * 1_310_720 for _ in range(3)]
        del pictures
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults(3)
print(faults(100) if hasattr(ctypes.CDLL(None), 'mallopt') else 0)
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=120
    )
    # If the memory were returned to the system, each of the 300 blocks would cause 320 page faults.
    assert int(ended.stdout) < 1000


@pytest.mark.parametrize("coding", [".jpg", ".png"])
def test_a_compressed_image_is_close_to_the_raw_image(coding: str) -> None:
    grey = RANDOM.normal(LUMA, 2.0).clip(0, 255).astype(np.uint8)
    if coding == ".jpg":
        made = images.compress(images.to_message(grey, "mono8"), 95)
        assert made.format.startswith("mono8; jpeg compressed")
    else:
        made = CompressedImage(format="mono8; png compressed ")
        made.data = array.array("B", cv2.imencode(coding, grey)[1].tobytes())
    back = images.to_grey(made)
    assert back.shape == grey.shape
    off = np.abs(back.astype(int) - grey)
    assert off.max() <= (0 if coding == ".png" else 6) and off.mean() < 2


def png(width: int, height: int) -> bytes:
    """Return a PNG file whose header states this size, with the data of few pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        check = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(bytes(10))), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in parts)


@pytest.mark.parametrize("encoding", ["mono8", "rgb8", "mono16"])
def test_an_image_without_columns_is_refused(encoding: str) -> None:
    made = message(CASES[encoding], encoding)
    made.width = 0
    for convert in (images.to_grey, lambda empty: images.to_jpeg(empty, 80)):
        with pytest.raises(ImageRefused, match=f"states 0 x {HEIGHT} {encoding}"):
            convert(made)


@pytest.mark.parametrize(
    "data", [b"", b"no picture", b"\xff\xd8\xff\xe0", png(2**19, 2**14)], ids=len
)
def test_undecodable_data_is_refused_with_a_message(data: bytes) -> None:
    made = CompressedImage(format="jpeg", data=array.array("B", data))
    with pytest.raises(ImageRefused, match=f"{len(data)} bytes, format 'jpeg'"):
        images.to_grey(made)
