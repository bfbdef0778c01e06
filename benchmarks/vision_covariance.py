"""Consistency of the covariance: normalised errors over random scenes and calibrations.

If the covariance is correct, the squared error normalised by the covariance has a mean of 3 (3
degrees of freedom) and is below the 95 % bound in 95 of 100 cases. Every scene is evaluated with
exact and with inaccurate camera and table files.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from benchmarks.vision_scenes import (
    Cell,
    Score,
    miscalibrated,
    random_place,
    random_scene,
    score_lines,
)
from tapping_cell.vision import PoseTracker

DEFAULT_COUNT = 500
PLACES = 5
"""Number of object positions per camera."""
FUSED = 30
CASES = {
    "exact files, one frame": (0.0, 0.0, 1),
    f"exact files, {FUSED} frames": (0.0, 0.0, FUSED),
    "lens off by 0.3 standard deviations": (0.3, 0.0, 1),
    "lens off by 1 standard deviation": (1.0, 0.0, 1),
    "references misplaced by 0.03 mm": (0.0, 3e-5, 1),
    "both: 0.3 and 0.03 mm": (0.3, 3e-5, 1),
    "both: 1 and 0.1 mm": (1.0, 1e-4, 1),
}


def measure(count: int) -> dict[str, Any]:
    """Return the scores of ``count`` scenes in every case."""
    cv2.setNumThreads(1)
    cell = Cell.load()
    scores = {name: Score([], []) for name in CASES}
    scene = None
    for number in range(count):
        random = np.random.default_rng([number, 11])
        if number % PLACES == 0:
            scene = random_scene(random, cell, seed=number)
        assert scene is not None
        true = random_place(random)
        for name, (lens, misprint, frames) in CASES.items():
            camera, table = miscalibrated(random, cell, lens, misprint)
            tracker = PoseTracker(camera, table, cell.marker)
            for k in range(frames):
                observation = tracker.update(scene.render(true), k / 30.0)
            scores[name].add(observation, true)
    return {name: score.figures() for name, score in scores.items()}


def lines(report: dict[str, Any]) -> list[str]:
    """Format the report as lines of text."""
    return score_lines(report)
