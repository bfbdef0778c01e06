"""The vision package compared with cv2.aruco and pupil-apriltags on frames with ground truth.

The other packages detect corners in the same rendered images. Poses are computed from these corners
with the same known camera and plane. pupil-apriltags is measured if it is installed (``pip install
pupil-apriltags``).
"""

from __future__ import annotations

import importlib.util
import math
import statistics
import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from benchmarks.vision_scenes import Cell, disk_outline, one_opencv_thread
from tapping_cell.nodes.memory import keep_memory
from tapping_cell.se2 import transform_points, wrap_angle
from tapping_cell.simulation.rendered_camera import SceneRenderer, SceneSettings
from tapping_cell.vision import CameraPose, ObjectMarker, PoseTracker, View
from tapping_cell.vision.markers import aruco
from tapping_cell.vision.markers.detection import UNIT_CORNERS, find_markers, marker_pattern
from tapping_cell.vision.markers.edges import refine
from tapping_cell.vision.markers.object_pose import fit_marker, pose_of_corners

DEFAULT_COUNT = 60
FRAMES = 30
"""Number of frames of a stationary object for measuring the tracker's time."""
MARGIN = 40
"""Margin around the marker for a search near the last pose, in pixels."""
Pose = np.ndarray | None


def measure(count: int = DEFAULT_COUNT) -> dict[str, Any]:
    """Return errors and times over ``count`` random scenes and for a tracker of a stationary
    object."""
    keep_memory()  # the memory settings of the nodes that process images
    with one_opencv_thread():
        return _measure(count)


def _measure(count: int) -> dict[str, Any]:
    cell = Cell.load()
    marker = cell.marker
    outline = disk_outline()
    random = np.random.default_rng(1)
    results: dict[str, list[tuple[float, float, float]]] = {}
    missed: dict[str, int] = {}
    scene, methods = None, {}
    for number in range(count):
        if number % 10 == 0:
            place = (*random.uniform(-0.06, 0.06, 2), 0.7)
            settings = SceneSettings(
                noise=random.uniform(2.0, 4.0),
                light_falloff=random.uniform(0.0, 0.67),
                light_direction=random.uniform(0.0, 6.3),
                vignetting=0.2,
                blur=random.uniform(0.5, 0.9),
            )
            pose = CameraPose.above(place, spin=random.uniform(-0.05, 0.05))
            scene = SceneRenderer(
                cell.camera, pose, cell.table, outline, marker, settings, seed=number
            )
            methods = _methods(scene.view, marker)
        assert scene is not None
        true = random.uniform([-0.25, -0.17, -math.pi], [0.25, 0.17, math.pi])
        image = scene.render(true)
        # The first method starts with a cold CPU cache. Therefore, the method that runs first
        # changes from image to image.
        turn = number % len(methods)
        for name in [*methods][turn:] + [*methods][:turn]:
            method = methods[name]
            begin = time.process_time()
            found = method(image, true)
            spent = (time.process_time() - begin) * 1e3
            if found is None:
                missed[name] = missed.get(name, 0) + 1
                continue
            gap = math.hypot(*(found - true)[:2]) * 1e3
            turn = math.degrees(abs(float(wrap_angle(found[2] - true[2]))))
            results.setdefault(name, []).append((gap, turn, spent))
    assert scene is not None
    return {
        "scenes": count,
        "methods": {
            name: _figures(results[name]) | {"missed": missed.get(name, 0)}
            for name in methods
            if name in results
        },
        "tracker": _tracker(scene, cell),
        "pupil_apriltags": importlib.util.find_spec("pupil_apriltags") is not None,
    }


def _figures(rows: list[tuple[float, float, float]]) -> dict[str, float]:
    gaps, turns, spent = zip(*rows, strict=True)
    return {
        "median_mm": statistics.median(gaps),
        "p95_mm": float(np.quantile(gaps, 0.95)),
        "median_deg": statistics.median(turns),
        "p95_deg": float(np.quantile(turns, 0.95)),
        "median_ms": statistics.median(spent),
    }


def _methods(
    view: View, marker: ObjectMarker
) -> dict[str, Callable[[np.ndarray, np.ndarray], Pose]]:
    """Return functions by name. Each one measures the pose in an image. Its second argument is the
    true pose; functions that search only near a predicted pose derive the prediction from it."""
    modules = marker_pattern(marker.dictionary, marker.id).shape[0]

    def quad(true: np.ndarray) -> np.ndarray:
        return view.project(transform_points(true, UNIT_CORNERS * marker.size), marker.height)

    def region(true: np.ndarray) -> tuple[int, int, int, int]:
        corners = quad(true)
        low = corners.min(axis=0).astype(int) - MARGIN
        high = corners.max(axis=0).astype(int) + MARGIN
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def by_edges(image: np.ndarray, corners: np.ndarray) -> Pose:
        fit = fit_marker(view, refine(image, corners[None], modules), 0, marker)
        return None if fit is None else fit.pose

    def tracking(image: np.ndarray, true: np.ndarray) -> Pose:
        # Start from the pose in the previous image, about one pixel away.
        return by_edges(image, quad(true + np.array([0.0005, -0.0004, 0.004])))

    def settled(image: np.ndarray, true: np.ndarray) -> Pose:
        # Start from the predicted pose. The predicted pose is nearly exact if the object is
        # stationary or if its motion was predicted well.
        return by_edges(image, quad(true + np.array([2e-5, -2e-5, 2e-4])))

    def full(image: np.ndarray, true: np.ndarray) -> Pose:
        found = [d for d in find_markers(image, marker.dictionary) if d.id == marker.id]
        return by_edges(image, found[0].corners) if found else None

    methods = {
        "tracking at rest, edges": settled,
        "tracking, a pixel away": tracking,
        "full search, edges": full,
        "cv2.aruco subpix, region": _aruco(view, marker, cv2.aruco.CORNER_REFINE_SUBPIX, region),
        "cv2.aruco contour, region": _aruco(view, marker, cv2.aruco.CORNER_REFINE_CONTOUR, region),
        "cv2.aruco contour, full": _aruco(view, marker, cv2.aruco.CORNER_REFINE_CONTOUR, None),
    }
    if importlib.util.find_spec("pupil_apriltags") is not None:
        methods["pupil-apriltags, region"] = _pupil(view, marker, region)
        methods["pupil-apriltags, full"] = _pupil(view, marker, None)
    return methods


