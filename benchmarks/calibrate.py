"""Errors of the calibrations of camera, table, arm and tapper, for random true parameters.

For comparison, the same corners are calibrated by OpenCV's calibrateCamera with its default five
distortion coefficients.
"""

from __future__ import annotations

import math
import time
from typing import Any

import calibration_truths as truths
import cv2
import numpy as np

from benchmarks.vision_scenes import one_opencv_thread
from tapping_cell.calibration.arm import calibrate_arm, wrist
from tapping_cell.calibration.camera import calibrate_camera
from tapping_cell.calibration.table import calibrate_table, observe_markers
from tapping_cell.calibration.table_frame import frame_of_map, in_frame
from tapping_cell.calibration.tapper import SHARES, calibrate_tapper
from tapping_cell.calibration.target import Target, TargetView, find_target
from tapping_cell.cli.calibration.photographs_verb import view_of_table
from tapping_cell.configuration.cell import load_cell
from tapping_cell.hardware.energy import EnergyCurve
from tapping_cell.hardware.scara import ScaraGeometry
from tapping_cell.se2 import wrap_angle
from tapping_cell.simulation.rendered_sheet import SheetCamera
from tapping_cell.vision import CameraModel

VIEWS = 20
CORNER_SETS, PHOTO_SETS, TABLES, ARMS, TAPPERS = 12, 4, 4, 100, 300
CORNER_NOISE = 0.05
"""Standard deviation of the simulated corner noise, pixels. In rendered photographs, the detected
corners have noise of 0.02 to 0.04 pixels."""
TARGETS = (
    Target("charuco", 10, 7, 0.025, 0.01875, "4X4_250"),
    Target("chessboard", 9, 7, 0.025),
)


def measure() -> dict[str, Any]:
    """Return the errors of all calibrations."""
    with one_opencv_thread():
        return {
            "camera_corners": _cameras_of_corners(),
            "camera_photographs": _cameras_of_photographs(),
            "table": _tables(),
            "arm": _arms(),
            "tapper": _tappers(),
        }


def _camera_errors(
    model: CameraModel, views: list[TargetView], target: Target
) -> tuple[float, float, float, float]:
    """Return four values:

    - the RMS reprojection error in pixels;
    - the relative error of the focal length with this package;
    - the relative error of the focal length with plain OpenCV;
    - the RMS of the errors of fx, fy, cx and cy, each divided by its stated standard deviation.
    """
    result = calibrate_camera(views, target, (model.width, model.height))
    points = [
        np.column_stack([target.points[v.ids], np.zeros(len(v.ids))]).astype(np.float32)
        for v in views
    ]
    pixels = [np.array(v.pixels, dtype=np.float32, order="C")[:, None] for v in views]
    plain = cv2.calibrateCamera(points, pixels, (model.width, model.height), None, None)[1]
    off = [
        (getattr(result.model, name) - getattr(model, name)) / result.deviations[name]
        for name in ("fx", "fy", "cx", "cy")
    ]
    return (
        result.rms,
        abs(result.model.fx / model.fx - 1.0),
        abs(plain[0, 0] / model.fx - 1.0),
        float(np.sqrt(np.mean(np.square(off)))),
    )


def _camera_figures(rows: list[tuple[float, float, float, float]]) -> dict[str, float]:
    rms, focal, plain, off = np.array(rows).T
    return {
        "sets": len(rows),
        "rms_px_largest": float(rms.max()),
        "focal_percent_median": 100 * float(np.median(focal)),
        "focal_percent_largest": 100 * float(focal.max()),
        "plain_opencv_focal_percent_largest": 100 * float(plain.max()),
        "errors_over_deviations": float(np.sqrt((off**2).mean())),
    }


def _cameras_of_corners() -> dict[str, float]:
    rows = []
    for seed in range(CORNER_SETS):
        random = np.random.default_rng(seed)
        model = truths.camera(random)
        views = truths.corner_views(random, model, TARGETS[0], VIEWS, CORNER_NOISE)
        rows.append(_camera_errors(model, views, TARGETS[0]))
    return _camera_figures(rows)


def _cameras_of_photographs() -> dict[str, float]:
    rows = []
    for seed in range(PHOTO_SETS):
        random = np.random.default_rng(100 + seed)
        model, target = truths.camera(random), TARGETS[seed % 2]
        eye, sheet = SheetCamera(model, seed), truths.target_sheet(target)
        views: list[TargetView] = []
        while len(views) < VIEWS:
            pose = truths.view_pose(random, model, sheet.size)
            image = eye.photograph(sheet, pose, noise=random.uniform(1.0, 3.0), blur=0.7)
            found = find_target(image, target, f"view {len(views) + 1}")
            if not isinstance(found, str):
                views.append(found)
        rows.append(_camera_errors(model, views, target))
    return _camera_figures(rows)


def _tables() -> dict[str, float]:
    gaps, turns, rms = [], [], []
    for seed in range(TABLES):
        random = np.random.default_rng(200 + seed)
        model, references = truths.camera(random), truths.markers(random)
        eye, sheet = SheetCamera(model, seed), truths.markers_sheet(references)
        views = []
        for number in range(6):
            image = eye.photograph(sheet, view_of_table(random, model, number))
            found = observe_markers(image, f"view {number}", model, references.dictionary)
            if not isinstance(found, str):
                views.append(found)
        sizes = {m.id: m.size for m in references.markers}
        result = calibrate_table(views, sizes, references.dictionary, model.fx)
        frame, _ = frame_of_map(result.references, references)
        truly = {m.id: m for m in references.markers}
        for m in in_frame(result.references, frame).markers:
            gaps.append(math.hypot(m.x - truly[m.id].x, m.y - truly[m.id].y) * 1e3)
            turns.append(math.degrees(abs(float(wrap_angle(m.theta - truly[m.id].theta)))))
        rms.append(result.rms)
    return {
        "tables": TABLES,
        "images": 6,
        "mm_median": float(np.median(gaps)),
        "mm_largest": max(gaps),
        "deg_largest": max(turns),
        "rms_px_largest": max(rms),
    }


