"""The one reader of images: encodings, depths, orientation, formats, and refusals."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapping_cell.vision import images
from tapping_cell.vision.images import ImageRefused, read_compressed, read_photograph, read_raw

HEIGHT, WIDTH = 48, 64
INNER = np.s_[2:-2, 2:-2]  # values at the border of a Bayer pattern are extrapolated
ACROSS, DOWN = np.meshgrid(np.linspace(0, 1, WIDTH), np.linspace(0, 1, HEIGHT))
# The colours vary smoothly, so that they can be reconstructed from a Bayer pattern.
RGB = np.stack([30 + 220 * ACROSS, 20 + 200 * DOWN, 40 + 100 * ACROSS * DOWN], axis=-1)
LUMA = RGB @ np.array([0.299, 0.587, 0.114])
COLOUR, GREY = np.rint(RGB).astype(np.uint8), np.rint(LUMA).astype(np.uint8)
PATTERNS = {"rggb": ("rg", "gb"), "bggr": ("bg", "gr"), "gbrg": ("gb", "rg"), "grbg": ("gr", "bg")}


def mosaic(pattern: str) -> np.ndarray:
    made = np.zeros((HEIGHT, WIDTH), np.uint8)
    for row, letters in enumerate(PATTERNS[pattern]):
        for column, letter in enumerate(letters):
            made[row::2, column::2] = COLOUR[row::2, column::2, "rgb".index(letter)]
    return made


def raw(pixels: np.ndarray, encoding: str, big: bool = False, padding: int = 0) -> np.ndarray:
    lines = np.ascontiguousarray(pixels).reshape(HEIGHT, -1).view(np.uint8)
    lines = np.pad(lines, ((0, 0), (0, padding)), constant_values=77)
    return read_raw(lines.tobytes(), WIDTH, HEIGHT, lines.shape[1], encoding, big)


def saved(image: PIL.Image.Image, form: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return stream.getvalue()


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def differs(image: images.GreyImage, expected: np.ndarray = LUMA) -> float:
    assert image.pixels.dtype == np.uint8 and image.pixels.shape == expected.shape
    return float(np.abs(image.pixels.astype(float) - expected)[INNER].max())


@settings(deadline=None)
@given(
    encoding=st.sampled_from(["mono", "bgr", "rgb", "bgra", "rgba", *PATTERNS]),
    bits=st.sampled_from([8, 10, 12, 14, 16]),
    upper=st.booleans(),
    big=st.booleans(),
    padding=st.integers(0, 9),
)
def test_every_encoding_depth_byte_order_and_padding_gives_the_same_grey(
    encoding, bits, upper, big, padding
):
    alpha = np.full((HEIGHT, WIDTH, 1), 9, np.uint8)
    pixels = {"mono": GREY, "rgb": COLOUR, "bgr": COLOUR[..., ::-1]}.get(encoding[:3], None)
    pixels = GREY if encoding == "mono" else pixels
    if encoding in PATTERNS:
        pixels = mosaic(encoding)
    elif encoding.endswith("a"):
        pixels = np.concatenate([pixels, alpha], axis=-1)
    name = ("bayer_" if encoding in PATTERNS else "") + encoding
    assert differs(raw(pixels, f"{name}8", big, padding)) <= 3.0
    shift = (8 if upper else bits - 8) if bits < 16 else 8
    deep = pixels.astype(np.uint16) << shift
    image = raw(deep.astype(">u2" if big else "<u2"), f"{name}16", big, padding)
    assert differs(image) <= 3.0
    assert image.warnings == ()
    assert image.bits == 8 + shift


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("part", ["lower", "upper"])
def test_the_depth_is_named(bits, part):
    noise = np.random.default_rng(bits).integers(0, 1 << bits, (HEIGHT, WIDTH))
    smooth = (GREY.astype(np.int64) << (bits - 8)) + noise % (1 << (bits - 8))
    samples = (smooth << (16 - bits if part == "upper" else 0)).astype("<u2")
    image = raw(samples, "mono16")
    assert image.depth == f"{bits} bits in the {part} part of 16"
    assert differs(image) <= 1.0
    assert f"{bits} bits in the {part}" in image.explain("no marker is seen", False)
    assert image.explain("", True) == ""
    compressed = read_compressed(png(samples), "mono16; png compressed ")
    assert np.array_equal(compressed.pixels, image.pixels) and compressed.depth == image.depth


def test_the_depth_survives_hot_pixels_and_never_decreases_in_a_sequence():
    samples = np.zeros((1000, 1000), "<u2")
    samples[::2] = 4000
    samples[0, :20] = 65535  # data of the camera in the first pixels
    image = read_raw(samples.tobytes(), 1000, 1000, 2000, "mono16")
    assert image.bits == 12 and image.pixels.max() == 255
    dark = (samples // 100).tobytes()
    later = read_raw(dark, 1000, 1000, 2000, "mono16", bits=image.bits)
    assert later.bits == 12 and later.pixels[2, 2] == 40 // 16


@pytest.mark.parametrize("shift", [4, 6, 8])
def test_exchanged_bytes_are_suspected(shift):
    noise = np.random.default_rng(3).integers(0, 1 << shift, (HEIGHT, WIDTH))
    samples = ((GREY.astype(np.int64) << shift) + noise).astype("<u2")
    assert raw(samples, "mono16").warnings == ()
    assert "is_bigendian" in raw(samples, "mono16", big=True).warnings[0]
    assert "is_bigendian" in read_compressed(png(samples.byteswap())).warnings[0]


def test_rows_that_are_twice_as_long_as_the_encoding_are_named():
    deep = GREY.astype("<u2") << 8
    data = deep.tobytes()
    image = read_raw(data, WIDTH, HEIGHT, 2 * WIDTH, "mono8")
    assert "check the encoding" in image.warnings[0]
    for planar in ("nv12", "nv21", "nv24"):
        assert np.array_equal(
            read_raw(GREY.tobytes() * 2, WIDTH, HEIGHT, WIDTH, planar).pixels, GREY
        )


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("codec", "deep"), [("jpeg", False), ("png", False), ("png", True)])
def test_a_compressed_mosaic_is_converted_by_the_encoding_before_compression(pattern, codec, deep):
    pixels = mosaic(pattern).astype(np.uint16) << 4 if deep else mosaic(pattern)
    end = ".jpg" if codec == "jpeg" else ".png"
    data = cv2.imencode(end, pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    encoding = f"bayer_{pattern}{16 if deep else 8}"
    assert differs(read_compressed(data, f"{encoding}; {codec} compressed ")) <= 4.0
    # The publisher has already converted these, so they are no mosaics.
    grey = cv2.imencode(end, GREY)[1].tobytes()
    colour = cv2.imencode(end, COLOUR[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    assert differs(read_compressed(grey, f"{encoding}; {codec} compressed mono8")) <= 4.0
    assert differs(read_compressed(colour, f"{encoding}; {codec} compressed bgr8")) <= 4.0


def test_channels_in_the_order_rgb_are_read_as_declared():
    data = cv2.imencode(".png", COLOUR)[1].tobytes()  # the encoder takes them for BGR
    assert differs(read_compressed(data, "rgb8; png compressed rgb8")) <= 2.0
    assert differs(read_compressed(png(COLOUR[..., ::-1]), "rgb8; png compressed bgr8")) <= 2.0


def test_16_bits_cut_off_by_jpeg_are_named():
    data = cv2.imencode(".jpg", GREY)[1].tobytes()
    assert (
        "set the compressed transport to png" in read_compressed(data, "mono16; jpeg").warnings[0]
    )


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_stay_as_on_the_sensor(form, orientation, tmp_path):
    exif = PIL.Image.Exif()
    exif[0x112] = orientation
    options = {"JPEG": {"quality": 100}, "WEBP": {"lossless": True}}.get(form, {})
    data = saved(PIL.Image.fromarray(GREY), form, exif=exif, **options)
    image = read_compressed(data)
    assert differs(image, GREY.astype(float)) <= 2.0
    assert ("is not applied" in " ".join(image.warnings)) == (orientation > 1)
    file = tmp_path / "shot"
    file.write_bytes(data)
    assert np.array_equal(read_photograph(file).pixels, image.pixels)


@pytest.mark.parametrize("form", ["JPEG", "TIFF"])
@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_rotation_is_applied_if_the_calibration_has_the_rotated_size(form, orientation):
    inverse = {5: 5, 6: 8, 7: 7, 8: 6}[orientation]
    turned = PIL.Image.fromarray(GREY)
    methods = {5: 5, 6: 4, 7: 6, 8: 2}  # Pillow: TRANSPOSE, ROTATE_270, TRANSVERSE, ROTATE_90
    turned = turned.transpose(PIL.Image.Transpose(methods[inverse]))
    exif = PIL.Image.Exif()
    exif[0x112] = orientation
    data = saved(turned, form, exif=exif, quality=100)
    image = read_compressed(data, size=(WIDTH, HEIGHT))
    assert differs(image, GREY.astype(float)) <= 2.0
    assert "is applied" in image.warnings[0]


def palette() -> PIL.Image.Image:
    return PIL.Image.fromarray(COLOUR).quantize(64)


def test_palette_cmyk_bilevel_and_transparent_files_are_read_as_an_independent_reader_does():
    picture = PIL.Image.fromarray(COLOUR)
    opaque = np.dstack([COLOUR, np.full((HEIGHT, WIDTH), 255, np.uint8)])
    for image, form, options in (
        (palette(), "PNG", {}),
        (palette(), "BMP", {}),
        (palette(), "TIFF", {}),
        (palette(), "PNG", {"transparency": 3}),
        (picture.quantize(16), "PNG", {"bits": 4}),
        (picture.convert("1"), "PNG", {}),
        (picture.convert("1"), "TIFF", {}),
        (picture.convert("CMYK"), "JPEG", {"quality": 100}),
        (picture.convert("CMYK"), "TIFF", {}),
        (picture.convert("L"), "PPM", {}),
        (PIL.Image.fromarray(opaque), "PNG", {}),
        (PIL.Image.fromarray(opaque), "TIFF", {}),
        (picture.convert("LA"), "PNG", {}),
    ):
        expected = np.asarray(image.convert("RGB")) @ np.array([0.299, 0.587, 0.114])
        assert differs(read_compressed(saved(image, form, **options)), expected) <= 3.0


@pytest.mark.parametrize("deep", [False, True])
def test_a_tiff_file_in_which_white_is_zero_is_inverted(deep):
    pixels = GREY.astype(np.uint16) * 257 if deep else GREY
    data = saved(PIL.Image.fromarray(np.invert(pixels)), "TIFF")
    kept = [struct.pack("<HHIHH", 262, 3, 1, value, 0) for value in (1, 0)]  # PhotometricInterp.
    assert kept[0] in data
    assert differs(read_compressed(data.replace(*kept)), GREY.astype(float)) == 0.0


@pytest.mark.parametrize("form", ["TIFF", "PNG", "WEBP"])
def test_a_file_of_several_images_is_named(form):
    first, second = (
        PIL.Image.fromarray(pixels) for pixels in (GREY, GREY.T.copy().reshape(48, 64))
    )
    image = read_compressed(
        saved(first, form, save_all=True, append_images=[second], lossless=True)
    )
    assert differs(image, GREY.astype(float)) <= 3.0
    assert image.warnings == ("the file contains 2 images, of which the first is used",)


def test_transparent_pixels_are_named():
    alpha = np.rint(255 * ACROSS).astype(np.uint8)
    picture = PIL.Image.fromarray(np.dstack([COLOUR, alpha]))
    image = read_compressed(saved(picture, "PNG"))
    assert differs(image) <= 2.0 and "transparent" in image.warnings[0]
    with pytest.raises(ImageRefused, match="save it without transparency"):
        read_compressed(saved(picture, "TIFF"))


@settings(deadline=None)
@given(st.integers(5, 100))
def test_the_jpeg_quality_is_estimated_and_a_low_one_is_named(quality):
    image = read_compressed(saved(PIL.Image.fromarray(GREY), "JPEG", quality=quality))
    assert bool(image.warnings) == (quality < images.LOW_QUALITY)
    if 20 <= quality < images.LOW_QUALITY:
        assert f"about {quality} (limit 50)" in image.warnings[0]


@pytest.mark.parametrize("form", ["JPEG", "PNG", "TIFF", "BMP", "PPM", "WEBP"])
@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9])
def test_a_file_that_is_cut_off_is_refused(form, part, tmp_path):
    data = saved(PIL.Image.fromarray(COLOUR), form)
    file = tmp_path / "cut"
    file.write_bytes(data[: int(part * len(data))])
    with pytest.raises(ImageRefused, match="cannot be read as an image|incomplete"):
        read_photograph(file)


@settings(deadline=None)
@given(st.binary(max_size=300), st.sampled_from(["JPEG", "PNG", "TIFF", "BMP", "PPM"]), st.data())
def test_damaged_data_are_read_or_refused(noise, form, draws):
    data = bytearray(saved(PIL.Image.fromarray(COLOUR), form))
    at = draws.draw(st.integers(0, len(data)))
    data[at : at + len(noise)] = noise
    try:
        image = read_compressed(bytes(data))
    except ImageRefused:
        return
    assert image.pixels.ndim == 2 and image.pixels.dtype == np.uint8


def test_missing_files_folders_and_other_types_are_refused(tmp_path: Path):
    for path, words in ((tmp_path, "is a folder"), (tmp_path / "none.png", "does not exist")):
        with pytest.raises(ImageRefused, match=words):
            read_photograph(path)
    deep = cv2.imencode(".tiff", GREY.astype(np.float32))[1].tobytes()
    with pytest.raises(ImageRefused, match="8 or 16 bits"):
        read_compressed(deep)
    with pytest.raises(ImageRefused, match="cannot be read as an image"):
        read_compressed(saved(PIL.Image.fromarray(COLOUR), "GIF"))
