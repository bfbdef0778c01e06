"""The map of the reference markers: known maps are recovered, and moved markers and unconnected
parts are reported."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import calibration_truths as truths
import cv2
import numpy as np
import pytest

from tapping_cell.calibration.camera import CalibrationRefused
from tapping_cell.calibration.table import MarkerView, calibrate_table, observe_markers
from tapping_cell.calibration.table_frame import frame_of_map, frame_of_markers, in_frame, scaled
from tapping_cell.cli import main
from tapping_cell.se2 import transform_points
from tapping_cell.simulation.rendered_sheet import SheetCamera
from tapping_cell.vision import CameraModel, CameraPose, ReferenceMap, View
from tapping_cell.vision.markers.detection import UNIT_CORNERS

CAMERA = CameraModel(1280, 1024, 1000.0, 1000.0, 640.0, 512.0)
NOISE = 0.05


def views_of(seed: int, images: int = 6) -> tuple[ReferenceMap, list[MarkerView]]:
    random = np.random.default_rng(seed)
    references = truths.markers(random)
    ids = np.array([m.id for m in references.markers])
    views = []
    for number in range(images):
        side = number * 2 * math.pi / images
        place = (0.35 * math.cos(side), 0.35 * math.sin(side), 0.75)
        pose = CameraPose.above(place, spin=random.uniform(-3, 3))
        pixels = View(CAMERA, pose).project(references.corners())
        pixels += NOISE * random.standard_normal(pixels.shape)
        rays, noise = CAMERA.rays(pixels), np.full(len(ids), NOISE / CAMERA.fx)
        views.append(MarkerView(f"view {number}", ids, rays, noise))
    return references, views


def solve(references: ReferenceMap, views: list[MarkerView]):
    sizes = {m.id: m.size for m in references.markers}
    return calibrate_table(views, sizes, references.dictionary, CAMERA.fx)


def test_the_map_is_recovered_within_its_standard_deviations() -> None:
    off = []
    for seed in range(4):
        references, views = views_of(seed)
        result = solve(references, views)
        frame, left = frame_of_map(result.references, references)
        assert left < 2e-4
        assert result.rms == pytest.approx(NOISE * math.sqrt(2), rel=0.2)
        # The stated deviations refer to the frame given by the mean position and direction of all
        # markers.
        middle = np.mean([(m.x, m.y, m.theta) for m in references.markers], axis=0)
        pairs = zip(result.references.markers, in_frame(references, middle).markers, strict=True)
        for row, (a, b) in enumerate(pairs):
            off += list(np.array([a.x - b.x, a.y - b.y]) / result.deviations[row, :2])
    assert 0.6 < float(np.sqrt(np.mean(np.square(off)))) < 1.4


def test_the_stated_corner_noise_matches_the_error_in_photographs() -> None:
    random = np.random.default_rng(51)
    references = truths.markers(random)
    truly = {m.id: m for m in references.markers}
    eye, sheet = SheetCamera(CAMERA, 1), truths.markers_sheet(references)
    pose = CameraPose.above((0.32, 0.14, 0.7), spin=0.4)
    view = observe_markers(
        eye.photograph(sheet, pose, noise=8.0), "", CAMERA, references.dictionary
    )
    assert isinstance(view, MarkerView)
    off = []
    for i, rays in zip(view.ids.tolist(), view.rays, strict=True):
        m = truly[i]
        corners = transform_points((m.x, m.y, m.theta), UNIT_CORNERS * m.size)
        in_camera = pose.apply(np.column_stack([corners, np.zeros(4)]))
        off.append(rays - in_camera[:, :2] / in_camera[:, 2:])
    error = float(np.sqrt(np.mean(np.square(off))))
    assert error == pytest.approx(float(np.sqrt(np.mean(np.square(view.noise)))), rel=0.25)


def test_markers_of_another_dictionary_or_with_other_ids_are_named() -> None:
    references = truths.markers(np.random.default_rng(51))
    pose = CameraPose.above((0.32, 0.14, 0.7), spin=0.4)
    image = SheetCamera(CAMERA, 1).photograph(truths.markers_sheet(references), pose, noise=2.0)
    seen = observe_markers(image, "", CAMERA, references.dictionary)
    assert isinstance(seen, MarkerView) and len(seen.ids) > 4
    ids = ", ".join(map(str, sorted(seen.ids.tolist())))
    other = observe_markers(image, "", CAMERA, "5X5_1000")
    assert other == (
        f"no marker of 5X5_1000 is visible, but the markers {ids} of APRILTAG_36H11 are visible; "
        "correct the dictionary"
    )
    wanted = observe_markers(image, "", CAMERA, references.dictionary, [1, 2])
    assert isinstance(wanted, str) and f"but the markers {ids} of" in wanted
    empty = np.full_like(image, 128)
    assert observe_markers(empty, "", CAMERA, "5X5_1000") == "no marker of 5X5_1000 is visible"


def test_a_marker_displaced_in_one_image_is_named() -> None:
    references, views = views_of(7)
    rays = views[2].rays.copy()
    rays[4] += 0.01
    result = solve(references, [*views[:2], replace(views[2], rays=rays), *views[3:]])
    assert [(s.image, s.marker) for s in result.outliers] == [("view 2", int(views[2].ids[4]))]
    frame, left = frame_of_map(result.references, references)
    assert left < 2e-4


def test_a_marker_of_another_size_is_excluded_from_the_map() -> None:
    references, views = views_of(8)
    sizes = {m.id: m.size for m in references.markers} | {103: 0.030}
    result = calibrate_table(views, sizes, references.dictionary, CAMERA.fx)
    assert 103 not in [m.id for m in result.references.markers]
    assert any("marker 103 is left out" in text for text in result.warnings)


def test_frames_and_scales() -> None:
    references, _ = views_of(9)
    there = in_frame(references, frame_of_markers(references, 106, 108))
    places = {m.id: m for m in there.markers}
    assert (places[106].x, places[106].y) == pytest.approx((0, 0), abs=1e-12)
    assert places[108].y == pytest.approx(0, abs=1e-12) and places[108].x > 0
    frame, left = frame_of_map(there, references)
    assert left < 1e-12
    larger = scaled(references, 1.01).markers[0]
    assert (larger.size, larger.x) == pytest.approx((0.0404, 1.01 * references.markers[0].x))


def test_images_without_common_markers_are_refused() -> None:
    references, views = views_of(10)
    halves = [
        MarkerView(v.name, v.ids[part], v.rays[part], v.noise[part])
        for number, v in enumerate(views)
        for part in [slice(0, 4) if number % 2 else slice(4, 8)]
    ]
    with pytest.raises(CalibrationRefused, match="no marker in common"):
        solve(references, halves)
    with pytest.raises(CalibrationRefused, match="at least 2"):
        solve(references, views[:1])


def test_images_with_equal_names_and_different_sizes_are_refused(tmp_path: Path, capsys) -> None:
    images = []
    for part, shape in (("a", (960, 1280)), ("b", (480, 640)), ("c", (960, 1280))):
        images.append(tmp_path / part / "1.png")
        images[-1].parent.mkdir()
        cv2.imwrite(str(images[-1]), np.full(shape, 120, dtype=np.uint8))
    words = ["calibrate", "table", *map(str, images), "--size", "40"]
    assert main([*words, "--output", str(tmp_path / "table.yaml")]) == 1
    assert "2 are 1280 x 960 pixels, but b/1.png (640 x 480)" in capsys.readouterr().err
