"""The node overhead_camera over real DDS: image files, a source that disappears, and wrong
sizes."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from harness import Bench, bench
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image

from tapping_cell.configuration.cell import load_cell
from tapping_cell.nodes.camera import images
from tapping_cell.nodes.camera.overhead_camera import OverheadCamera

LEVELS = (40, 80, 120)


def write(folder: Path, size: tuple[int, int] | None = None) -> Path:
    camera = load_cell().camera
    width, height = size or (camera.width, camera.height)
    folder.mkdir()
    for k, level in enumerate(LEVELS):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((height, width), level, np.uint8))
    (folder / "1a.png").write_bytes(b"\x89PNG broken")
    return folder


def parameters(source: Path, **more: object) -> dict[str, dict[str, object]]:
    return {"overhead_camera": {"source": source, "frame_rate": 30.0, **more}}


def listen(b: Bench) -> tuple[list[Image], list[CameraInfo], list[DiagnosticArray]]:
    return (
        b.listen(Image, "camera/image_raw", qos_profile_sensor_data),
        b.listen(CameraInfo, "camera/camera_info", qos_profile_sensor_data),
        b.listen(DiagnosticArray, "/diagnostics"),
    )


def reports(diagnostics: list[DiagnosticArray], words: str) -> bool:
    return any(words in status.message for array in diagnostics for status in array.status)


def test_images_of_a_folder_are_published_with_calibration_and_increasing_stamps(tmp_path):
    folder = write(tmp_path / "shots")
    with bench(lambda: [OverheadCamera()], parameters(folder, loop=True, exposure=0.01)) as b:
        pictures, infos, diagnostics = listen(b)
        b.wait(lambda: len(pictures) >= 9 and infos, "nine pictures")
        b.wait(lambda: reports(diagnostics, "1a.png"), "the broken picture is named")
        pictures = list(pictures)  # only the images that were received before ``now``
        now = b.probe.get_clock().now().nanoseconds
    seen = [int(np.median(images.to_grey(p))) for p in pictures]
    assert set(seen) == set(LEVELS)
    stamps = [p.header.stamp.sec * 10**9 + p.header.stamp.nanosec for p in pictures]
    assert stamps == sorted(stamps) and len(set(stamps)) == len(stamps)
    assert 0 < now - stamps[-1] < 10 * 10**9
    assert images.from_camera_info(infos[0]) == load_cell().camera
    assert {p.header.frame_id for p in pictures} == {"camera_optical"}


def test_the_end_of_a_folder_is_reported_and_playback_does_not_repeat(tmp_path):
    folder = write(tmp_path / "shots")
    with bench(lambda: [OverheadCamera()], parameters(folder)) as b:
        pictures, _, diagnostics = listen(b)
        b.wait(lambda: reports(diagnostics, "no more images"), "the end is reported")
        b.wait(lambda: len(diagnostics) >= 4, "two more seconds")
        levels = [int(np.median(images.to_grey(picture))) for picture in pictures]
    assert len(levels) == len(set(levels)), "an image was sent twice"


def test_a_lost_source_recovers(tmp_path):
    folder = write(tmp_path / "shots")
    with bench(lambda: [OverheadCamera()], parameters(folder, loop=True)) as b:
        pictures, _, diagnostics = listen(b)
        b.wait(lambda: len(pictures) >= 3, "pictures")
        shutil.move(folder, tmp_path / "away")
        b.wait(lambda: reports(diagnostics, "there is no camera"), "the loss is said")
        count = len(pictures)
        shutil.move(tmp_path / "away", folder)
        b.wait(lambda: len(pictures) > count + 3, "images again")


def test_a_missing_source_is_reported():
    given: dict[str, dict[str, object]] = {"overhead_camera": {"source": '""', "frame_rate": 30.0}}
    with bench(lambda: [OverheadCamera()], given) as b:
        _, _, diagnostics = listen(b)
        b.wait(lambda: reports(diagnostics, "the parameter source is empty"), "it is said")


def test_a_node_waits_for_a_source_that_is_not_available_yet(tmp_path):
    with bench(lambda: [OverheadCamera()], parameters(tmp_path / "shots", loop=True)) as b:
        pictures, _, diagnostics = listen(b)
        b.wait(lambda: reports(diagnostics, "there is no camera"), "said")
        write(tmp_path / "shots")
        b.wait(lambda: len(pictures) >= 3, "pictures")


@pytest.mark.parametrize("size", [(640, 480)])
def test_images_of_another_size_than_the_calibration_are_not_published(tmp_path, size):
    folder = write(tmp_path / "shots", size)
    with bench(lambda: [OverheadCamera()], parameters(folder, loop=True)) as b:
        pictures, _, diagnostics = listen(b)
        b.wait(lambda: reports(diagnostics, "640 x 480"), "refused in words")
        assert not pictures
