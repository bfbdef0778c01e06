"""Accuracy of a cell whose camera was calibrated from photographs, compared with an exact
calibration.

The camera is calibrated from rendered photographs of a ChArUco board, as by ``calibrate camera``.
The stationary object is then measured over the whole table from fused frames, with that calibration
and with the exact calibration.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from benchmarks.vision_scenes import (
    Cell,
    Score,
    random_place,
    random_scene,
    score_lines,
    with_deviations,
)
from tapping_cell.calibration.camera import CameraCalibration, calibrate_camera
from tapping_cell.calibration.target import Target, TargetView, find_target
from tapping_cell.vision import CameraModel, CameraPose, PoseTracker, View
from tapping_cell.vision.markers import aruco
from tapping_cell.vision.markers.detection import marker_dictionary

DEFAULT_COUNT = 100
VIEWS = 25
FUSED = 30
PLACES = 10
"""Number of object positions per camera and calibration."""
TEXEL = 0.0002
TARGET = Target("charuco", 14, 10, 0.030, 0.022, "4X4_100")


def measure(count: int) -> dict[str, Any]:
    """Return the scores of ``count`` positions. After every ten positions, a new camera with new
    photographs is used."""
    cv2.setNumThreads(1)
    cell = Cell.load()
    names = ("calibrated from photographs", "the same, one frame", "exact files")
    scores = {name: Score([], []) for name in names}
    calibrations = []
    scene, camera = None, cell.camera
    for number in range(count):
        random = np.random.default_rng([number, 31])
        if number % PLACES == 0:
            scene = random_scene(random, cell, seed=number)
            calibration = calibrated(random, cell.camera)
            calibrations.append(calibration)
            camera = with_deviations(calibration)
        assert scene is not None
        true = random_place(random)
        trackers = [PoseTracker(c, cell.table, cell.marker) for c in (camera, cell.camera)]
        for k in range(FUSED):
            image = scene.render(true)
            by_calibration, by_exact = (t.update(image, k / 30.0) for t in trackers)
            if k == 0:
                scores[names[1]].add(by_calibration, true)
        scores[names[0]].add(by_calibration, true)
        scores[names[2]].add(by_exact, true)
    true_camera = cell.camera
    return {
        "scores": {name: score.figures() for name, score in scores.items()},
        "views": VIEWS,
        "calibrations": [
            {
                "rms_pixels": c.rms,
                "lens": c.lens,
                "views_used": len(c.views),
                "fx_error_pixels": c.model.fx - true_camera.fx,
                "cx_error_pixels": c.model.cx - true_camera.cx,
                "cy_error_pixels": c.model.cy - true_camera.cy,
            }
            for c in calibrations
        ],
    }


def calibrated(random: np.random.Generator, camera: CameraModel) -> CameraCalibration:
    """Calibrate a camera from photographs of a board with tilts of up to 35 degrees."""
    board = _board()
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width].astype(float)
    rays = camera.rays(np.stack([columns, rows], axis=-1))
    size = np.array([TARGET.columns, TARGET.rows]) * TARGET.square
    views: list[TargetView] = []
    for number in range(VIEWS):
        tilt, way = math.radians(random.uniform(0.0, 35.0)), random.uniform(0.0, 2.0 * math.pi)
        distance = random.uniform(0.42, 0.7)
        aim = random.uniform(-0.35, 0.35, 2) * size
        off = distance * math.sin(tilt) * np.array([math.cos(way), math.sin(way)])
        place = (*(aim + off), distance * math.cos(tilt))
        pose = CameraPose.above(place, (aim[0], aim[1]), random.uniform(-math.pi, math.pi))
        image = _photograph(random, View(camera, pose), board, rays)
        found = find_target(image, TARGET, f"view {number}")
        if isinstance(found, TargetView):
            views.append(found)
    return calibrate_camera(views, TARGET, (camera.width, camera.height))


def _board() -> np.ndarray:
    """Return the reflectance of the board, one value per texel, blurred as in a well focused
    image."""
    book = marker_dictionary(TARGET.dictionary)
    each = round(TARGET.square / TEXEL)
    grid = (TARGET.columns, TARGET.rows)
    drawn = aruco.draw_board(book, grid, TARGET.square, TARGET.marker, each)
    sheet = np.pad(drawn.astype(np.float32), each, constant_values=255.0)
    return np.asarray(cv2.GaussianBlur(30.0 + sheet * (170.0 / 255.0), (0, 0), 1.7))


def _photograph(
    random: np.random.Generator, view: View, board: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    points = view.rays_on_plane(rays, 0.0)
    middle = 0.5 * np.array(board.shape[::-1]) - 0.5
    x = (points[..., 0] / TEXEL + middle[0]).astype(np.float32)
    y = (middle[1] - points[..., 1] / TEXEL).astype(np.float32)
    image = cv2.remap(board, x, y, cv2.INTER_LINEAR, borderValue=(90.0,))
    slope = random.uniform(-0.3, 0.0)
    image = image * (1.0 + slope * np.linspace(0.0, 1.0, image.shape[1]))
    noise = random.normal(0.0, 2.0, image.shape)
    return np.asarray(np.clip(np.rint(image + noise), 0, 255), dtype=np.uint8)


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = score_lines(report["scores"])
    found = report["calibrations"]
    rows.append(
        f"{len(found)} calibrations from {report['views']} photographs each: focal length off by "
        f"{_rms(found, 'fx_error_pixels'):.2f} pixels, middle by "
        f"{_rms(found, 'cx_error_pixels'):.2f} and "
        f"{_rms(found, 'cy_error_pixels'):.2f}, corners fitted to "
        f"{np.median([c['rms_pixels'] for c in found]):.3f} pixels"
    )
    return rows


def _rms(found: list[dict[str, Any]], name: str) -> float:
    return float(np.sqrt(np.mean([c[name] ** 2 for c in found])))