def _arms() -> dict[str, float]:
    """Return the errors of the wrist's position and of the forearm's heading at poses outside the
    calibration data."""
    gaps, turns, off, spent = [], [], [], []
    for seed in range(ARMS):
        random = np.random.default_rng(300 + seed)
        truth = truths.arm(random)
        record = truths.arm_record(random, truth, 20, 1e-4, math.radians(0.1))
        begin = time.process_time()
        result = calibrate_arm(record, ScaraGeometry())
        spent.append(time.process_time() - begin)
        joints = truths.arm_joints(random, truth, 50, 0.0)
        places = [
            complex(v["base_x"], v["base_y"]) + np.exp(1j * v["base_yaw"]) * wrist(joints, v)
            for v in (truth, result.values)
        ]
        error = np.abs(places[1] - places[0])
        gaps.append(float(error.max()) * 1e3)
        off.append(float(np.sqrt((error**2).mean())) / result.wrist_deviation)
        heading = sum(result.values[n] - truth[n] for n in ("base_yaw", "elbow_zero"))
        turns.append(math.degrees(abs(float(wrap_angle(heading)))))
    return {
        "arms": ARMS,
        "mm_median": float(np.median(gaps)),
        "mm_p95": float(np.quantile(gaps, 0.95)),
        "mm_largest": max(gaps),
        "deg_p95": float(np.quantile(turns, 0.95)),
        "deg_largest": max(turns),
        "errors_over_deviations": float(np.sqrt(np.mean(np.square(off)))),
        "ms_median": 1e3 * float(np.median(spent)),
    }


def _tappers() -> dict[str, float]:
    """Return the errors of the tapper's calibration for the recommended energies."""
    cell = load_cell()
    tap = cell.object.tap(cell.file.tapper.striker())
    whole, worst, off, scatter = [], [], [], []
    for seed in range(TAPPERS):
        random = np.random.default_rng(400 + seed)
        speed = truths.tapper(random, cell.file.tapper.mass)
        result = calibrate_tapper(truths.tap_record(random, tap, speed, SHARES, 0.05), tap)
        curve = EnergyCurve(tuple(zip(result.energies, result.speeds, strict=True)))
        at = np.geomspace(result.energies[0], result.energies[-1], 60)[1:-1]
        error = np.array([curve.speed_for(float(energy)) for energy in at]) / speed(at) - 1.0
        whole.append(float(np.sqrt((error**2).mean())))
        worst.append(float(np.abs(error).max()))
        log = np.log(result.speeds) - np.log(speed(np.array(result.energies)))
        off.append(float(np.sqrt(np.mean((log / np.array(result.deviations)) ** 2))))
        scatter.append(result.scatter)
    return {
        "tappers": TAPPERS,
        "taps": sum(SHARES),
        "rms_percent_median": 100 * float(np.median(whole)),
        "rms_percent_p95": 100 * float(np.quantile(whole, 0.95)),
        "worst_percent_p95": 100 * float(np.quantile(worst, 0.95)),
        "errors_over_deviations": float(np.sqrt(np.mean(np.square(off)))),
        "scatter_percent_mean": 100 * float(np.mean(scatter)),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    rows = []
    for name, words in (
        ("camera_corners", f"camera, {VIEWS} views, corners with {CORNER_NOISE} px noise"),
        ("camera_photographs", f"camera, {VIEWS} rendered photographs"),
    ):
        f = report[name]
        rows.append(
            f"{words}, {f['sets']} truths: rms at most {f['rms_px_largest']:.3f} px; focal length"
            f" off by {f['focal_percent_median']:.4f} % median,"
            f" {f['focal_percent_largest']:.4f} % at most (plain OpenCV"
            f" {f['plain_opencv_focal_percent_largest']:.4f} %); errors over standard deviations"
            f" {f['errors_over_deviations']:.2f}"
        )
    f = report["table"]
    rows.append(
        f"table, {f['images']} rendered images, {f['tables']} truths: markers off by"
        f" {f['mm_median']:.4f} mm median, {f['mm_largest']:.4f} mm and {f['deg_largest']:.4f} deg"
        f" at most; rms {f['rms_px_largest']:.3f} px"
    )
    f = report["arm"]
    rows.append(
        f"arm, 20 poses measured to 0.1 mm and 0.1 deg, {f['arms']} truths: wrist at the worst of"
        f" 50 other poses {f['mm_median']:.3f} mm median, {f['mm_p95']:.3f} mm p95,"
        f" {f['mm_largest']:.3f} mm at most; heading {f['deg_p95']:.4f} deg p95,"
        f" {f['deg_largest']:.4f} deg at most; errors over standard deviations"
        f" {f['errors_over_deviations']:.2f}; {f['ms_median']:.0f} ms"
    )
    f = report["tapper"]
    rows.append(
        f"tapper, {f['taps']} taps with 5 % scatter, {f['tappers']} truths: speeds off by"
        f" {f['rms_percent_median']:.2f} % rms (median), {f['rms_percent_p95']:.2f} %"
        f" p95; at its worst energy {f['worst_percent_p95']:.2f} % p95; errors over standard"
        f" deviations {f['errors_over_deviations']:.2f}; scatter found"
        f" {f['scatter_percent_mean']:.1f} %"
    )
    return rows
