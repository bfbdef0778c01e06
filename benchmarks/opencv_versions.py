"""Detections by the oldest supported OpenCV and by the installed one, in the same images.

The images are rendered once, with random pose, light, noise and blur. In half of the images the
object moves, and in every third image a disk covers part of the table. Each version of OpenCV then
detects markers in these images, in a separate process. A marker is *missed* if it is visible but
not found. A detection is *wrong* if it is more than ``WRONG_PX`` from all markers with its id. The
reported accuracies are those of the object's pose from a single image and of the detected corners
before refinement.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.vision_scenes import Cell, Score, random_place, random_scene
from tapping_cell.se2 import transform_points
from tapping_cell.simulation.rendered_camera import Occluder
from tapping_cell.vision import PoseTracker
from tapping_cell.vision.markers.detection import UNIT_CORNERS, Effort, find_markers

DEFAULT_COUNT = 200
"""Number of images."""
WRONG_PX = 3.0
ROOT = Path(__file__).resolve().parent.parent
OVERLAY = ROOT / "build" / "oldest"


def measure(count: int) -> dict[str, Any]:
    """Return the results of both versions of OpenCV."""
    overlay = _overlay()
    with tempfile.TemporaryDirectory() as folder:
        truth = _render(Path(folder), count)
        (Path(folder) / "truth.json").write_text(json.dumps(truth), encoding="utf-8")
        reports = {}
        for paths in ((overlay,), ()):
            search = os.pathsep.join(
                (*map(str, paths), str(ROOT), os.environ.get("PYTHONPATH", ""))
            )
            ended = subprocess.run(
                [sys.executable, "-m", "benchmarks.opencv_versions", folder],
                env={**os.environ, "PYTHONPATH": search},
                capture_output=True,
                text=True,
                check=True,
            )
            report = json.loads(ended.stdout)
            reports[report.pop("version")] = report
    return {"images": count, "markers": sum(len(each["seen"]) for each in truth), **reports}


def _overlay() -> Path:
    """Return the folder with the oldest supported versions of the dependencies; install them if
    necessary."""
    sys.path.insert(0, str(ROOT / "environment"))
    import overlay

    overlay.install(ROOT / "environment" / "oldest.txt", OVERLAY)
    return OVERLAY


def _render(folder: Path, count: int) -> list[dict[str, Any]]:
    cell = Cell.load()
    random = np.random.default_rng(46)
    truth: list[dict[str, Any]] = []
    for number in range(count):
        if number % 10 == 0:
            scene = random_scene(random, cell, number)
        pose = random_place(random)
        end = pose + random.normal(0.0, [0.003, 0.003, 0.03]) if number % 2 else pose
        centre, radius = random.uniform([-0.25, -0.17], [0.25, 0.17]), 0.05
        circle = centre + radius * np.stack(
            [np.cos(turn := np.linspace(0.0, 2.0 * np.pi, 60)), np.sin(turn)], axis=-1
        )
        covered = number % 3 == 0
        shapes = [Occluder(np.c_[circle, np.full(60, 0.02)], 40.0)] if covered else []
        cv2.imwrite(str(folder / f"{number}.png"), scene.render(pose, end, shapes))
        middle = (pose + end) / 2
        quads = {
            cell.marker.id: scene.view.project(
                transform_points(middle, UNIT_CORNERS * cell.marker.size), cell.marker.height
            )
        }
        for marker in cell.table.markers:
            place = np.array([marker.x, marker.y, marker.theta])
            quads[marker.id] = scene.view.project(
                transform_points(place, UNIT_CORNERS * marker.size)
            )
        hidden = scene.view.project(shapes[0].points) if covered else np.zeros((0, 2))
        truth.append(
            {
                "quads": {str(key): quad.tolist() for key, quad in quads.items()},
                "seen": [key for key, quad in quads.items() if _is_free(quad, hidden)],
                "pose": middle.tolist(),
            }
        )
    return truth


def _is_free(quad: np.ndarray, hidden: np.ndarray) -> bool:
    """Return whether a marker is within the image and its centre is more than one side of the
    marker away from the cover."""
    side = float(np.linalg.norm(quad[0] - quad[1]))
    if np.any(quad < 10) or np.any(quad > [1269, 1013]):
        return False
    if not len(hidden):
        return True
    contour = hidden.astype(np.float32).reshape(-1, 1, 2)
    middle = tuple(float(value) for value in quad.mean(axis=0))
    return cv2.pointPolygonTest(contour, middle, True) < -side


def _judge(folder: Path) -> dict[str, Any]:
    """Return the results of the OpenCV version that this process uses."""
    cell = Cell.load()
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    missed = wrong = 0
    gaps: list[float] = []
    score = Score([], [])
    for number, true in enumerate(truth):
        image = np.asarray(cv2.imread(str(folder / f"{number}.png"), cv2.IMREAD_GRAYSCALE))
        quads = {int(key): np.array(quad) for key, quad in true["quads"].items()}
        found = set()
        for detection in find_markers(image, cell.marker.dictionary, None, Effort.THOROUGH):
            quad = quads.get(detection.id)
            gap = np.inf if quad is None else np.abs(detection.corners - quad).max()
            if gap > WRONG_PX:
                wrong += 1
                continue
            found.add(detection.id)
            gaps.append(float(gap))
        missed += len(set(true["seen"]) - found)
        tracker = PoseTracker(cell.camera, cell.table, cell.marker)
        if cell.marker.id in true["seen"]:
            score.add(tracker.update(image, float(number + 1)), np.array(true["pose"]))
    return {
        "version": cv2.__version__,
        "missed": missed,
        "wrong": wrong,
        "corner_p95_px": float(np.quantile(gaps, 0.95)),
        "poses": score.figures(),
    }


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    text = [f"{report['images']} images, {report['markers']} markers in view and free"]
    for version, figures in report.items():
        if not isinstance(figures, dict):
            continue
        poses = figures["poses"]
        text.append(
            f"OpenCV {version:<8} missed {figures['missed']}, wrong {figures['wrong']}, corners"
            f" within {figures['corner_p95_px']:.2f} px (95 %); object not measured in"
            f" {poses['missed']} of {poses['missed'] + poses['count']} images, else"
            f" {poses['median_mm']:.4f} mm (95 % {poses['p95_mm']:.4f}),"
            f" {poses['median_deg']:.4f} deg (95 % {poses['p95_deg']:.4f})"
        )
    return text


if __name__ == "__main__":
    print(json.dumps(_judge(Path(sys.argv[1]))))