def _aruco(
    view: View,
    marker: ObjectMarker,
    refinement: int,
    region: Callable[[np.ndarray], tuple[int, int, int, int]] | None,
) -> Callable[[np.ndarray, np.ndarray], Pose]:
    """Detect with OpenCV's default parameters and one of its corner refinements."""
    parameters = aruco.detector_parameters()
    parameters.cornerRefinementMethod = refinement
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)

    def method(image: np.ndarray, true: np.ndarray) -> Pose:
        part, origin = _cut(image, region, true)
        for number, corners in aruco.detect_markers(part, book, parameters):
            if number == marker.id:
                return pose_of_corners(view, corners + origin, marker)
        return None

    return method


@lru_cache(maxsize=1)
def _pupil_detector() -> Any:
    """Create the detector once and never delete it, because its destructor crashes Python."""
    from pupil_apriltags import Detector

    Detector.__del__ = lambda self: None
    return Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)


def _pupil(
    view: View,
    marker: ObjectMarker,
    region: Callable[[np.ndarray], tuple[int, int, int, int]] | None,
) -> Callable[[np.ndarray, np.ndarray], Pose]:
    """Detect with the AprilTag library through pupil-apriltags, with one thread and without
    decimation."""
    detector = _pupil_detector()

    def method(image: np.ndarray, true: np.ndarray) -> Pose:
        part, origin = _cut(image, region, true)
        for found in detector.detect(part):
            if found.tag_id == marker.id:
                # The corners are in counter-clockwise order, from the bottom left of the tag as
                # AprilRobotics prints it. OpenCV prints the tag upside down. In the AprilTag
                # library, integer coordinates are the corners of pixels, not their centres.
                corners = found.corners + origin - 0.5
                poses = [
                    pose_of_corners(view, np.roll(corners[::-1], shift, axis=0), marker)
                    for shift in range(4)
                ]
                return min(poses, key=lambda p: abs(float(wrap_angle(p[2] - true[2]))))
        return None

    return method


def _cut(
    image: np.ndarray,
    region: Callable[[np.ndarray], tuple[int, int, int, int]] | None,
    true: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    if region is None:
        return image, np.zeros(2)
    x0, y0, x1, y1 = region(true)
    x0, y0 = max(x0, 0), max(y0, 0)
    return np.ascontiguousarray(image[y0:y1, x0:x1]), np.array([x0, y0], dtype=float)


def _tracker(scene: SceneRenderer, cell: Cell) -> dict[str, float]:
    """Measure the complete tracker with reference markers: time per frame for a stationary and for
    a sliding object, in ms."""
    tracker = PoseTracker(scene.view.camera, cell.table, cell.marker)
    still, moving = [], []
    pose = np.array([-0.1, 0.05, 0.3])
    step = np.array([0.004, -0.001, 0.02])
    for k in range(2 * FRAMES):
        if k >= FRAMES:
            pose = pose + step
        image = scene.render(pose)
        begin = time.process_time()
        tracker.update(image, k / 30.0)
        (moving if k >= FRAMES else still).append((time.process_time() - begin) * 1e3)
    return {
        "first_ms": still[0],
        "rest_median_ms": statistics.median(still[5:]),
        "sliding_median_ms": statistics.median(moving[2:]),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    width = max(len(name) for name in report["methods"])
    rows = [
        f"{report['scenes']} scenes, one frame each, known camera and table",
        f"{'':<{width}}  {'mm median':>9} {'p95':>7}  {'deg median':>10} {'p95':>7}  {'ms':>6}"
        "  missed",
    ]
    for name, f in report["methods"].items():
        rows.append(
            f"{name:<{width}}  {f['median_mm']:>9.4f} {f['p95_mm']:>7.4f}  "
            f"{f['median_deg']:>10.4f} {f['p95_deg']:>7.4f}  "
            f"{f['median_ms']:>6.2f}  {f['missed']:>6}"
        )
    t = report["tracker"]
    rows.append(
        f"whole tracker with reference markers: first frame {t['first_ms']:.1f} ms, at rest "
        f"{t['rest_median_ms']:.1f} ms, sliding {t['sliding_median_ms']:.1f} ms"
    )
    if not report["pupil_apriltags"]:
        rows.append("pupil-apriltags is not installed and was not measured")
    return rows
