"""Images from real files: folders, videos, and invalid files."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tapping_cell.hardware.camera_source import (
    CameraSettings,
    CameraSourceError,
    SourceEnded,
    captured_at,
    open_source,
)

FAST = CameraSettings(width=64, height=48, rate=240.0)


def grey(level: int) -> np.ndarray:
    picture = np.full((48, 64), level, np.uint8)
    picture[10:20, 30:40] = 255 - level
    return picture


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write a grey PNG, a corrupt PNG, a colour JPEG, a 16-bit PNG and a text file, in this
    order."""
    folder = tmp_path / "shots"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), grey(60))
    (folder / "b.png").write_bytes((folder / "a.png").read_bytes()[:60])
    cv2.imwrite(str(folder / "c.jpg"), cv2.cvtColor(grey(90), cv2.COLOR_GRAY2BGR))
    cv2.imwrite(str(folder / "d.png"), grey(120).astype(np.uint16) * 257)
    (folder / "e.txt").write_text("no image")
    return folder


def test_every_image_type_is_converted_to_grey_and_a_corrupt_one_is_named(folder):
    source = open_source(str(folder), FAST)
    frames = [source.read() for _ in range(3)]
    for frame, level in zip(frames, (60, 90, 120), strict=True):
        picture = frame.picture
        assert picture.dtype == np.uint8
        assert np.abs(picture.astype(int) - grey(level)).max() <= (8 if level == 90 else 0)
        assert np.median(picture) == level
    assert [frame.sentence != "" for frame in frames] == [False, True, False]
    assert "b.png" in frames[1].sentence
    with pytest.raises(SourceEnded, match="loop"):
        source.read()


def test_a_folder_repeats_only_if_requested(folder):
    again = open_source(str(folder), CameraSettings(64, 48, 240.0, loop=True))
    levels = [int(np.median(again.read().picture)) for _ in range(7)]
    assert levels == [60, 90, 120, 60, 90, 120, 60]


def test_a_folder_that_vanishes_is_an_error_and_can_be_reopened(folder):
    looping = CameraSettings(64, 48, 240.0, loop=True)
    source = open_source(str(folder), looping)
    source.read()
    away = folder.with_name("away")
    shutil.move(folder, away)
    with pytest.raises(CameraSourceError):
        for _ in range(4):
            source.read()
    with pytest.raises(CameraSourceError, match="there is no camera"):
        open_source(str(folder), looping)
    shutil.move(away, folder)
    assert np.median(open_source(str(folder), looping).read().picture) == 60


def test_a_folder_that_vanishes_between_two_reads(folder, monkeypatch):
    monkeypatch.setattr(Path, "is_dir", lambda self: True)
    monkeypatch.setattr(Path, "exists", lambda self: True)
    with pytest.raises(CameraSourceError, match="cannot be read"):
        open_source(str(folder / "gone"), FAST)


def test_a_folder_whose_images_vanish_while_it_repeats_has_not_ended(folder):
    source = open_source(str(folder), CameraSettings(64, 48, 240.0, loop=True))
    for _ in range(3):
        source.read()
    for file in folder.iterdir():
        file.write_bytes(b"")  # still listed, but empty
    with pytest.raises(CameraSourceError, match="no image that can be decoded"):
        source.read()


def test_a_folder_without_images_or_with_only_corrupt_images(tmp_path):
    with pytest.raises(CameraSourceError, match="contains no images"):
        open_source(str(tmp_path), FAST)
    (tmp_path / "x.png").write_bytes(b"\x89PNG broken")
    with pytest.raises(CameraSourceError, match="can be decoded"):
        open_source(str(tmp_path), FAST).read()


def test_a_video_keeps_its_rate(tmp_path):
    file = tmp_path / "film.avi"
    film = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for k in range(12):
        film.write(cv2.cvtColor(grey(40 + 10 * k), cv2.COLOR_GRAY2BGR))
    film.release()
    begin = time.monotonic()
    source = open_source(str(file), CameraSettings(64, 48, 60.0))
    frames = [source.read() for _ in range(12)]
    assert [round(float(np.median(f.picture)), -1) for f in frames] == [
        40 + 10 * k for k in range(12)
    ]
    times = np.array([frame.captured for frame in frames])
    # No image comes before its time; on a busy machine it may come later.
    assert np.all(times - begin >= np.arange(12) / 60.0 - 0.002)
    with pytest.raises(SourceEnded):
        source.read()


def test_a_file_that_is_not_a_video_is_refused(tmp_path):
    file = tmp_path / "film.avi"
    file.write_text("no video")
    with pytest.raises(CameraSourceError, match="cannot be opened or decoded"):
        open_source(str(file), FAST).read()


def test_a_missing_camera_is_reported():
    with pytest.raises(CameraSourceError, match="cannot be opened"):
        open_source("/dev/video-of-nobody", FAST)


def test_the_driver_stamp_is_used_if_it_is_on_the_steady_clock():
    now = time.monotonic()
    assert captured_at(now - 0.03, now) == now - 0.03
    for stamp in (0.0 if now > 10.0 else -1.0, now + 5.0, now - 100.0, 1.7e9 + now):
        assert captured_at(stamp, now) == now
