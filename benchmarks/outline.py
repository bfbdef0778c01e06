"""Pose accuracy, covariance and time for objects without a marker on rendered frames."""

from __future__ import annotations

import math
import statistics
import time
from typing import Any

import numpy as np

from benchmarks.vision_scenes import BOUND_95, Cell, one_opencv_thread
from tapping_cell.nodes.memory import keep_memory
from tapping_cell.se2 import wrap_angle
from tapping_cell.simulation.rendered_camera import SceneRenderer, SceneSettings
from tapping_cell.vision import CameraPose, Dot, ObjectOutline, OutlineError
from tapping_cell.vision.camera import Array
from tapping_cell.vision.outline.fit import USUAL_BLUR
from tapping_cell.vision.outline.outline_follower import rim_uncertainty
from tapping_cell.vision.outline.search import (
    Refused,
    accept,
    find_outlines,
    fit_closely,
    fit_surely,
)

DEFAULT_COUNT = 6
"""Number of scenes, which differ in camera, light, blur and noise."""
PLACES = 10
"""Number of object positions per scene."""
WRONG = 0.0003
"""Error above which an accepted pose counts as wrong, in m."""
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
    """Return errors of single frames, normalised errors and times for each object."""
    keep_memory()  # the node uses this setting as well
    with one_opencv_thread():
        found = {name: _one([outline] * scenes, PLACES) for name, outline in OBJECTS.items()}
        found["objects of all kinds"] = _one(_of_all_kinds(scenes * PLACES), 1)
        return {"scenes": scenes, "places": PLACES, "objects": found}


def _of_all_kinds(count: int) -> list[ObjectOutline]:
    """Return disks with a dot, triangles, pentagons and other convex polygons, light and dark, with
    widths of 30 to 130 mm and heights of 4 to 30 mm."""
    random = np.random.default_rng(3)
    made: list[ObjectOutline] = []
    while len(made) < count:
        height, brighter = random.uniform(0.004, 0.030), bool(random.random() < 0.5)
        corners = int(random.choice([0, 3, 5, random.integers(4, 8)]))
        radius, angle = random.uniform(0.015, 0.06), random.uniform(0.0, 2.0 * math.pi)
        try:
            if not corners:
                dot = random.uniform(0.0025, 0.001 + 0.16 * radius)
                off = random.uniform(0.35, 0.85) * (radius - dot - 0.002)
                at = off * math.cos(angle), off * math.sin(angle)
                shape = {"radius": radius, "dot": Dot(dot, at, not brighter)}
            else:
                angles = 2 * np.pi * (np.arange(corners) + random.uniform(-0.3, 0.3, corners))
                arms = max(radius, 0.025) * random.uniform(0.7, 1.1, corners)
                around = np.sort(angles / corners)
                places = np.stack([arms * np.cos(around), arms * np.sin(around)], axis=-1)
                shape = {"vertices": tuple(map(tuple, places.tolist()))}
            made.append(ObjectOutline(height, brighter, **shape))
        except OutlineError:
            continue  # not convex, or rotationally symmetric
    return made


def _one(outlines: list[ObjectOutline], places: int) -> dict[str, float]:
    cell = Cell.load()
    random = np.random.default_rng(2)
    gaps, turns, normalised, follow, search = [], [], [], [], []
    missed = wrong = 0
    for number, outline in enumerate(outlines):
        shared = rim_uncertainty(outline)
        settings = SceneSettings(
            noise=random.uniform(2.0, 4.0),
            light_falloff=random.uniform(0.0, 0.67),
            light_direction=random.uniform(0.0, 6.3),
            vignetting=0.2,
            blur=random.uniform(0.5, 0.9),
        )
        pose = CameraPose.above((*random.uniform(-0.06, 0.06, 2), 0.7), spin=0.03)
        points = outline.points(720)
        scene = SceneRenderer(cell.camera, pose, cell.table, points, outline, settings, seed=number)
        for _ in range(places):
            true = random.uniform([-0.22, -0.15, -math.pi], [0.22, 0.15, math.pi])
            image = scene.render(true)
            begin = time.process_time()
            found, _ = find_outlines(image, scene.view, outline, cell.table.corners())
            search.append((time.process_time() - begin) * 1e3)
            missed += not found
            wrong += any(_off(fit.pose, true)[0] > WRONG for fit in found)
            start = true + random.normal(0.0, 1.0, 3) * [3e-4, 3e-4, 0.005]
            begin = time.process_time()
            fit = fit_surely(image, scene.view, outline, start, blur=USUAL_BLUR)
            follow.append((time.process_time() - begin) * 1e3)
            if fit is None or isinstance(accept(fit, outline), Refused):
                # If tracking fails, search near the last pose, as the node does.
                fit = fit_closely(image, scene.view, outline, start)
            if isinstance(fit, Refused):
                missed += 1
                continue
            gap, d = _off(fit.pose, true)
            gaps.append(gap * 1e3)
            wrong += gap > WRONG
            turns.append(math.degrees(abs(d[2])))
            normalised.append(float(d @ np.linalg.solve(fit.covariance + shared, d)))
    return {
        "median_mm": statistics.median(gaps),
        "p95_mm": float(np.quantile(gaps, 0.95)),
        "median_deg": statistics.median(turns),
        "p95_deg": float(np.quantile(turns, 0.95)),
        "mean_normalised": statistics.fmean(normalised),
        "within_95": float(np.mean(np.array(normalised) < BOUND_95)),
        "tracking_ms": statistics.median(follow),
        "search_ms": statistics.median(search),
        "missed": missed,
        "wrong": wrong,
    }


def _off(pose: Array, true: Array) -> tuple[float, Array]:
    """Return the position error (m) and the error of the pose (3,): m, m, rad."""
    d = pose - true
    d[2] = wrap_angle(d[2])
    return math.hypot(d[0], d[1]), d


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    count = report["scenes"] * report["places"]
    text = [
        f"one frame at each of {count} poses; normalised: mean squared normalised error, 3 if the "
        f"covariance is correct; wrong: poses accepted with an error above {WRONG * 1e3:.1f} mm",
        f"{'':<29}{'mm median':>10}{'p95':>8}{'deg median':>12}{'p95':>8}{'normalised':>12}"
        f"{'in 95 %':>9}{'track ms':>10}{'search ms':>11}{'missed':>8}{'wrong':>7}",
    ]
    for name, row in report["objects"].items():
        text.append(
            f"{name:<29}{row['median_mm']:>10.4f}{row['p95_mm']:>8.4f}{row['median_deg']:>12.4f}"
            f"{row['p95_deg']:>8.4f}{row['mean_normalised']:>12.1f}{row['within_95']:>9.0%}"
            f"{row['tracking_ms']:>10.1f}{row['search_ms']:>11.1f}{row['missed']:>8}"
            f"{row['wrong']:>7}"
        )
    return text
