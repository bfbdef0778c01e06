"""Objects without a marker on rendered frames with exact truth: how exact, how honest, how long."""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import cv2
import numpy as np

from tapping_cell.configuration.files import shared_folder
from tapping_cell.configuration.table import load_camera_model, load_reference_map
from tapping_cell.se2 import wrap_angle
from tapping_cell.simulation.rendered_camera import SceneRenderer, SceneSettings
from tapping_cell.vision import CameraPose, Dot, ObjectOutline
from tapping_cell.vision.outline_finder import OutlineFinder
from tapping_cell.vision.outline_fit import fit_outline
from tapping_cell.vision.outline_search import Refused, accept, find_outlines

DEFAULT_COUNT = 6
"""Scenes: camera, light, blur and noise differ from one to the next."""
PLACES = 10
"""Places of the object in a scene."""
_SIDES = ((-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04))
OBJECTS = {
    "dark disk, light dot": ObjectOutline(
        0.012, False, radius=0.048, dot=Dot(0.006, (0.03, 0.0), True)
    ),
    "light disk, dark dot": ObjectOutline(
        0.012, True, radius=0.035, dot=Dot(0.004, (0.018, 0.0), False)
    ),
    "dark square, light dot": ObjectOutline(
        0.012, False, vertices=_SIDES, dot=Dot(0.005, (0.02, 0.02), True)
    ),
    "light quadrilateral, no dot": ObjectOutline(
        0.020, True, vertices=((-0.04, -0.03), (0.05, -0.03), (0.02, 0.05), (-0.03, 0.03))
    ),
}


def measure(scenes: int) -> dict[str, Any]:
    """Errors of single frames, normalised errors, and times, for each object."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        found = {name: _one(outline, scenes) for name, outline in OBJECTS.items()}
        return {"scenes": scenes, "places": PLACES, "objects": found}
    finally:
        cv2.setNumThreads(threads)


def _one(outline: ObjectOutline, scenes: int) -> dict[str, float]:
    folder = shared_folder()
    camera = load_camera_model(folder / "camera_info.yaml")
    table = load_reference_map(folder / "table.yaml")
    random = np.random.default_rng(2)
    shared = OutlineFinder(outline, table).shared()
    gaps, turns, normalised, follow, search = [], [], [], [], []
    missed = 0
    for number in range(scenes):
        settings = SceneSettings(
            noise=random.uniform(2.0, 4.0),
            light_falloff=random.uniform(0.0, 0.67),
            light_direction=random.uniform(0.0, 6.3),
            vignetting=0.2,
            blur=random.uniform(0.5, 0.9),
        )
        pose = CameraPose.above((*random.uniform(-0.06, 0.06, 2), 0.7), spin=0.03)
        points = outline.points(720)
        scene = SceneRenderer(camera, pose, table, points, outline, settings, seed=number)
        for _ in range(PLACES):
            true = random.uniform([-0.22, -0.15, -math.pi], [0.22, 0.15, math.pi])
            image = scene.render(true)
            begin = time.process_time()
            found, _ = find_outlines(image, scene.view, outline, table.corners())
            search.append((time.process_time() - begin) * 1e3)
            missed += len(found) != 1
            start = true + random.normal(0.0, 1.0, 3) * [3e-4, 3e-4, 0.005]
            begin = time.process_time()
            fit = fit_outline(image, scene.view, outline, start)
            follow.append((time.process_time() - begin) * 1e3)
            if fit is None or isinstance(accept(fit, outline), Refused):
                missed += 1
                continue
            d = fit.pose - true
            d[2] = wrap_angle(d[2])
            gaps.append(math.hypot(d[0], d[1]) * 1e3)
            turns.append(math.degrees(abs(d[2])))
            normalised.append(float(d @ np.linalg.solve(fit.covariance + shared, d)))
    return {
        "median_mm": statistics.median(gaps),
        "p95_mm": float(np.quantile(gaps, 0.95)),
        "median_deg": statistics.median(turns),
        "p95_deg": float(np.quantile(turns, 0.95)),
        "median_normalised": statistics.median(normalised),
        "tracking_ms": statistics.median(follow),
        "search_ms": statistics.median(search),
        "missed": missed,
    }


def lines(report: dict[str, Any]) -> list[str]:
    """The report for people."""
    count = report["scenes"] * report["places"]
    text = [
        f"one frame each of {count} places; normalised error squared: 2.4 for an honest covariance",
        f"{'':<29}{'mm median':>10}{'p95':>8}{'deg median':>12}{'p95':>8}{'normalised':>12}"
        f"{'track ms':>10}{'search ms':>11}{'missed':>8}",
    ]
    for name, row in report["objects"].items():
        text.append(
            f"{name:<29}{row['median_mm']:>10.4f}{row['p95_mm']:>8.4f}{row['median_deg']:>12.4f}"
            f"{row['p95_deg']:>8.4f}{row['median_normalised']:>12.1f}{row['tracking_ms']:>10.1f}"
            f"{row['search_ms']:>11.1f}{row['missed']:>8}"
        )
    return text
